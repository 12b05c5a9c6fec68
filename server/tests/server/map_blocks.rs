//! A map that is larger than the memory for it answers as one that is not.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use jiff::{SignedDuration, Timestamp};
use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::friction::{Segment, Withdrawal};
use tread_server::config::MapConfig;

use crate::harness::{Yard, measured, segment};
use crate::ingest::Writer;
use crate::map::said;
use crate::robot::Robot;

/// Everything that is read from the map, over several blocks of cells; a Parquet file has row groups of
/// other sizes where memory is short.
pub(crate) const PATHS: [&str; 14] = [
    "cells?limit=1000",
    "cells?limit=7&cursor=-40,-70",
    "cells?limit=1000&resolution_m=8&x_min_m=-100&x_max_m=100&y_min_m=-100&y_max_m=100",
    "cells?limit=3&resolution_m=64&x_min_m=-128&x_max_m=127&y_min_m=-128&y_max_m=127",
    "cells?limit=1000&x_min_m=-30&x_max_m=30&y_min_m=-200&y_max_m=64",
    "cells?limit=1000&as_of=2026-10-26T10:10:00Z",
    "point?x_m=5.5&y_m=0.5",
    "difference?from=2026-10-26T11:00:00Z&limit=1000",
    "visits?x_min_m=-100&x_max_m=100&y_min_m=-100&y_max_m=100",
    "robots",
    "point/history?x_m=5.5&y_m=0.5&from=2026-10-26T08:00:00Z&step_s=1800",
    "map?format=csv",
    "map?format=png&x_min_m=-100&x_max_m=100&y_min_m=-100&y_max_m=100",
    "map?format=png&resolution_m=16",
];

pub(crate) fn at() -> Timestamp {
    segment((0, 0), 0.2, 0).ended_at + SignedDuration::from_hours(9)
}

/// Two robots on 70 cells of sixteen blocks, within eight hours.
pub(crate) async fn drive(yard: &Yard) {
    for (name, bias) in [("rover-2", 0.0), ("rover-1", 0.02)] {
        let robot = Robot::join(yard, name).await;
        let passes = (0..140).map(|seq| {
            let number = i32::try_from(seq).unwrap();
            let place = (number % 10 * 19 - 90, number % 7 * 25 - 75);
            let theta = 0.2 + bias + 0.001 * f64::from(number % 11);
            let mut pass: Segment = segment(place, theta, i64::from(number) * 200);
            if number % 3 == 0 {
                pass.terrain = None;
            }
            measured(seq, pass)
        });
        let receipt = robot.upload(passes.collect()).await.unwrap();
        assert_eq!(receipt.committed, 140, "{receipt:?}");
    }
}

/// What a server at a URL answers to these paths.
pub(crate) async fn answers_at(
    client: &reqwest::Client,
    server: &str,
    paths: &[&str],
) -> Vec<(String, Vec<u8>)> {
    let mut answers = Vec::new();
    for &path in paths {
        let url = format!("{server}/v1/sites/yard/friction/{path}");
        let response = client.get(url).send().await.unwrap();
        let (status, body) = (response.status(), response.bytes().await.unwrap());
        let said = String::from_utf8_lossy(&body).into_owned();
        assert_eq!(status, StatusCode::OK, "{path}: {said}");
        answers.push((path.to_owned(), body.to_vec()));
    }
    answers
}

async fn answers(yard: &Yard) -> Vec<(String, Vec<u8>)> {
    let mut answers = answers_at(yard.client(), &yard.url(""), &PATHS).await;
    let along = json!({"robot": "rover-1", "points": [{"x_m": -90, "y_m": -75},
                       {"x_m": 60, "y_m": 70}, {"x_m": 81, "y_m": -50}]});
    let (status, body) = yard.post("/v1/sites/yard/friction/path", &along).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    assert!(body["known_ratio"].as_f64().unwrap() > 0.0, "{body}");
    answers.push(("path".to_owned(), body.to_string().into_bytes()));
    answers
}

