//! Rights, and the sites and robots that they hold for.

use std::collections::BTreeSet;
use std::time::Duration;

use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tread_api::identity::Role;
use tread_api::ids::JoinTokenId;
use tread_api::rights::{Right, Rights};
use tread_server::db;
use tread_server::identity::secret::{Kind, Secret};
use uuid::Uuid;

use super::every_route::{is_open, operations};
use crate::events::read_until;
use crate::harness::{Yard, circle, client, eventually, measured, segment, time};
use crate::robot::Robot;

/// What takes a token for everything.
const SERVER_WIDE: [(&str, &str); 15] = [
    ("GET", "/v1/audit"),
    ("GET", "/v1/audit/chain"),
    ("GET", "/v1/authority"),
    ("POST", "/v1/authority/rotation"),
    ("POST", "/v1/authority/rotation/finish"),
    ("POST", "/v1/authority/replace"),
    ("POST", "/v1/sites"),
    ("GET", "/v1/webhooks"),
    ("POST", "/v1/webhooks"),
    ("GET", "/v1/webhooks/{webhook}"),
    ("PUT", "/v1/webhooks/{webhook}"),
    ("DELETE", "/v1/webhooks/{webhook}"),
    ("POST", "/v1/webhooks/{webhook}/secret"),
    ("POST", "/v1/webhooks/{webhook}/test"),
    ("GET", "/v1/webhooks/{webhook}/deliveries"),
];
/// What is about whoever asks, or about the server, and nothing of a site.
const OWN: [(&str, &str); 3] = [
    ("GET", "/v1/session"),
    ("DELETE", "/v1/session"),
    ("GET", "/v1/server"),
];
/// Lists of all sites, which show what the token is for.
const LISTS: [(&str, &str); 8] = [
    ("GET", "/v1/alerts"),
    ("GET", "/v1/events"),
    ("GET", "/v1/join-tokens"),
    ("GET", "/v1/missions"),
    ("GET", "/v1/sessions"),
    ("GET", "/v1/sites"),
    ("GET", "/v1/stops"),
    ("GET", "/v1/tokens"),
];

/// A site with two robots that have been at work, and one where there is nothing.
struct Ground {
    yard: Yard,
    first: Robot,
    second: Robot,
    /// Of the second robot.
    mission: String,
    alert: String,
    join_token: String,
    /// Of a token for everything, and of its browser.
    token: String,
    session: String,
}

impl Ground {
    async fn prepare() -> Self {
        let yard = Yard::start().await;
        let made = yard.post("/v1/sites", &json!({"id": "field"})).await;
        assert_eq!(made.0, StatusCode::CREATED, "{made:?}");
        let first = Robot::join(&yard, "rover-1").await;
        let second = Robot::join(&yard, "rover-2").await;
        let mut missions = Vec::new();
        for robot in [&first, &second] {
            let mission = yard.create_mission(&robot.id).await;
            missions.push(mission.id.to_string());
            let piece = segment((1, 1), 1.3, 10);
            robot.upload(vec![measured(0, piece)]).await.unwrap();
            let stop = format!("/v1/sites/yard/robots/{}/stop", robot.id);
            assert!(yard.post(&stop, &json!({})).await.0.is_success());
            robot.say(|state| {
                let said = json!({"code": "tyre", "severity": "warning", "text": "flat"});
                state.alerts = vec![serde_json::from_value(said).unwrap()];
            });
        }
        let alert = eventually("both robots' alerts are raised", async || {
            let (_, alerts) = yard.get_value("/v1/alerts").await;
            let items = alerts["items"].as_array().unwrap();
            let tyres = items.iter().filter(|alert| alert["code"] == "tyre");
            let of_second = |alert: &&Value| alert["robot"] == "rover-2";
            match tyres.clone().find(of_second) {
                Some(alert) if tyres.count() == 2 => Ok(alert["id"].as_str().unwrap().to_owned()),
                _ => Err(alerts),
            }
        })
        .await;
        let join_token = JoinTokenId::from_uuid(Uuid::from_u128(7));
        let kept = serde_json::from_value(json!({
            "id": join_token, "site": "yard", "robot": "rover-2",
            "created_at": time("2026-11-01T00:00:00Z"), "created_by": "test",
            "expires_at": time("2027-11-01T00:00:00Z"), "used_at": null, "used_by": null,
            "revoked_at": null,
        }));
        let fingerprint = Secret::from_random(Kind::Join, &[7; 32]).fingerprint();
        let mut tx = yard.server.app().db().write("test").await.unwrap();
        db::join_tokens::insert(&mut tx, &kept.unwrap(), &fingerprint)
            .await
            .unwrap();
        tx.commit().await.unwrap();
        let made = yard.token("for everything", Role::Viewer).await;
        let token = made.token.id;
        let asked = client(None).post(yard.url("/v1/session"));
        let asked = asked.json(&json!({"token": made.secret}));
        let (_, session) = yard.send(asked).await;
        let session = session["session"].as_str().unwrap().to_owned();
        Self {
            first,
            second,
            mission: missions.pop().unwrap(),
            alert,
            join_token: join_token.to_string(),
            token: token.to_string(),
            session,
            yard,
        }
    }

