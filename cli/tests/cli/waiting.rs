//! Commands that wait for missions, while the server is out of reach for a time.

use tread_tests::relay::Relay;

use crate::yard::{ROBOT, Yard};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_command_that_waits_for_a_mission_bridges_an_outage_of_the_server() {
    let yard = Yard::start().await;
    let relay = Relay::start(yard.server.http_address()).await.unwrap();
    let sent = yard
        .json(&[
            "send", "circle", "--robot", ROBOT, "--center", "8,6", "--radius", "3", "--turns", "50",
        ])
        .await;
    let id = sent["id"].as_str().expect("an identifier").to_owned();
    let mut waiting = yard.tread(relay.address().port(), &["missions", "wait", &id]);
    waiting.shows("active").await;
    relay.cut();
    relay.reset();
    waiting.shows("trying again for 60 s").await;
    relay.heal();
    waiting.shows("the server answers again").await;
    yard.table(&["missions", "cancel", &id]).await;
    assert_eq!(waiting.ended().await, Some(1), "{}", waiting.screen());
    assert!(
        waiting.screen().contains("cancelled"),
        "{}",
        waiting.screen()
    );
    yard.end().await;
}
