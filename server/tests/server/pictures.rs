//! The map in the formats of other programs, read back by other readers than what wrote it.

use jiff::SignedDuration;
use reqwest::{StatusCode, header};
use serde_json::json;
use tread_api::friction::{CellFriction, Segment};
use tread_api::page::Page;
use tread_api::tile::Tile;
use tread_api::wire::ingest::Record;
use tread_control::robot::GRAVITY_M_S2;

use crate::harness::{Yard, measured, model, segment};
use crate::robot::Robot;

const MAP: &str = "/v1/sites/yard/friction/map";

fn records(segments: impl IntoIterator<Item = Segment>) -> Vec<Record> {
    let numbered = (0..).zip(segments);
    numbered
        .map(|(seq, segment)| measured(seq, segment))
        .collect()
}

fn off_terrain(cell: (i32, i32), theta: f64, hour: i64) -> Segment {
    let mut segment = segment(cell, theta, hour * 3_600);
    segment.terrain = None;
    segment
}

/// A site on which nothing is drawn, driven in an L: six cells to the east, three to the north.
async fn driven_yard() -> (Yard, Robot) {
    let at = segment((0, 0), 0.2, 0).ended_at + SignedDuration::from_hours(3);
    let yard = Yard::start_at(at).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let east = (-2..4).map(|ix| off_terrain((ix, 0), 0.1 + 0.05 * f64::from(ix + 2), 0));
    let north = (1..4).map(|iy| off_terrain((-2, iy), 1.5, 1));
    robot.upload(records(east.chain(north))).await.unwrap();
    (yard, robot)
}

