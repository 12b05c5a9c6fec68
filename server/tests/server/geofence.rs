//! Geofences and external limits: what is refused, and what reaches the robots.

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::geometry::Pose;
use tread_api::robot::Aged;
use tread_api::safety::{Geofence, LimitStatus};

use crate::harness::{Yard, circle, eventually};
use crate::robot::Robot;

const FENCE: &str = "/v1/sites/yard/geofence";

fn square(half_m: f64) -> Value {
    corners(
        &[(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
            .map(|(x, y)| (x * half_m, y * half_m)),
    )
}

fn corners(points: &[(f64, f64)]) -> Value {
    points
        .iter()
        .map(|&(x_m, y_m)| json!({"x_m": x_m, "y_m": y_m}))
        .collect()
}

impl Yard {
    async fn put(&self, path: &str, body: &Value) -> (StatusCode, Value) {
        self.send(self.client().put(self.url(path)).json(body))
            .await
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_geofence_reaches_the_robots_and_refuses_paths_that_leave_it_with_the_place() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let first: Geofence = yard.get(FENCE).await;
    assert_eq!((first.revision, first.is_empty()), (0, true));
    let (status, body) = yard.put(FENCE, &json!({"keep_in": [square(10.0)]})).await;
    assert_eq!(
        (status, body["revision"].as_u64()),
        (StatusCode::OK, Some(1)),
        "{body}"
    );
    eventually("the robot has it", async || {
        let sites = robot.sites();
        let has = sites.last().is_some_and(|site| site.geofence.revision == 1);
        if has { Ok(()) } else { Err(sites) }
    })
    .await;
    // It is not sent again and again.
    let count = robot.sites().len();

    let missions = "/v1/missions";
    let inside = circle(&robot.id);
    let (status, body) = yard.post(missions, &inside).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
    let mut outside = circle(&robot.id);
    outside["trajectory"]["circle"]["radius_m"] = json!(9.5);
    for path in [missions, "/v1/trajectories/check"] {
        let (status, body) = yard.post(path, &outside).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{path}: {body}");
        assert_eq!(body["type"], "/problems/crosses-geofence", "{path}: {body}");
        let point = &body["place"]["point"];
        let (x_m, y_m) = (
            point["x_m"].as_f64().unwrap(),
            point["y_m"].as_f64().unwrap(),
        );
        let border_m = 10.0 - x_m.abs().max(y_m.abs());
        assert!(border_m < 0.7, "{path}: {body}");
    }
    // A path between points that are all inside, with a wall in its middle.
    let wall = corners(&[(-0.05, -2.0), (0.05, -2.0), (0.05, 2.0), (-0.05, 2.0)]);
    let request = json!({"keep_in": [square(10.0)], "keep_out": [wall]});
    let (status, body) = yard.put(FENCE, &request).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let across = json!({"site": "yard", "robot": robot.id, "trajectory": {"waypoints": {
        "speed_m_s": 0.5, "points": [{"x_m": -5, "y_m": 0}, {"x_m": 5, "y_m": 0}]}}});
    let (status, body) = yard.post(missions, &across).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
    let x_m = body["place"]["point"]["x_m"].as_f64().unwrap();
    assert!((-0.8..-0.3).contains(&x_m), "{body}");
    // The mission itself is clear of the wall, but its robot comes from where its queue ends.
    let path = |from: f64, to: f64| {
        json!({"site": "yard", "robot": "rover-2", "trajectory": {"waypoints": {
            "speed_m_s": 0.5, "points": [{"x_m": from, "y_m": 0}, {"x_m": to, "y_m": 0}]}}})
    };
    let second = Robot::join(&yard, "rover-2").await;
    let (status, body) = yard.post(missions, &path(-8.0, -5.0)).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
    let mut beyond = path(3.0, 6.0);
    for path in [missions, "/v1/trajectories/check"] {
        let (status, body) = yard.post(path, &beyond).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{path}: {body}");
        assert_eq!(body["type"], "/problems/crosses-geofence", "{path}: {body}");
    }
    // In place of what is queued it begins where it says.
    beyond["start_policy"] = json!("replace");
    let (status, body) = yard.post(missions, &beyond).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
    drop(second);
    eventually("the robot has the wall", async || {
        let sites = robot.sites();
        if sites.len() == count + 1 {
            Ok(())
        } else {
            Err(sites.len())
        }
    })
    .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_geofence_that_crosses_itself_or_leaves_a_robot_outside_is_refused_by_name() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.say(|state| {
        let value = Pose {
            x_m: 30.0,
            y_m: 2.0,
            heading_rad: 0.0,
        };
        state.pose = Some(Aged { value, age_ms: 5 });
    });
    eventually("the robot's place is known", async || {
        let (_, body) = yard.get_value("/v1/sites/yard/robots/rover-1").await;
        if body["live"]["pose"].is_object() {
            Ok(())
        } else {
            Err(body)
        }
    })
    .await;
    let bow = corners(&[(0.0, 0.0), (4.0, 4.0), (4.0, 0.0), (0.0, 4.0)]);
    let (status, body) = yard.put(FENCE, &json!({"keep_in": [bow]})).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
    let detail = body["detail"].as_str().unwrap();
    assert!(
        detail.contains("corner 0 at (0.00 m, 0.00 m)")
            && detail.contains("corner 2 at (4.00 m, 0.00 m)"),
        "{body}"
    );
    let around = corners(&[(28.0, 0.0), (32.0, 0.0), (32.0, 4.0), (28.0, 4.0)]);
    for fence in [
        json!({"keep_in": [square(10.0)]}),
        json!({"keep_out": [around]}),
    ] {
        let (status, body) = yard.put(FENCE, &fence).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
        assert_eq!(body["type"], "/problems/robot-outside-geofence");
        assert!(
            body["detail"].as_str().unwrap().contains("rover-1"),
            "{body}"
        );
        assert_eq!(body["place"]["point"]["x_m"], 30.0);
    }
    // The robot's centre is inside, and a part of its body is not: it reaches 0.47 m around it.
    let tight = corners(&[(20.0, -10.0), (30.3, -10.0), (30.3, 10.0), (20.0, 10.0)]);
    let beside = corners(&[(30.3, -1.0), (31.0, -1.0), (31.0, 3.0), (30.3, 3.0)]);
    for (fence, polygon) in [
        (json!({"keep_in": [tight]}), "keep_in[0]"),
        (json!({"keep_out": [square(1.0), beside]}), "keep_out[1]"),
    ] {
        let (status, body) = yard.put(FENCE, &fence).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
        let detail = body["detail"].as_str().unwrap();
        for part in ["rover-1", "(30.00 m, 2.00 m)", polygon, "(30.30 m, 2.00 m)"] {
            assert!(detail.contains(part), "`{part}` is missing: {detail}");
        }
    }
    let many: Vec<Value> = (0..65).map(|_| square(50.0)).collect();
    let (status, body) = yard.put(FENCE, &json!({"keep_in": many})).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
    assert_eq!(yard.get::<Geofence>(FENCE).await.revision, 0);

    let put = |tag: &str| {
        let request = yard
            .client()
            .put(yard.url(FENCE))
            .header("if-match", tag.to_owned());
        request.json(&json!({"keep_in": [square(50.0)]}))
    };
    assert_eq!(yard.send(put("\"0\"")).await.0, StatusCode::OK);
    let (status, body) = yard.send(put("\"0\"")).await;
    assert_eq!(status, StatusCode::PRECONDITION_FAILED, "{body}");
    assert_eq!(yard.send(put("first")).await.0, StatusCode::BAD_REQUEST);
    let (status, body) = yard.send(put("W/\"1\"")).await;
    assert_eq!(status, StatusCode::PRECONDITION_FAILED, "{body}");
    for held in ["\"0\", \"1\"", "*"] {
        assert_eq!(yard.send(put(held)).await.0, StatusCode::OK, "{held}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_external_limit_reaches_the_robot_in_its_own_time_and_ends_there() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let path = "/v1/sites/yard/robots/rover-1/limits/lidar";
    eventually("the robot's clock is known", async || {
        let slow = json!({"linear_max_m_s": 0.2, "for_ms": 2_000});
        let (status, body) = yard.put(path, &slow).await;
        if status == StatusCode::NO_CONTENT {
            Ok(())
        } else {
            Err(body)
        }
    })
    .await;
    let (limit, now_us) = (
        robot.limits()[0].clone(),
        robot.state().monotonic_us.unwrap(),
    );
    assert_eq!(
        (limit.owner.as_str(), limit.boot, limit.hold),
        ("lidar", robot.boot, false)
    );
    assert!(
        limit.until_us.abs_diff(now_us + 2_000_000) < 500_000,
        "{limit:?} at {now_us}"
    );
    let hold = json!({"hold": true, "for_ms": 500});
    assert_eq!(yard.put(path, &hold).await.0, StatusCode::NO_CONTENT);
    let request = yard.client().delete(yard.url(path));
    assert_eq!(yard.send(request).await.0, StatusCode::NO_CONTENT);
    let limits = robot.limits();
    let seqs: Vec<u64> = limits.iter().map(|limit| limit.seq).collect();
    assert!(
        seqs.is_sorted_by(|before, after| before < after),
        "{seqs:?}"
    );
    assert_eq!(limits.last().unwrap().until_us, 0);
    for wrong in [
        json!({"for_ms": 0}),
        json!({"for_ms": 3_600_001}),
        json!({"linear_max_m_s": -0.1, "for_ms": 100}),
        json!({"hold": true}),
        json!({"hold": true, "for_ms": 100, "forever": true}),
    ] {
        let (status, body) = yard.put(path, &wrong).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{wrong}: {body}");
    }
    robot.say(|state| {
        state.safety.limits = vec![LimitStatus {
            owner: "lidar".parse().unwrap(),
            required: true,
            hold: true,
            linear_max_m_s: None,
            ends_in_ms: None,
        }];
    });
    eventually("the robot's limits are shown", async || {
        let (_, body) = yard.get_value("/v1/sites/yard/robots/rover-1/limits").await;
        if body["items"][0]["required"] == json!(true) {
            Ok(())
        } else {
            Err(body)
        }
    })
    .await;
    yard.server.stop().await.unwrap();
}
