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
