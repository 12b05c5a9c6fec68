//! Questions about the map, and what a bad question gets.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use jiff::{SignedDuration, Timestamp};
use reqwest::{StatusCode, header};
use serde_json::{Value, json};
use tread_api::friction::{
    CellDifference, CellFriction, Information, PathFriction, PointFriction, ROBOT_BIAS_RATIO,
    RobotContribution, Segment, TerrainFriction, TerrainHistory, VisitSuggestion,
};
use tread_api::ids::ConfigurationId;
use tread_api::page::{DifferencePage, MapPage, Page};
use tread_api::tile::Tile;
use tread_api::wire::ingest::Record;
use tread_control::robot::GRAVITY_M_S2;
use tread_server::friction::index::Normalisation;
use uuid::Uuid;

use crate::harness::{Yard, eventually, measured, model, segment};
use crate::robot::Robot;

const BASE: &str = "/v1/sites/yard/friction";

fn begin() -> Timestamp {
    segment((0, 0), 0.2, 0).ended_at
}

/// A time so many hours after the first measurement.
fn after_h(hours: i64) -> Timestamp {
    begin() + SignedDuration::from_hours(hours)
}

fn close(left: f64, right: f64) -> bool {
    (left - right).abs() < 1e-9
}

fn rectangle(x_m: RangeInclusive<f64>) -> Value {
    let (x_min_m, x_max_m) = x_m.into_inner();
    json!([{"x_m": x_min_m, "y_m": -5.0}, {"x_m": x_max_m, "y_m": -5.0},
           {"x_m": x_max_m, "y_m": 5.0}, {"x_m": x_min_m, "y_m": 5.0}])
}

