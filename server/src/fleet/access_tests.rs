//! Every key of robots × every certificate × everything that can be done with a key, over real
//! zenoh through the gate. The keys come from the table in `tread_api::access`: a new one is in
//! here without a word.
//!
//! What is not to arrive is never waited for: whoever did it says something afterwards, over the
//! same link, that does arrive.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use rcgen::{CertificateParams, KeyPair};
use tokio::sync::mpsc;
use tread_api::access::{Act, Owner, ROBOT_KEYS, RobotKeys};
use tread_api::enrolment::Enrolment;
use tread_api::ids::{JoinTokenId, RobotId, SiteId};
use tread_api::keys;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Session, Wait as _};

use super::test_client::{ClientOverrides, TestClient, TestSession, until};
use super::{Fleet, Security};
use crate::app::enrolment::EnrolmentService;
use crate::app::{App, Dependencies};
use crate::authority::{Authorities, Authority, RobotName, RobotRequest};
use crate::clock::Clock;
use crate::db::Db;
use crate::supervisor::Supervisor;

const PATIENCE: Duration = Duration::from_secs(20);
const HOUR: SignedDuration = SignedDuration::from_hours(1);

/// Who does something with the keys of `rover-1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Who {
    /// Its own certificate.
    Own,
    /// Another robot's of the same site.
    Foreign,
    /// Its own, of an enrolment that was followed by another.
    Former,
    /// A robot's that was put out.
    Revoked,
    /// One of the same name by another authority.
    Stranger,
    /// One whose time is over.
    Expired,
    /// None.
    Nobody,
}

const REFUSED: [Who; 5] = [
    Who::Former,
    Who::Revoked,
    Who::Stranger,
    Who::Expired,
    Who::Nobody,
];

/// How often something is sent to a robot on each key.
const SAID_TIMES: u32 = 3;

/// What was done, by whom, and on which key.
type Cell = (&'static str, Act, Who);

pub(super) fn site() -> SiteId {
    "yard".parse().unwrap()
}

pub(super) fn robot(name: &str) -> RobotId {
    name.parse().unwrap()
}

pub(super) fn enrolment(name: &str, number: u32, is_revoked: bool) -> Enrolment {
    Enrolment {
        site: site(),
        robot: robot(name),
        number,
        enrolled_at: Timestamp::UNIX_EPOCH,
        join_token: JoinTokenId::from_uuid(uuid::Uuid::nil()),
        renewed_at: Timestamp::UNIX_EPOCH,
        expires_at: Timestamp::MAX,
        revoked_at: is_revoked.then_some(Timestamp::UNIX_EPOCH),
        revoked_by: is_revoked.then(|| "test".to_owned()),
        authority: None,
    }
}

/// A fleet of two robots, one that was put out, and an authority that nobody knows.
pub(super) struct Rig {
    pub(super) app: App,
    pub(super) fleet: Fleet,
    authority: Arc<Authority>,
    pub(super) authorities: Arc<Authorities>,
    stranger: Authority,
    pub(super) supervisor: Supervisor,
    _folder: tempfile::TempDir,
}

impl Rig {
    pub(super) async fn start() -> Self {
        Self::start_with(|_fleet| ()).await
    }

    /// The same, with a network that is changed before it opens.
    pub(super) async fn start_with(change: impl FnOnce(&mut Fleet)) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&folder.path().join("tread.db")).await.unwrap();
        let clock = Clock::system();
        let authority = Arc::new(Authority::generate("fleet", clock.now()).unwrap());
        let authorities = Arc::new(Authorities::in_memory(Arc::clone(&authority)));
        let security = Security {
            authorities: Arc::clone(&authorities),
            names: Vec::new(),
            robots_per_router: NonZeroUsize::MIN.saturating_add(255),
        };
        let supervisor = Supervisor::new();
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let opening = Fleet::open(address, Some(security), clock.clone(), supervisor.clone());
        let mut fleet = opening.unwrap();
        change(&mut fleet);
        let app = App::new(Dependencies {
            robots: fleet.robot_link(),
            enrolment: Some(EnrolmentService {
                authorities: Arc::clone(&authorities),
                lifetime: HOUR,
                port: fleet.address().port(),
            }),
            ..Dependencies::on_database(db, clock.clone())
        });
        app.ensure_site(&site()).await.unwrap();
        for (name, number, is_revoked) in [
            ("rover-1", 2, false),
            ("rover-2", 1, false),
            ("rover-3", 1, true),
        ] {
            app.enrolment_registry()
                .record(&enrolment(name, number, is_revoked));
        }
        let (uploads, uploads_in) = mpsc::channel(1);
        drop(uploads_in);
        fleet.listen(&app, uploads, None).await.unwrap();
        Self {
            stranger: Authority::generate("fleet", clock.now()).unwrap(),
            app,
            fleet,
            authority,
            authorities,
            supervisor,
            _folder: folder,
        }
    }

    /// The router's own session, which sees everything.
    pub(super) fn witness(&self) -> Session {
        self.fleet.routers.newest().unwrap().session.clone()
    }

    pub(super) fn certificate(&self, who: Who) -> Option<(String, KeyPair)> {
        let (authority, name, enrolment) = match who {
            Who::Own | Who::Expired => (&*self.authority, "rover-1", 2),
            Who::Foreign => (&*self.authority, "rover-2", 1),
            Who::Former => (&*self.authority, "rover-1", 1),
            Who::Revoked => (&*self.authority, "rover-3", 1),
            Who::Stranger => (&self.stranger, "rover-1", 2),
            Who::Nobody => return None,
        };
        let key = KeyPair::generate().unwrap();
        let request = CertificateParams::default()
            .serialize_request(&key)
            .unwrap();
        let request = RobotRequest::read(&request.pem().unwrap()).unwrap();
        let name = RobotName {
            site: site(),
            robot: robot(name),
            enrolment,
        };
        let mut now = self.app.clock().now();
        if who == Who::Expired {
            now -= HOUR + SignedDuration::from_secs(2);
        }
        let signed = authority.sign(&request, &name, now, HOUR).unwrap();
        Some((signed.certificate, key))
    }

    /// What connects with a certificate.
    pub(super) fn client(&self, who: Who) -> TestClient {
        TestClient::new(
            self.fleet.address(),
            self.authority.certificate(),
            self.certificate(who),
        )
    }

    /// Connects with a certificate, if the gate lets it.
    pub(super) async fn connect(&self, who: Who, wait_ms: u32) -> Option<TestSession> {
        self.client(who)
            .open(&ClientOverrides::default(), wait_ms)
            .await
    }
}

