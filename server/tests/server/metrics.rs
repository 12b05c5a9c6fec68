//! The metrics say what happened, and nobody looks for one that does not exist.

use std::collections::BTreeSet;

use reqwest::StatusCode;
use tread_api::mission::MissionState;
use tread_api::wire::ingest::MissionPhase;
use tread_server::certificate::Certificate;
use tread_server::config::backup::BackupConfig;

use crate::harness::{Yard, eventually, folder_of_the_crate, time};
use crate::robot::Robot;

async fn page(yard: &Yard) -> String {
    let address = yard.server.metrics_address().unwrap();
    let page = yard.client().get(format!("http://{address}/metrics"));
    page.send().await.unwrap().text().await.unwrap()
}

/// Every name of ours in a text.
fn names(text: &str) -> BTreeSet<String> {
    let words = text.split(|letter: char| !(letter.is_ascii_alphanumeric() || letter == '_'));
    let ours = words.filter(|word| word.starts_with("tread_"));
    ours.map(str::to_owned).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missions_refusals_queues_and_transactions_are_measured() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.report(0, &mission, MissionPhase::Started).await;
    robot.report(1, &mission, MissionPhase::Succeeded).await;
    yard.mission_becomes(mission.id, MissionState::Succeeded)
        .await;
    let (status, _) = yard.get_value("/v1/missions?robot=nobody").await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    for wanted in [
        "tread_mission_seconds_count{state=\"succeeded\"} 1",
        "tread_refusals_total{of=\"request\",reason=\"invalid-query\"} 1",
        "tread_refusals_total{of=\"robot\",reason=\"malformed\"} 0",
        "tread_queue_depth{queue=\"ingest\"} 0",
        "tread_db_transaction_seconds_count{kind=\"ingest\",writes=\"true\"} 2",
        "tread_db_transaction_seconds_count{kind=\"missions\",writes=\"true\"} 1",
    ] {
        eventually(wanted, async || {
            let text = page(&yard).await;
            let found = text.lines().any(|line| line == wanted);
            if found { Ok(()) } else { Err(text) }
        })
        .await;
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn alert_rules_and_dashboard_name_only_metrics_that_exist() {
    let yard = Yard::start_configured(|config, folder| {
        config.backup = Some(BackupConfig {
            folder: folder.join("backups"),
            every_hours: 24,
            keep: 1,
            encrypt: None,
        });
        config.retention.archive = Some(folder.join("archive").into());
    })
    .await;
    eventually("the server has made a backup", async || {
        let (_, status) = yard.get_value("/v1/server").await;
        let is_made = status["backup"]["last_at"].is_string();
        if is_made { Ok(()) } else { Err(status) }
    })
    .await;
    // Of requests there is nothing before the first one.
    assert_eq!(yard.get_value("/v1/sites").await.0, StatusCode::OK);
    // A certificate and a robot that has answered are measured.
    let robot = Robot::join(&yard, "rover-1").await;
    let stop = "/v1/sites/yard/robots/rover-1/stop";
    assert_eq!(
        yard.post(stop, &serde_json::json!({})).await.0,
        StatusCode::OK
    );
    let certificate = Certificate {
        subject: "a server".to_owned(),
        issuer: "an authority".to_owned(),
        names: Vec::new(),
        not_before: time("2026-01-01T00:00:00Z"),
        not_after: time("2100-01-01T00:00:00Z"),
    };
    yard.server
        .app()
        .update_certificate_alert(Some(&certificate), "a test");
    let text = page(&yard).await;
    let mut exist = BTreeSet::new();
    for line in text.lines() {
        let Some(rest) = line.strip_prefix("# TYPE ") else {
            continue;
        };
        let (name, kind) = rest.split_once(' ').unwrap();
        match kind {
            "histogram" => {
                exist.extend(["bucket", "sum", "count"].map(|part| format!("{name}_{part}")));
            }
            "counter" => drop(exist.insert(format!("{name}_total"))),
            _ => drop(exist.insert(name.to_owned())),
        }
    }
    // These are of PostgreSQL and of its standbys, whose tests look at them.
    let of_pairs = ["tread_standbys", "tread_standby_map_age_seconds"];
    exist.extend(of_pairs.map(str::to_owned));
    let deploy = folder_of_the_crate().join("../deploy");
    for file in ["prometheus-alerts.yml", "grafana-dashboard.json"] {
        let looked_for = names(&std::fs::read_to_string(deploy.join(file)).unwrap());
        assert!(looked_for.len() > 5, "{file}: {looked_for:?}");
        let missing: Vec<&String> = looked_for.difference(&exist).collect();
        assert!(missing.is_empty(), "{file} looks for {missing:?}");
    }
    drop(robot);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn metrics_are_on_an_address_of_their_own_and_count_what_happens() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let address = yard.server.metrics_address().unwrap();
    let page = yard.client().get(format!("http://{address}/metrics"));
    let text = page.send().await.unwrap().text().await.unwrap();
    for line in [
        "tread_missions{state=\"active\"} 1",
        "tread_robots{link=\"online\"} 1",
        "tread_offers_sent_total 1",
        "tread_http_request_seconds_count{method=\"POST\",route=\"/v1/missions\",status=\"201\"} 1",
    ] {
        assert!(
            text.lines().any(|said| said == line),
            "{line} is not in {text}"
        );
    }
    let (status, _) = yard.get_value("/metrics").await;
    assert_eq!(status, StatusCode::NOT_FOUND, "not on the API's address");
    yard.server.stop().await.unwrap();
}
