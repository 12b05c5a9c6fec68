//! What agents of this release say, kept in `tests/fixtures/releases` for the servers of later ones,
//! and an agent of the release before at this server.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use jiff::Timestamp;
use serde_json::{Value, json};
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::keys::{self, Key, Verb};
use tread_api::mission::MissionState;
use tread_api::trajectory::Trajectory;
use tread_api::wire;
use tread_api::wire::command::{Offer, Outcomes, Pause};
use tread_api::wire::hello::{Hello, SiteDefinition, Welcome};
use tread_api::wire::ingest::{Batch, Receipt, RecordContent};
use tread_api::wire::reply::{
    Acknowledgement, Answer, Command, MissionOutcomes, OfferReply, OutcomesReply,
};
use tread_api::wire::state::RobotState;
use tread_tests::fleet::SITE;
use tread_tests::light_robot::ask;
use tread_tests::ports::free_address;
use tread_tests::process::Process;
use tread_tests::repository::root;
use tread_tests::wait::{DRIVE, SHORT, eventually};
use zenoh::Wait as _;

use crate::{arc, fleet, slalom};

/// Set to write the messages of the present version anew, before it is released.
const UPDATE: &str = "UPDATE_RELEASE";
/// The program `tread-agent` of the release before, when there is one.
const PREVIOUS: &str = "TREAD_PREVIOUS_AGENT";

fn kept() -> PathBuf {
    let version = env!("CARGO_PKG_VERSION");
    root().join(format!("tests/fixtures/releases/{version}/messages.json"))
}

#[derive(Debug, Default)]
struct Heard {
    hello: Option<Value>,
    batches: Vec<Value>,
    states: Vec<Value>,
    friction: Option<Value>,
}

impl Heard {
    fn has_segments(&self) -> bool {
        self.batches.iter().any(|batch| {
            let records = batch["body"]["records"].as_array();
            let mut records = records.into_iter().flatten();
            records.any(|record| record["content"]["segment"].is_object())
        })
    }
}

fn definition() -> SiteDefinition {
    let text = json!({
        "grid": {"revision": 1, "cell_m": 1.0}, "terrain_revision": 1,
        "terrains": [{"terrain": {"id": "slab", "revision": 1}, "class": "concrete", "layer": 0, "polygon": [
            {"x_m": -50.0, "y_m": -50.0}, {"x_m": 50.0, "y_m": -50.0}, {"x_m": 50.0, "y_m": 50.0},
            {"x_m": -50.0, "y_m": 50.0}]}],
    });
    serde_json::from_value(text).unwrap()
}

/// A server that only listens, and answers what an agent needs to go on.
fn listen(endpoint: &str, heard: &Arc<Mutex<Heard>>) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"router\"".to_owned()),
        ("listen/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    let session = zenoh::open(config).wait().unwrap();
    let noted = Arc::clone(heard);
    session
        .declare_queryable("tread/*/server/*/*")
        .complete(true)
        .callback(move |query| {
            let payload = query.payload().map(|bytes| bytes.to_bytes().into_owned());
            let message: Value = serde_json::from_slice(&payload.unwrap()).unwrap();
            let key = Key::parse(query.key_expr().as_str());
            let mut noted = noted.lock().unwrap();
            let reply = if matches!(key, Some(Key::Hello(..))) {
                noted.hello = Some(message);
                wire::encode(&Welcome {
                    site: definition(),
                    server_time: "2026-11-25T08:00:00Z".parse::<Timestamp>().unwrap(),
                    upload_encodings: Vec::new(),
                })
            } else {
                let records = message["body"]["records"].as_array().map_or(0, Vec::len);
                noted.batches.push(message);
                wire::encode(&Receipt {
                    committed: records as u64,
                    duplicates: 0,
                    refused: Vec::new(),
                })
            };
            let key = query.key_expr().clone();
            query.reply(key, reply.unwrap()).wait().unwrap();
        })
        .background()
        .wait()
        .unwrap();
    let noted = Arc::clone(heard);
    session
        .declare_subscriber("tread/*/robots/*/*")
        .callback(move |sample| {
            let Ok(message) = serde_json::from_slice(&sample.payload().to_bytes()) else {
                return;
            };
            let mut noted = noted.lock().unwrap();
            match Key::parse(sample.key_expr().as_str()) {
                Some(Key::State(..)) => noted.states.push(message),
                Some(Key::Friction(..)) => noted.friction = Some(message),
                Some(_) | None => {}
            }
        })
        .background()
        .wait()
        .unwrap();
    session
}

fn offer(mission: MissionId) -> Offer {
    let trajectory: Trajectory = serde_json::from_value(slalom(0.0, 12)).unwrap();
    serde_json::from_value(json!({
        "mission": mission, "revision": 1,
        "plan_hash": Offer::plan_hash_of(mission, 1, &trajectory), "trajectory": trajectory,
        "start_within_ms": null,
    }))
    .unwrap()
}

