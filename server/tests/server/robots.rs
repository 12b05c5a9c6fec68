//! Robots as people keep them: their alerts, their names, their retirement.

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::mission::{Cause, MissionState};
use tread_api::robot::{AlertReport, Severity};

use crate::control::causes;
use crate::harness::{Yard, circle, eventually};
use crate::robot::Robot;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn alerts_are_raised_once_acknowledged_and_cleared() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.say(|state| {
        state.alerts = vec![AlertReport {
            code: "battery-low".parse().unwrap(),
            severity: Severity::Warning,
            text: "15 %".to_owned(),
        }];
    });
    let raised = eventually("the alert is raised", async || {
        let (_, page) = yard.get_value("/v1/alerts?raised=true").await;
        let first = page["items"].get(0).cloned();
        first.ok_or(page)
    })
    .await;
    assert_eq!(raised["code"], "battery-low");
    let path = format!("/v1/alerts/{}/acknowledge", raised["id"].as_str().unwrap());
    let (status, seen) = yard.post(&path, &json!({})).await;
    assert_eq!(status, StatusCode::OK);
    assert!(
        seen["acknowledged_at"].is_string() && seen["cleared_at"].is_null(),
        "{seen}"
    );
    robot.say(|state| state.alerts.clear());
    eventually("the alert is cleared", async || {
        let (_, page) = yard.get_value("/v1/alerts?robot=rover-1").await;
        let items = page["items"].as_array().unwrap().clone();
        assert_eq!(items.len(), 1);
        if items[0]["cleared_at"].is_string() {
            Ok(())
        } else {
            Err(items)
        }
    })
    .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tags_of_a_robot_are_replaced_sorted_listed_and_kept_over_a_restart() {
    let yard = Yard::start().await;
    let _robot = Robot::join(&yard, "rover-1").await;
    let path = "/v1/sites/yard/robots/rover-1";
    let change = async |body: Value| {
        let request = yard.client().patch(yard.url(path));
        yard.send(request.json(&body)).await
    };
    let (_, new) = yard.get_value(path).await;
    assert_eq!(new["tags"], json!([]));
    let (status, body) = change(json!({"tags": ["spare", "north", "spare"]})).await;
    assert_eq!(
        (status, &body["tags"]),
        (StatusCode::OK, &json!(["north", "spare"]))
    );
    let many: Vec<String> = (0..17).map(|number| format!("tag-{number}")).collect();
    for (tags, says) in [
        (json!(many), "at most 16"),
        (json!(["North Yard"]), "North Yard"),
    ] {
        let (status, body) = change(json!({"tags": tags})).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
        assert!(body["detail"].as_str().unwrap().contains(says), "{body}");
    }
    // Another change leaves them.
    let (_, body) = change(json!({"name": "Old one"})).await;
    assert_eq!(body["tags"], json!(["north", "spare"]));
    let yard = yard.restart().await;
    let (_, page) = yard.get_value("/v1/sites/yard/robots").await;
    assert_eq!(page["items"][0]["tags"], json!(["north", "spare"]));
    let request = yard.client().patch(yard.url(path));
    let (_, body) = yard.send(request.json(&json!({"tags": []}))).await;
    assert_eq!(body["tags"], json!([]));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_retired_robot_is_renamed_loses_its_missions_and_gets_no_more() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let change = async |body: Value| {
        let request = yard
            .client()
            .patch(yard.url("/v1/sites/yard/robots/rover-1"));
        yard.send(request.json(&body)).await
    };
    let (status, body) = change(json!({"name": "Old one", "retired": true})).await;
    assert_eq!((status, &body["name"]), (StatusCode::OK, &json!("Old one")));
    let ended = yard
        .mission_becomes(mission.id, MissionState::Cancelled)
        .await;
    assert!(causes(&ended).contains(&Cause::RobotRetired));
    let (status, body) = yard.post("/v1/missions", &circle(&robot.id)).await;
    assert_eq!(
        (status, &body["type"]),
        (StatusCode::CONFLICT, &json!("/problems/robot-retired"))
    );
    let listed = async |query: &str| {
        let (_, page) = yard
            .get_value(&format!("/v1/sites/yard/robots{query}"))
            .await;
        page["items"].as_array().unwrap().len()
    };
    assert_eq!((listed("").await, listed("?retired=true").await), (0, 1));
    change(json!({"retired": false})).await;
    assert_eq!(listed("").await, 1);
    yard.server.stop().await.unwrap();
}