    /// A path about the second robot.
    fn filled(&self, path: &str) -> String {
        let token = if path.contains("join-tokens") {
            &self.join_token
        } else {
            &self.token
        };
        let pairs = [
            ("{site}", "yard"),
            ("{robot}", "rover-2"),
            ("{mission}", &self.mission),
            ("{alert}", &self.alert),
            ("{token}", token),
            ("{session}", &self.session),
            ("{terrain}", "gravel"),
            ("{owner}", "gate"),
            ("{webhook}", "0192f0c1-2b3c-7d4e-8f50-617283940a1b"),
        ];
        let mut filled = path.to_owned();
        for (name, value) in pairs {
            filled = filled.replace(name, value);
        }
        assert!(!filled.contains('{'), "{path} has a parameter nobody knows");
        filled
    }

    async fn ask(&self, token: &str, (method, path): (&Method, &str), body: &Value) -> Answer {
        let asked = client(Some(token)).request(method.clone(), self.yard.url(path));
        let asked = match *method {
            Method::GET | Method::DELETE => asked,
            _ => asked.json(body),
        };
        let mut response = asked.send().await.unwrap();
        let status = response.status();
        let mut text = String::new();
        if path.starts_with("/v1/events") && status.is_success() {
            read_until(&mut response, &mut text, |text| {
                text.contains("event: snapshot_end")
            })
            .await;
        } else {
            text = response.text().await.unwrap();
        }
        Answer {
            what: format!("{method} {path}"),
            status,
            text,
        }
    }
}

#[derive(Debug)]
struct Answer {
    what: String,
    status: StatusCode,
    text: String,
}

impl Answer {
    /// Refused as whatever the token's rights do not allow, with words for people.
    fn is_outside(&self, scope: &str) {
        let (status, what) = (self.status, &self.what);
        assert_eq!(status, StatusCode::FORBIDDEN, "{what}: {}", self.text);
        let body: Value = serde_json::from_str(&self.text).unwrap();
        assert_eq!(body["type"], "/problems/forbidden", "{self:?}");
        let detail = body["detail"].as_str().unwrap();
        assert!(detail.contains(&format!("is for {scope} ")), "{self:?}");
    }

    fn is_allowed(&self) {
        let refused = [StatusCode::FORBIDDEN, StatusCode::UNAUTHORIZED];
        assert!(!refused.contains(&self.status), "{self:?}");
    }

    fn shows_nothing_of(&self, names: &[&str]) {
        assert_eq!(self.status, StatusCode::OK, "{self:?}");
        let shown = |name: &&str| self.text.contains(&format!("\"{name}\""));
        assert!(!names.iter().any(shown), "{self:?}");
    }
}