async fn fetched(yard: &Yard, query: &str) -> (reqwest::header::HeaderMap, Vec<u8>) {
    let response = yard.client().get(yard.url(&format!("{MAP}?{query}")));
    let response = response.send().await.unwrap();
    let (status, headers) = (response.status(), response.headers().clone());
    let bytes = response.bytes().await.unwrap().to_vec();
    let said = String::from_utf8_lossy(&bytes).into_owned();
    assert_eq!(status, StatusCode::OK, "{query}: {said}");
    (headers, bytes)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_tile_says_what_the_cells_say() {
    let (yard, _robot) = driven_yard().await;
    let (headers, bytes) = fetched(&yard, "format=tile").await;
    assert_eq!(headers[header::CONTENT_TYPE], tread_api::tile::MEDIA_TYPE);
    let tile = Tile::decode(&bytes).unwrap();
    assert_eq!(
        (tile.columns, tile.rows),
        (6, 4),
        "no wider than was driven"
    );
    assert_eq!((tile.first.ix, tile.first.iy), (-2, 0));
    assert_eq!(tile.configuration, Some(model().configuration()));
    let said = headers["tread-configuration"].to_str().unwrap().to_owned();
    assert_eq!(said, model().configuration().to_string());
    assert_eq!(headers["tread-as-of"], "2026-10-26T10:33:00Z");

    let cells: Page<CellFriction> = yard.get("/v1/sites/yard/friction/cells").await;
    let known = tile
        .squares
        .iter()
        .filter(|square| square.is_some())
        .count();
    assert_eq!((known, cells.items.len()), (9, 9));
    for CellFriction { cell, friction, .. } in cells.items {
        let place = (cell.iy - tile.first.iy) * 6 + cell.ix - tile.first.ix;
        let square = tile.squares[usize::try_from(place).unwrap()].unwrap();
        assert!(
            (square.theta / friction.theta - 1.0).abs() < 2e-4,
            "{cell:?}"
        );
        let std_dev = square.std_dev / friction.std_dev;
        assert!((1.0 - 1e-6..1.06).contains(&std_dev), "{cell:?}: {std_dev}");
        assert_eq!(u64::from(square.segments), friction.segments, "{cell:?}");
    }
    // A box is what it says, known or not.
    let (_, bytes) = fetched(
        &yard,
        "format=tile&x_min_m=-2&y_min_m=-3&x_max_m=0.5&y_max_m=0.5",
    )
    .await;
    let tile = Tile::decode(&bytes).unwrap();
    assert_eq!((tile.columns, tile.rows), (3, 4));
    assert!(tile.squares[..9].iter().all(Option::is_none));
    assert!(tile.squares[9..].iter().all(Option::is_some));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_picture_follows_each_change_and_is_kept_until_then() {
    let (yard, robot) = driven_yard().await;
    let tile = async || Tile::decode(&fetched(&yard, "format=tile").await.1).unwrap();
    let first = tile().await;
    assert_eq!(tile().await, first);
    let late = off_terrain((0, 0), 0.2, 2);
    robot.upload(vec![measured(90, late)]).await.unwrap();
    let second = tile().await;
    let changed = first.squares.iter().zip(&second.squares);
    let changed: Vec<usize> = changed
        .enumerate()
        .filter(|(_, (before, after))| before != after)
        .map(|(place, _)| place)
        .collect();
    assert_eq!(changed, [2], "one cell was driven again");
    assert_eq!(second.squares[2].unwrap().segments, 2);

    // A terrain that is drawn makes new ground of what lies on it: nobody has measured that.
    let square = json!([{"x_m": 0, "y_m": -1}, {"x_m": 2, "y_m": -1}, {"x_m": 2, "y_m": 1},
                        {"x_m": 0, "y_m": 1}]);
    let body = json!({"id": "slab", "class": "concrete", "polygon": square});
    let (status, said) = yard.post("/v1/sites/yard/terrains", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    let third = tile().await;
    assert_eq!(third.squares[1].map(|known| known.segments), Some(1));
    assert_eq!((third.squares[2], third.squares[3]), (None, None));
    // Time alone makes an estimate less sure.
    yard.server
        .app()
        .clock()
        .advance(std::time::Duration::from_hours(20));
    let fourth = tile().await;
    assert!(fourth.squares[1].unwrap().std_dev > third.squares[1].unwrap().std_dev);
    // As it was known when the first hour was over and the others were not.
    let then = segment((0, 0), 0.2, 3_600).ended_at;
    let (_, bytes) = fetched(&yard, &format!("format=tile&as_of={then}")).await;
    let early = Tile::decode(&bytes).unwrap();
    assert_eq!(early.squares.iter().flatten().count(), 4);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn squares_of_several_cells_are_fused_as_one_ground() {
    let (yard, _robot) = driven_yard().await;
    let (_, bytes) = fetched(&yard, "format=tile&resolution_m=2").await;
    let tile = Tile::decode(&bytes).unwrap();
    assert_eq!((tile.columns, tile.rows), (3, 2));
    let coarse: Page<CellFriction> = yard
        .get("/v1/sites/yard/friction/cells?resolution_m=2&x_min_m=-9&y_min_m=-9&x_max_m=9&y_max_m=9")
        .await;
    for CellFriction { cell, friction, .. } in coarse.items {
        let place = (cell.iy - tile.first.iy) * 3 + cell.ix - tile.first.ix;
        let square = tile.squares[usize::try_from(place).unwrap()].unwrap();
        assert!(
            (square.theta / friction.theta - 1.0).abs() < 2e-4,
            "{cell:?}"
        );
        assert_eq!(u64::from(square.segments), friction.segments);
    }
    yard.server.stop().await.unwrap();
}

/// Width, height and pixels of four channels.
fn pixels(bytes: &[u8]) -> (usize, usize, Vec<u8>, Vec<(String, String)>) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes))
        .read_info()
        .unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let frame = reader.next_frame(&mut pixels).unwrap();
    assert_eq!(frame.color_type, png::ColorType::Rgba);
    let said = reader.info().utf8_text.iter();
    let said = said.map(|chunk| (chunk.keyword.clone(), chunk.get_text().unwrap()));
    let (width, height) = (frame.width as usize, frame.height as usize);
    (width, height, pixels, said.collect())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_png_has_a_colour_for_what_is_known_nothing_elsewhere_and_a_legend() {
    let (yard, _robot) = driven_yard().await;
    let (headers, bytes) = fetched(&yard, "format=png&scale=10").await;
    assert_eq!(headers[header::CONTENT_TYPE], "image/png");
    let (width, height, pixels, said) = pixels(&bytes);
    assert!(width >= 60 && height > 40, "{width} x {height}");
    let at =
        |x: usize, y: usize| -> [u8; 4] { pixels[4 * (y * width + x)..][..4].try_into().unwrap() };
    // The highest row is up: three cells of soft ground lie above the first of the lowest row.
    let (soft, firm, unknown) = (at(5, 5), at(5, 35), at(15, 5));
    assert_eq!((soft[3], firm[3], unknown[3]), (255, 255, 0));
    assert!(
        soft[0] > 150 && soft[0] > soft[2],
        "soft is yellow: {soft:?}"
    );
    assert!(firm[2] > firm[0], "firm is blue: {firm:?}");
    let legend = (40..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let colours: std::collections::BTreeSet<[u8; 4]> = legend.map(|(x, y)| at(x, y)).collect();
    assert!(colours.len() > 100, "{} colours", colours.len());
    assert!(
        said.contains(&("tread:site".to_owned(), "yard".to_owned())),
        "{said:?}"
    );

    let accepted = yard
        .client()
        .get(yard.url(MAP))
        .header(header::ACCEPT, "image/png");
    let response = accepted.send().await.unwrap();
    assert_eq!(response.headers()[header::CONTENT_TYPE], "image/png");
    let tag = response.headers()[header::ETAG].clone();
    let held = yard.client().get(yard.url(&format!("{MAP}?format=png")));
    let held = held
        .header(header::IF_NONE_MATCH, tag)
        .send()
        .await
        .unwrap();
    assert_eq!(held.status(), StatusCode::NOT_MODIFIED);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_map_that_nobody_has_driven_is_a_legend() {
    let yard = Yard::start().await;
    let (_, bytes) = fetched(&yard, "format=png").await;
    assert!(pixels(&bytes).0 > 100);
    let (_, bytes) = fetched(&yard, "format=tile").await;
    let tile = Tile::decode(&bytes).unwrap();
    assert_eq!((tile.columns, tile.rows, tile.configuration), (0, 0, None));
    yard.server.stop().await.unwrap();
}

/// Width, height and grey values of a binary PGM, from the highest row down.
fn greys(bytes: &[u8]) -> (usize, usize, Vec<u8>) {
    let mut words = Vec::new();
    let mut at = 0;
    while words.len() < 4 {
        let line = bytes[at..].iter().position(|byte| *byte == b'\n').unwrap();
        let text = std::str::from_utf8(&bytes[at..at + line]).unwrap();
        let text = text.split('#').next().unwrap();
        words.extend(text.split_whitespace().map(str::to_owned));
        at += line + 1;
    }
    assert_eq!((words[0].as_str(), words[3].as_str()), ("P5", "255"));
    (
        words[1].parse().unwrap(),
        words[2].parse().unwrap(),
        bytes[at..].to_vec(),
    )
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_speed_mask_is_slower_where_the_ground_gives_less() {
    let (yard, _robot) = driven_yard().await;
    let query = "speed_max_m_s=4&stopping_m=1";
    let (headers, bytes) = fetched(&yard, &format!("format=nav2&{query}")).await;
    assert_eq!(headers[header::CONTENT_TYPE], "application/yaml");
    let yaml = String::from_utf8(bytes).unwrap();
    let value = |key: &str| {
        let line = yaml
            .lines()
            .find_map(|line| line.strip_prefix(&format!("{key}: ")));
        line.unwrap_or_else(|| panic!("no {key} in {yaml}"))
            .to_owned()
    };
    assert_eq!(value("mode"), "scale");
    assert_eq!(value("resolution"), "1");
    assert_eq!(value("origin"), "[-2, 0, 0.0]");
    assert_eq!(value("image"), "speed.pgm");
    assert!(yaml.contains("multiplier 0.04"), "{yaml}");

    let (_, bytes) = fetched(&yard, &format!("format=pgm&{query}")).await;
    let (width, height, greys) = greys(&bytes);
    assert_eq!((width, height, greys.len()), (6, 4, 24));
    // As the map server reads it, and the filter after it.
    let speed_m_s = |grey: u8| ((255.0 - f64::from(grey)) / 255.0 * 100.0).round() * 0.04;
    let speeds: Vec<f64> = greys.iter().map(|&grey| speed_m_s(grey)).collect();
    let (soft, unknown, firm) = (speeds[0], speeds[1], speeds[18]);
    let stops_from = |mu: f64| (2.0 * 0.58 * mu * GRAVITY_M_S2).sqrt();
    assert!(
        (firm - stops_from(0.4)).abs() < 0.05,
        "shown of late: {firm}"
    );
    assert!(
        (unknown - stops_from(0.14)).abs() < 0.05,
        "cautious: {unknown}"
    );
    assert!(soft < unknown && soft > 0.0, "at the lower bound: {soft}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bad_question_for_a_picture_is_refused_with_the_bound_that_it_breaks() {
    let (yard, _robot) = driven_yard().await;
    for (query, field, said_of) in [
        ("format=gif", "format", "`png`"),
        (
            "format=png&x_min_m=5&x_max_m=1",
            "x_max_m",
            "is above the upper one",
        ),
        ("format=tile&y_min_m=NaN&y_max_m=1", "y_max_m", "1000000"),
        ("format=tile&x_max_m=inf", "x_max_m", "1000000"),
        (
            "format=tile&x_min_m=0&y_min_m=0&x_max_m=2000&y_max_m=2000",
            "resolution_m",
            "1048576",
        ),
        (
            "format=tile&resolution_m=1.5",
            "resolution_m",
            "whole multiple",
        ),
        ("format=png&scale=0", "scale", "1 to 32"),
        ("format=png&scale=33", "scale", "1 to 32"),
        (
            "format=png&scale=32&x_min_m=0&y_min_m=0&x_max_m=999&y_max_m=999",
            "scale",
            "16777216",
        ),
        ("format=nav2&speed_max_m_s=0", "speed_max_m_s", "0.01"),
        ("format=pgm&stopping_m=NaN", "stopping_m", "0.01"),
        ("format=tile&as_of=2100-01-01T00:00:00Z", "as_of", "future"),
        ("format=tile&normalisation=all", "normalisation", "declared"),
    ] {
        let (status, said) = yard.get_value(&format!("{MAP}?{query}")).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{query}: {said}");
        assert_eq!(said["field"], field, "{query}: {said}");
        let detail = said["detail"].as_str().unwrap();
        assert!(detail.contains(said_of), "{query}: {said}");
    }
    let asked = yard
        .client()
        .get(yard.url(MAP))
        .header(header::ACCEPT, "image/gif");
    assert_eq!(
        asked.send().await.unwrap().status(),
        StatusCode::NOT_ACCEPTABLE
    );
    let (status, _) = yard
        .get_value("/v1/sites/moon/friction/map?format=png")
        .await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    yard.server.stop().await.unwrap();
}
