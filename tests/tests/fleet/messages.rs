//! Messages on zenoh that lie or make no sense are refused, counted, and harm nobody.

use serde_json::{Value, json};
use tread_api::ids::RobotId;
use tread_api::keys;
use tread_api::wire::ingest::Receipt;
use tread_tests::light_robot::{LightRobot, ask_raw};
use tread_tests::wait::{SHORT, eventually};

use crate::fleet;

/// Uploads a payload as it is and returns the server's words of refusal.
async fn refusal(robot: &LightRobot, key: &str, payload: &str) -> String {
    let answer = ask_raw::<Receipt>(&robot.session, key, payload.as_bytes().to_vec()).await;
    answer.expect_err("a bad payload was taken").to_string()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn uploads_that_lie_or_do_not_parse_are_refused_and_counted() {
    let fleet = fleet().await;
    let site = fleet.site();
    let id: RobotId = "talker".parse().unwrap();
    let mut robot = LightRobot::start(&fleet.zenoh_endpoint(), &site, id.clone())
        .await
        .unwrap();
    let own_key = keys::ingest(&site, &id);
    let others_key = keys::ingest(&site, &"victim".parse().unwrap());
    let good = json!({"v": 2, "body": robot.next_batch(1)}).to_string();

    assert!(
        refusal(&robot, &others_key, &good)
            .await
            .contains("Impersonation")
    );
    assert!(
        refusal(&robot, &own_key, "{not json")
            .await
            .contains("Malformed")
    );
    assert!(
        refusal(&robot, &own_key, "\u{0}\u{1}")
            .await
            .contains("Malformed")
    );
    let newer = good.replacen("\"v\":2", "\"v\":3", 1);
    assert!(refusal(&robot, &own_key, &newer).await.contains("Version"));

    // A record that cannot be a measurement is refused by itself; its neighbours are stored.
    let mut batch = serde_json::to_value(robot.next_batch(3)).unwrap();
    batch["records"][1]["content"]["segment"]["theta"]["information"] = json!(-1.0);
    let mixed = json!({"v": 2, "body": batch, "a_newer_field": true}).to_string();
    let receipt: Receipt = ask_raw(&robot.session, &own_key, mixed.into_bytes())
        .await
        .unwrap();
    assert_eq!(
        (receipt.committed, receipt.refused.len()),
        (2, 1),
        "{receipt:?}"
    );
    assert!(receipt.refused[0].reason.contains("theta"), "{receipt:?}");

    // The same again: nothing is counted twice.
    let batch = robot.next_batch(5);
    for (committed, duplicates) in [(5, 0), (0, 5)] {
        let (receipt, _) = robot.upload(&batch).await.unwrap();
        assert_eq!(
            (receipt.committed, receipt.duplicates),
            (committed, duplicates)
        );
    }
    let segments: Vec<Value> = fleet.rest.all("/v1/sites/yard/segments").await;
    assert_eq!(segments.len(), 7);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_state_that_makes_no_sense_changes_nothing() {
    let fleet = fleet().await;
    let site = fleet.site();
    let id: RobotId = "talker".parse().unwrap();
    let mut robot = LightRobot::start(&fleet.zenoh_endpoint(), &site, id.clone())
        .await
        .unwrap();
    let heard = || async { fleet.rest.robot(&id).await.and_then(|robot| robot.live) };
    robot.publish_state().await.unwrap();
    let before = eventually("a state is heard", SHORT, heard, Option::is_some)
        .await
        .unwrap();

    let counters_before: Value = fleet.rest.get("/v1/server").await;
    let lies = [
        "{not json".to_owned(),
        json!({"v": 7, "body": {}}).to_string(),
        json!({"v": 2, "body": {"robot": "somebody-else"}}).to_string(),
    ];
    for lie in lies {
        robot
            .session
            .put(keys::state(&site, &id), lie)
            .await
            .unwrap();
    }
    let counters = || fleet.rest.get::<Value>("/v1/server");
    eventually("the refusals are counted", SHORT, counters, |now| {
        *now != counters_before
    })
    .await;
    let after = heard().await.unwrap();
    assert_eq!(
        after.pose.map(|pose| pose.value),
        before.pose.map(|pose| pose.value)
    );
    // And the server still listens.
    robot.publish_state().await.unwrap();
    eventually("a good state is heard", SHORT, heard, |live| {
        live.as_ref().is_some_and(|live| live.state_age_ms < 1_000)
    })
    .await;
}
