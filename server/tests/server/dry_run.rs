//! What a trajectory would ask of a robot, told before anything moves.

use reqwest::StatusCode;
use serde_json::{Value, json};

use crate::harness::{Yard, circle};
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
    assert!(robot.offers().is_empty(), "nothing moves");
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
    let none = &steady["measurement"]["relative_sd"];
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
    let relative_sd = excited["measurement"]["relative_sd"].as_f64();
    assert!(
        relative_sd.is_some_and(|relative_sd| (0.001..0.3).contains(&relative_sd)),
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
