//! The map as of a time in the past: what counts, down to the minute, and what the answers state.

use jiff::{SignedDuration, Timestamp};
use reqwest::StatusCode;
use serde_json::json;
use tread_api::friction::{
    CellDifference, CellFriction, PointFriction, PointHistory, Segment, TerrainHistory,
};
use tread_api::page::{DifferencePage, MapPage};
use tread_api::tile::Tile;
use tread_server::config::RetentionConfig;

use crate::friction::numbered;
use crate::harness::{Yard, measured, segment};
use crate::robot::Robot;

const BASE: &str = "/v1/sites/yard/friction";
/// Number of passes of the drive.
const PASSES: i64 = 24;

fn begin() -> Timestamp {
    segment((0, 0), 0.2, 0).ended_at
}

fn after_min(minutes: i64) -> Timestamp {
    begin() + SignedDuration::from_mins(minutes)
}

/// One pass through another cell each ten minutes, over four hours.
fn drive() -> Vec<Segment> {
    (0..PASSES)
        .map(|number| segment((i32::try_from(number).unwrap(), 0), 0.2, 600 * number))
        .collect()
}

async fn draw_lawn(yard: &Yard) {
    let square = json!([{"x_m": -9, "y_m": -9}, {"x_m": 30, "y_m": -9}, {"x_m": 30, "y_m": 9},
                        {"x_m": -9, "y_m": 9}]);
    let body = json!({"id": "lawn", "class": "grass", "polygon": square});
    let (status, said) = yard.post("/v1/sites/yard/terrains", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
}

/// A yard with that drive, whose clock stands so long after its begin.
async fn driven(after: SignedDuration) -> (Yard, Robot) {
    let yard = Yard::start_at(begin() + after).await;
    draw_lawn(&yard).await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.upload(numbered(drive())).await.unwrap();
    (yard, robot)
}

/// Asks as of a time, and holds what counts against what was measured by the time that is stated.
async fn stated_as_of(yard: &Yard, asked: Timestamp) -> Timestamp {
    let said: MapPage<CellFriction> = yard.get(&format!("{BASE}/cells?as_of={asked}")).await;
    let as_of = said.as_of.unwrap();
    assert!(as_of <= asked, "{as_of} {asked}");
    let newest = said.items.iter().map(|item| item.friction.newest_at).max();
    assert!(
        newest.is_none_or(|newest| newest <= as_of),
        "{newest:?} {as_of}"
    );
    let counted: u64 = said.items.iter().map(|item| item.friction.segments).sum();
    let measured = drive().iter().filter(|pass| pass.ended_at < as_of).count();
    assert_eq!(counted, u64::try_from(measured).unwrap(), "as of {as_of}");
    let x_m = f64::from(u32::try_from(measured).unwrap()) + 0.5;
    let point: PointFriction = yard
        .get(&format!("{BASE}/point?x_m={x_m}&y_m=0.5&as_of={asked}"))
        .await;
    assert_eq!(point.as_of, Some(as_of));
    let is_unknown = point.models.iter().all(|model| model.friction.is_none());
    assert!(is_unknown, "the next cell as of {as_of}: {point:?}");
    let picture = yard
        .client()
        .get(yard.url(&format!("{BASE}/map?format=tile&as_of={asked}")));
    let answer = picture.send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    assert_eq!(answer.headers()["tread-as-of"], as_of.to_string());
    let tile = Tile::decode(&answer.bytes().await.unwrap()).unwrap();
    let squares = tile.squares.iter().flatten();
    let drawn: u64 = squares.map(|square| u64::from(square.segments)).sum();
    assert_eq!(drawn, counted, "the picture as of {as_of}");
    as_of
}

async fn known_by_the_minute(yard: &Yard, minutes: &[i64]) {
    for &minutes in minutes {
        let asked = after_min(minutes);
        let as_of = stated_as_of(yard, asked).await;
        assert!(asked.duration_since(as_of) < SignedDuration::from_mins(1));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_map_is_known_by_the_minute_and_nothing_later_counts() {
    let (yard, _robot) = driven(SignedDuration::from_hours(5)).await;
    known_by_the_minute(&yard, &[1, 15, 29, 61, 100, 180, 233]).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pages_as_of_a_time_have_only_cells_that_were_measured_by_then() {
    let yard = Yard::start_at(begin() + SignedDuration::from_hours(5)).await;
    draw_lawn(&yard).await;
    let robot = Robot::join(&yard, "rover-1").await;
    // The cells that come first in the list were measured last.
    let back = (0..PASSES).map(|number| {
        let ix = i32::try_from(PASSES - 1 - number).unwrap();
        segment((ix, 0), 0.2, 600 * number)
    });
    robot.upload(numbered(back)).await.unwrap();
    let page = async |query: &str| -> (Vec<i32>, Option<String>) {
        let page: MapPage<CellFriction> = yard.get(&format!("{BASE}/cells?{query}")).await;
        let cells = page.items.iter().map(|item| item.cell.ix);
        (cells.collect(), page.next_cursor)
    };
    let as_of = after_min(45);
    for limit in [1, 2, 5, 100] {
        let query = format!("as_of={as_of}&limit={limit}");
        let mut all = Vec::new();
        let mut cursor: Option<String> = None;
        loop {
            let at = cursor.map(|cursor| format!("&cursor={cursor}"));
            let (cells, next) = page(&format!("{query}{}", at.unwrap_or_default())).await;
            assert!(!cells.is_empty() && cells.len() <= limit, "{cells:?}");
            all.extend(cells);
            cursor = next;
            if cursor.is_none() {
                break;
            }
        }
        assert_eq!(all, [19, 20, 21, 22, 23], "pages of {limit}");
    }
    // A cursor is a place: a list as of another time goes on there.
    let (cells, cursor) = page("limit=10").await;
    assert_eq!(cells, (0..10).collect::<Vec<i32>>());
    let query = format!("as_of={as_of}&limit=2&cursor={}", cursor.unwrap());
    let (cells, cursor) = page(&query).await;
    assert_eq!((cells, cursor.as_deref()), (vec![19, 20], Some("20,0")));
    let (cells, cursor) = page(&format!("as_of={}", after_min(0))).await;
    assert_eq!((cells, cursor), (Vec::new(), None));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn days_of_merged_hours_are_divided_too() {
    let (yard, _robot) = driven(SignedDuration::from_hours(24 * 10)).await;
    yard.server.app().move_horizons().await.unwrap();
    // They are merged: one hour alone can no longer be withdrawn.
    let body = json!({"from": after_min(60), "to": after_min(90), "reason": "a wheel was loose"});
    let path = "/v1/sites/yard/robots/rover-1/withdrawals";
    let (status, said) = yard.post(path, &body).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
    assert!(
        said["detail"].as_str().unwrap().contains("merged"),
        "{said}"
    );
    known_by_the_minute(&yard, &[60, 180, 1_800, 3_600]).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn epochs_count_when_they_are_over_where_raw_measurements_were_removed() {
    let (yard, _robot) = driven(SignedDuration::from_hours(24 * 10)).await;
    let app = yard.server.app();
    app.move_horizons().await.unwrap();
    let few = RetentionConfig {
        segments_days: 90,
        segments_max: 20,
        archive: None,
    };
    assert_eq!(app.remove_some(&few, 1_000).await.unwrap(), 4);
    for hours in [1, 3] {
        let as_of = stated_as_of(&yard, after_min(60 * hours)).await;
        assert_eq!(as_of.as_second() % 86_400, 0, "{as_of}");
    }
    // A day in which nothing was measured needs none.
    known_by_the_minute(&yard, &[1_800]).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_comes_late_and_what_is_withdrawn_changes_what_was_known_within_the_hour() {
    let (yard, robot) = driven(SignedDuration::from_hours(5)).await;
    let segments = async || {
        let path = format!("{BASE}/cells?as_of={}", after_min(45));
        let said: MapPage<CellFriction> = yard.get(&path).await;
        let minute = after_min(45).as_second().div_euclid(60) * 60;
        assert_eq!(said.as_of.unwrap().as_second(), minute);
        let segments = said.items.iter().map(|item| item.friction.segments);
        segments.sum::<u64>()
    };
    assert_eq!(segments().await, 5);
    let late = |seq: u64, minute: i64| measured(seq, segment((0, 0), 0.2, 60 * minute));
    robot
        .upload(vec![late(90, 30), late(91, 50)])
        .await
        .unwrap();
    assert_eq!(segments().await, 6);
    let two = Robot::join(&yard, "rover-2").await;
    two.upload(vec![late(0, 31), late(1, 32)]).await.unwrap();
    assert_eq!(segments().await, 8);
    let path = "/v1/sites/yard/robots/rover-1/withdrawals";
    let body = json!({"from": after_min(30), "reason": "a wheel was loose"});
    let (status, said) = yard.post(path, &body).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    // What it measured before that hour stays, and what the other one measured.
    let before = drive()
        .iter()
        .filter(|pass| pass.ended_at < after_min(26))
        .count();
    assert_eq!(segments().await, u64::try_from(before).unwrap() + 2);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn histories_by_the_minute_say_what_the_map_said_at_each_time() {
    let yard = Yard::start_at(after_min(180)).await;
    draw_lawn(&yard).await;
    for (name, theta, every_s) in [("rover-1", 0.19, 400), ("rover-2", 0.21, 700)] {
        let robot = Robot::join(&yard, name).await;
        let drive = (0..12).map(|number| segment((0, 0), theta, every_s * number));
        robot.upload(numbered(drive)).await.unwrap();
    }
    let times = format!("from={}&to={}&step_s=300", after_min(0), after_min(150));
    let path = format!("{BASE}/terrains/lawn/history?{times}");
    let terrain: TerrainHistory = yard.get(&path).await;
    let path = format!("{BASE}/point/history?x_m=0.5&y_m=0.5&{times}");
    let point: PointHistory = yard.get(&path).await;
    assert_eq!((point.cell.ix, point.cell.iy), (0, 0));
    assert_eq!(point.terrain.unwrap().id.as_str(), "lawn");
    assert_eq!(point.items.len(), 31);
    let mut counts = Vec::new();
    for (of_point, of_terrain) in point.items.iter().zip(&terrain.items) {
        assert_eq!(
            (of_point.at, of_point.as_of),
            (of_terrain.at, of_terrain.as_of)
        );
        let at = of_point.at;
        assert!(at.duration_since(of_point.as_of) < SignedDuration::from_mins(1));
        let path = format!("{BASE}/point?x_m=0.5&y_m=0.5&as_of={at}");
        let then: PointFriction = yard.get(&path).await;
        assert_eq!(then.models, of_point.models, "{at}");
        let segments = |models: &[tread_api::friction::ModelFriction]| {
            let known = models.iter().filter_map(|model| model.friction);
            known.map(|known| known.segments).sum::<u64>()
        };
        assert_eq!(segments(&of_terrain.models), segments(&of_point.models));
        counts.push(segments(&of_point.models));
    }
    assert!(counts.is_sorted() && counts[0] == 0, "{counts:?}");
    assert_eq!(counts.last(), Some(&24));
    let distinct: std::collections::BTreeSet<u64> = counts.iter().copied().collect();
    assert!(distinct.len() > 15, "{counts:?}");
    // The newest of a history to the present has all that has come.
    let path = format!("{BASE}/point/history?x_m=0.5&y_m=0.5&from={}", after_min(0));
    let to_now: PointHistory = yard.get(&path).await;
    let newest = to_now.items.last().unwrap();
    assert_eq!(newest.at, newest.as_of);
    for (path, what) in [
        (
            format!("{BASE}/point/history?x_m=1&y_m=1e9&{times}"),
            "on the map",
        ),
        (
            format!("{BASE}/point/history?x_m=1&y_m=1&{times}&step_s=59"),
            "step_s",
        ),
        (
            format!("{BASE}/point/history?x_m=1&y_m=1&from=2020-01-01T00:00:00Z"),
            "at most 1000",
        ),
    ] {
        let answer = yard.client().get(yard.url(&path)).send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::BAD_REQUEST, "{path}");
        let said = answer.text().await.unwrap();
        assert!(said.contains(what), "{path}: {said}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_times_of_one_hour_are_compared() {
    let yard = Yard::start_at(after_min(180)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let drive = (0..20).map(|number| {
        let theta = if number < 10 { 0.2 } else { 0.6 };
        segment((0, 0), theta, 1_600 + 60 * number)
    });
    robot.upload(numbered(drive)).await.unwrap();
    let middle = segment((0, 0), 0.2, 1_600 + 60 * 10).ended_at;
    let end = segment((0, 0), 0.2, 1_600 + 60 * 21).ended_at;
    let path = format!("{BASE}/difference?from={middle}&to={end}");
    let said: DifferencePage<CellDifference> = yard.get(&path).await;
    assert!(said.from.unwrap() < said.as_of.unwrap());
    let [item] = said.items.as_slice() else {
        panic!("{said:?}");
    };
    let (before, after) = (item.before.unwrap(), item.after.unwrap());
    assert!((before.theta - 0.2).abs() < 0.02, "{item:?}");
    assert!((after.theta - 0.6).abs() < 0.06, "{item:?}");
    yard.server.stop().await.unwrap();
}
