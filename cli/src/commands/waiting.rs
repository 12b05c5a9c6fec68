//! Waits until missions have ended, with a bar for each mission in a terminal and a line for each
//! change elsewhere.

use std::io::IsTerminal as _;
use std::time::Duration;

use futures_util::future::try_join_all;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use tokio::time::Instant;
use tread_api::ids::MissionId;
use tread_api::mission::{Mission, MissionState};

use super::mission_text::{state, summary};
use super::robots::steps_driven;
use crate::args::format_duration;
use crate::client::{Client, Outage};
use crate::output::{Output, WaitTimeout, print_note};

/// Polling period of the missions.
const POLL_INTERVAL: Duration = Duration::from_millis(250);
/// Number of steps of a bar.
const STEPS: usize = 1_000;

/// Mission whose end is awaited.
struct AwaitedMission {
    id: MissionId,
    bar: ProgressBar,
    /// Last printed state, where there are no bars.
    printed: Option<String>,
    ended: Option<Mission>,
}

impl AwaitedMission {
    fn show(&mut self, mission: &Mission, lines: bool) {
        if lines {
            let state = state(mission);
            if self.printed.as_ref() != Some(&state) {
                print_note(&summary(mission));
                self.printed = Some(state);
            }
            return;
        }
        self.bar.set_prefix(mission.robot.to_string());
        let steps = mission
            .progress
            .and_then(|it| Some((it, steps_driven(it, STEPS)?)));
        let Some((progress, steps)) = steps else {
            self.bar.set_message(state(mission));
            return;
        };
        self.bar.set_position(steps as u64);
        self.bar.set_message(format!(
            "{:.1} of {:.1} m, {:.0} mm off, {}",
            progress.driven_m,
            progress.length_m,
            1e3 * progress.cross_track_m.abs(),
            state(mission)
        ));
    }
}

/// Waits until the missions have ended and returns them in the order of `missions`. A short outage of
/// the server does not end the wait, because the missions continue without the server.
///
/// # Errors
/// [`WaitTimeout`] if they have not ended within `allowed`; the missions continue.
/// [`ClientError`](crate::client::ClientError) if a request fails for good.
pub(super) async fn wait(
    client: &Client,
    missions: &[MissionId],
    allowed: Option<Duration>,
    output: Output,
) -> anyhow::Result<Vec<Mission>> {
    let in_terminal = std::io::stderr().is_terminal();
    let (bars, lines) = (
        in_terminal && !output.is_json(),
        !in_terminal && !output.is_json(),
    );
    let all = MultiProgress::with_draw_target(if bars {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    });
    let style = ProgressStyle::with_template("{prefix:12} {bar:32} {msg}")?;
    let mut waited: Vec<AwaitedMission> = missions
        .iter()
        .map(|id| AwaitedMission {
            id: *id,
            bar: all
                .add(ProgressBar::new(STEPS as u64))
                .with_style(style.clone()),
            printed: None,
            ended: None,
        })
        .collect();
    let notify = |note: &str| {
        if bars {
            all.suspend(|| print_note(note));
        } else if lines {
            print_note(note);
        }
    };
    let begin = Instant::now();
    let mut outage = Outage::default();
    loop {
        let open: Vec<MissionId> = waited
            .iter()
            .filter(|waited| waited.ended.is_none())
            .map(|waited| waited.id)
            .collect();
        let requests = open.iter().map(|id| client.mission(*id));
        let answers = outage.bridge(try_join_all(requests).await, notify)?;
        for detail in answers.into_iter().flatten() {
            let seen = detail.mission;
            let awaited = waited.iter_mut().find(|waited| waited.id == seen.id);
            if let Some(awaited) = awaited {
                awaited.show(&seen, lines);
                awaited.ended = seen.state.is_terminal().then_some(seen);
            }
        }
        if waited.iter().all(|waited| waited.ended.is_some()) {
            for waited in &waited {
                waited.bar.finish_and_clear();
            }
            return Ok(waited
                .into_iter()
                .filter_map(|waited| waited.ended)
                .collect());
        }
        if let Some(allowed) = allowed.filter(|allowed| begin.elapsed() >= *allowed) {
            let left = waited.iter().filter(|waited| waited.ended.is_none());
            let left = left.count();
            for waited in &waited {
                waited.bar.abandon();
            }
            let text = match outage.duration() {
                None => format!(
                    "{left} of {} missions have not ended within {}; they continue, see `tread missions`",
                    waited.len(),
                    format_duration(allowed)
                ),
                Some(silent) => format!(
                    "{} is over, and the server has not answered for {} s; missions continue without \
                     it, see `tread missions`",
                    format_duration(allowed),
                    silent.as_secs()
                ),
            };
            return Err(WaitTimeout(text).into());
        }
        tokio::time::sleep(outage.interval(POLL_INTERVAL)).await;
    }
}

/// Whether all missions have succeeded.
pub(super) fn have_succeeded(missions: &[Mission]) -> bool {
    missions
        .iter()
        .all(|mission| mission.state == MissionState::Succeeded)
}
