//! What is said outwards, read by the codec's own decoders; and heard by somebody else on a real bus.

use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;
use std::net::TcpListener;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};

use tread_control::geometry::Point;
use tread_ros2::cdr::decode;
use tread_ros2::messages::Path;
use tread_ros2::rmw::{Attachment, Generation, gid, topic_key};
use zenoh::Wait as _;

use super::*;
use crate::clock::{SharedClock, SystemClock};
use crate::control_loop::channels::Fault;
use crate::control_loop::hold_tests::driving;
use crate::drive::ros2::Ros2Drive;
use crate::drive::ros2::bus_config::session_config;
use crate::drive::ros2::refusal::{Refusal, Source};
use crate::drive::ros2::settings::{BusMode, Ros2Settings};
use crate::drive::ros2::tests as drive_tests;

/// Longest wait for what is to be heard.
const WAIT_MAX: Duration = Duration::from_secs(10);
/// Where the robot's frame lies in the site of these tests.
const SITE_FROM_MAP: Pose = Pose {
    x_m: 4.0,
    y_m: 3.0,
    heading_rad: FRAC_PI_2,
};

fn settings() -> OutwardSettings {
    let topic = drive_tests::topic;
    OutwardSettings {
        plan: topic("tread/plan"),
        driven: topic("tread/driven"),
        theta: topic("tread/theta"),
        diagnostics: topic("/diagnostics"),
        frame: "map".to_owned(),
        site_from_frame: SITE_FROM_MAP,
    }
}

fn outward(shared: &Arc<Shared>) -> AgentStatePublisher {
    let robot = "rover-1".to_owned();
    AgentStatePublisher::new(settings(), Arc::clone(shared), Arc::default(), robot)
}

type Messages = BTreeMap<PublishedTopic, Vec<u8>>;

/// What is said at that moment.
fn said(outward: &mut AgentStatePublisher, now: Duration) -> Messages {
    let mut messages = Messages::new();
    outward.step(now, 1_500_000_000, &mut |topic, bytes| {
        let again = messages.insert(topic, bytes.to_vec());
        assert_eq!(again, None, "{topic:?} was said twice");
    });
    messages
}

fn points(messages: &Messages, topic: PublishedTopic) -> Vec<Point> {
    let path: Path<'_> = decode(&messages[&topic]).unwrap();
    assert_eq!(path.header.frame_id, "map");
    assert_eq!(path.header.stamp.nanoseconds(), Some(1_500_000_000));
    let poses = path.poses.iter();
    poses
        .map(|pose| Point {
            x_m: pose.pose.position.x,
            y_m: pose.pose.position.y,
        })
        .collect()
}

fn numbers(messages: &Messages) -> Vec<f64> {
    let theta: Float64MultiArray<'_> = decode(&messages[&PublishedTopic::Theta]).unwrap();
    let dimension = theta.layout.dim.get(0).unwrap();
    assert_eq!((dimension.label, dimension.size), (THETA_LABEL, 3));
    theta.data.iter().collect()
}

/// Level, sentence and figures of a part.
fn part(messages: &Messages, name: &str) -> (u8, String, BTreeMap<String, String>) {
    let array: DiagnosticArray<'_> = decode(&messages[&PublishedTopic::Diagnostics]).unwrap();
    let mut parts = array.status.iter();
    let part = parts.find(|part| part.name == name).unwrap();
    assert_eq!(part.hardware_id, "rover-1");
    let values = part.values.iter();
    let values = values.map(|pair| (pair.key.to_owned(), pair.value.to_owned()));
    (part.level, part.message.to_owned(), values.collect())
}

fn near(point: Point, other: Point) -> bool {
    point.distance_m(other) < 1.0e-9
}

