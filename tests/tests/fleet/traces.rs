//! One mission is one trace through server and agent, as a collector receives it that the test plays.

use std::path::Path;

use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::wire::trace::TraceParent;
use tread_tests::collector::Collector;
use tread_tests::fleet::Fleet;
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::bend;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_one_trace_through_server_and_agent() {
    let collector = Collector::default();
    let endpoint = collector.start().await.unwrap();
    let tracing = format!("[tracing]\nendpoint = \"{endpoint}\"\n");
    let config = format!("[robots]\nauthority = \"authority\"\n{tracing}");
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let mut fleet = Fleet::start_in_environment(node, &config, &[]).await;
    let file = fleet.file("robot.toml");
    std::fs::write(&file, tracing).unwrap();
    fleet.agents_get(&[&format!("--config={}", file.display())]);
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
    let trace = TraceParent::of_mission(mission);
    assert_eq!(trace.trace_id, mission.as_uuid().as_u128());
    let names = ["mission", "store", "offer", "plan", "drive"];
    let look = async || collector.of_trace(trace.trace_id);
    let spans = eventually("all spans have arrived", SHORT, look, |spans| {
        names.iter().all(|name| spans.contains_key(*name))
    })
    .await;
    let one = |name: &str| {
        let found = &spans[name];
        assert_eq!(found.len(), 1, "{name}: {spans:#?}");
        &found[0]
    };
    let (service, of_mission) = one("mission");
    assert_eq!(service, "tread-server");
    assert_eq!(of_mission.span_id, trace.span_id.to_be_bytes());
    assert!(of_mission.parent_span_id.iter().all(|byte| *byte == 0));
    let (service, store) = one("store");
    assert_eq!(service, "tread-server");
    assert_eq!(store.parent_span_id, of_mission.span_id);
    assert_eq!(store.start_time_unix_nano, of_mission.start_time_unix_nano);
    // An offer may have been repeated; the last was accepted.
    let (service, offer) = spans["offer"].last().unwrap();
    assert_eq!(service, "tread-server");
    assert_eq!(offer.parent_span_id, of_mission.span_id);
    let offers: Vec<&Vec<u8>> = spans["offer"]
        .iter()
        .map(|(_, span)| &span.span_id)
        .collect();
    let (service, plan) = spans["plan"].last().unwrap();
    assert_eq!(service, "tread-agent");
    assert!(offers.contains(&&plan.parent_span_id), "{spans:#?}");
    let (service, drive) = one("drive");
    assert_eq!(service, "tread-agent");
    assert!(offers.contains(&&drive.parent_span_id), "{spans:#?}");
    assert!(
        drive.end_time_unix_nano > drive.start_time_unix_nano + 1_000_000_000,
        "it drove for longer than a second: {drive:?}"
    );
    assert!(of_mission.start_time_unix_nano <= plan.start_time_unix_nano);
    fleet.stop_agent(&robot).await.unwrap();
    fleet.stop_server().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collector_that_is_away_costs_spans_and_no_mission() {
    let config = "[robots]\nauthority = \"authority\"\n[tracing]\nendpoint = \"http://127.0.0.1:9/v1/traces\"\n";
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let mut fleet = Fleet::start_in_environment(node, config, &[]).await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
    let ended = fleet.stop_server().await.unwrap();
    assert!(ended.success(), "{ended}");
}