async fn draw(yard: &Yard, id: &str, class: &str, x_m: RangeInclusive<f64>) {
    let body = json!({"id": id, "class": class, "polygon": rectangle(x_m)});
    let (status, body) = yard.post("/v1/sites/yard/terrains", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
}

fn on(terrain: &str, cell: (i32, i32), theta: f64, hour: i64) -> Segment {
    let mut segment = segment(cell, theta, hour * 3_600);
    if let Some(named) = segment.terrain.as_mut() {
        named.id = terrain.parse().unwrap();
    }
    segment
}

pub(crate) fn numbered(segments: impl IntoIterator<Item = Segment>) -> Vec<Record> {
    let numbered = (0..).zip(segments);
    numbered
        .map(|(seq, segment)| measured(seq, segment))
        .collect()
}

/// A yard whose clock stands ten hours after its first measurement: a lawn driven by two robots, a
/// road beside it driven by one, a meadow that nobody has driven.
async fn measured_yard() -> Yard {
    let yard = Yard::start_at(after_h(10)).await;
    draw(&yard, "lawn", "grass", 0.0..=10.5).await;
    draw(&yard, "road", "asphalt", 10.5..=20.0).await;
    draw(&yard, "meadow", "grass", 30.0..=40.0).await;
    let lawn = |theta: f64| (0..11).map(move |ix| on("lawn", (ix, 0), theta, i64::from(ix % 5)));
    let road = (10..20).map(|ix| on("road", (ix, 0), 0.05, 6));
    let one = Robot::join(&yard, "rover-1").await;
    one.upload(numbered(lawn(0.19).chain(road))).await.unwrap();
    let two = Robot::join(&yard, "rover-2").await;
    two.upload(numbered(lawn(0.21))).await.unwrap();
    yard
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_border_cell_answers_for_the_ground_under_the_point_and_never_mixes_it() {
    let yard = measured_yard().await;
    let at = async |x_m: f64| -> PointFriction {
        yard.get(&format!("{BASE}/point?x_m={x_m}&y_m=0.5")).await
    };
    let (left, right) = (at(10.2).await, at(10.8).await);
    assert_eq!(left.cell, right.cell, "one cell, two grounds");
    let theta = |point: &PointFriction| point.models[0].friction.unwrap().theta;
    assert!((theta(&left) - 0.2).abs() < 0.005, "{left:?}");
    assert!((theta(&right) - 0.05).abs() < 0.005, "{right:?}");
    assert_eq!(right.terrain.unwrap().id.as_str(), "road");
    let nowhere = at(25.0).await;
    assert!(nowhere.terrain.is_none() && nowhere.models.is_empty());

    // Squares of 4 m keep the two grounds apart as well.
    let coarse: Page<CellFriction> = yard
        .get(&format!(
            "{BASE}/cells?x_min_m=0&y_min_m=0&x_max_m=19&y_max_m=3&resolution_m=4"
        ))
        .await;
    let seen: Vec<(i32, &str, u64)> = coarse
        .items
        .iter()
        .map(|item| {
            let terrain = item.terrain.as_ref().unwrap().id.as_str();
            (item.cell.ix, terrain, item.friction.segments)
        })
        .collect();
    let expected = [
        (0, "lawn", 8),
        (1, "lawn", 8),
        (2, "lawn", 6),
        (2, "road", 2),
        (3, "road", 4),
        (4, "road", 4),
    ];
    assert_eq!(seen, expected);
    assert!(coarse.items.iter().all(|item| close(item.size_m, 4.0)));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ground_nobody_has_driven_has_an_expectation_marked_as_such() {
    let yard = measured_yard().await;
    let meadow: TerrainFriction = yard.get(&format!("{BASE}/terrains/meadow")).await;
    assert_eq!(meadow.models.len(), 1);
    assert_eq!(meadow.models[0].friction, None, "unknown stays null");
    let prior = meadow.models[0].prior.unwrap();
    assert!((prior.theta - 0.2).abs() < 0.01, "{prior:?}");
    assert!(
        prior.std_dev > 0.05,
        "terrains of a class differ: {prior:?}"
    );
    assert_eq!(prior.terrains, 1);
    let point: PointFriction = yard.get(&format!("{BASE}/point?x_m=35&y_m=0")).await;
    assert_eq!(point.models[0].friction, None);
    assert_eq!(point.models[0].prior, Some(prior));
    let road: TerrainFriction = yard.get(&format!("{BASE}/terrains/road")).await;
    assert_eq!(road.models[0].prior, None, "it was measured itself");
    let listed: Page<TerrainFriction> = yard.get(&format!("{BASE}/terrains")).await;
    assert_eq!(listed.items.len(), 3);
    assert_eq!(listed.items[1].models[0].prior, Some(prior));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_terrain_has_a_history_and_cells_differ_between_two_times() {
    let yard = measured_yard().await;
    let (from, to) = (after_h(-2), after_h(6));
    let history: TerrainHistory = yard
        .get(&format!(
            "{BASE}/terrains/lawn/history?from={from}&to={to}&step_s=7200"
        ))
        .await;
    let segments: Vec<u64> = history
        .items
        .iter()
        .map(|item| {
            item.models
                .first()
                .map_or(0, |m| m.friction.unwrap().segments)
        })
        .collect();
    // Both robots drove three cells in the first hour and two in each later one.
    // What was measured at those times is not over then.
    assert_eq!(segments, [0, 0, 10, 18, 22]);
    let as_of: TerrainFriction = yard
        .get(&format!("{BASE}/terrains/lawn?as_of={}", after_h(2)))
        .await;
    assert_eq!(as_of.models, history.items[2].models);

    let three = Robot::join(&yard, "rover-3").await;
    let iced = (0..2).map(|number| {
        let mut iced = on("lawn", (3, 0), 1.2, 9);
        iced.ended_at += SignedDuration::from_secs(number);
        iced
    });
    three.upload(numbered(iced)).await.unwrap();
    let differences: DifferencePage<CellDifference> = yard
        .get(&format!("{BASE}/difference?from={}", after_h(8)))
        .await;
    // The map is known by the minute, and the answer says so.
    let minute = |at: Timestamp| at.as_second().div_euclid(60) * 60;
    assert_eq!(differences.from.unwrap().as_second(), minute(after_h(8)));
    let [item] = differences.items.as_slice() else {
        panic!("only one cell was measured since: {differences:?}");
    };
    assert_eq!(item.cell.ix, 3);
    assert!((item.before.unwrap().theta - 0.2).abs() < 0.01, "{item:?}");
    let after = item.after.unwrap();
    assert!(
        (after.theta - 1.2).abs() < 0.1 && !after.disputed,
        "{item:?}"
    );
    assert!(after.changed_at.is_some());
    assert!(item.z_score.unwrap() > 5.0, "{item:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_path_tells_what_is_known_and_how_fast_it_may_be_driven() {
    let yard = measured_yard().await;
    let three = Robot::join(&yard, "rover-3").await;
    let iced = (14..18).flat_map(|ix| {
        (0..2).map(move |number| {
            let mut iced = on("road", (ix, 0), 1.5, 9);
            iced.mu_peak_lower_bound = Some(0.08);
            iced.ended_at += SignedDuration::from_secs(number);
            iced
        })
    });
    three.upload(numbered(iced)).await.unwrap();
    let body = json!({"robot": "rover-1", "points": [
        {"x_m": 0.5, "y_m": 0.5}, {"x_m": 24.5, "y_m": 0.5}]});
    let (status, said) = yard.post(&format!("{BASE}/path"), &body).await;
    assert_eq!(status, StatusCode::OK, "{said}");
    let path: PathFriction = serde_json::from_value(said).unwrap();
    assert!((path.length_m - 24.0).abs() < 1e-9);
    // The last pieces of the cells from 0 to 19 end at x = 20.
    assert!((path.known_ratio - 19.5 / 24.0).abs() < 1e-6, "{path:?}");
    let piece = |ix: i32| {
        *path
            .pieces
            .iter()
            .find(|piece| piece.cell.ix == ix)
            .unwrap()
    };
    let (ice, unknown) = (piece(15), piece(22));
    assert!(close(piece(12).traction_limit_mu, 0.4), "shown of late");
    assert!(
        close(piece(5).traction_limit_mu, 0.14),
        "shown ten hours ago"
    );
    assert!(
        ice.traction_limit_mu < 0.14 && ice.theta_upper_95.unwrap() > 1.5,
        "{ice:?}"
    );
    assert_eq!(unknown.theta, None);
    assert!(
        close(unknown.traction_limit_mu, 0.14),
        "cautious where nothing is known"
    );
    let speeds: Vec<f64> = path.pieces.iter().map(|piece| piece.speed_m_s).collect();
    assert!(
        speeds.is_sorted_by(|left, right| left >= right),
        "{speeds:?}"
    );
    let last = path.pieces.last().unwrap();
    let stopping_m = last.speed_m_s.powi(2) / (2.0 * 0.58 * 0.14 * GRAVITY_M_S2);
    assert!(stopping_m <= path.length_m - last.from_m + 1e-9, "{last:?}");

    for (points, said_of) in [
        (json!([{"x_m": 0, "y_m": 0}]), "2 to 10000"),
        (
            json!([{"x_m": 0, "y_m": 0}, {"x_m": 0, "y_m": 0}]),
            "length",
        ),
        (
            json!([{"x_m": 0, "y_m": 0}, {"x_m": 0, "y_m": 20_000}]),
            "10000",
        ),
        (
            json!([{"x_m": 0, "y_m": 0}, {"x_m": 0, "y_m": 2e6}]),
            "point 1",
        ),
    ] {
        let body = json!({"robot": "rover-1", "points": points});
        let (status, said) = yard.post(&format!("{BASE}/path"), &body).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
        let detail = said["detail"].as_str().unwrap();
        assert!(detail.contains(said_of), "{said}");
    }
    let body = json!({"robot": "nobody", "points": []});
    let (status, _) = yard.post(&format!("{BASE}/path"), &body).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_path_that_nobody_has_driven_says_so() {
    let yard = measured_yard().await;
    let body = json!({"robot": "rover-1", "points": [
        {"x_m": 50.5, "y_m": 0.5}, {"x_m": 54.5, "y_m": 0.5}]});
    let (status, said) = yard.post(&format!("{BASE}/path"), &body).await;
    assert_eq!(status, StatusCode::OK, "{said}");
    assert_eq!(said["known_ratio"], json!(0.0));
    for piece in said["pieces"].as_array().unwrap() {
        for layer in ["theta", "std_dev", "theta_upper_95", "age_s"] {
            assert_eq!(piece[layer], Value::Null, "unknown stays null: {piece}");
        }
        assert_eq!(
            piece["traction_limit_mu"],
            json!(0.14),
            "the cautious one: {piece}"
        );
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_answer_says_which_normalisation_it_used() {
    let reference = model().configuration();
    let other = ConfigurationId::from_uuid(Uuid::from_u128(77));
    let yard = Yard::start_with(after_h(10), |config| {
        config.normalisations = vec![Normalisation {
            name: "to-lugged".to_owned(),
            reference,
            ratios: BTreeMap::from([(other, 2.0)]),
        }];
    })
    .await;
    draw(&yard, "lawn", "grass", 0.0..=10.5).await;
    let one = Robot::join(&yard, "rover-1").await;
    let own = on("lawn", (1, 0), 0.2, 0);
    one.upload(numbered([own])).await.unwrap();
    let two = Robot::join(&yard, "rover-2").await;
    let mut foreign = on("lawn", (1, 0), 0.4, 1);
    foreign.configuration = other;
    two.upload(numbered([foreign])).await.unwrap();

    let apart: Page<CellFriction> = yard.get(&format!("{BASE}/cells")).await;
    assert_eq!(apart.items.len(), 2, "models are kept apart");
    let from = after_h(-1);
    for (path, places) in [
        ("cells?", "/items/0/normalisation"),
        ("point?x_m=1.5&y_m=0.5&", "/models/0/normalisation"),
        ("terrains?", "/items/0/models/0/normalisation"),
        ("terrains/lawn?", "/models/0/normalisation"),
        (
            "visits?x_min_m=1&y_min_m=0&x_max_m=1.5&y_max_m=0.5&",
            "/items/0/normalisation",
        ),
        (
            &format!("difference?from={from}&"),
            "/items/0/normalisation",
        ),
    ] {
        let plain: Value = yard.get(&format!("{BASE}/{path}")).await;
        assert_eq!(plain.pointer(places), Some(&Value::Null), "{path}: {plain}");
        let joined: Value = yard
            .get(&format!("{BASE}/{path}normalisation=to-lugged"))
            .await;
        assert_eq!(
            joined.pointer(places),
            Some(&json!("to-lugged")),
            "{path}: {joined}"
        );
    }
    let joined: Page<CellFriction> = yard
        .get(&format!("{BASE}/cells?normalisation=to-lugged"))
        .await;
    let [cell] = joined.items.as_slice() else {
        panic!("one model: {joined:?}");
    };
    assert_eq!((cell.configuration, cell.friction.robots), (reference, 2));
    assert!((cell.friction.theta - 0.2).abs() < 1e-6, "{cell:?}");
    // Whose θ is asked for is whose it is, also if that is not the reference.
    let of_other = format!("configuration={other}&normalisation=to-lugged");
    let joined: Page<CellFriction> = yard.get(&format!("{BASE}/cells?{of_other}")).await;
    let [cell] = joined.items.as_slice() else {
        panic!("one model: {joined:?}");
    };
    assert_eq!((cell.configuration, cell.friction.robots), (other, 2));
    assert!((cell.friction.theta - 0.4).abs() < 1e-6, "{cell:?}");
    let body = json!({"robot": "rover-1", "normalisation": "to-lugged", "points": [
        {"x_m": 1.1, "y_m": 0.5}, {"x_m": 1.9, "y_m": 0.5}]});
    let (_, path) = yard.post(&format!("{BASE}/path"), &body).await;
    assert_eq!(path["normalisation"], json!("to-lugged"));
    let map = format!("{BASE}/map?format=tile&normalisation=to-lugged");
    let answer = yard.client().get(yard.url(&map)).send().await.unwrap();
    assert_eq!(answer.headers()["tread-normalisation"], "to-lugged");
    let tile = Tile::decode(&answer.bytes().await.unwrap()).unwrap();
    assert_eq!(tile.normalisation.as_deref(), Some("to-lugged"));
    let of_reference = tile.squares[0].unwrap();
    assert_eq!(of_reference.segments, 2);
    let map = format!("{BASE}/map?format=tile&{of_other}");
    let answer = yard.client().get(yard.url(&map)).send().await.unwrap();
    let tile = Tile::decode(&answer.bytes().await.unwrap()).unwrap();
    let of_other = tile.squares[0].unwrap();
    assert!(
        (of_other.theta / of_reference.theta - 2.0).abs() < 0.01,
        "{of_reference:?}, {of_other:?}"
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dispatch_tells_the_robot_what_the_map_knows_along_its_path() {
    let yard = measured_yard().await;
    let robot = Robot::join(&yard, "rover-3").await;
    let offered = async |begin_x_m: f64, y_m: f64| {
        let body = json!({"site": "yard", "robot": "rover-3", "trajectory": {"waypoints": {
            "speed_m_s": 0.5, "points": [{"x_m": begin_x_m, "y_m": y_m},
                                         {"x_m": begin_x_m + 7.0, "y_m": y_m}]}}});
        let (status, said) = yard.post("/v1/missions", &body).await;
        assert_eq!(status, StatusCode::CREATED, "{said}");
        let id: tread_api::ids::MissionId = serde_json::from_value(said["id"].clone()).unwrap();
        let offer = eventually("the offer comes", async || {
            let offers = robot.offers();
            let mut offers = offers.into_iter().filter(|offer| offer.mission == id);
            offers.next().ok_or("none")
        })
        .await;
        let url = yard.url(&format!("/v1/missions/{id}/cancel"));
        let (status, said) = yard.send(yard.client().post(url).json(&json!({}))).await;
        assert!(status.is_success(), "{said}");
        offer.prior
    };
    assert_eq!(offered(5.5, 9.5).await, None, "nobody has driven there");
    let prior = offered(5.5, 0.5).await.unwrap();
    let cells: Vec<i32> = prior.cells.iter().map(|known| known.cell.ix).collect();
    assert_eq!(
        cells,
        [3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14],
        "the path and two cells around it; the border cell has two grounds"
    );
    assert!((prior.cells[2].theta - 0.2).abs() < 0.01, "{prior:?}");
    assert!((prior.cells[8].theta - 0.05).abs() < 0.01, "{prior:?}");
    assert!(
        close(prior.traction_limit_mu, 0.14),
        "nothing was shown there of late"
    );
    assert!(close(prior.robot_bias_ratio, ROBOT_BIAS_RATIO));
    let traction_limits: Vec<(i32, f64)> = prior
        .traction_limits
        .iter()
        .map(|limit| (limit.cell.ix, limit.mu))
        .collect();
    let columns: Vec<i32> = traction_limits.iter().map(|(ix, _)| *ix).collect();
    assert_eq!(
        columns,
        [5, 6, 7, 8, 9, 10, 11, 12],
        "every cell of the path"
    );
    for &(ix, mu) in &traction_limits {
        let shown = if ix < 10 { 0.14 } else { 0.4 };
        assert!(
            close(mu, shown),
            "as each terrain has shown: {traction_limits:?}"
        );
    }
    // Ice two cells farther on the road: the road may be frozen here too, the lawn is not.
    let ice = (0..2).map(|number| {
        let mut iced = on("road", (14, 0), 1.5, 9);
        iced.ended_at += SignedDuration::from_secs(number);
        iced
    });
    robot.upload(numbered(ice)).await.unwrap();
    let prior = offered(5.5, 0.5).await.unwrap();
    for limit in &prior.traction_limits {
        let is_road = limit.cell.ix > 10;
        // In the border cell lies some of both.
        assert!(
            limit.cell.ix == 10 || (limit.mu < 0.139) == is_road,
            "{limit:?}"
        );
    }
    assert!(prior.traction_limit_mu < 0.139, "{prior:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn visits_are_worth_most_where_nothing_is_known_and_robots_show_their_bias() {
    let yard = measured_yard().await;
    let visits: Page<VisitSuggestion> = yard
        .get(&format!(
            "{BASE}/visits?x_min_m=0&y_min_m=0&x_max_m=29&y_max_m=1&limit=1000"
        ))
        .await;
    assert!(
        visits
            .items
            .is_sorted_by(|left, right| left.gain >= right.gain)
    );
    assert_eq!(visits.items[0].relative_std_dev, None, "unknown first");
    assert!(
        visits.items.iter().all(|item| item.cell.ix < 20),
        "nobody is sent where nothing is drawn"
    );
    let last = visits.items.last().unwrap();
    assert_eq!(last.cell.iy, 0, "two robots have been there: {last:?}");
    assert!(last.gain > 0.0 && last.cell.ix < 10, "{last:?}");

    let robots: Page<RobotContribution> = yard.get(&format!("{BASE}/robots")).await;
    let [one, two] = robots.items.as_slice() else {
        panic!("two robots: {robots:?}");
    };
    assert_eq!((one.cells, one.segments), (20, 21));
    assert_eq!((two.cells, two.segments), (11, 11));
    let bias = |robot: &RobotContribution| robot.bias_ratio.unwrap();
    assert!((bias(one) - 0.95).abs() < 0.01 && (bias(two) - 1.05).abs() < 0.01);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_answer_that_is_still_the_same_is_not_sent_again() {
    let yard = measured_yard().await;
    for path in [
        "terrains",
        "terrains/lawn",
        "cells?limit=3",
        "point?x_m=1&y_m=0",
        "robots",
        "visits?x_min_m=0&y_min_m=0&x_max_m=9&y_max_m=1",
    ] {
        let url = yard.url(&format!("{BASE}/{path}"));
        let first = yard.client().get(&url).send().await.unwrap();
        assert_eq!(first.status(), StatusCode::OK, "{path}");
        let tag = first.headers()[header::ETAG].clone();
        let held = yard.client().get(&url).header(header::IF_NONE_MATCH, &tag);
        let again = held.send().await.unwrap();
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED, "{path}");
        assert_eq!(again.headers()[header::ETAG], tag, "{path}");
        assert_eq!(again.bytes().await.unwrap().len(), 0, "{path}");
    }
    let url = yard.url(&format!("{BASE}/terrains/lawn"));
    let first = yard.client().get(&url).send().await.unwrap();
    let tag = first.headers()[header::ETAG].clone();
    let three = Robot::join(&yard, "rover-3").await;
    three
        .upload(numbered([on("lawn", (1, 0), 0.2, 9)]))
        .await
        .unwrap();
    let held = yard.client().get(&url).header(header::IF_NONE_MATCH, &tag);
    assert_eq!(held.send().await.unwrap().status(), StatusCode::OK);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bad_question_is_refused_with_the_bound_that_it_breaks() {
    let yard = measured_yard().await;
    for (path, field, said_of) in [
        (
            "cells?x_min_m=5&x_max_m=1",
            "x_max_m",
            "is above the upper one",
        ),
        (
            "cells?y_min_m=5&y_max_m=1",
            "y_max_m",
            "is above the upper one",
        ),
        ("cells?x_min_m=NaN", "x_max_m", "1000000"),
        ("cells?x_max_m=inf", "x_max_m", "1000000"),
        ("cells?y_min_m=-2e6", "y_max_m", "1000000"),
        ("cells?resolution_m=4", "resolution_m", "4194304"),
        ("cells?resolution_m=1.5", "resolution_m", "whole multiple"),
        ("cells?resolution_m=NaN", "resolution_m", "whole multiple"),
        ("cells?resolution_m=0", "resolution_m", "whole multiple"),
        ("cells?cursor=x", "cursor", "next_cursor"),
        ("cells?as_of=2100-01-01T00:00:00Z", "as_of", "future"),
        ("cells?normalisation=all", "normalisation", "declared"),
        ("point?x_m=1e7&y_m=0", "x_m", "1000000"),
        ("point?x_m=NaN&y_m=0", "x_m", "1000000"),
        (
            "visits?x_min_m=0&y_min_m=0&x_max_m=9999&y_max_m=9999",
            "x_min_m",
            "262144",
        ),
        ("difference?from=2100-01-01T00:00:00Z", "to", "before from"),
        (
            "terrains/lawn/history?from=2000-01-01T00:00:00Z&step_s=60",
            "step_s",
            "1000",
        ),
        (
            "terrains/lawn/history?from=2000-01-01T00:00:00Z&step_s=0",
            "step_s",
            "60 to",
        ),
    ] {
        let (status, said) = yard.get_value(&format!("{BASE}/{path}")).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{path}: {said}");
        assert_eq!(said["field"], field, "{path}: {said}");
        let detail = said["detail"].as_str().unwrap();
        assert!(detail.contains(said_of), "{path}: {said}");
    }
    for path in ["cells?colour=red", "cells?as_of=yesterday", "point?x_m=1"] {
        let (status, said) = yard.get_value(&format!("{BASE}/{path}")).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{path}: {said}");
    }
    let crossed = json!({"id": "bow", "class": "mud", "polygon": [
        {"x_m": 0, "y_m": 0}, {"x_m": 2, "y_m": 2}, {"x_m": 2, "y_m": 0}, {"x_m": 0, "y_m": 2}]});
    let mut outside = crossed.clone();
    outside["polygon"] = json!([{"x_m": 0, "y_m": 0}, {"x_m": 2e6, "y_m": 0},
                                {"x_m": 0, "y_m": 2}]);
    for (body, said_of) in [(crossed, "crosses"), (outside, "1000000 m of the origin")] {
        let (status, said) = yard.post("/v1/sites/yard/terrains", &body).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
        assert!(said["detail"].as_str().unwrap().contains(said_of), "{said}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn passes_that_tell_nothing_are_counted_and_change_no_estimate() {
    let first = segment((0, 0), 0.2, 0).ended_at;
    let yard = Yard::start_at(first + SignedDuration::from_hours(5)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let telling = (0..3).map(|number| segment((0, 0), 0.2, number));
    robot.upload(numbered(telling)).await.unwrap();
    let cells = format!("{BASE}/cells");
    let before: MapPage<CellFriction> = yard.get(&cells).await;
    // In an hour of their own, so that their sum is all that is known of it.
    let silent = (0..8).map(|number| {
        let mut silent = segment((0, 0), 0.2, 7_200 + number);
        silent.theta = Information {
            information: 1e-11,
            weighted: 2e-12,
        };
        silent
    });
    let two = Robot::join(&yard, "rover-2").await;
    two.upload(numbered(silent)).await.unwrap();
    let after: MapPage<CellFriction> = yard.get(&cells).await;
    let [was, is] = [before.items[0].friction, after.items[0].friction];
    assert_eq!((was.segments, is.segments), (3, 11));
    assert_eq!(
        (was.theta, was.std_dev, was.robots),
        (is.theta, is.std_dev, is.robots)
    );
    let box_of = "x_min_m=-1&y_min_m=-1&x_max_m=1&y_max_m=1&resolution_m=2";
    let coarse: MapPage<CellFriction> = yard.get(&format!("{cells}?{box_of}")).await;
    assert_eq!(coarse.items[0].friction.segments, 11);
    yard.server.stop().await.unwrap();
}
