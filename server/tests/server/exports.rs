//! Cells and measurements as lists for other programs, read back by other readers than what wrote
//! them.

use std::collections::BTreeMap;

use jiff::SignedDuration;
use parquet::file::reader::{FileReader as _, SerializedFileReader};
use parquet::record::{Field, Row};
use reqwest::{StatusCode, header};
use serde_json::{Value, json};
use tread_api::friction::{CellFriction, StoredSegment};
use tread_api::page::Page;
use tread_api::site::Site;

use crate::harness::{Yard, measured, segment};
use crate::robot::Robot;

const MAP: &str = "/v1/sites/yard/friction/map";
const SEGMENTS: &str = "/v1/sites/yard/segments";

/// Two robots on a lawn and beside it, one of them with every layer.
async fn driven_yard() -> Yard {
    let at = segment((0, 0), 0.2, 0).ended_at + SignedDuration::from_hours(3);
    let yard = Yard::start_at(at).await;
    let square = json!([{"x_m": -9, "y_m": -9}, {"x_m": 3, "y_m": -9}, {"x_m": 3, "y_m": 9},
                        {"x_m": -9, "y_m": 9}]);
    let body = json!({"id": "lawn", "class": "grass", "polygon": square});
    let (status, said) = yard.post("/v1/sites/yard/terrains", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    for (name, theta) in [("rover-1", 0.19), ("rover-2", 0.21)] {
        let robot = Robot::join(&yard, name).await;
        let drive = (0..6).map(|seq| {
            let ix = i32::try_from(seq).unwrap();
            let mut pass = segment((ix, -1), theta, 600);
            if ix >= 3 {
                pass.terrain = None;
                pass.mu_peak_lower_bound = None;
            }
            if ix == 2 {
                pass.theta_errors = Some(tread_api::friction::ThetaErrors {
                    independent_information: 2.5e4,
                    robot_ratio: 0.0625,
                    tyre_ratio: 0.25,
                });
            }
            if ix == 1 {
                let layer = tread_api::friction::Information {
                    information: 100.0,
                    weighted: 150.0,
                };
                pass.effective_track_ratio = Some(layer);
            }
            measured(seq, pass)
        });
        robot.upload(drive.collect()).await.unwrap();
    }
    yard
}

async fn fetched(yard: &Yard, path: &str) -> (header::HeaderMap, Vec<u8>) {
    let response = yard.client().get(yard.url(path)).send().await.unwrap();
    let (status, headers) = (response.status(), response.headers().clone());
    let bytes = response.bytes().await.unwrap().to_vec();
    let said = String::from_utf8_lossy(&bytes).into_owned();
    assert_eq!(status, StatusCode::OK, "{path}: {said}");
    (headers, bytes)
}

/// Rows of a CSV by the names of its columns.
fn comma_rows(bytes: &[u8]) -> Vec<BTreeMap<String, String>> {
    let mut reader = csv::Reader::from_reader(bytes);
    reader.deserialize().map(Result::unwrap).collect()
}

/// Rows of a Parquet file, by a reader that has seen nothing but the file.
fn parquet_rows(bytes: Vec<u8>) -> Vec<Row> {
    let reader = SerializedFileReader::new(axum::body::Bytes::from(bytes)).unwrap();
    reader
        .get_row_iter(None)
        .unwrap()
        .map(Result::unwrap)
        .collect()
}

fn field(row: &Row, name: &str) -> Field {
    let mut columns = row.get_column_iter();
    let found = columns.find(|(column, _)| *column == name);
    found
        .unwrap_or_else(|| panic!("no {name} in {row}"))
        .1
        .clone()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cells_are_the_same_as_json_csv_and_parquet() {
    let yard = driven_yard().await;
    let cells: Page<CellFriction> = yard.get("/v1/sites/yard/friction/cells").await;
    assert_eq!(cells.items.len(), 6);
    let (headers, bytes) = fetched(&yard, &format!("{MAP}?format=json")).await;
    assert_eq!(headers[header::CONTENT_TYPE], "application/json");
    let listed: Page<CellFriction> = serde_json::from_slice(&bytes).unwrap();
    assert_eq!(listed, cells);

    let (headers, bytes) = fetched(&yard, &format!("{MAP}?format=csv")).await;
    assert_eq!(headers[header::CONTENT_TYPE], "text/csv");
    let comma = comma_rows(&bytes);
    let (headers, bytes) = fetched(&yard, &format!("{MAP}?format=parquet")).await;
    assert_eq!(
        headers[header::CONTENT_TYPE],
        "application/vnd.apache.parquet"
    );
    let rows = parquet_rows(bytes);
    assert_eq!((comma.len(), rows.len()), (6, 6));
    for ((cell, comma), row) in cells.items.iter().zip(&comma).zip(&rows) {
        assert_eq!(comma["ix"], cell.cell.ix.to_string());
        assert_eq!(field(row, "ix"), Field::Long(cell.cell.ix.into()));
        let theta: f64 = comma["theta"].parse().unwrap();
        assert_eq!(theta.to_bits(), cell.friction.theta.to_bits(), "to the bit");
        assert_eq!(field(row, "theta"), Field::Double(cell.friction.theta));
        assert_eq!(comma["newest_at"], cell.friction.newest_at.to_string());
        let newest_us = cell.friction.newest_at.as_microsecond();
        assert_eq!(field(row, "newest_at"), Field::TimestampMicros(newest_us));
        let terrain = cell.terrain.as_ref().map(|terrain| terrain.id.to_string());
        assert_eq!(comma["terrain"], terrain.clone().unwrap_or_default());
        assert_eq!(
            field(row, "terrain"),
            terrain.map_or(Field::Null, Field::Str)
        );
        let peak = cell.friction.mu_peak_lower_bound;
        assert_eq!(
            field(row, "mu_peak_lower_bound"),
            peak.map_or(Field::Null, Field::Double)
        );
        let track = cell.friction.effective_track_ratio;
        assert_eq!(
            field(row, "effective_track_ratio"),
            track.map_or(Field::Null, |track| Field::Double(track.value))
        );
        assert_eq!(field(row, "disputed"), Field::Bool(cell.friction.disputed));
        assert_eq!(comma["segments"], "2");
    }
    let accepted = yard
        .client()
        .get(yard.url(MAP))
        .header(header::ACCEPT, "text/csv");
    let response = accepted.send().await.unwrap();
    assert_eq!(response.headers()[header::CONTENT_TYPE], "text/csv");
    let none = format!("{MAP}?format=parquet&x_min_m=500&y_min_m=500&x_max_m=600&y_max_m=600");
    assert!(parquet_rows(fetched(&yard, &none).await.1).is_empty());
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn measurements_are_the_same_as_json_csv_and_parquet() {
    let yard = driven_yard().await;
    let listed: Page<StoredSegment> = yard.get(SEGMENTS).await;
    assert_eq!(listed.items.len(), 12);
    let (_, bytes) = fetched(&yard, &format!("{SEGMENTS}?format=csv")).await;
    let comma = comma_rows(&bytes);
    let rows = parquet_rows(
        fetched(&yard, &format!("{SEGMENTS}?format=parquet"))
            .await
            .1,
    );
    assert_eq!((comma.len(), rows.len()), (12, 12));
    for ((stored, comma), row) in listed.items.iter().zip(&comma).zip(&rows) {
        assert_eq!(comma["id"], stored.id.to_string());
        assert_eq!(field(row, "robot"), Field::Str(stored.robot.to_string()));
        let weighted = stored.segment.theta.weighted;
        assert_eq!(field(row, "theta_weighted"), Field::Double(weighted));
        let weighted_theta: f64 = comma["theta_weighted"].parse().unwrap();
        assert_eq!(weighted_theta.to_bits(), weighted.to_bits());
        assert_eq!(comma["ended_at"], stored.segment.ended_at.to_string());
        let errors = stored.segment.theta_errors;
        let ratio = errors.map_or(Field::Null, |errors| Field::Double(errors.robot_ratio));
        assert_eq!(field(row, "theta_robot_error_ratio"), ratio);
        let ratio = errors.map(|errors| errors.tyre_ratio.to_string());
        assert_eq!(comma["theta_tyre_error_ratio"], ratio.unwrap_or_default());
        let independent = errors.map(|errors| errors.independent_information.to_string());
        let column = &comma["theta_independent_information"];
        assert_eq!(column, &independent.unwrap_or_default());
    }
    let of_one = format!("{SEGMENTS}?format=csv&robot=rover-2&terrain=lawn");
    let of_one = comma_rows(&fetched(&yard, &of_one).await.1);
    assert_eq!(of_one.len(), 3);
    assert!(of_one.iter().all(|row| row["robot"] == "rover-2"));
    let (status, said) = yard.get_value(&format!("{SEGMENTS}?format=png")).await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    assert_eq!(said["field"], "format", "{said}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn many_measurements_come_in_pieces_and_none_twice() {
    let yard =
        Yard::start_at(segment((0, 0), 0.2, 0).ended_at + SignedDuration::from_hours(1)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    // More than two pieces of 4 096.
    for batch in 0..19_u64 {
        let seqs = batch * 500..(batch + 1) * 500;
        let records = seqs.map(|seq| {
            let place = i32::try_from(seq).unwrap();
            measured(seq, segment((place % 100, place / 100), 0.2, 0))
        });
        robot.upload(records.collect()).await.unwrap();
    }
    let rows = parquet_rows(
        fetched(&yard, &format!("{SEGMENTS}?format=parquet"))
            .await
            .1,
    );
    let seqs: Vec<i64> = rows
        .iter()
        .map(|row| {
            let Field::Long(seq) = field(row, "seq") else {
                panic!("a number of another kind: {row}");
            };
            seq
        })
        .collect();
    assert_eq!(seqs, (0..9_500).collect::<Vec<i64>>());
    let cells = comma_rows(&fetched(&yard, &format!("{MAP}?format=csv")).await.1);
    assert_eq!(cells.len(), 9_500);
    let coarse = comma_rows(
        &fetched(&yard, &format!("{MAP}?format=csv&resolution_m=10"))
            .await
            .1,
    );
    let segments = coarse
        .iter()
        .map(|row| row["segments"].parse::<u64>().unwrap());
    assert_eq!((coarse.len(), segments.sum::<u64>()), (100, 9_500));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn geojson_is_in_degrees_where_the_site_is_tied_and_says_metres_where_it_is_not() {
    let yard = driven_yard().await;
    let features = async || -> Value {
        let (headers, bytes) = fetched(&yard, &format!("{MAP}?format=geojson")).await;
        assert_eq!(headers[header::CONTENT_TYPE], "application/geo+json");
        serde_json::from_slice(&bytes).unwrap()
    };
    let local = features().await;
    assert_eq!(local["type"], "FeatureCollection");
    assert!(local["tread:frame"].as_str().unwrap().contains("metres"));
    assert!(local["coordRefSys"].as_str().unwrap().contains("yard"));
    assert_eq!(local["features"].as_array().unwrap().len(), 6);
    let first = &local["features"][0];
    assert_eq!(
        first["geometry"],
        Value::Null,
        "nobody takes metres for degrees"
    );
    assert_eq!(first["place"]["coordinates"][0][2], json!([1.0, 0.0]));

    let origin = json!({"latitude_deg": 52.0, "longitude_deg": 4.0});
    let put = yard
        .client()
        .put(yard.url("/v1/sites/yard/origin"))
        .json(&origin);
    let (status, said) = yard.send(put).await;
    assert_eq!(status, StatusCode::OK, "{said}");
    let site: Site = yard.get("/v1/sites/yard").await;
    assert!((site.origin.unwrap().latitude_deg - 52.0).abs() < 1e-12);
    let tied = features().await;
    assert_eq!(tied["coordRefSys"], Value::Null);
    let cell = &tied["features"][5];
    assert_eq!(cell["properties"]["cell"], json!({"ix": 5, "iy": -1}));
    let ring = cell["geometry"]["coordinates"][0].as_array().unwrap();
    assert_eq!(ring.len(), 5);
    assert_eq!(ring[0], ring[4], "closed");
    // The corner at (6, 0): 68 677.7 m to a degree of longitude here.
    let (lon, lat) = (ring[2][0].as_f64().unwrap(), ring[2][1].as_f64().unwrap());
    assert!(((lon - 4.0) * 68_677.7 - 6.0).abs() < 1e-3, "{lon}");
    assert!((lat - 52.0).abs() < 1e-9, "{lat}");
    assert!((cell["properties"]["friction"]["theta"].as_f64().unwrap() - 0.2).abs() < 0.01);

    let wrong = json!({"latitude_deg": 91.0, "longitude_deg": 4.0});
    let put = yard
        .client()
        .put(yard.url("/v1/sites/yard/origin"))
        .json(&wrong);
    let (status, said) = yard.send(put).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
    let untied = yard.client().delete(yard.url("/v1/sites/yard/origin"));
    assert_eq!(yard.send(untied).await.0, StatusCode::OK);
    assert_eq!(features().await["features"][0]["geometry"], Value::Null);
    let (status, _) = yard
        .send(yard.client().delete(yard.url("/v1/sites/moon/origin")))
        .await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    yard.server.stop().await.unwrap();
}

/// All that the map and the measurements can be given as.
const REPRESENTATIONS: [&str; 12] = [
    "friction/map?format=png",
    "friction/map?format=tile",
    "friction/map?format=nav2",
    "friction/map?format=pgm",
    "friction/map?format=json",
    "friction/map?format=geojson",
    "friction/map?format=csv",
    "friction/map?format=parquet",
    "segments",
    "segments?format=csv",
    "segments?format=parquet",
    "withdrawals",
];

async fn tag_of(yard: &Yard, path: &str, held: Option<&str>) -> (StatusCode, String, usize) {
    let url = yard.url(&format!("/v1/sites/yard/{path}"));
    let mut request = yard.client().get(url);
    if let Some(held) = held {
        request = request.header(header::IF_NONE_MATCH, held);
    }
    let response = request.send().await.unwrap();
    let status = response.status();
    let tag = response.headers().get(header::ETAG);
    let tag = tag.unwrap_or_else(|| panic!("{path} has no ETag"));
    let tag = tag.to_str().unwrap().to_owned();
    (status, tag, response.bytes().await.unwrap().len())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_representation_has_a_tag_of_its_own_that_changes_when_its_content_does() {
    let yard = driven_yard().await;
    let mut tags = BTreeMap::new();
    for path in REPRESENTATIONS {
        let (status, tag, length) = tag_of(&yard, path, None).await;
        assert_eq!(status, StatusCode::OK, "{path}");
        assert!(length > 0, "{path}");
        let held = format!("\"of-another\", {tag}");
        let (status, again, length) = tag_of(&yard, path, Some(&held)).await;
        assert_eq!(status, StatusCode::NOT_MODIFIED, "{path}");
        assert_eq!((again, length), (tag.clone(), 0), "{path}");
        if let Some(other) = tags.insert(tag, path) {
            panic!("{path} and {other} have one tag");
        }
    }
    // Boxes and pages are representations too.
    for path in [
        "friction/map?format=csv&x_min_m=0&y_min_m=-9&x_max_m=2&y_max_m=9",
        "segments?format=csv&robot=rover-1",
        "segments?format=csv&terrain=lawn",
        "segments?format=csv&cursor=2",
    ] {
        let (_, tag, _) = tag_of(&yard, path, None).await;
        assert_eq!(tags.insert(tag, path), None, "{path}");
    }
    // One more measurement, and one that is taken off.
    let robot = Robot::join(&yard, "rover-3").await;
    robot
        .upload(vec![measured(0, segment((1, -1), 0.2, 700))])
        .await
        .unwrap();
    let path = "/v1/sites/yard/robots/rover-2/withdrawals";
    let (status, said) = yard.post(path, &json!({"reason": "worn tyres"})).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    for (tag, path) in &tags {
        // Speeds follow from the traction limit, which is the same as before; so is the mask's YAML.
        if ["robot=rover-1", "nav2", "pgm"]
            .iter()
            .any(|same| path.contains(same))
        {
            continue;
        }
        let (status, new, length) = tag_of(&yard, path, Some(tag)).await;
        assert_eq!(status, StatusCode::OK, "{path}");
        assert!(new != *tag && length > 0, "{path}");
    }
    let (status, ..) = {
        let tag = tags.iter().find(|(_, path)| path.contains("robot=rover-1"));
        tag_of(
            &yard,
            "segments?format=csv&robot=rover-1",
            tag.map(|(tag, _)| tag.as_str()),
        )
        .await
    };
    assert_eq!(
        status,
        StatusCode::NOT_MODIFIED,
        "nothing of this robot has changed"
    );
    // Ages are counted in whole minutes.
    let (_, before, _) = tag_of(&yard, "friction/map?format=csv", None).await;
    yard.server
        .app()
        .clock()
        .advance(std::time::Duration::from_mins(2));
    let (status, ..) = tag_of(&yard, "friction/map?format=csv", Some(&before)).await;
    assert_eq!(status, StatusCode::OK);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_export_says_as_of_when_it_is() {
    let yard = driven_yard().await;
    let measured_at = segment((0, 0), 0.2, 600).ended_at;
    for (asked, count) in [
        (measured_at, 0),
        (measured_at + SignedDuration::from_hours(1), 6),
    ] {
        let minute = asked.as_second().div_euclid(60) * 60;
        let effective = jiff::Timestamp::from_second(minute).unwrap().to_string();
        for format in ["json", "geojson", "csv", "parquet", "png", "tile"] {
            let path = format!("{MAP}?format={format}&as_of={asked}");
            let (headers, bytes) = fetched(&yard, &path).await;
            assert_eq!(headers["tread-as-of"], effective, "{format}");
            match format {
                "csv" => assert_eq!(comma_rows(&bytes).len(), count),
                "parquet" => assert_eq!(parquet_rows(bytes).len(), count),
                "json" => {
                    let listed: Value = serde_json::from_slice(&bytes).unwrap();
                    assert_eq!(listed["as_of"], effective);
                    assert_eq!(listed["items"].as_array().unwrap().len(), count);
                }
                "geojson" => {
                    let listed: Value = serde_json::from_slice(&bytes).unwrap();
                    assert_eq!(listed["tread:as_of"], effective);
                    assert_eq!(listed["features"].as_array().unwrap().len(), count);
                }
                _ => {}
            }
        }
    }
    let now: Value = yard.get(&format!("{MAP}?format=json")).await;
    assert!(now["as_of"].is_null(), "all that has come counts");
    yard.server.stop().await.unwrap();
}
