//! Sites, terrains and robots over REST.

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::robot::LinkState;

use crate::harness::{Yard, eventually};
use crate::robot::Robot;

fn square(id: &str, class: &str) -> Value {
    json!({"id": id, "class": class, "polygon": [
        {"x_m": 0.0, "y_m": 0.0}, {"x_m": 9.0, "y_m": 0.0}, {"x_m": 9.0, "y_m": 9.0}]})
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_terrain_that_is_drawn_again_under_an_old_name_counts_on() {
    let yard = Yard::start().await;
    let (status, body) = yard
        .post("/v1/sites/yard/terrains", &square("lawn", "grass"))
        .await;
    assert_eq!(
        (status, &body["revision"]),
        (StatusCode::CREATED, &json!(1)),
        "{body}"
    );
    let (status, body) = yard
        .post("/v1/sites/yard/terrains", &square("lawn", "mud"))
        .await;
    assert_eq!(
        (status, &body["type"]),
        (StatusCode::CONFLICT, &json!("/problems/already-exists"))
    );

    let url = yard.url("/v1/sites/yard/terrains/lawn");
    let mut replacement = square("lawn", "gravel");
    replacement.as_object_mut().unwrap().remove("id");
    let (status, body) = yard.send(yard.client().put(&url).json(&replacement)).await;
    assert_eq!(
        (status, &body["revision"]),
        (StatusCode::OK, &json!(2)),
        "{body}"
    );
    let (status, _) = yard.send(yard.client().delete(&url)).await;
    assert_eq!(status, StatusCode::NO_CONTENT);
    let (status, _) = yard.send(yard.client().delete(&url)).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    let (_, body) = yard
        .post("/v1/sites/yard/terrains", &square("lawn", "grass"))
        .await;
    assert_eq!(body["revision"], 3);
    let site: Value = yard.get("/v1/sites/yard").await;
    assert_eq!(site["terrain_revision"], 4);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lists_come_in_pages_without_gaps_or_repetitions() {
    let yard = Yard::start().await;
    for number in 0..5 {
        let body = square(&format!("terrain-{number}"), "sand");
        assert_eq!(
            yard.post("/v1/sites/yard/terrains", &body).await.0,
            StatusCode::CREATED
        );
    }
    let mut names = Vec::new();
    let mut path = "/v1/sites/yard/terrains?limit=2".to_owned();
    loop {
        let page: Value = yard.get(&path).await;
        let items = page["items"].as_array().unwrap();
        assert!(items.len() <= 2);
        names.extend(
            items
                .iter()
                .map(|item| item["id"].as_str().unwrap().to_owned()),
        );
        let Some(cursor) = page["next_cursor"].as_str() else {
            break;
        };
        path = format!("/v1/sites/yard/terrains?limit=2&cursor={cursor}");
    }
    assert_eq!(
        names,
        [
            "terrain-0",
            "terrain-1",
            "terrain-2",
            "terrain-3",
            "terrain-4"
        ]
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_terrain_that_is_saved_unchanged_keeps_its_revision() {
    let yard = Yard::start().await;
    let polygon = json!([{"x_m": 0, "y_m": 0}, {"x_m": 9, "y_m": 0}, {"x_m": 9, "y_m": 9}]);
    let lawn = json!({"id": "lawn", "name": "Lawn", "class": "grass", "polygon": polygon});
    let (status, made) = yard.post("/v1/sites/yard/terrains", &lawn).await;
    assert_eq!(status, StatusCode::CREATED, "{made}");
    let replace = async |body: Value| {
        let request = yard.client().put(yard.url("/v1/sites/yard/terrains/lawn"));
        let (status, terrain) = yard.send(request.json(&body)).await;
        assert_eq!(status, StatusCode::OK, "{terrain}");
        terrain
    };
    let same = json!({"name": "Lawn", "class": "grass", "polygon": polygon, "layer": 0});
    assert_eq!(replace(same).await, made);
    let higher = json!({"name": "Lawn", "class": "grass", "polygon": polygon, "layer": 1});
    assert_eq!(replace(higher).await["revision"], 2);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_terrain_that_changed_meanwhile_is_neither_replaced_nor_deleted() {
    let yard = Yard::start().await;
    let polygon = json!([{"x_m": 0, "y_m": 0}, {"x_m": 9, "y_m": 0}, {"x_m": 0, "y_m": 9}]);
    let body = json!({"id": "lawn", "class": "grass", "polygon": polygon});
    let request = yard.client().post(yard.url("/v1/sites/yard/terrains"));
    let created = request.json(&body).send().await.unwrap();
    assert_eq!(created.status(), StatusCode::CREATED);
    let tag = created.headers()[reqwest::header::ETAG]
        .to_str()
        .unwrap()
        .to_owned();
    assert_eq!(tag, "\"1\"");

    let path = "/v1/sites/yard/terrains/lawn";
    let put = |class: &str, tag: &str| {
        let request = yard
            .client()
            .put(yard.url(path))
            .header("if-match", tag.to_owned());
        request.json(&json!({"class": class, "polygon": polygon}))
    };
    assert_eq!(yard.send(put("gravel", &tag)).await.0, StatusCode::OK);
    let (status, said) = yard.send(put("ice", &tag)).await;
    assert_eq!(status, StatusCode::PRECONDITION_FAILED, "{said}");
    assert!(
        said["detail"].as_str().unwrap().contains("terrain"),
        "{said}"
    );
    let delete = |tag: &str| {
        let request = yard.client().delete(yard.url(path));
        request.header("if-match", tag.to_owned())
    };
    let (status, said) = yard.send(delete(&tag)).await;
    assert_eq!(status, StatusCode::PRECONDITION_FAILED, "{said}");
    let present = yard.client().get(yard.url(path)).send().await.unwrap();
    let tag = present.headers()[reqwest::header::ETAG]
        .to_str()
        .unwrap()
        .to_owned();
    assert_eq!(tag, "\"2\"");
    assert_eq!(present.json::<Value>().await.unwrap()["class"], "gravel");
    // A weak tag matches nothing, and of a list one is enough.
    for held in ["W/\"2\"", "\"1\", W/\"2\"", "\"of-another\""] {
        let (status, said) = yard.send(put("ice", held)).await;
        assert_eq!(status, StatusCode::PRECONDITION_FAILED, "{held}: {said}");
        assert_eq!(yard.send(delete(held)).await.0, status, "{held}");
    }
    assert_eq!(yard.send(put("ice", "2")).await.0, StatusCode::BAD_REQUEST);
    let of_list = put("ice", "\"1\", \"2\"");
    assert_eq!(yard.send(of_list).await.0, StatusCode::OK);
    let (status, terrain) = yard.send(put("sand", "*")).await;
    assert_eq!((status, &terrain["revision"]), (StatusCode::OK, &json!(4)));
    let tag = "\"4\"".to_owned();
    assert_eq!(yard.send(delete(&tag)).await.0, StatusCode::NO_CONTENT);
    assert_eq!(yard.send(put("ice", "*")).await.0, StatusCode::NOT_FOUND);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_shows_with_its_link_and_a_new_terrain_reaches_it() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let shown = async || {
        yard.get::<tread_api::robot::Robot>("/v1/sites/yard/robots/rover-1")
            .await
    };
    let online = eventually("the robot is online", async || {
        let robot = shown().await;
        if robot.link == LinkState::Online && robot.live.is_some() {
            Ok(robot)
        } else {
            Err(robot)
        }
    })
    .await;
    let live = online.live.unwrap();
    assert_eq!(live.boot, robot.boot);
    assert!(live.state_age_ms <= 1_500, "{live:?}");

    yard.post("/v1/sites/yard/terrains", &square("lawn", "grass"))
        .await;
    eventually("the robot holds the terrain", async || {
        let sites = robot.sites();
        match sites.last() {
            Some(site) if site.terrain_revision == 1 && site.terrains.len() == 1 => Ok(()),
            _ => Err(sites),
        }
    })
    .await;
    drop(robot);
    eventually("the robot is offline", async || {
        let link = shown().await.link;
        if link == LinkState::Offline {
            Ok(())
        } else {
            Err(link)
        }
    })
    .await;
    let all: Value = yard.get("/v1/sites/yard/robots").await;
    assert_eq!(
        all["items"].as_array().unwrap().len(),
        1,
        "it is still known"
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn health_and_readiness_are_reported() {
    let yard = Yard::start().await;
    assert_eq!(yard.get::<Value>("/healthz").await["status"], "ok");
    assert_eq!(yard.get::<Value>("/readyz").await["status"], "ok");
    let status: Value = yard.get("/v1/server").await;
    assert!(
        status["database"]["version"]
            .as_str()
            .unwrap()
            .starts_with("3."),
        "{status}"
    );
    yard.server.stop().await.unwrap();
}