/// The bodies of what names a site only there: about the second robot, or its whole site.
fn body_of(method: &Method, path: &str) -> Option<Value> {
    let robot = "rover-2".parse().unwrap();
    match (method.as_str(), path) {
        ("POST", "/v1/missions") => Some(circle(&robot)),
        ("POST", "/v1/trajectories/check") => {
            let mut asked = circle(&robot);
            asked
                .as_object_mut()
                .unwrap()
                .retain(|name, _| name == "site" || name == "robot" || name == "trajectory");
            Some(asked)
        }
        ("POST", "/v1/stop") => Some(json!({"site": "yard"})),
        ("POST", "/v1/join-tokens") => Some(json!({"site": "yard", "robot": "rover-2"})),
        ("POST", "/v1/tokens") => {
            Some(json!({"name": "mine", "role": "viewer", "sites": [{"site": "yard"}]}))
        }
        _ => None,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_of_another_site_is_refused_everywhere_and_shown_nothing() {
    let ground = Ground::prepare().await;
    let foreign = ground.yard.limited("far", &Right::ALL, &["field"]).await;
    let mut walked = BTreeSet::new();
    for operation in operations() {
        let (method, path) = (&operation.method, operation.path.as_str());
        let key = (method.as_str(), path);
        if is_open(method, path) || OWN.contains(&key) {
            continue;
        }
        let body = body_of(method, path).unwrap_or_else(|| json!({}));
        let asked = (method, ground.filled(path));
        let answer = ground.ask(&foreign, (asked.0, &asked.1), &body).await;
        if LISTS.contains(&key) {
            answer.shows_nothing_of(&["yard", "rover-1", "rover-2", "for everything"]);
        } else {
            // All else names a site or robot, or is about the whole server.
            let names = path.contains('{') || body != json!({});
            assert!(names || SERVER_WIDE.contains(&key), "{key:?} is nowhere");
            answer.is_outside("field");
        }
        if operation.query.contains("site") {
            let path = format!("{path}?site=yard");
            let answer = ground.ask(&foreign, (method, &path), &body).await;
            answer.is_outside("field");
        }
        walked.insert(key.1.to_owned());
    }
    assert!(walked.len() > 40, "{walked:?}");
    // Written otherwise it is the same site.
    let path = "/v1/sites/%79ard/robots";
    let answer = ground.ask(&foreign, (&Method::GET, path), &json!({})).await;
    answer.is_outside("field");
    let refused = ground.yard.counters().await.refused_scope;
    assert!(refused > 40, "{refused}");
    // Nothing of it was done.
    assert!(ground.second.stops().len() == 1 && ground.first.stops().len() == 1);
    ground.yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_of_one_robot_acts_on_it_alone_and_lists_show_nothing_else() {
    let ground = Ground::prepare().await;
    let own = ground
        .yard
        .limited("mine", &Right::ALL, &["yard/rover-1", "field"])
        .await;
    let scope = "field, yard/rover-1";
    for operation in operations() {
        let (method, path) = (&operation.method, operation.path.as_str());
        let key = (method.as_str(), path);
        if is_open(method, path) || OWN.contains(&key) || SERVER_WIDE.contains(&key) {
            continue;
        }
        let mut body = body_of(method, path).unwrap_or_else(|| json!({}));
        let is_path = path.ends_with("/friction/path");
        if is_path {
            let corners = [
                json!({"x_m": 0.0, "y_m": 0.0}),
                json!({"x_m": 1.0, "y_m": 0.0}),
            ];
            body = json!({"points": corners, "robot": "rover-2"});
        }
        let filled = ground.filled(path);
        if operation.query.contains("robot") || operation.query.contains("robots") {
            let name = if operation.query.contains("robot") {
                "robot"
            } else {
                "robots"
            };
            // `field` may have a robot of that name; of the yard it is not this token's.
            let site = if path.contains("{site}") {
                ""
            } else {
                "&site=yard"
            };
            let path = format!("{filled}?{name}=rover-2{site}");
            let answer = ground.ask(&own, (method, &path), &body).await;
            answer.is_outside(scope);
        }
        if key == ("POST", "/v1/stop") {
            continue;
        }
        let answer = ground.ask(&own, (method, &filled), &body).await;
        let is_site = path.contains("{site}") && !path.contains("{robot}");
        if LISTS.contains(&key) {
            answer.shows_nothing_of(&["rover-2", "for everything"]);
        } else if is_site && operation.right == Right::Read && !is_path {
            answer.is_allowed();
            assert!(!answer.text.contains("rover-2"), "{answer:?}");
        } else {
            answer.is_outside(scope);
        }
    }
    // Its own robot is in all of them.
    for path in [
        "/v1/missions",
        "/v1/stops",
        "/v1/alerts",
        "/v1/sites/yard/robots",
        "/v1/sites/yard/segments",
        "/v1/sites/yard/segments?format=csv",
        "/v1/sites/yard/friction/robots",
        "/v1/events",
        "/v1/events?robots=rover-1",
        "/v1/missions?robot=rover-1",
    ] {
        let answer = ground.ask(&own, (&Method::GET, path), &json!({})).await;
        assert!(answer.status.is_success(), "{answer:?}");
        assert!(answer.text.contains("rover-1"), "{answer:?}");
        assert!(!answer.text.contains("rover-2"), "{answer:?}");
    }
    let csv = "/v1/sites/yard/segments?format=csv";
    let asked = (&Method::GET, csv);
    let whole = ground.ask(ground.yard.admin(), asked, &json!({})).await;
    assert!(whole.text.contains("rover-2"));
    // A stop of everything stops what the token is for, and whoever asks may ask for no more.
    for body in [json!({}), json!({"site": "yard"}), json!(["no object"])] {
        let (first, second) = (ground.first.stops().len(), ground.second.stops().len());
        let answer = ground.ask(&own, (&Method::POST, "/v1/stop"), &body).await;
        assert_eq!(answer.status, StatusCode::OK, "{answer:?}");
        assert!(!answer.text.contains("rover-2"), "{answer:?}");
        assert_eq!(ground.first.stops().len(), first + 1);
        assert_eq!(ground.second.stops().len(), second);
    }
    ground.yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_happens_elsewhere_is_not_sent_to_a_stream_that_is_open() {
    let ground = Ground::prepare().await;
    let own = ground
        .yard
        .limited("mine", &[Right::Read], &["yard/rover-1"])
        .await;
    let url = ground.yard.url("/v1/events?topics=missions");
    let mut stream = client(Some(&own)).get(url).send().await.unwrap();
    let mut text = String::new();
    read_until(&mut stream, &mut text, |text| text.contains("snapshot_end")).await;
    // In this order: when the second is sent, the first would have been.
    let other = ground.yard.create_mission(&ground.second.id).await;
    let shown = ground.yard.create_mission(&ground.first.id).await;
    let id = shown.id.to_string();
    read_until(&mut stream, &mut text, |text| text.contains(&id)).await;
    assert!(
        !text.contains(&other.id.to_string()) && !text.contains("rover-2"),
        "{text}"
    );
    ground.yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_may_hold_alone_does_not_end_what_another_program_holds() {
    let yard = Yard::start().await;
    let _robot = Robot::join(&yard, "rover-1").await;
    let gate = yard.limited("gate", &[Right::Hold], &[]).await;
    let foreman = yard.limited("foreman", &[Right::ReleaseHold], &[]).await;
    let limits = "/v1/sites/yard/robots/rover-1/limits";
    let limit = |token: &str, method: Method, owner: &str| {
        let url = yard.url(&format!("{limits}/{owner}"));
        let body = json!({"for_ms": 500, "hold": true});
        let asked = client(Some(token)).request(method.clone(), url);
        if method == Method::PUT {
            asked.json(&body)
        } else {
            asked
        }
    };
    eventually("the robot's clock is known", async || {
        let (status, body) = yard.send(limit(&gate, Method::PUT, "gate")).await;
        if status == StatusCode::NO_CONTENT {
            Ok(())
        } else {
            Err(body)
        }
    })
    .await;
    for (token, method, owner, is_refused) in [
        (&gate, Method::PUT, "gate", false),
        (&gate, Method::PUT, "crane", true),
        (&gate, Method::DELETE, "crane", true),
        (&foreman, Method::PUT, "crane", false),
        (&foreman, Method::DELETE, "crane", false),
        (&gate, Method::DELETE, "gate", false),
    ] {
        let (status, body) = yard.send(limit(token, method.clone(), owner)).await;
        let expected = if is_refused {
            StatusCode::FORBIDDEN
        } else {
            StatusCode::NO_CONTENT
        };
        assert_eq!(status, expected, "{method} {owner}: {body}");
        if is_refused {
            let detail = body["detail"].as_str().unwrap();
            assert!(detail.contains("`release_hold`"), "{detail}");
        }
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nobody_gives_more_than_he_has() {
    let yard = Yard::start().await;
    assert!(
        yard.post("/v1/sites", &json!({"id": "field"}))
            .await
            .0
            .is_success()
    );
    let of_yard = yard.limited("yard", &Right::ALL, &["yard"]).await;
    let clerk = yard.limited("clerk", &[Right::Administer], &[]).await;
    let holds = [Right::Administer, Right::Hold];
    let owner = yard.limited("obstacle watch", &holds, &[]).await;
    let give = async |token: &str, body: Value| {
        let asked = client(Some(token)).post(yard.url("/v1/tokens")).json(&body);
        yard.send(asked).await
    };
    let here = json!([{"site": "yard", "robots": ["rover-1"]}]);
    for (number, (token, what, status)) in [
        (
            &of_yard,
            json!({"role": "admin", "sites": [{"site": "yard"}]}),
            201,
        ),
        (&of_yard, json!({"rights": ["drive"], "sites": here}), 201),
        (&of_yard, json!({"role": "viewer"}), 403),
        (
            &of_yard,
            json!({"role": "viewer", "sites": [{"site": "field"}]}),
            403,
        ),
        (&clerk, json!({"role": "viewer"}), 201),
        (&clerk, json!({"rights": ["administer"]}), 201),
        (&clerk, json!({"rights": ["drive"]}), 403),
        // A token named like another program would end that one's limits.
        (&owner, json!({"rights": ["hold"]}), 403),
        (&owner, json!({"rights": ["administer"]}), 201),
        (&clerk, json!({"role": "operator"}), 403),
        (&clerk, json!({"rights": []}), 422),
        (&clerk, json!({}), 422),
        (&clerk, json!({"role": "viewer", "rights": ["read"]}), 422),
        (&clerk, json!({"role": "viewer", "sites": []}), 422),
        (
            &clerk,
            json!({"role": "viewer", "sites": [{"site": "moon"}]}),
            404,
        ),
    ]
    .into_iter()
    .enumerate()
    {
        let mut body = what.clone();
        body["name"] = json!(format!("number {number}"));
        let (answered, said) = give(token, body).await;
        assert_eq!(answered.as_u16(), status, "{what}: {said}");
    }
    // Whoever administers a site sees and revokes the tokens that hold there alone.
    let asked = client(Some(&of_yard)).get(yard.url("/v1/tokens"));
    let (_, listed) = yard.send(asked).await;
    let names: BTreeSet<&str> = listed["items"]
        .as_array()
        .unwrap()
        .iter()
        .map(|token| token["name"].as_str().unwrap())
        .collect();
    assert_eq!(names, BTreeSet::from(["yard", "number 0", "number 1"]));
    for token in listed["items"].as_array().unwrap() {
        if token["name"] == "number 1" {
            assert_eq!(token["role"], Value::Null);
            assert_eq!(token["rights"], json!(["stop", "read", "drive"]));
            assert_eq!(token["sites"], here);
            let url = yard.url(&format!("/v1/tokens/{}", token["id"].as_str().unwrap()));
            let revoked = client(Some(&of_yard)).delete(url);
            assert_eq!(yard.send(revoked).await.0, StatusCode::OK);
        }
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_administers_a_site_revokes_every_token_that_holds_there_alone_and_no_other() {
    let yard = Yard::start().await;
    let clerk = yard.limited("clerk", &[Right::Administer], &["yard"]).await;
    yard.limited("of the yard", &Right::ALL, &["yard"]).await;
    yard.limited("of a robot", &Right::ALL, &["yard/rover-1"])
        .await;
    let made = yard.post("/v1/sites", &json!({"id": "field"})).await;
    assert!(made.0.is_success(), "{made:?}");
    yard.limited("of both", &[Right::Read], &["yard", "field"])
        .await;
    yard.limited("of all", &[Right::Read], &[]).await;
    let (_, listed) = yard.get_value("/v1/tokens?limit=100").await;
    let revoke = async |token: &str, name: &str| {
        let mut items = listed["items"].as_array().unwrap().iter();
        let found = items.find(|it| it["name"] == name).unwrap();
        let path = format!("/v1/tokens/{}", found["id"].as_str().unwrap());
        let asked = client(Some(token)).delete(yard.url(&path));
        yard.send(asked).await.0.as_u16()
    };
    // More rights protect from nobody who administers the place: taking away is what an incident
    // needs.
    for (name, status) in [
        ("of both", 403),
        ("of all", 403),
        ("tests", 403),
        ("of a robot", 200),
        ("of the yard", 200),
    ] {
        assert_eq!(revoke(&clerk, name).await, status, "{name}");
    }
    let clerk_of_all = yard
        .limited("clerk of all", &[Right::Administer], &[])
        .await;
    assert_eq!(revoke(&clerk_of_all, "tests").await, 200);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_admin_of_a_site_uses_up_its_share_of_tokens_and_nobody_elses() {
    let yard = Yard::start().await;
    let made = yard.post("/v1/sites", &json!({"id": "field"})).await;
    assert!(made.0.is_success(), "{made:?}");
    let of_yard = yard.limited("yard", &Right::ALL, &["yard"]).await;
    let of_field = yard.limited("field", &Right::ALL, &["field"]).await;
    let give = async |token: &str, name: String, site: &str| {
        let body = json!({"name": name, "role": "admin", "sites": [{"site": site}]});
        let asked = client(Some(token)).post(yard.url("/v1/tokens")).json(&body);
        yard.send(asked).await
    };
    // Whom it makes an admin of the site shares with it.
    let mut maker = of_yard;
    for number in 1..100 {
        let (status, made) = give(&maker, format!("number {number}"), "yard").await;
        assert_eq!(status, StatusCode::CREATED, "{number}: {made}");
        if number == 50 {
            maker = made["secret"].as_str().unwrap().to_owned();
        }
    }
    let (status, refused) = give(&maker, "one more".to_owned(), "yard").await;
    assert_eq!(status, StatusCode::CONFLICT, "{refused}");
    assert_eq!(refused["type"], "/problems/too-many", "{refused}");
    for (maker, site) in [(&*of_field, "field"), (yard.admin(), "yard")] {
        let (status, made) = give(maker, format!("by another in {site}"), site).await;
        assert_eq!(status, StatusCode::CREATED, "{made}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_token_has_used_as_an_idempotency_key_is_shown_to_no_other_and_blocks_none() {
    let yard = Yard::start().await;
    let mut robots = Vec::new();
    let mut tokens = Vec::new();
    for name in ["rover-1", "rover-2"] {
        robots.push(Robot::join(&yard, name).await);
        let place = format!("yard/{name}");
        let rights = [Right::Dispatch, Right::Read];
        tokens.push(yard.limited(name, &rights, &[&place]).await);
    }
    let send = async |token: &str, robot: &Robot| {
        let asked = client(Some(token)).post(yard.url("/v1/missions"));
        let asked = asked.header("idempotency-key", "monday");
        yard.send(asked.json(&circle(&robot.id))).await
    };
    let (status, first) = send(&tokens[0], &robots[0]).await;
    assert_eq!(status, StatusCode::CREATED, "{first}");
    let (status, second) = send(&tokens[1], &robots[1]).await;
    assert_eq!(status, StatusCode::CREATED, "{second}");
    assert_eq!(second["robot"], "rover-2");
    for (number, made) in [first, second].iter().enumerate() {
        let (_, again) = send(&tokens[number], &robots[number]).await;
        assert_eq!(again["id"], made["id"], "{again}");
    }
    // Its own key is for one request alone, as before.
    let (status, refused) = send(yard.admin(), &robots[0]).await;
    assert_eq!(status, StatusCode::CREATED, "{refused}");
    let (status, refused) = send(yard.admin(), &robots[1]).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{refused}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_has_the_rights_of_its_token_after_a_restart_too() {
    let yard = Yard::start().await;
    let secret = yard
        .limited("night", &[Right::ClearStop], &["yard/rover-1"])
        .await;
    let yard = yard.restart().await;
    let signed_in = reqwest::Client::new()
        .post(yard.url("/v1/session"))
        .json(&json!({"token": secret}))
        .send()
        .await
        .unwrap();
    let cookie = signed_in.headers()["set-cookie"]
        .to_str()
        .unwrap()
        .to_owned();
    let cookie = cookie.split(';').next().unwrap().to_owned();
    let ask = async |path: &str| {
        let asked = reqwest::Client::new().get(yard.url(path));
        yard.send(asked.header("cookie", cookie.as_str())).await
    };
    let (_, who) = ask("/v1/session").await;
    let rights: Rights = [Right::ClearStop].into_iter().collect();
    assert_eq!(who["rights"], json!(rights), "{who}");
    assert_eq!(
        who["sites"],
        json!([{"site": "yard", "robots": ["rover-1"]}])
    );
    let (status, body) = ask("/v1/sites/yard/robots/rover-2").await;
    assert_eq!(status, StatusCode::FORBIDDEN, "{body}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_is_revoked_before_its_body_is_here_gives_nothing() {
    let yard = Yard::start().await;
    let thief = yard.token("thief", Role::Admin).await;
    let body = json!({"name": "for later", "role": "admin"}).to_string();
    let (begin, end) = body.split_at(body.len() - 1);
    let mut stream = TcpStream::connect(yard.server.http_address())
        .await
        .unwrap();
    let head = format!(
        "POST /v1/tokens HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {}\r\n\
         Content-Type: application/json\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{begin}",
        thief.secret,
        body.len(),
    );
    stream.write_all(head.as_bytes()).await.unwrap();
    // The head is here long before; the guard would refuse a late one, to the same end.
    tokio::time::sleep(Duration::from_millis(300)).await;
    let path = format!("/v1/tokens/{}", thief.token.id);
    let revoking = client(Some(yard.admin())).delete(yard.url(&path));
    assert!(yard.send(revoking).await.0.is_success());
    stream.write_all(end.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 401"), "{answer}");
    let (_, tokens) = yard.get_value("/v1/tokens?limit=100").await;
    assert!(!tokens.to_string().contains("for later"), "{tokens}");
}