/// A command as JSON with a field that this release does not know, as a newer server sends it.
async fn command<C: Command>(
    session: &zenoh::Session,
    (site, robot, verb): (&SiteId, &RobotId, Verb),
    command: &C,
) -> Value {
    let mut asked = serde_json::to_value(command).unwrap();
    asked["of_a_newer_release"] = json!({"a": [1, 2]});
    let key = keys::command(site, robot, verb);
    let answer: anyhow::Result<Value> = ask(session, &key, &asked).await;
    answer.unwrap_or_default()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_messages_of_this_release_are_kept_and_newer_commands_are_understood() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = format!("tcp/{}", free_address());
    let heard = Arc::new(Mutex::new(Heard::default()));
    let opening = (endpoint.clone(), Arc::clone(&heard));
    let session = tokio::task::spawn_blocking(move || listen(&opening.0, &opening.1));
    let session = session.await.unwrap();
    let scenario = folder.path().join("scenario.toml");
    let text = format!(
        "site = \"{SITE}\"\ncell_m = 1.0\nterrains = []\n[ground]\nstiffness = 2.5\n[[robots]]\n\
         id = \"rover-1\"\nx_m = 0.0\ny_m = 0.0\nheading_rad = 0.0\nseed = 7\n"
    );
    fs::write(&scenario, text).unwrap();
    let arguments = [
        "agent".to_owned(),
        format!("--site={SITE}"),
        "--robot=rover-1".to_owned(),
        format!("--server={endpoint}"),
        format!("--data-dir={}", folder.path().join("rover-1").display()),
        format!("--scenario={}", scenario.display()),
    ];
    let log = folder.path().join("agent.log");
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let mut agent = Process::start("rover-1", node, &arguments, &log).unwrap();
    let (site, robot): (SiteId, RobotId) = (SITE.parse().unwrap(), "rover-1".parse().unwrap());
    let mission: MissionId = "0192f0c1-2b3c-7d4e-8f50-617283940a1b".parse().unwrap();
    let mut answers = serde_json::Map::new();
    let accepted = eventually(
        "the robot takes a mission",
        SHORT,
        || async { command(&session, (&site, &robot, Verb::Offer), &offer(mission)).await },
        |answer| answer["outcome"]["accepted"].is_object(),
    );
    answers.insert("offer".to_owned(), accepted.await);
    let look = || async { heard.lock().unwrap().has_segments() };
    eventually("it measures", DRIVE, look, |found| *found).await;
    let pause = Pause {
        mission,
        revision: 1,
    };
    let paused = command(&session, (&site, &robot, Verb::Pause), &pause).await;
    answers.insert("pause".to_owned(), paused);
    let asked = Outcomes {
        missions: vec![mission],
    };
    let outcomes = command(&session, (&site, &robot, Verb::Outcomes), &asked).await;
    answers.insert("outcomes".to_owned(), outcomes);
    let site_taken = command(&session, (&site, &robot, Verb::Site), &definition()).await;
    answers.insert("site".to_owned(), site_taken);
    agent.stop().await.unwrap();
    let closing = tokio::task::spawn_blocking(move || session.close().wait());
    closing.await.unwrap().unwrap();

    let heard = heard.lock().unwrap();
    let count = heard.states.len();
    let states: Vec<&Value> = heard.states.iter().skip(count / 2).take(2).collect();
    let recorded = json!({
        "hello": heard.hello, "states": states, "friction": heard.friction,
        "batches": heard.batches, "answers": answers,
    });
    if std::env::var_os(UPDATE).is_some() {
        fs::create_dir_all(kept().parent().unwrap()).unwrap();
        let text = serde_json::to_string_pretty(&recorded).unwrap();
        fs::write(kept(), text + "\n").unwrap();
    }
    reads(&recorded);
    let kept = fs::read_to_string(kept()).expect("run this test with UPDATE_RELEASE=1");
    reads(&serde_json::from_str(&kept).unwrap());
}

fn read<T: serde::de::DeserializeOwned>(message: &Value) -> T {
    let text = serde_json::to_vec(message).unwrap();
    wire::decode(&text).unwrap_or_else(|error| panic!("{error}: {message}"))
}

/// Everything that was recorded is what this release understands.
fn reads(recorded: &Value) {
    let _: Hello = read(&recorded["hello"]);
    let states = recorded["states"].as_array().unwrap();
    assert!(!states.is_empty());
    for state in states {
        let _: RobotState = read(state);
    }
    let mut contents = Vec::new();
    for batch in recorded["batches"].as_array().unwrap() {
        let batch: Batch = read(batch);
        contents.extend(batch.records.into_iter().map(|record| record.content));
    }
    let is_segment = |content: &RecordContent| matches!(content, RecordContent::Segment(_));
    assert!(contents.iter().any(is_segment));
    assert!(!contents.iter().all(is_segment), "and reports of missions");
    let answers = &recorded["answers"];
    let enveloped = |name: &str| json!({"v": wire::VERSION, "body": answers[name]});
    let offered: Answer<OfferReply> = read(&enveloped("offer"));
    assert!(offered.reply.into_result().is_ok());
    let paused: Answer<Acknowledgement> = read(&enveloped("pause"));
    assert_eq!(paused.reply, Acknowledgement::Done);
    let outcomes: Answer<OutcomesReply> = read(&enveloped("outcomes"));
    let OutcomesReply::Outcomes(MissionOutcomes { active, .. }) = outcomes.reply else {
        panic!("it refused: {answers}");
    };
    assert!(active.is_some(), "{answers}");
    let taken: Answer<Acknowledgement> = read(&enveloped("site"));
    assert_eq!(taken.reply, Acknowledgement::Done);
}

/// Tries the program of the release before, where `TREAD_PREVIOUS_AGENT` names it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_of_the_release_before_drives_a_mission_of_this_server() {
    let Some(previous) = std::env::var_os(PREVIOUS) else {
        eprintln!("NOT CHECKED: {PREVIOUS} names no tread-agent of the release before");
        return;
    };
    let mut fleet = fleet().await;
    fleet.agents_run(Path::new(&previous));
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, arc(0.0, 1.0)).await;
    let succeeded = [MissionState::Succeeded];
    fleet.rest.mission_reaches(mission, &succeeded, DRIVE).await;
    let look = || async { fleet.rest.all::<Value>("/v1/sites/yard/segments").await };
    eventually("its measurements arrive", SHORT, look, |found| {
        !found.is_empty()
    })
    .await;
}
