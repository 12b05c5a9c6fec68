//! Raw measurements go after their time; the map stays to the bit, whatever kills it on the way.

use std::pin::pin;
use std::task::Poll;
use std::time::Duration;

use tread_api::friction::StoredSegment;
use tread_api::wire::ingest::Record;
use tread_server::app::App;
use tread_server::config::RetentionConfig;
use tread_server::db::segments::SegmentFilter;

use crate::harness::{measured, segment, site};
use crate::ingest::{Writer, stored_sums};
use crate::map::{restarted, said};

const DAY: Duration = Duration::from_hours(24);

fn kept(segments_days: u32, segments_max: i64) -> RetentionConfig {
    RetentionConfig {
        segments_days,
        segments_max,
        archive: None,
    }
}

/// Thirty hours over two days, in three cells.
fn drive() -> Vec<Record> {
    let numbers = 0..30;
    let record = |seq: u64| {
        let (place, hour) = (i32::try_from(seq % 3).unwrap(), i64::try_from(seq).unwrap());
        let theta = 0.2 + 0.001 * f64::from(place);
        measured(seq, segment((place, 0), theta, hour * 3_600))
    };
    numbers.map(record).collect()
}

async fn stored(app: &App) -> Vec<StoredSegment> {
    let filter = SegmentFilter::default();
    app.segments(&site(), &filter, 1_000).await.unwrap().items
}

/// Runs a future until it has waited so many times, then drops it, as a kill does; whether it came
/// to its end before.
async fn killed_after<T>(waits: u32, work: impl Future<Output = T>) -> Option<T> {
    let mut work = pin!(work);
    let mut left = waits;
    std::future::poll_fn(|context| match work.as_mut().poll(context) {
        Poll::Ready(done) => Poll::Ready(Some(done)),
        Poll::Pending if left == 0 => Poll::Ready(None),
        Poll::Pending => {
            left -= 1;
            Poll::Pending
        }
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_kill_between_any_two_statements_changes_nothing_that_is_said() {
    let writer = Writer::start().await;
    let receipt = writer.upload_as("rover-1", drive()).await;
    assert_eq!(receipt.committed, 30);
    writer.app.clock().advance(20 * DAY);
    writer.app.move_horizons().await.unwrap();
    let expected = said(&writer.app).await;
    assert_eq!(expected.items.len(), 3);

    assert_eq!(stored(&writer.app).await.len(), 30);

    // Killed after one wait, two waits and so on; each time a new server goes on from there. What
    // a killed one had committed counts, though nobody heard of it.
    let (mut kills, mut waits) = (0, 0);
    loop {
        // A commit that has begun may end after its caller, but not after its process.
        writer.app.db().await_commits().await.unwrap();
        let app = restarted(&writer.app).await;
        assert_eq!(said(&app).await, expected, "after {kills} kills");
        let config = kept(7, 1_000_000);
        let work = async {
            let removed = app.remove_some(&config, 4).await.unwrap();
            let merges = app.merge_some(3).await.unwrap();
            (removed, merges)
        };
        match killed_after(waits, work).await {
            Some((0, false)) => break,
            Some(_) => waits = 0,
            None => {
                kills += 1;
                waits += 1;
            }
        }
    }
    assert!(kills > 20, "{kills} kills");
    let app = restarted(&writer.app).await;
    assert_eq!(said(&app).await, expected);
    assert_eq!(
        stored(&app).await.len(),
        1,
        "the last one keeps the numbers"
    );
    assert_eq!(app.unwritten_sums().sums, 0, "none was removed before");
    let sums = stored_sums(&app).await;
    assert!(sums.iter().all(|row| row.key.epoch_h % 24 == 0), "merged");
    let segments: u64 = sums.iter().map(|row| row.sums.segments).sum();
    assert_eq!(segments, 30, "nothing lost, nothing twice");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_removed_is_known_when_it_is_sent_again() {
    let writer = Writer::start().await;
    // In two parts, the later numbers first, with a gap between them that is none of the map's.
    let (early, late): (Vec<Record>, Vec<Record>) =
        drive().into_iter().partition(|record| record.seq < 12);
    let late: Vec<Record> = late.into_iter().filter(|record| record.seq > 12).collect();
    assert_eq!(
        writer.upload_as("rover-1", late.clone()).await.committed,
        17
    );
    assert_eq!(
        writer.upload_as("rover-1", early.clone()).await.committed,
        12
    );
    let expected = writer.sums().await;
    writer.app.clock().advance(20 * DAY);
    let config = kept(7, 1_000_000);
    while writer.app.remove_some(&config, 5).await.unwrap() > 0 {}
    assert_eq!(stored(&writer.app).await.len(), 1);

    let receipt = writer.upload_as("rover-1", drive()).await;
    assert_eq!(
        (receipt.committed, receipt.duplicates),
        (1, 29),
        "{receipt:?}"
    );
    let again = writer.upload_as("rover-1", drive()).await;
    assert_eq!((again.committed, again.duplicates), (0, 30));
    let segments = |rows: &[tread_server::db::sums::SumRow]| -> u64 {
        rows.iter().map(|row| row.sums.segments).sum()
    };
    assert_eq!(segments(&expected) + 1, segments(&writer.sums().await));
    // Another robot's numbers are its own.
    assert_eq!(writer.upload_as("rover-2", drive()).await.committed, 30);
    assert_eq!(writer.app.counters().values().segments_removed, 28);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_oldest_go_when_there_are_too_many() {
    let writer = Writer::start().await;
    writer.upload_as("rover-1", drive()).await;
    let config = kept(36_500, 10);
    assert_eq!(writer.app.remove_some(&config, 1_000).await.unwrap(), 20);
    assert_eq!(writer.app.remove_some(&config, 1_000).await.unwrap(), 0);
    let left: Vec<u64> = stored(&writer.app)
        .await
        .iter()
        .map(|one| one.seq)
        .collect();
    assert_eq!(left, (20..30).collect::<Vec<u64>>());
    let nothing_over = kept(90, 1_000);
    assert_eq!(
        writer.app.remove_some(&nothing_over, 1_000).await.unwrap(),
        0
    );
}