pub(crate) fn assert_same(found: &[(String, Vec<u8>)], expected: &[(String, Vec<u8>)], when: &str) {
    for ((path, found), (_, expected)) in found.iter().zip(expected) {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        assert!(
            found == expected,
            "{path} {when}:\n{}\ninstead of\n{}",
            text(found),
            text(expected)
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_map_of_which_nothing_fits_into_memory_answers_as_one_of_which_all_does() {
    let yard = Yard::start_at(at()).await;
    drive(&yard).await;
    let blocks = yard.server.app().map_blocks();
    assert_eq!((blocks.driven, blocks.in_memory), (16, 0), "{blocks:?}");
    let unwritten = answers(&yard).await;
    yard.server.app().write_sums().await.unwrap();
    let stored = answers(&yard).await;
    assert_same(&stored, &unwritten, "after its sums were stored");
    let read = yard.server.app().map_blocks().read;
    assert!(read > 16, "{read} blocks were read");

    let in_memory = |config: &mut tread_server::config::Config| config.map = MapConfig::default();
    let yard = yard.restart_configured_at(at(), in_memory).await;
    let blocks = yard.server.app().map_blocks();
    assert_eq!((blocks.driven, blocks.in_memory), (16, 16), "{blocks:?}");
    assert!(blocks.bytes > 0, "{blocks:?}");
    let kept = answers(&yard).await;
    assert_eq!(yard.server.app().map_blocks().read, 0, "all were there");
    assert_same(&kept, &stored, "with all in memory");

    // Withdrawn measurements are not read again either.
    let path = "/v1/sites/yard/robots/rover-2/withdrawals";
    let begin = segment((0, 0), 0.2, 0).ended_at;
    let body = json!({"to": begin + SignedDuration::from_hours(4), "reason": "worn tyres"});
    let (status, said): (_, Value) = yard.post(path, &body).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    let _: Withdrawal = serde_json::from_value(said).unwrap();
    let kept = answers(&yard).await;
    assert_ne!(kept, stored);
    let yard = yard.restart_at(at()).await;
    assert_same(&answers(&yard).await, &kept, "of what was not withdrawn");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_measurement_counts_once_while_sums_are_stored_and_their_blocks_are_read() {
    const PASSES: u64 = 150;
    let writer = Writer::start_without_memory().await;
    let (sent, received) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let is_over = Arc::new(AtomicBool::new(false));
    let app = writer.app.clone();
    let over = Arc::clone(&is_over);
    let mut storing = tokio::task::JoinSet::new();
    storing.spawn(async move {
        let mut stored = 0_u64;
        while !over.load(Ordering::Relaxed) {
            app.write_sums().await.unwrap();
            stored += 1;
            tokio::task::yield_now().await;
        }
        stored
    });
    let mut readers = tokio::task::JoinSet::new();
    for _ in 0..2 {
        let (app, over) = (writer.app.clone(), Arc::clone(&is_over));
        let (sent, received) = (Arc::clone(&sent), Arc::clone(&received));
        readers.spawn(async move {
            let mut readings = 0_u64;
            while !over.load(Ordering::Relaxed) {
                let least = received.load(Ordering::SeqCst);
                let cells = said(&app).await.items;
                let most = sent.load(Ordering::SeqCst);
                let counted: u64 = cells.iter().map(|cell| cell.friction.segments).sum();
                assert!(
                    (least..=most).contains(&counted),
                    "{counted} measurements, of {least} received and {most} sent"
                );
                readings += 1;
            }
            readings
        });
    }
    for seq in 0..PASSES {
        let place = i32::try_from(seq % 5).unwrap() * 40;
        let pass = segment((place, -place), 0.2, i64::try_from(seq).unwrap());
        sent.fetch_add(1, Ordering::SeqCst);
        let receipt = writer.upload_as("rover-1", vec![measured(seq, pass)]).await;
        assert_eq!(receipt.committed, 1);
        received.fetch_add(1, Ordering::SeqCst);
    }
    is_over.store(true, Ordering::Relaxed);
    let readings: u64 = readers.join_all().await.iter().sum();
    let stored: u64 = storing.join_all().await.iter().sum();
    assert!(
        readings > 20 && stored > 20,
        "{readings} readings, stored {stored} times"
    );
    let counted: u64 = said(&writer.app)
        .await
        .items
        .iter()
        .map(|cell| cell.friction.segments)
        .sum();
    assert_eq!(counted, PASSES);
    assert!(writer.app.map_blocks().read > 20);
}
