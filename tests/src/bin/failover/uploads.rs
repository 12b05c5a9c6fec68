//! Uploads beside the robots that drive: as many segments a second as asked for, by robots that know both
//! servers, and what became of them.

use std::collections::BTreeSet;
use std::time::Duration;

use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;
use tread_api::ids::{BootId, RobotId, SiteId};
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::LightRobot;
use tread_tests::stored;

/// Robots that upload.
const UPLOADERS: u32 = 10;
/// Segments of an upload.
const BATCH: usize = 250;
/// Longest wait for a connection or a receipt before the other server is tried.
const ANSWER_MAX: Duration = Duration::from_secs(2);
/// Longest time from the first attempt of an upload to its receipt.
const UPLOAD_MAX: Duration = Duration::from_mins(2);
/// Pause after an attempt to connect that failed.
const RETRY: Duration = Duration::from_millis(200);

/// Robots that upload until they are asked to end.
#[derive(Debug)]
pub(crate) struct Uploads {
    tasks: JoinSet<anyhow::Result<Uploaded>>,
    stop: CancellationToken,
    began: Instant,
}

/// What one robot has receipts for: all records before that number.
#[derive(Debug)]
struct Uploaded {
    boot: BootId,
    acknowledged: u64,
    /// Longest time from the first attempt of an upload to its receipt.
    longest: Duration,
}

/// What became of all uploads.
#[derive(Debug)]
pub(crate) struct Outcome {
    /// Segments with a receipt, a second.
    pub(crate) per_s: f64,
    /// Longest time to a receipt, over the failures of servers, seconds.
    pub(crate) longest_s: f64,
    /// Segments with a receipt that are not stored.
    pub(crate) lost: u64,
    /// Segments that are stored twice, or without having been sent.
    pub(crate) doubled: u64,
}

impl Uploads {
    /// Starts robots that upload so many segments a second together.
    pub(crate) fn start(fleet: &Fleet, per_s: u32) -> Self {
        let stop = CancellationToken::new();
        let mut tasks = JoinSet::new();
        let endpoint = fleet.zenoh_endpoint();
        let endpoints: Vec<String> = endpoint.split(',').map(str::to_owned).collect();
        for number in 0..UPLOADERS {
            let robot: RobotId = format!("uploader-{number}").parse().expect("a name");
            let per_s = f64::from(per_s) / f64::from(UPLOADERS);
            let of_robot = (fleet.site(), robot);
            tasks.spawn(upload(endpoints.clone(), of_robot, per_s, stop.clone()));
        }
        Self {
            tasks,
            stop,
            began: Instant::now(),
        }
    }

    /// Ends the uploads after those under way, and compares the receipts with what is stored.
    ///
    /// # Errors
    /// A robot failed, or the database cannot be read.
    pub(crate) async fn end(self, fleet: &Fleet) -> anyhow::Result<Outcome> {
        self.stop.cancel();
        let mut uploaded = Vec::new();
        for robot in self.tasks.join_all().await {
            uploaded.push(robot?);
        }
        let lasted_s = self.began.elapsed().as_secs_f64();
        let stored = stored::records(fleet.database()).await?;
        let acknowledged: u64 = uploaded.iter().map(|robot| robot.acknowledged).sum();
        let mut outcome = Outcome {
            #[expect(clippy::cast_precision_loss, reason = "far fewer than 2^52 segments")]
            per_s: acknowledged as f64 / lasted_s,
            longest_s: uploaded
                .iter()
                .map(|robot| robot.longest.as_secs_f64())
                .fold(0.0, f64::max),
            lost: 0,
            doubled: 0,
        };
        for robot in &uploaded {
            let boot = robot.boot.to_string();
            let own = stored.iter().filter(|(of, _)| *of == boot);
            let own: Vec<u64> = own
                .filter_map(|(_, seq)| u64::try_from(*seq).ok())
                .collect();
            let distinct: BTreeSet<u64> = own.iter().copied().collect();
            let sent = |seq: &&u64| **seq < robot.acknowledged;
            let arrived = distinct.iter().filter(sent).count() as u64;
            outcome.lost += robot.acknowledged - arrived;
            outcome.doubled += own.len() as u64 - arrived;
        }
        Ok(outcome)
    }
}

/// Uploads until the stop, and goes on at the other server when one does not answer.
async fn upload(
    endpoints: Vec<String>,
    (site, id): (SiteId, RobotId),
    per_s: f64,
    stop: CancellationToken,
) -> anyhow::Result<Uploaded> {
    let mut robot = LightRobot::start(&endpoints[0], &site, id).await?;
    let mut at = 0;
    #[expect(clippy::cast_precision_loss, reason = "a small number")]
    let mut turns = interval(Duration::from_secs_f64(BATCH as f64 / per_s));
    // What was not sent while a server was away is sent afterwards.
    turns.set_missed_tick_behavior(MissedTickBehavior::Burst);
    let (mut acknowledged, mut longest) = (0, Duration::ZERO);
    while !stop.is_cancelled() {
        turns.tick().await;
        let batch = robot.next_batch(BATCH);
        let began = Instant::now();
        while !matches!(
            timeout(ANSWER_MAX, robot.upload(&batch)).await,
            Ok(Ok(_receipt))
        ) {
            anyhow::ensure!(
                began.elapsed() < UPLOAD_MAX,
                "no server takes an upload within {UPLOAD_MAX:?}"
            );
            at = (at + 1) % endpoints.len();
            let reconnecting = robot.reconnect(&endpoints[at]);
            if !matches!(timeout(ANSWER_MAX, reconnecting).await, Ok(Ok(()))) {
                sleep(RETRY).await;
            }
        }
        longest = longest.max(began.elapsed());
        acknowledged += BATCH as u64;
    }
    Ok(Uploaded {
        boot: robot.boot,
        acknowledged,
        longest,
    })
}