#[test]
fn a_mission_is_shown_from_its_plan_to_the_way_driven_in_the_robots_frame() {
    let (mut bench, mission, plan) = driving();
    let shared = Arc::clone(&bench.ends.shared);
    let mut outward = outward(&shared);
    let messages = said(&mut outward, bench.now);
    assert_eq!(
        points(&messages, PublishedTopic::Plan),
        [],
        "it was not given yet"
    );
    let progress = shared.snapshot().mission.unwrap();
    let end = plan.path().sample(plan.length_m()).pose;
    let start = plan.path().sample(0.0).pose;
    shared.show_plan(GivenPlan {
        mission,
        revision: progress.revision,
        plan: Arc::new(plan),
    });
    let messages = said(&mut outward, bench.now);
    let shown = points(&messages, PublishedTopic::Plan);
    let in_map = |pose: Pose| SITE_FROM_MAP.body_from_site(pose.point());
    assert!(near(shown[0], in_map(start)), "{shown:?}");
    assert!(near(*shown.last().unwrap(), in_map(end)), "{shown:?}");

    let (began, mut times) = (bench.now, 0);
    while bench.now < began + Duration::from_secs(3) {
        bench.tick();
        times += u32::from(!said(&mut outward, bench.now).is_empty());
    }
    assert!((2..=3).contains(&times), "{times} times in three seconds");

    let messages = said(&mut outward, bench.now + PUBLISH_PERIOD);
    let driven = points(&messages, PublishedTopic::Driven);
    let snapshot = shared.snapshot();
    let (pose, _) = snapshot.pose.unwrap();
    let behind_m = driven.last().unwrap().distance_m(in_map(pose));
    assert!(driven.len() > 5 && behind_m < SPACING_M, "{behind_m}");
    for pair in driven.windows(2) {
        assert!(pair[0].distance_m(pair[1]) >= SPACING_M);
    }
    let measured = snapshot.theta_measured.unwrap();
    let expected = [
        measured.theta,
        measured.std_dev,
        snapshot.theta_loop.unwrap(),
    ];
    assert_eq!(
        numbers(&messages)
            .iter()
            .map(|it| it.to_bits())
            .collect::<Vec<_>>(),
        expected.map(f64::to_bits)
    );
    let (level, text, values) = part(&messages, "tread_agent: control");
    assert_eq!((level, text.as_str()), (Level::Ok as u8, "on a mission"));
    assert_eq!(values["mission"], mission.to_string());
}

#[test]
fn a_path_keeps_its_newest_points_and_no_more_than_it_may() {
    let mut outward = outward(&Arc::default());
    let at = |x_m: f64| Pose {
        x_m,
        ..Pose::default()
    };
    for step in 0..3 * PATH_POINTS_MAX {
        let pose = at(f64::from(step));
        let snapshot = Snapshot {
            pose: Some((pose, Duration::ZERO)),
            ..Snapshot::default()
        };
        outward.update_place(&snapshot);
        outward.update_place(&snapshot);
    }
    let messages = said(&mut outward, Duration::ZERO);
    let driven = points(&messages, PublishedTopic::Driven);
    assert_eq!(driven.len(), PATH_POINTS_MAX as usize);
    let last = at(f64::from(3 * PATH_POINTS_MAX - 1));
    let newest = SITE_FROM_MAP.body_from_site(last.point());
    assert!(near(driven[driven.len() - 1], newest));
}

#[test]
fn what_is_wrong_is_said_and_is_over_when_it_is() {
    let shared = Arc::new(Shared::default());
    let mut outward = outward(&shared);
    let now = SILENT_SERVER / 2;
    shared.record_server_message(now);
    let messages = said(&mut outward, now);
    assert!(numbers(&messages).iter().all(|number| number.is_nan()));
    for name in ["control", "link", "estimator", "base"] {
        let (level, text, _) = part(&messages, &format!("tread_agent: {name}"));
        assert_eq!(level, Level::Ok as u8, "{name}: {text}");
    }
    outward.counts.refuse(Source::Imu, Refusal::Late);
    shared.publish(&Snapshot {
        fault: Some(Fault::BaseSilent),
        dug_in_at: Some(Point { x_m: 1.0, y_m: 2.0 }),
        ..Snapshot::default()
    });
    assert_eq!(said(&mut outward, now), Messages::new(), "nothing is due");
    let messages = said(&mut outward, now + SILENT_SERVER);
    for (name, expected) in [
        ("control", Level::Error),
        ("link", Level::Warn),
        ("estimator", Level::Warn),
        ("base", Level::Warn),
    ] {
        let (level, text, _) = part(&messages, &format!("tread_agent: {name}"));
        assert_eq!(level, expected as u8, "{name}: {text}");
    }
    let (_, text, values) = part(&messages, "tread_agent: base");
    assert_eq!(text, "messages dropped of late: 1");
    assert_eq!(values["imu: late"], "1");
    let messages = said(&mut outward, now + SILENT_SERVER + PUBLISH_PERIOD);
    let (level, _, values) = part(&messages, "tread_agent: base");
    assert_eq!(
        (level, values["imu: late"].as_str()),
        (Level::Ok as u8, "1")
    );
    outward.counts.count_foreign_command();
    let messages = said(&mut outward, now + SILENT_SERVER + 2 * PUBLISH_PERIOD);
    let (level, text, values) = part(&messages, "tread_agent: base");
    assert_eq!(level, Level::Error as u8, "{text}");
    assert_eq!(values["commands of others"], "1");
}

/// One message as it was heard: key, attachment, bytes.
type Heard = (String, Vec<u8>, Vec<u8>);

/// Somebody else on the bus.
struct Observer {
    session: zenoh::Session,
    heard: Receiver<Heard>,
}

