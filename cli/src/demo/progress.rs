//! Progress of a demo, with a bar for each robot.

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use tread_agent::sim::scenario::ScenarioRobot;
use tread_api::ids::RobotId;
use tread_api::mission::{Mission, MissionState};
use tread_api::robot::Robot;

use crate::output::print_note;

/// Number of steps of a bar.
const STEPS: u64 = 1_000;

/// Bars of the robots; hidden unless a person sees them.
pub(super) struct Progress {
    all: MultiProgress,
    shown: bool,
    lines: Vec<(RobotId, ProgressBar)>,
}

impl Progress {
    pub(super) fn new(robots: &[ScenarioRobot], shown: bool) -> Self {
        // The bars draw nothing if standard error is not a terminal.
        let target = if shown {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        };
        let all = MultiProgress::with_draw_target(target);
        let style = ProgressStyle::with_template("  {prefix:12} {bar:32} {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        let line = |robot: &ScenarioRobot| {
            let bar = all.add(ProgressBar::new(STEPS)).with_style(style.clone());
            bar.set_prefix(robot.id.to_string());
            (robot.id.clone(), bar)
        };
        let lines = robots.iter().map(line).collect();
        Self { all, shown, lines }
    }

    /// Prints a note above the bars.
    pub(super) fn notify(&self, note: &str) {
        if self.shown {
            self.all.suspend(|| print_note(note));
        }
    }

    /// Updates the bars.
    pub(super) fn show(&self, robots: &[Robot], missions: &[Mission]) {
        for (robot_id, bar) in &self.lines {
            let own = || missions.iter().filter(|mission| mission.robot == *robot_id);
            let ended = own().filter(|mission| mission.state.is_terminal()).count();
            let live = robots
                .iter()
                .find(|robot| robot.id == *robot_id)
                .and_then(|robot| robot.live.as_ref());
            let mission = live.and_then(|live| live.mission);
            let done = mission.map_or(0.0, |mission| mission.driven_m / mission.length_m.max(1e-9));
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                clippy::cast_precision_loss,
                reason = "0 to 1000"
            )]
            bar.set_position((done.clamp(0.0, 1.0) * STEPS as f64) as u64);
            let theta = live
                .and_then(|live| live.friction?.value.theta_measured)
                .map(|theta| format!(", theta {:.3} ± {:.3}", theta.theta, theta.std_dev));
            let failed = own()
                .filter(|mission| mission.state == MissionState::Failed)
                .count();
            let failures = if failed > 0 {
                format!(", {failed} failed")
            } else {
                String::new()
            };
            bar.set_message(format!(
                "mission {} of {}{failures}{}",
                (ended + 1).min(own().count()),
                own().count(),
                theta.unwrap_or_default()
            ));
        }
    }

    pub(super) fn finish(&self) {
        for (_, bar) in &self.lines {
            bar.abandon();
        }
    }
}
