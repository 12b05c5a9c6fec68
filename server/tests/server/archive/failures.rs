//! An archive that cannot be written, or whose files are damaged or missing.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;

use reqwest::{StatusCode, header};
use tokio_util::sync::CancellationToken;
use tread_api::identity::Role;
use tread_server::db::segments::SegmentFilter;

use super::{DAY, Ground, alert, everything, first_key, listed, week};
use crate::harness::{Yard, client, measured, segment, site, time};
use crate::ingest::Writer;
use crate::robot::Robot;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_archive_that_cannot_be_written_keeps_everything_and_raises_an_alert() {
    let ground = Ground::start(10).await;
    let app = ground.app();
    let expected = everything(app).await;
    // A file where the folder would be: root too cannot write there.
    fs::write(ground.archive(), "").unwrap();
    ground.archive_and_remove(app, 100).await;
    assert_eq!(first_key(app).await, 1);
    assert_eq!(everything(app).await, expected);
    let text = alert(app).await.unwrap();
    let folder = ground.archive().display().to_string();
    assert!(
        text.contains(&folder) && text.contains("none is removed"),
        "{text}"
    );
    assert_eq!(app.is_archive_failed(), Some(true));
    assert_eq!(app.counters().values().archive_failures, 1);
    fs::remove_file(ground.archive()).unwrap();
    ground.archive_and_remove(app, 100).await;
    assert_eq!(alert(app).await, None);
    assert_eq!(app.is_archive_failed(), Some(false));
    assert_eq!(first_key(app).await, 241);
    assert_eq!(everything(app).await, expected);
    let mode = fs::metadata(ground.archive()).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o700);
    assert_eq!(Writer::start().await.app.is_archive_failed(), None);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_damaged_or_missing_file_is_an_error_for_those_who_need_it() {
    let ground = Ground::start(12).await;
    let app = ground.app();
    ground.archive_and_remove(app, 100).await;
    let names = ground.names();
    let path = ground.archive().join(&names[2]);
    let content = fs::read(&path).unwrap();
    let mut damaged = content.clone();
    damaged[1_000] ^= 1;
    fs::write(&path, damaged).unwrap();
    let filter = SegmentFilter::default();
    let refused = app
        .segments(&site(), &filter, 1_000)
        .await
        .unwrap_err()
        .to_string();
    assert!(
        refused.contains(&names[2]) && refused.contains("damaged"),
        "{refused}"
    );
    assert_eq!(app.counters().values().archive_failures, 1);
    // Who needs other files alone gets them.
    let page = app.segments(&site(), &filter, 100).await.unwrap();
    assert_eq!(
        (page.items.len(), page.next_cursor.as_deref()),
        (100, Some("100"))
    );
    let later = SegmentFilter {
        after: 240,
        ..SegmentFilter::default()
    };
    assert_eq!(listed(app, &later, 1_000).await.len(), 720);

    fs::remove_file(&path).unwrap();
    let refused = app
        .segments(&site(), &filter, 1_000)
        .await
        .unwrap_err()
        .to_string();
    assert!(refused.contains("lacks the measurement 240"), "{refused}");
    // The disk of the archive is not mounted: nothing is shown as if there were nothing, and nothing
    // is written into the empty folder.
    fs::rename(ground.archive(), ground.folder.path().join("elsewhere")).unwrap();
    assert!(app.segments(&site(), &later, 10).await.is_err());
    ground.a_day(12).await;
    let first = first_key(app).await;
    ground.archive_and_remove(app, 100).await;
    assert!(alert(app).await.unwrap().contains("is not mounted"));
    assert_eq!((first_key(app).await, ground.names().len()), (first, 0));
    fs::rename(ground.folder.path().join("elsewhere"), ground.archive()).unwrap();
    fs::write(&path, content).unwrap();
    ground.archive_and_remove(app, 100).await;
    assert_eq!((alert(app).await, first_key(app).await), (None, first + 80));
    assert_eq!(everything(app).await.len(), 1_040);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_export_that_cannot_be_read_to_its_end_breaks_off_and_one_that_cannot_begin_is_a_problem()
 {
    let folder = tempfile::tempdir().unwrap();
    let archive = folder.path().join("archive");
    let yard = Yard::start_with(time("2026-11-01T00:00:00Z"), |config| {
        config.retention = week(&archive);
    })
    .await;
    let robot = Robot::join(&yard, "rover-1").await;
    let upload = async |from: u64, to: u64| {
        let record = |seq: u64| {
            let place = i32::try_from(seq).unwrap();
            measured(seq, segment((place % 100, place / 100), 0.2, 0))
        };
        robot
            .upload((from..to).map(record).collect())
            .await
            .unwrap();
    };
    for batch in 0..18 {
        upload(batch * 500, (batch + 1) * 500).await;
    }
    let app = yard.server.app();
    app.clock().advance(10 * DAY);
    upload(9_000, 9_040).await;
    let (config, stop) = (week(&archive), CancellationToken::new());
    let archiving = app.archive_and_remove(&config, 3_000, &stop);
    archiving.await.unwrap();
    assert_eq!(first_key(app).await, 9_001);
    let mut files: Vec<_> = fs::read_dir(&archive)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "parquet"))
        .collect();
    files.sort();
    assert_eq!(files.len(), 3, "{files:?}");

    // The admin's token has expired.
    let reader = client(Some(&yard.token("reader", Role::Viewer).await.secret));
    let exported = async || {
        let url = yard.url("/v1/sites/yard/segments?format=csv");
        reader.get(url).send().await.unwrap()
    };
    let whole = exported().await.text().await.unwrap();
    assert_eq!(whole.lines().count(), 9_041);
    // The first chunk is in the first two files.
    fs::write(&files[2], "another file").unwrap();
    let answer = exported().await;
    assert_eq!(answer.status(), StatusCode::OK);
    let part = answer.bytes().await;
    assert!(part.is_err(), "a part passes for the whole");
    fs::write(&files[0], "another file").unwrap();
    let answer = exported().await;
    assert_eq!(answer.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(
        answer.headers()[header::CONTENT_TYPE],
        "application/problem+json"
    );
    yard.server.stop().await.unwrap();
}