/// Keys on which something came, in order.
#[derive(Debug, Clone, Default)]
struct Seen(Arc<Mutex<Vec<String>>>);

impl Seen {
    fn record(&self, key: &str) {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(key.to_owned());
    }

    fn has(&self, key: &str) -> bool {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .iter()
            .any(|seen| seen == key)
    }

    async fn waits_for(&self, key: &str) {
        let waiting = async {
            while !self.has(key) {
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        };
        let waited = tokio::time::timeout(PATIENCE, waiting).await;
        assert!(waited.is_ok(), "nothing came on {key}, only {:?}", self.0);
    }
}

/// One key of an expression.
fn one_of(expression: &str, act: Act) -> String {
    expression.replace('*', &format!("{act:?}").to_lowercase())
}

/// What the router's own session sees.
struct Witness {
    session: Session,
    published: Seen,
    announced: Seen,
    asked: Seen,
    _kept: Kept,
}

/// What is declared as long as it is kept.
type Kept = Vec<Box<dyn std::any::Any + Send>>;

impl Witness {
    fn of(session: Session) -> Self {
        let (published, announced) = (Seen::default(), Seen::default());
        let asked = Seen::default();
        let to = published.clone();
        let subscriber = session
            .declare_subscriber("tread/**")
            .callback(move |sample| {
                to.record(&signed(
                    sample.key_expr().as_str(),
                    &sample.payload().to_bytes(),
                ));
            });
        let subscriber = subscriber.wait().unwrap();
        let to = announced.clone();
        let live = session
            .liveliness()
            .declare_subscriber("tread/**")
            .callback(move |sample| to.record(sample.key_expr().as_str()));
        let live = live.wait().unwrap();
        let to = asked.clone();
        let queryable = session
            .declare_queryable("tread/**")
            .callback(move |query| {
                to.record(query.key_expr().as_str());
                let _ = query.reply(query.key_expr().clone(), "answer").wait();
            });
        let queryable = queryable.wait().unwrap();
        Self {
            _kept: vec![Box::new(subscriber), Box::new(live), Box::new(queryable)],
            session,
            published,
            announced,
            asked,
        }
    }

