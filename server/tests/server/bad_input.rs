//! What is wrong gets a clear answer, and changes nothing.

use reqwest::{Method, StatusCode, header};
use serde_json::{Value, json};

use crate::harness::{Yard, circle};
use crate::robot::Robot;

struct Case {
    what: &'static str,
    path: &'static str,
    body: Value,
    status: u16,
    kind: &'static str,
    says: &'static str,
}

fn waypoints(points: &Value) -> Value {
    json!({"site": "yard", "robot": "rover-1",
           "trajectory": {"waypoints": {"points": points, "speed_m_s": 0.5}}})
}

fn with(path: &[&str], value: Value) -> Value {
    let mut body = circle(&"rover-1".parse().unwrap());
    let mut place = &mut body;
    for name in path {
        place = &mut place[*name];
    }
    *place = value;
    body
}

fn terrain(corners: &[(f64, f64)]) -> Value {
    let corner = |&(x_m, y_m): &(f64, f64)| json!({"x_m": x_m, "y_m": y_m});
    let polygon: Vec<Value> = corners.iter().map(corner).collect();
    json!({"id": "lawn", "class": "grass", "polygon": polygon})
}

#[expect(clippy::too_many_lines, reason = "a list of cases")]
fn cases() -> Vec<Case> {
    let missions = "/v1/missions";
    let case = |what, body, status, kind, says| Case {
        what,
        path: missions,
        body,
        status,
        kind,
        says,
    };
    let many: Vec<Value> = (0..=100_000).map(|x| json!({"x_m": x, "y_m": 0})).collect();
    let same = json!([{"x_m": 1.0, "y_m": 1.0}, {"x_m": 1.0, "y_m": 1.0}]);
    let circle_field = |name, value| with(&["trajectory", "circle", name], value);
    let mut cases = vec![
        case(
            "radius 0",
            circle_field("radius_m", json!(0.0)),
            422,
            "invalid-body",
            "radius_m",
        ),
        case(
            "negative speed",
            circle_field("speed_m_s", json!(-1.0)),
            422,
            "invalid-body",
            "speed",
        ),
        case(
            "a single waypoint",
            waypoints(&json!([{"x_m": 1.0, "y_m": 1.0}])),
            422,
            "invalid-body",
            "2 to 100000",
        ),
        case(
            "100 001 waypoints",
            waypoints(&json!(many)),
            422,
            "invalid-body",
            "has 100001",
        ),
        case(
            "duplicate points",
            waypoints(&same),
            422,
            "invalid-body",
            "points[1] repeats",
        ),
        case(
            "beyond the robot's speed",
            circle_field("speed_m_s", json!(2.5)),
            422,
            "beyond-limits",
            "2.5 m/s",
        ),
        case(
            "beyond the robot's yaw rate",
            circle_field("radius_m", json!(0.3)),
            422,
            "beyond-limits",
            "yaw rate",
        ),
        case(
            "an unknown robot",
            with(&["robot"], json!("nobody")),
            404,
            "unknown-robot",
            "nobody",
        ),
        case(
            "an unknown site",
            with(&["site"], json!("nowhere")),
            404,
            "unknown-site",
            "nowhere",
        ),
        case(
            "no identifier",
            with(&["robot"], json!("Rover 1")),
            422,
            "invalid-body",
            "Rover 1",
        ),
        case(
            "an unknown field",
            with(&["speed"], json!(1)),
            422,
            "unknown-field",
            "speed",
        ),
        case(
            "an unknown field deep inside",
            circle_field("radius", json!(1)),
            422,
            "unknown-field",
            "trajectory.circle.radius",
        ),
        case(
            "a missing field",
            json!({"site": "yard"}),
            422,
            "invalid-body",
            "robot",
        ),
        case(
            "both speed and period",
            circle_field("period_s", json!(9.0)),
            422,
            "invalid-body",
            "either",
        ),
    ];
    let bow_tie = terrain(&[(0.0, 0.0), (2.0, 2.0), (2.0, 0.0), (0.0, 2.0)]);
    let two_corners = terrain(&[(0.0, 0.0), (2.0, 2.0)]);
    for (what, body, says) in [
        ("a bow tie", bow_tie, "crosses"),
        ("two corners", two_corners, "3 to 1000"),
    ] {
        let path = "/v1/sites/yard/terrains";
        cases.push(Case {
            what,
            path,
            body,
            status: 422,
            kind: "invalid-body",
            says,
        });
    }
    cases.push(Case {
        what: "a cell of no size",
        path: "/v1/sites",
        body: json!({"id": "field", "cell_m": 0.0}),
        status: 422,
        kind: "invalid-body",
        says: "cell_m",
    });
    cases
}

