//! What a trajectory would ask of a robot, computed before anything moves.

use std::f64::consts::PI;

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::geometry::Pose;
use tread_api::robot::Aged;
use uuid::Uuid;

use crate::harness::{Yard, circle, eventually};
use crate::robot::Robot;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dry_run_tells_duration_and_limits_and_refuses_the_impossible_with_its_place() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut body = circle(&robot.id);
    let (status, easy) = yard.post("/v1/trajectories/check", &body).await;
    assert_eq!(status, StatusCode::OK, "{easy}");
    let length_m = easy["length_m"].as_f64().unwrap();
    assert!((length_m - 18.85).abs() < 0.05, "{easy}");
    assert!(easy["duration_s"].as_f64().unwrap() > length_m / 0.6);
    // 2 m/s on a radius of 1.5 m asks for 2.7 m/s² across the path, and the robot has 1.
    body["trajectory"]["circle"]["radius_m"] = json!(1.5);
    body["trajectory"]["circle"]["speed_m_s"] = json!(2.0);
    let (status, hard) = yard.post("/v1/trajectories/check", &body).await;
    assert_eq!(status, StatusCode::OK, "{hard}");
    let binds = hard["bindings"].as_array().unwrap();
    assert!(
        binds
            .iter()
            .any(|binding| binding["limit"] == "lateral_acceleration"),
        "{hard}"
    );
    assert!(hard["lateral_acceleration_peak_m_s2"].as_f64().unwrap() < 1.01);
    let point = |x_m: f64, y_m: f64| json!({"x_m": x_m, "y_m": y_m});
    let mut points = vec![point(0.0, 0.0), point(1.0, 0.0), point(2.0, 0.0)];
    points[2]["speed_m_s"] = json!(40.0);
    body["trajectory"] = json!({"waypoints": {"speed_m_s": 0.5, "points": points}});
    let (status, refused) = yard.post("/v1/trajectories/check", &body).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{refused}");
    assert_eq!(refused["place"]["waypoint"], 2, "{refused}");
    assert_eq!(refused["type"], "/problems/beyond-limits", "{refused}");
    assert!(robot.offers().is_empty(), "nothing moves");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_turn_that_is_too_sharp_has_a_type_of_its_own_and_the_waypoint_before_it() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let refused = async |body: &Value| {
        let (status, refused) = yard.post("/v1/trajectories/check", body).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{refused}");
        assert_eq!(refused["type"], "/problems/turn-too-sharp", "{refused}");
        assert!(refused["field"].is_null(), "{refused}");
        refused
    };
    // On a line the path would have to turn back to arrive with the heading of its last point.
    let points = json!([{"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0},
        {"x_m": 4.0, "y_m": 0.0, "heading_rad": 0.0}, {"x_m": 8.0, "y_m": 0.0, "heading_rad": PI}]);
    let mut body = circle(&robot.id);
    body["trajectory"] = json!({"waypoints": {"speed_m_s": 0.5, "points": points}});
    body["start"] = json!({"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0});
    let place = refused(&body).await["place"].clone();
    assert_eq!(place["waypoint"], 1, "{place}");
    assert_eq!(place["point"], json!({"x_m": 4.0, "y_m": 0.0}), "{place}");
    // No approach can join a circle as small as this one, and no waypoint is at fault.
    let mut body = circle(&robot.id);
    body["trajectory"]["circle"]["radius_m"] = json!(0.05);
    body["start"] = json!({"x_m": 2.0, "y_m": 2.0, "heading_rad": 0.0});
    let said = refused(&body).await;
    assert!(said["place"].is_null(), "{said}");
    yard.server.stop().await.unwrap();
}

/// The points of a planned path, and how far each is from the one before at the most.
fn points(path: &Value) -> Vec<(f64, f64)> {
    let number = |point: &Value, name: &str| point[name].as_f64().unwrap();
    let points = path["points"].as_array().unwrap().iter();
    let points: Vec<(f64, f64)> = points
        .map(|point| (number(point, "x_m"), number(point, "y_m")))
        .collect();
    let step_m = path["step_m"].as_f64().unwrap();
    for pair in points.windows(2) {
        let apart_m = (pair[1].0 - pair[0].0).hypot(pair[1].1 - pair[0].1);
        assert!(
            apart_m <= step_m + 1e-9,
            "{apart_m} m in a step of {step_m} m"
        );
    }
    assert!((2..=1_000).contains(&points.len()));
    points
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_planned_path_is_given_by_a_dry_run_and_of_a_mission_and_is_bounded() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut body = circle(&robot.id);
    body["trajectory"]["circle"]["turns"] = json!(900.0);
    let (_, checked) = yard.post("/v1/trajectories/check", &body).await;
    let round = points(&checked["path"]);
    let centre = &body["trajectory"]["circle"]["center"];
    let centre = (
        centre["x_m"].as_f64().unwrap(),
        centre["y_m"].as_f64().unwrap(),
    );
    let radius_m = body["trajectory"]["circle"]["radius_m"].as_f64().unwrap();
    let last = round.last().unwrap();
    let off_m = (last.0 - centre.0).hypot(last.1 - centre.1) - radius_m;
    assert!(off_m.abs() < 1e-6, "{off_m}");
    // Waypoints are passed on a smooth path, not on the straight lines between them.
    let corners =
        json!([{"x_m": 0.0, "y_m": 0.0}, {"x_m": 6.0, "y_m": 0.0}, {"x_m": 6.0, "y_m": 6.0}]);
    body["trajectory"] = json!({"waypoints": {"points": corners, "speed_m_s": 0.5}});
    let (status, mission) = yard.post("/v1/missions", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{mission}");
    let id = mission["id"].as_str().unwrap();
    let (status, path) = yard.get_value(&format!("/v1/missions/{id}/path")).await;
    assert_eq!(status, StatusCode::OK, "{path}");
    let smooth = points(&path);
    assert_eq!(smooth[0], (0.0, 0.0));
    let end = smooth.last().unwrap();
    assert!((end.0 - 6.0).hypot(end.1 - 6.0) < 1e-6, "{end:?}");
    let near = |x_m: f64, y_m: f64| {
        let distances = smooth
            .iter()
            .map(|point| (point.0 - x_m).hypot(point.1 - y_m));
        distances.fold(f64::INFINITY, f64::min)
    };
    assert!(near(6.0, 0.0) < 0.1, "it passes the corner");
    assert!(near(3.0, 0.0) > 0.1, "it swings out before");
    let nobody = "0192f0c1-2b3c-7d4e-8f50-617283940a1b";
    let (status, _) = yard.get_value(&format!("/v1/missions/{nobody}/path")).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dry_run_tells_how_well_friction_would_be_measured() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut body = circle(&robot.id);
    let check = async |body: &Value| yard.post("/v1/trajectories/check", body).await;
    let (_, steady) = check(&body).await;
    assert_eq!(steady["measurement"]["theta_assumed"], 0.2, "{steady}");
    let none = &steady["measurement"]["relative_std_dev"];
    assert!(
        none.is_null(),
        "a steady circle tells a base without torque nothing: {steady}"
    );
    let points = json!([{"x_m": 0.0, "y_m": 0.0}, {"x_m": 20.0, "y_m": 0.0}]);
    body["trajectory"] = json!({"waypoints": {"points": points, "speed_m_s": 0.6,
        "options": {"excitation": {"depth_ratio": 0.5}}}});
    body["theta"] = json!(0.5);
    let (_, excited) = check(&body).await;
    assert_eq!(excited["measurement"]["theta_assumed"], 0.5, "{excited}");
    let relative_std_dev = excited["measurement"]["relative_std_dev"].as_f64();
    assert!(
        relative_std_dev.is_some_and(|relative_std_dev| (0.001..0.3).contains(&relative_std_dev)),
        "{excited}"
    );
    let depth = excited["excitation_depth_ratio"].as_f64().unwrap();
    assert!(depth > 0.05 && depth <= 0.5, "{excited}");
    let longer = |checked: &Value| checked["duration_s"].as_f64().unwrap();
    assert!(longer(&excited) > longer(&steady), "{excited}");
    body["theta"] = json!(-1.0);
    let (status, refused) = check(&body).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{refused}");
    assert_eq!(refused["field"], "theta", "{refused}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dry_run_plans_from_the_end_of_what_is_driven_before() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.say(|state| {
        let value = Pose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.0,
        };
        state.pose = Some(Aged { value, age_ms: 0 });
    });
    eventually("the server knows where the robot is", async || {
        let (_, shown) = yard.get_value("/v1/sites/yard/robots/rover-1").await;
        let pose = shown["live"]["pose"].clone();
        if pose.is_object() { Ok(()) } else { Err(shown) }
    })
    .await;
    let line = |from: (f64, f64), to: (f64, f64)| {
        let points = json!([{"x_m": from.0, "y_m": from.1}, {"x_m": to.0, "y_m": to.1}]);
        json!({"site": "yard", "robot": "rover-1",
               "trajectory": {"waypoints": {"speed_m_s": 0.5, "points": points}}})
    };
    let check = async |body: &Value| {
        let (status, said) = yard.post("/v1/trajectories/check", body).await;
        assert_eq!(status, StatusCode::OK, "{said}");
        said
    };
    let near = |said: &Value, x_m: f64, y_m: f64| {
        let place = |name: &str| said["start"][name].as_f64().unwrap();
        let off_m = (place("x_m") - x_m).hypot(place("y_m") - y_m);
        assert!(off_m < 1e-3, "{said}");
    };
    let wanted = line((0.0, 1.0), (5.0, 1.0));
    let idle = check(&wanted).await;
    assert_eq!(idle["start_source"], "robot");
    near(&idle, 0.0, 0.0);
    // One is driven to x 10, one waits that comes back to x 4, and one of low priority goes off.
    let send = async |mut body: Value, priority: i32| {
        body["priority"] = json!(priority);
        let (status, mission) = yard.post("/v1/missions", &body).await;
        assert_eq!(status, StatusCode::CREATED, "{mission}");
        mission["id"].clone()
    };
    let driven = send(line((0.0, 0.0), (10.0, 0.0)), 0).await;
    eventually("the robot drives it", async || {
        let (_, mission) = yard
            .get_value(&format!("/v1/missions/{}", driven.as_str().unwrap()))
            .await;
        if mission["state"] == "active" {
            Ok(())
        } else {
            Err(mission)
        }
    })
    .await;
    let after = check(&wanted).await;
    assert_eq!(
        (&after["start_source"], &after["after_mission"]),
        (&json!("mission"), &driven)
    );
    near(&after, 10.0, 0.0);
    assert!(
        after["length_m"].as_f64() > idle["length_m"].as_f64(),
        "{after}"
    );
    let back = send(line((10.0, 0.0), (4.0, -3.0)), 5).await;
    let low = send(line((4.0, -3.0), (40.0, -3.0)), -5).await;
    let queued = check(&wanted).await;
    assert_eq!(queued["after_mission"], back);
    near(&queued, 4.0, -3.0);
    let mut body = wanted.clone();
    body["priority"] = json!(-5);
    assert_eq!(check(&body).await["after_mission"], low);
    body["priority"] = json!(9);
    assert_eq!(check(&body).await["after_mission"], driven);
    body["start_policy"] = json!("replace");
    let replacing = check(&body).await;
    assert_eq!(replacing["start_source"], "robot");
    near(&replacing, 0.0, 0.0);
    let mut body = wanted.clone();
    body["replaces"] = back.clone();
    assert_eq!(check(&body).await["after_mission"], driven);
    body["replaces"] = json!(Uuid::new_v4());
    let (status, said) = yard.post("/v1/trajectories/check", &body).await;
    assert_eq!(status, StatusCode::NOT_FOUND, "{said}");
    let mut body = wanted.clone();
    body["start"] = json!({"x_m": 1.0, "y_m": 1.0, "heading_rad": 0.0});
    assert_eq!(check(&body).await["start_source"], "request");
    // The path that is held against the geofence is the one from there: from where the robot is, it
    // would be clear.
    let fence = json!({"keep_in": [], "keep_out": [[{"x_m": 1.0, "y_m": -2.4}, {"x_m": 3.4, "y_m": -2.4},
        {"x_m": 3.4, "y_m": -0.9}, {"x_m": 1.0, "y_m": -0.9}]]});
    let path = yard.url("/v1/sites/yard/geofence");
    let (status, said) = yard.send(yard.client().put(path).json(&fence)).await;
    assert_eq!(status, StatusCode::OK, "{said}");
    let (status, said) = yard.post("/v1/trajectories/check", &wanted).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
    assert_eq!(said["type"], "/problems/crosses-geofence", "{said}");
    let mut body = wanted.clone();
    body["start_policy"] = json!("replace");
    assert_eq!(check(&body).await["start_source"], "robot");
    yard.server.stop().await.unwrap();
}