impl Observer {
    fn start(settings: &Ros2Settings) -> Self {
        let (sender, heard): (Sender<Heard>, _) = channel();
        let mut bus = settings.bus.clone();
        bus.mode = BusMode::Client;
        let config = session_config(&bus).unwrap();
        // The router is there as soon as its thread has come so far.
        let opened = (0..20).find_map(|_| zenoh::open(config.clone()).wait().ok());
        let session = opened.unwrap();
        let listening = session.declare_subscriber("0/**").callback(move |sample| {
            let attachment = sample.attachment().map(|it| it.to_bytes().into_owned());
            let _ = sender.send((
                sample.key_expr().to_string(),
                attachment.unwrap_or_default(),
                sample.payload().to_bytes().into_owned(),
            ));
        });
        listening.background().wait().unwrap();
        Self { session, heard }
    }

    /// The publishers that the ROS graph shows.
    fn publishers(&self) -> Vec<String> {
        let (sender, found) = channel();
        let asking = self.session.liveliness().get("@ros2_lv/0/**");
        let asked = asking.callback(move |reply| {
            if let Ok(sample) = reply.result() {
                let _ = sender.send(sample.key_expr().to_string());
            }
        });
        asked.wait().unwrap();
        // It ends when the query does, which lets go of the sender.
        let tokens = found.iter();
        tokens.filter(|token| token.contains("/MP/")).collect()
    }

    /// The first message of each key, until there are so many keys.
    fn first_of(&self, keys: usize) -> BTreeMap<String, (Vec<u8>, Vec<u8>)> {
        let mut found = BTreeMap::new();
        while found.len() < keys {
            match self.heard.recv_timeout(WAIT_MAX) {
                Ok((key, attachment, bytes)) => {
                    found.entry(key).or_insert((attachment, bytes));
                }
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                    panic!("only {:?} were heard", found.keys());
                }
            }
        }
        found
    }
}

/// A robot that is its own router, and what somebody else on its bus makes of it.
fn heard_by_another(tells: bool, look: impl FnOnce(&OutwardSettings, &Observer)) {
    let free = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = free.local_addr().unwrap().port();
    drop(free);
    let mut settings = drive_tests::settings();
    settings.bus.mode = BusMode::Router;
    settings.bus.endpoint = format!("tcp/127.0.0.1:{port}");
    settings.outward = Some(self::settings());
    let clock: SharedClock = Arc::new(SystemClock::new());
    let (drive, mut bus) = Ros2Drive::new(settings.clone(), &clock).unwrap();
    if tells {
        let shared = Arc::new(Shared::default());
        shared.record_server_message(clock.monotonic());
        let settings = bus.outward_settings().cloned().unwrap();
        let outward =
            AgentStatePublisher::new(settings, shared, drive.counts(), "rover-1".to_owned());
        bus.publish(Box::new(outward));
    }
    let running = std::thread::spawn(move || bus.run());
    let observer = Observer::start(&settings);
    look(&self::settings(), &observer);
    observer.session.close().wait().unwrap();
    drop(drive);
    running.join().unwrap();
}

#[test]
fn another_node_on_the_bus_hears_every_topic_by_its_key_and_sees_who_publishes_it() {
    heard_by_another(true, |settings, observer| {
        // Rest is commanded as well.
        let found = observer.first_of(PublishedTopic::ALL.len() + 1);
        let tokens = observer.publishers();
        assert_eq!(tokens.len(), PublishedTopic::ALL.len() + 1, "{tokens:?}");
        let mut messages = Messages::new();
        for topic in PublishedTopic::ALL {
            let message_type = topic.message_type();
            let key = topic_key(0, topic.topic(settings), &message_type, Generation::Hashed);
            assert!(key.ends_with(message_type.hash), "{key}");
            let (attachment, bytes) = &found[&key];
            let attachment = Attachment::from_bytes(attachment).unwrap();
            let token = tokens.iter().find(|token| gid(token) == attachment.gid);
            let token = token.unwrap_or_else(|| panic!("nobody publishes {key}"));
            assert!(token.contains(message_type.hash), "{token}");
            messages.insert(topic, bytes.clone());
        }
        for topic in [PublishedTopic::Plan, PublishedTopic::Driven] {
            let path: Path<'_> = decode(&messages[&topic]).unwrap();
            assert_eq!((path.header.frame_id, path.poses.len()), ("map", 0));
        }
        assert_eq!(numbers(&messages).len(), 3);
        let (level, text, _) = part(&messages, "tread_agent: control");
        assert_eq!((level, text.as_str()), (Level::Ok as u8, "idle"));
    });
}

#[test]
fn a_bus_with_nobody_to_speak_of_announces_its_commands_alone() {
    heard_by_another(false, |_, observer| {
        let found = observer.first_of(1);
        assert!(found.keys().all(|key| key.contains("cmd_vel")), "{found:?}");
        assert_eq!(observer.publishers().len(), 1);
    });
}