    /// Whether a robot answers on a key. The witness answers its own question too; what the robot
    /// says is another answer.
    async fn is_answered_by_robot(&self, key: String) -> bool {
        let asking = self.session.get(key).target(QueryTarget::All);
        let asking = asking.consolidation(ConsolidationMode::None);
        let replies = asking.timeout(PATIENCE).wait().unwrap();
        let mut answered = false;
        while let Ok(reply) = replies.recv_async().await {
            let sample = reply.result();
            answered |= sample.is_ok_and(|sample| *sample.payload().to_bytes() == *b"robot");
        }
        answered
    }
}

fn signed(key: &str, payload: &[u8]) -> String {
    format!("{key}={}", String::from_utf8_lossy(payload))
}

/// Publishes without ever dropping anything: what does not arrive was not let through.
pub(super) fn put(session: &Session, key: String, payload: String) {
    let putting = session.put(key, payload);
    let putting = putting.congestion_control(CongestionControl::Block);
    putting.wait().unwrap();
}

/// The keys of `rover-1` in one row of the table.
fn expression(row: &RobotKeys) -> String {
    row.expression(&site(), &robot("rover-1"))
}

/// Does over a robot's link everything with every key of `rover-1`. What it hears goes to `heard`;
/// returns whether its queries are answered.
async fn do_all(
    session: &Session,
    who: Who,
    heard: &Seen,
    kept: &mut Kept,
) -> Vec<(&'static str, bool)> {
    let mut answers = Vec::new();
    for row in ROBOT_KEYS {
        let keys = expression(&row);
        let to = heard.clone();
        let hearing = session.declare_subscriber(&keys).callback(move |sample| {
            to.record(&signed(
                sample.key_expr().as_str(),
                &sample.payload().to_bytes(),
            ));
        });
        kept.push(Box::new(hearing.wait().unwrap()));
        let answering = session.declare_queryable(&keys).callback(|query| {
            let _ = query.reply(query.key_expr().clone(), "robot").wait();
        });
        kept.push(Box::new(answering.wait().unwrap()));
        let token = session
            .liveliness()
            .declare_token(one_of(&keys, Act::Announce));
        kept.push(Box::new(token.wait().unwrap()));
        let key = one_of(&keys, Act::Publish);
        put(session, key, format!("{who:?}"));
        let asking = session.get(one_of(&keys, Act::Ask)).timeout(PATIENCE);
        let asking = asking.consolidation(ConsolidationMode::None);
        let replies = asking.target(QueryTarget::All).wait().unwrap();
        let mut answered = false;
        while let Ok(reply) = replies.recv_async().await {
            let sample = reply.result();
            answered |= sample.is_ok_and(|sample| *sample.payload().to_bytes() == *b"answer");
        }
        answers.push((row.pattern, answered));
    }
    answers
}

/// Does everything with every key of `rover-1` over a link, and says what came of it.
async fn try_all(rig: &Rig, who: Who, session: &Session) -> BTreeMap<Cell, bool> {
    let witness = Witness::of(rig.witness());
    let own = robot(if who == Who::Own {
        "rover-1"
    } else {
        "rover-2"
    });
    // What passes always: the robot's own state outwards, its drive commands inwards.
    let (outward, inward) = (keys::state(&site(), &own), keys::teleop(&site(), &own));
    let (heard, mut kept) = (Seen::default(), Kept::new());
    let answers = do_all(session, who, &heard, &mut kept).await;
    let to = heard.clone();
    let last = session.declare_subscriber(&inward).callback(move |sample| {
        let round = sample.payload().to_bytes();
        to.record(&format!("last {}", String::from_utf8_lossy(&round)));
    });
    kept.push(Box::new(last.wait().unwrap()));
    // Everything before this has reached the router when this has.
    put(session, outward.clone(), "the end".to_owned());
    witness
        .published
        .waits_for(&signed(&outward, b"the end"))
        .await;
    let mut came = BTreeMap::new();
    for (row, (pattern, answered)) in ROBOT_KEYS.iter().zip(answers) {
        let keys = expression(row);
        let asked = witness.asked.has(&one_of(&keys, Act::Ask));
        came.insert((pattern, Act::Ask, who), asked || answered);
        let published = signed(&one_of(&keys, Act::Publish), format!("{who:?}").as_bytes());
        let published = witness.published.has(&published);
        came.insert((pattern, Act::Publish, who), published);
        let announced = witness.announced.has(&one_of(&keys, Act::Announce));
        came.insert((pattern, Act::Announce, who), announced);
        let answered = witness
            .is_answered_by_robot(one_of(&keys, Act::Answer))
            .await;
        came.insert((pattern, Act::Answer, who), answered);
    }
    // A router that publishes on a key at the moment at which somebody subscribes to it may leave
    // that one message out, so each is said more than once.
    for round in 0..SAID_TIMES {
        for row in ROBOT_KEYS {
            let to_robot = one_of(&expression(&row), Act::Listen);
            put(&witness.session, to_robot, "hear this".to_owned());
        }
        put(&witness.session, inward.clone(), round.to_string());
        heard.waits_for(&format!("last {round}")).await;
    }
    for row in ROBOT_KEYS {
        // A robot hears itself too; this is what the server said.
        let said = signed(&one_of(&expression(&row), Act::Listen), b"hear this");
        let is_heard = heard.has(&said);
        came.insert((row.pattern, Act::Listen, who), is_heard);
    }
    came
}

/// What may come of it, from the table alone.
fn may(pattern: &str, act: Act, who: Who) -> bool {
    let row = ROBOT_KEYS
        .iter()
        .find(|row| row.pattern == pattern)
        .unwrap();
    let is_ones_own = match row.owner {
        Owner::Robot => who == Who::Own,
        Owner::Site => who == Who::Own || who == Who::Foreign,
    };
    is_ones_own && row.act == act
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_key_with_every_certificate_allows_what_the_table_says_and_nothing_else() {
    let rig = Rig::start().await;
    let mut came = BTreeMap::new();
    for who in [Who::Own, Who::Foreign] {
        let session = rig.connect(who, 10_000).await.expect("the gate lets it in");
        came.extend(try_all(&rig, who, &session.zenoh).await);
        session.close().await;
    }
    for who in REFUSED {
        let counters = rig.app.counters();
        let refusals = || counters.gate_tls_failed.get() + counters.gate_revoked.get();
        let before = refusals();
        let connected = rig.connect(who, 300).await;
        assert!(connected.is_none(), "{who:?} was let in");
        until(&format!("{who:?} is counted"), async || refusals() > before).await;
        for row in ROBOT_KEYS {
            came.extend(Act::ALL.map(|act| ((row.pattern, act, who), false)));
        }
    }
    let whole = ROBOT_KEYS.len() * Act::ALL.len() * (2 + REFUSED.len());
    assert_eq!(came.len(), whole, "the matrix is complete");
    let surprises: Vec<_> = came
        .iter()
        .filter(|((pattern, act, who), came)| **came != may(pattern, *act, *who))
        .collect();
    assert!(surprises.is_empty(), "{surprises:#?}");
    rig.supervisor.stop().await.unwrap();
    rig.fleet.close().await;
}

/// What `rover-2` shows to pass for `rover-1`, whose password and session id it has learned.
async fn impersonations(rig: &Rig) -> Vec<(&'static str, ClientOverrides)> {
    let learned = rig.client(Who::Own).credentials().await.unwrap();
    let own = rig.client(Who::Foreign).credentials().await.unwrap();
    assert_ne!(learned.password, own.password);
    let user = || ClientOverrides {
        user: Some(learned.user.clone()),
        password: Some(learned.password.clone()),
        ..ClientOverrides::default()
    };
    vec![
        ("user and password", user()),
        (
            "user, password and session id",
            ClientOverrides {
                session_id: Some(learned.session_prefix.session_id(1)),
                ..user()
            },
        ),
        (
            "session id",
            ClientOverrides {
                session_id: Some(learned.session_prefix.session_id(1)),
                ..ClientOverrides::default()
            },
        ),
        (
            "password alone",
            ClientOverrides {
                password: Some(learned.password.clone()),
                ..ClientOverrides::default()
            },
        ),
        (
            "the user of the server's own look",
            ClientOverrides {
                user: Some(super::credentials::PROBE_USER.to_owned()),
                ..ClientOverrides::default()
            },
        ),
        (
            "no user at all",
            ClientOverrides {
                is_anonymous: true,
                ..ClientOverrides::default()
            },
        ),
        (
            "another session's id",
            ClientOverrides {
                session_id: Some("8000000000000000deadbeefdeadbeef".to_owned()),
                ..ClientOverrides::default()
            },
        ),
        (
            "the mode of a peer",
            ClientOverrides {
                mode: Some("peer"),
                ..ClientOverrides::default()
            },
        ),
        (
            "the mode of a router",
            ClientOverrides {
                mode: Some("router"),
                ..ClientOverrides::default()
            },
        ),
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_robots_password_and_session_id_open_nothing() {
    let rig = Rig::start().await;
    for (what, shown) in impersonations(&rig).await {
        let failed = rig.app.counters().gate_session_failed.get();
        let opened = rig.client(Who::Foreign).open(&shown, 300).await;
        // A peer's session opens without any router; it must not have reached this one.
        let sessions = rig.witness().info().transports().wait().count();
        assert_eq!(sessions, 0, "{what} opened a session");
        drop(opened);
        until(&format!("{what} is counted"), async || {
            rig.app.counters().gate_session_failed.get() > failed || what == "password alone"
        })
        .await;
    }
    let own = rig.connect(Who::Foreign, 10_000).await;
    own.expect("the robot itself is let in still").close().await;
    rig.supervisor.stop().await.unwrap();
    rig.fleet.close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_does_not_name_the_protocol_is_refused_before_anything_is_sent() {
    let rig = Rig::start().await;
    for protocols in [vec![], vec![b"h2".to_vec()], vec![b"tread/1".to_vec()]] {
        let failed = rig.app.counters().gate_tls_failed.get();
        let mut client = rig.client(Who::Own);
        client.protocols = protocols;
        assert!(client.credentials().await.is_none());
        until("the refusal is counted", async || {
            rig.app.counters().gate_tls_failed.get() > failed
        })
        .await;
    }
    rig.supervisor.stop().await.unwrap();
    rig.fleet.close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_opening_that_is_none_ends_the_link_and_harms_nobody() {
    let rig = Rig::start().await;
    let own = rig.connect(Who::Own, 10_000).await.unwrap();
    // A length of which nothing follows, one above all bounds, garbage, an empty frame, and a
    // message of an opened session.
    for bytes in [
        &[4_u8, 0, 0][..],
        &[0xff, 0xff],
        &[5, 0, 0x41, 0xff, 0xff, 0xff, 0xff],
        &[0, 0],
        &[1, 0, 0x04],
    ] {
        let failed = rig.app.counters().gate_session_failed.get();
        let client = rig.client(Who::Foreign);
        assert!(client.says_instead(bytes).await, "the link ended");
        until("the failed opening is counted", async || {
            rig.app.counters().gate_session_failed.get() > failed
        })
        .await;
    }
    let witness = Witness::of(rig.witness());
    let key = keys::state(&site(), &robot("rover-1"));
    put(&own.zenoh, key.clone(), "here".to_owned());
    witness.published.waits_for(&signed(&key, b"here")).await;
    own.close().await;
    rig.supervisor.stop().await.unwrap();
    rig.fleet.close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_router_has_no_more_robots_than_configured_and_robots_reach_their_own() {
    let rig = Rig::start_with(|fleet| {
        let opener = fleet.opener.get_mut().unwrap();
        opener.as_mut().unwrap().robots_max = 1;
    })
    .await;
    let sizes = || -> Vec<usize> {
        let open = rig.fleet.routers.all();
        open.iter().map(|router| router.robots.len()).collect()
    };
    assert_eq!(sizes(), [1; 3], "one for each robot that has ever joined");
    let registry = rig.app.enrolment_registry();
    registry.record(&enrolment("rover-4", 1, false));
    until("a router is open for another one", async || {
        sizes() == [1; 4]
    })
    .await;
    for who in [Who::Own, Who::Foreign] {
        let session = rig.connect(who, 10_000).await.unwrap();
        session.close().await;
    }
    rig.supervisor.stop().await.unwrap();
    rig.fleet.close().await;
}
