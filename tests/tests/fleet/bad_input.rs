//! Bad requests get a clear problem and change nothing.

use reqwest::Method;
use serde_json::{Value, json};
use tread_api::problem::ProblemType;
use tread_tests::light_robot::LightRobot;

use crate::fleet;

fn mission(trajectory: &Value) -> Value {
    json!({"site": "yard", "robot": "talker", "trajectory": trajectory})
}

fn circle(radius_m: f64, speed_m_s: f64) -> Value {
    json!({"circle": {"center": {"x_m": 0.0, "y_m": 0.0}, "radius_m": radius_m,
                      "speed_m_s": speed_m_s}})
}

fn waypoints(points: &[(f64, f64)]) -> Value {
    let points: Vec<_> = points
        .iter()
        .map(|(x_m, y_m)| json!({"x_m": x_m, "y_m": y_m}))
        .collect();
    json!({"waypoints": {"points": points, "speed_m_s": 0.5}})
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn impossible_missions_are_refused_and_leave_no_trace() {
    let fleet = fleet().await;
    let robot = "talker".parse().unwrap();
    let _robot = LightRobot::start(&fleet.zenoh_endpoint(), &fleet.site(), robot)
        .await
        .unwrap();
    let too_many: Vec<_> = (0..=100_000).map(|index| (f64::from(index), 0.0)).collect();
    let mut unknown_field = mission(&circle(2.0, 0.5));
    unknown_field["trajectory"]["circle"]["colour"] = json!("red");
    let mut other_robot = mission(&circle(2.0, 0.5));
    other_robot["robot"] = json!("nobody");
    let mut other_site = mission(&circle(2.0, 0.5));
    other_site["site"] = json!("nowhere");
    let cases = [
        (
            mission(&circle(0.0, 0.5)),
            ProblemType::InvalidBody,
            "radius_m",
        ),
        (
            mission(&circle(-1.0, 0.5)),
            ProblemType::InvalidBody,
            "radius_m",
        ),
        (
            mission(&waypoints(&[(0.0, 0.0)])),
            ProblemType::InvalidBody,
            "2 to 100000",
        ),
        (
            mission(&waypoints(&too_many)),
            ProblemType::InvalidBody,
            "100001",
        ),
        (
            mission(&waypoints(&[(0.0, 0.0), (0.0, 0.0)])),
            ProblemType::InvalidBody,
            "repeats",
        ),
        (mission(&circle(2.0, 40.0)), ProblemType::BeyondLimits, "40"),
        (other_robot, ProblemType::UnknownRobot, "nobody"),
        (other_site, ProblemType::UnknownSite, "nowhere"),
        (unknown_field, ProblemType::UnknownField, "colour"),
    ];
    for (body, kind, word) in cases {
        let problem = fleet.rest.post_refused("/v1/missions", &body, kind).await;
        assert!(
            problem.to_string().contains(word),
            "`{word}` is not in {problem}"
        );
    }
    for text in ["NaN", "Infinity", "1e999"] {
        let body = mission(&circle(2.0, 0.5)).to_string().replace("2.0", text);
        let (status, problem) = fleet.rest.post_text("/v1/missions", &body).await;
        assert!(status.is_client_error(), "{text}: {status} {problem}");
    }
    let missions: Vec<Value> = fleet.rest.all("/v1/missions?site=yard").await;
    assert!(missions.is_empty(), "{missions:#?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_that_make_no_sense_are_refused_by_kind() {
    let fleet = fleet().await;
    let bow_tie = json!({"id": "bow-tie", "class": "grass", "polygon": [
        {"x_m": 0.0, "y_m": 0.0}, {"x_m": 2.0, "y_m": 2.0},
        {"x_m": 2.0, "y_m": 0.0}, {"x_m": 0.0, "y_m": 2.0},
    ]});
    let problem = fleet
        .rest
        .post_refused(
            "/v1/sites/yard/terrains",
            &bow_tie,
            ProblemType::InvalidBody,
        )
        .await;
    assert!(problem.to_string().contains("crosses"), "{problem}");
    let again = json!({"id": "yard"});
    fleet
        .rest
        .post_refused("/v1/sites", &again, ProblemType::AlreadyExists)
        .await;

    let (status, problem) = fleet.rest.post_text("/v1/missions", "{\"site\":").await;
    assert_eq!(
        (status.as_u16(), &problem["type"]),
        (400, &json!(ProblemType::MalformedBody))
    );
    let large = format!("\"{}\"", "a".repeat(20 * 1024 * 1024));
    let (status, problem) = fleet.rest.post_text("/v1/missions", &large).await;
    assert_eq!(
        (status.as_u16(), &problem["type"]),
        (413, &json!(ProblemType::BodyTooLarge))
    );
    let (status, problem) = fleet.rest.post_without_type("/v1/missions", "{}").await;
    let unsupported = json!(ProblemType::UnsupportedMediaType);
    assert_eq!((status.as_u16(), &problem["type"]), (415, &unsupported));

    for (method, path, status, kind) in [
        (Method::GET, "/v1/nothing", 404, ProblemType::NotFound),
        (
            Method::DELETE,
            "/v1/missions",
            405,
            ProblemType::MethodNotAllowed,
        ),
        (
            Method::GET,
            "/v1/missions/not-a-uuid",
            400,
            ProblemType::InvalidPath,
        ),
        (
            Method::GET,
            "/v1/missions?limit=0",
            400,
            ProblemType::InvalidQuery,
        ),
        (
            Method::GET,
            "/v1/missions?state=lost",
            400,
            ProblemType::InvalidQuery,
        ),
        (
            Method::GET,
            "/v1/sites/nowhere",
            404,
            ProblemType::UnknownSite,
        ),
        (
            Method::GET,
            "/v1/sites/yard/terrains/nothing",
            404,
            ProblemType::UnknownTerrain,
        ),
    ] {
        let (seen, problem) = fleet.rest.call(method.clone(), path, None).await.unwrap();
        assert_eq!(seen.as_u16(), status, "{method} {path}: {problem}");
        assert_eq!(problem["type"], json!(kind), "{method} {path}: {problem}");
    }
}