async fn nothing_changed(yard: &Yard) {
    let missions: Value = yard.get("/v1/missions").await;
    assert_eq!(missions["items"], json!([]));
    let terrains: Value = yard.get("/v1/sites/yard/terrains").await;
    assert_eq!(terrains["items"], json!([]));
    let sites: Value = yard.get("/v1/sites").await;
    assert_eq!(sites["items"].as_array().unwrap().len(), 1);
}

fn assert_problem(
    (status, body): (StatusCode, Value),
    expected: (u16, &str),
    says: &str,
    what: &str,
) {
    assert_eq!(status.as_u16(), expected.0, "{what}: {body}");
    assert_eq!(
        body["type"],
        format!("/problems/{}", expected.1),
        "{what}: {body}"
    );
    assert_eq!(body["status"], expected.0, "{what}: {body}");
    assert!(body.to_string().contains(says), "{what}: {body}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_impossible_request_is_a_clear_problem_and_changes_nothing() {
    let yard = Yard::start().await;
    let _robot = Robot::join(&yard, "rover-1").await;
    for Case {
        what,
        path,
        body,
        status,
        kind,
        says,
    } in cases()
    {
        assert_problem(yard.post(path, &body).await, (status, kind), says, what);
    }
    nothing_changed(&yard).await;
    yard.server.stop().await.unwrap();
}

/// Trajectories with one value at fault, the type of the problem, and the value's path.
fn faulty_trajectories() -> Vec<(Value, &'static str, &'static str)> {
    let robot = "rover-1".parse().unwrap();
    let of_circle = |name: &str, value: Value| {
        let mut body = circle(&robot);
        body["trajectory"]["circle"][name] = value;
        body
    };
    let by_period = |period_s: f64| {
        json!({"site": "yard", "robot": "rover-1", "trajectory": {"circle":
            {"center": {"x_m": 1.0, "y_m": 2.0}, "radius_m": 3.0, "period_s": period_s}}})
    };
    let from_origin = |point: Value| waypoints(&json!([{"x_m": 0.0, "y_m": 0.0}, point]));
    let approach = json!({"approach_speed_m_s": 40.0});
    let depth = json!({"excitation": {"depth_ratio": 0.9}});
    vec![
        (
            of_circle("radius_m", json!(0.01)),
            "invalid-body",
            "circle.radius_m",
        ),
        (of_circle("turns", json!(0)), "invalid-body", "circle.turns"),
        (
            of_circle("center", json!({"x_m": 2e6, "y_m": 0.0})),
            "invalid-body",
            "circle.center",
        ),
        (
            of_circle("speed_m_s", json!(-1.0)),
            "invalid-body",
            "circle.speed_m_s",
        ),
        (
            of_circle("options", depth),
            "invalid-body",
            "circle.options.excitation.depth_ratio",
        ),
        (
            from_origin(json!({"x_m": 0.0, "y_m": 0.0})),
            "invalid-body",
            "waypoints.points[1]",
        ),
        (
            of_circle("speed_m_s", json!(2.5)),
            "beyond-limits",
            "circle.speed_m_s",
        ),
        (by_period(1.0), "beyond-limits", "circle.period_s"),
        (
            of_circle("options", approach),
            "beyond-limits",
            "circle.options.approach_speed_m_s",
        ),
        (
            from_origin(json!({"x_m": 4.0, "y_m": 0.0, "speed_m_s": 40.0})),
            "beyond-limits",
            "waypoints.points[1].speed_m_s",
        ),
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_value_of_a_trajectory_that_is_at_fault_is_named_with_its_path() {
    let yard = Yard::start().await;
    let _robot = Robot::join(&yard, "rover-1").await;
    for (body, kind, value) in faulty_trajectories() {
        for path in ["/v1/missions", "/v1/trajectories/check"] {
            let answer = yard.post(path, &body).await;
            assert_eq!(answer.1["field"], format!("trajectory.{value}"), "{path}");
            assert_problem(answer, (422, kind), "", value);
        }
    }
    nothing_changed(&yard).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bodies_that_cannot_be_read_are_problems_too() {
    let yard = Yard::start().await;
    let send = async |path: &str, content_type: &str, body: Vec<u8>| {
        let request = yard.client().post(yard.url(path)).body(body);
        yard.send(request.header(header::CONTENT_TYPE, content_type))
            .await
    };
    let json_type = "application/json";
    for (what, text) in [
        (
            "NaN",
            r#"{"site":"yard","robot":"r","trajectory":{"circle":{"radius_m":NaN}}}"#,
        ),
        (
            "infinity",
            r#"{"site":"yard","robot":"r","trajectory":{"circle":{"radius_m":1e999}}}"#,
        ),
        ("no JSON", "site=yard"),
        ("nothing", ""),
        ("half", r#"{"site":"yard""#),
        ("more than one", "{} {}"),
    ] {
        let answer = send("/v1/missions", json_type, text.into()).await;
        assert!(answer.0.is_client_error(), "{what}: {answer:?}");
        let kind = answer.1["type"].as_str().unwrap();
        assert!(
            ["/problems/malformed-body", "/problems/invalid-body"].contains(&kind),
            "{what}"
        );
    }
    let text = circle(&"r".parse().unwrap()).to_string().into_bytes();
    let answer = send("/v1/missions", "text/plain", text).await;
    assert_problem(
        answer,
        (415, "unsupported-media-type"),
        "application/json",
        "wrong type",
    );
    let large = vec![b' '; 1024 * 1024 + 1];
    let answer = send("/v1/sites", json_type, large.clone()).await;
    assert_problem(answer, (413, "body-too-large"), "", "over 1 MiB");
    let answer = send("/v1/missions", json_type, large).await;
    assert_problem(
        answer,
        (400, "malformed-body"),
        "",
        "missions may be larger",
    );
    let answer = send("/v1/missions", json_type, vec![b' '; 16 * 1024 * 1024 + 1]).await;
    assert_problem(answer, (413, "body-too-large"), "", "over 16 MiB");
    nothing_changed(&yard).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn paths_queries_and_methods_are_checked() {
    let yard = Yard::start().await;
    for (path, status, kind) in [
        ("/nothing/here", 404, "not-found"),
        ("/v1/sites/Not%20One", 400, "invalid-path"),
        ("/v1/missions/17", 400, "invalid-path"),
        ("/v1/missions?limit=0", 400, "invalid-query"),
        ("/v1/missions?limit=1001", 400, "invalid-query"),
        ("/v1/missions?colour=red", 400, "invalid-query"),
        ("/v1/missions?state=sleeping", 400, "invalid-query"),
        ("/v1/missions?cursor=x", 400, "invalid-query"),
        (
            "/v1/sites/yard/friction/cells?x_min_m=NaN",
            400,
            "invalid-query",
        ),
        (
            "/v1/sites/yard/friction/cells?cursor=1",
            400,
            "invalid-query",
        ),
        ("/v1/sites/yard/segments?cursor=x", 400, "invalid-query"),
        ("/v1/sites/nowhere", 404, "unknown-site"),
        ("/v1/sites/nowhere/robots", 404, "unknown-site"),
        ("/v1/sites/yard/robots/nobody", 404, "unknown-robot"),
        ("/v1/sites/yard/terrains/none", 404, "unknown-terrain"),
        (
            "/v1/sites/yard/friction/terrains/none",
            404,
            "unknown-terrain",
        ),
        (
            "/v1/missions/0190163d-8694-739b-aea5-966c26f8ad91",
            404,
            "unknown-mission",
        ),
    ] {
        assert_problem(yard.get_value(path).await, (status, kind), "", path);
    }
    let request = yard
        .client()
        .request(Method::PATCH, yard.url("/v1/missions"));
    assert_problem(
        yard.send(request).await,
        (405, "method-not-allowed"),
        "",
        "PATCH",
    );
    let response = yard
        .client()
        .get(yard.url("/nothing"))
        .send()
        .await
        .unwrap();
    assert_eq!(
        response.headers()[header::CONTENT_TYPE],
        "application/problem+json"
    );
    assert!(response.headers().contains_key("x-request-id"));
    yard.server.stop().await.unwrap();
}
