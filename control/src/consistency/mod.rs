//! Consistency of the sensors: each channel is predicted from the others all the time.
//!
//! The turn rate is measured by gyro, wheels and the heading of position fixes; the forward speed
//! by wheels, odometry over ground and position; changes of both by the accelerometer. The wheels'
//! command is a further prediction for the wheels. A channel that contradicts the others beyond
//! noise for long enough gives a [`Finding`]:
//!
//! * Gyro, odometry and position measure the motion of the *body*, so if two of them disagree, one
//!   is faulty: the one that the wheels, or else the command, contradict more.
//! * If wheels contradict the body, their sensor is faulty where they contradict their command too
//!   and the body follows it. Where they follow the command, they may slip: the finding is then
//!   [`Subject::WheelsAndMotion`], which names no sensor.
//! * A channel that repeats its value to the last bit while it should change is frozen.
//!
//! ```text
//!            contradicts for RAISE_S                       agrees for CLEAR_S, while excited
//! consistent ───────────────────────► active finding ──────────────────────────────► consistent
//! ```
//! [`track`] implements the end of findings, also at standstill; [`verdict`] compares the channels.
//! No I/O, no allocation.

mod accelerometer;
mod findings;
mod fixes;
mod history;
mod track;
mod turn_gain;
mod verdict;

use std::time::Duration;

use crate::geometry::{Pose, Twist, wrap_angle_rad};
use crate::localisation::FixNoise;
use crate::measured::{BodyAcceleration, WheelSpeeds};
use crate::repeats::Repeats;
use crate::robot::RobotModel;
use accelerometer::Accelerometer;
use findings::Comparison;
pub use findings::{Consequence, Finding, Findings, Kind, Subject, Unit};
use fixes::{FixResidual, Fixes};
use history::{BIN_S, History, Span};
use track::Track;
use turn_gain::TurnGain;
use verdict::Verdicts;

/// Maximum time between two samples; a longer gap resets the history.
const GAP_MAX: Duration = Duration::from_millis(250);
/// Maximum age of the last fix for comparisons, seconds.
const FIX_AGE_MAX_S: f64 = 0.8;
/// Spans over which fixes are compared, seconds: short for large errors, long for small ones.
const SPANS_S: [f64; 5] = [0.4, 0.55, 0.75, 1.2, 2.0];

/// Measurements at one time; None for sensors without a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sample {
    /// Time of measurement.
    pub at: Duration,
    /// Turn rate by gyro, radians per second, counter-clockwise positive.
    pub gyro_rad_s: Option<f64>,
    /// Measured wheel speeds.
    pub wheel_speeds: Option<WheelSpeeds>,
    /// Acceleration in the body frame.
    pub acceleration: Option<BodyAcceleration>,
    /// Whether `acceleration` is the specific force, which contains gravity on a slope.
    pub is_specific_force: bool,
    /// Forward speed of the body over ground, metres per second.
    pub odometry_m_s: Option<f64>,
    /// Position fix in the site frame; it may be older than earlier samples.
    pub position: Option<Pose>,
    /// Standard deviations of the fix, if known.
    pub position_noise: Option<FixNoise>,
}

/// Consecutive equal values of each channel.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct AllRepeats {
    gyro: Repeats,
    wheels: Repeats,
    acceleration: Repeats,
    odometry: Repeats,
    position: Repeats,
}

/// Consistency monitor of one robot. Does not allocate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Monitor {
    model: RobotModel,
    history: History,
    fixes: Fixes,
    /// Motion by fixes minus dead reckoning for each of [`SPANS_S`], computed at the last fix.
    residuals: [Option<FixResidual>; SPANS_S.len()],
    last_fix: Option<Duration>,
    last: Option<Duration>,
    repeats: AllRepeats,
    accelerometer: Accelerometer,
    turn_gain: TurnGain,
    /// Position fix when the robot stopped.
    rest_at: Option<Pose>,
    tracks: [Track; Subject::ALL.len()],
}

impl Monitor {
    /// Creates a monitor without measurements.
    pub fn new(model: RobotModel) -> Self {
        Self {
            model,
            history: History::default(),
            fixes: Fixes::default(),
            residuals: [None; SPANS_S.len()],
            last_fix: None,
            last: None,
            repeats: AllRepeats::default(),
            accelerometer: Accelerometer::default(),
            turn_gain: TurnGain::default(),
            rest_at: None,
            tracks: [Track::default(); Subject::ALL.len()],
        }
    }

    /// Returns the active findings.
    pub fn findings(&self) -> Findings {
        Findings {
            active: self.tracks.map(|track| track.active),
        }
    }

    /// Sets the wheel speeds commanded from now on; a non-finite command is ignored.
    pub fn command(&mut self, command: WheelSpeeds) {
        if command.is_finite() {
            let twist = self.model.twist_from_wheel_speeds(command);
            self.history.command(twist);
        }
    }

    /// Adds a sample and evaluates all channels whenever a bin of 50 ms has ended. Samples come in
    /// the order of their arrival. Non-finite values are ignored.
    pub fn take(&mut self, sample: &Sample) {
        let at = sample.at;
        if let Some(odometry_m_s) = finite(sample.odometry_m_s) {
            self.repeats.odometry.take(at, [odometry_m_s, 0.0, 0.0]);
            self.history.odometry(odometry_m_s);
        }
        if let Some(acceleration) = sample.acceleration
            && acceleration.forward_m_s2.is_finite()
            && acceleration.left_m_s2.is_finite()
        {
            let words = [acceleration.forward_m_s2, acceleration.left_m_s2, 0.0];
            self.repeats.acceleration.take(at, words);
            self.accelerometer
                .take(acceleration, sample.is_specific_force);
        }
        let wheels = sample.wheel_speeds.filter(|wheels| wheels.is_finite());
        if let (Some(gyro_rad_s), Some(wheels)) = (finite(sample.gyro_rad_s), wheels) {
            self.repeats.gyro.take(at, [gyro_rad_s, 0.0, 0.0]);
            let words = [wheels.left_rad_s, wheels.right_rad_s, 0.0];
            self.repeats.wheels.take(at, words);
            self.add_motion(at, gyro_rad_s, self.model.twist_from_wheel_speeds(wheels));
        }
        if let Some(pose) = sample.position.filter(|pose| pose.is_finite()) {
            let words = [pose.x_m, pose.y_m, pose.heading_rad];
            self.repeats.position.take(at, words);
            if self.last.is_some() {
                let noise = sample.position_noise;
                let is_used = self
                    .fixes
                    .take(at.as_secs_f64(), pose, noise, &self.history);
                if is_used {
                    self.last_fix = Some(at);
                    self.residuals = SPANS_S.map(|span_s| self.fixes.residual(span_s));
                }
            }
        }
    }

    /// Adds gyro and wheels at a time; after a gap, restarts everything that integrates motion.
    fn add_motion(&mut self, at: Duration, gyro_rad_s: f64, wheels: Twist) {
        let is_gap = self
            .last
            .is_none_or(|last| at.saturating_sub(last) > GAP_MAX);
        self.last = self.last.max(Some(at));
        if is_gap {
            // The motion during the gap is unknown.
            self.history.restart(at);
            self.fixes.restart();
            self.residuals = [None; SPANS_S.len()];
            self.last_fix = None;
            self.accelerometer.restart();
            for track in &mut self.tracks {
                track.contradicting_s = 0.0;
                track.rested_s = 0.0;
            }
            return;
        }
        if self.history.add(at, gyro_rad_s, wheels) {
            self.evaluate();
        }
    }

    /// Evaluates all channels at the end of a bin.
    fn evaluate(&mut self) {
        let now_s = self.history.now().at_s;
        if let Some(recent) = self.history.means(self.history.last(BIN_S)) {
            self.accelerometer.step(&recent, &self.repeats.acceleration);
        }
        let fix_age_s = self
            .last_fix
            .map_or(f64::INFINITY, |fix| now_s - fix.as_secs_f64());
        let residuals = if fix_age_s <= FIX_AGE_MAX_S {
            self.residuals
        } else {
            [None; SPANS_S.len()]
        };
        let mut verdicts = Verdicts::default();
        let is_standing = self.update_standing();
        let view = verdict::View {
            model: &self.model,
            history: &self.history,
            residuals: &residuals,
            jump: self.fixes.jump(),
            repeats: &self.repeats,
            tracks: &self.tracks,
            turn_gain: self.turn_gain,
            is_standing,
            channels: verdict::Channels::default(),
        }
        .with_trusted();
        verdict::evaluate(&view, &mut verdicts);
        // Motion of the wheels that is not the body's would appear as a wrong gain of the
        // accelerometer.
        let is_quiet = self
            .tracks
            .iter()
            .zip(Subject::ALL)
            .all(|(track, subject)| {
                subject == Subject::Accelerometer
                    || track.contradicting_s <= 0.0
                    || (track.active.is_some() && subject.is_outside_dead_reckoning())
            });
        if is_quiet && verdicts.is_consistent() {
            if residuals.iter().any(Option::is_some)
                && let Some(recent) = self.history.means(Span {
                    from_s: now_s - LEARN_FROM_S,
                    to_s: now_s - LEARN_TO_S,
                })
            {
                self.turn_gain.learn(&recent);
            }
            if let Some(finding) = self.accelerometer.verdict() {
                let raise_s = if finding.kind == Kind::Inverted {
                    0.0
                } else {
                    ACCELEROMETER_RAISE_S
                };
                verdicts.contradict(finding, raise_s);
            } else if self.accelerometer.is_healthy() {
                verdicts.agree(Subject::Accelerometer);
            }
        }
        let is_on_probation = self.is_on_probation();
        for (track, subject) in self.tracks.iter_mut().zip(Subject::ALL) {
            let verdict = verdicts.of(subject);
            let is_at_once = is_on_probation && !is_standing && subject.concerns_position();
            track.step(if is_at_once {
                verdict.at_once()
            } else {
                verdict
            });
        }
        let has_relapsed = is_on_probation
            && Subject::ALL.into_iter().any(|subject| {
                subject.concerns_position() && self.tracks[subject as usize].active.is_some()
            });
        if has_relapsed {
            for (track, subject) in self.tracks.iter_mut().zip(Subject::ALL) {
                if subject.concerns_position() {
                    track.record_relapse();
                }
            }
        }
    }

    /// Returns whether a finding about the position ended at standstill and no motion has confirmed
    /// that since.
    fn is_on_probation(&self) -> bool {
        self.tracks.iter().any(|track| track.is_on_probation)
    }

    /// Returns whether the robot stands: command and wheels are at zero speed, and the fixes stay
    /// where they were when the robot stopped. Records or clears the position of that stop.
    fn update_standing(&mut self) -> bool {
        let commanded = self.history.commanded(self.history.last(REST_SPAN_S));
        let is_commanded = [commanded.least, commanded.most]
            .iter()
            .all(|twist| *twist == Twist::default());
        let at_rest = self
            .history
            .means(self.history.last(REST_SPAN_S))
            .is_some_and(|means| {
                means.wheels.linear_m_s.abs() <= REST_M_S
                    && means.wheels.angular_rad_s.abs() <= REST_RAD_S
            });
        if !(is_commanded && at_rest) {
            self.rest_at = None;
            return false;
        }
        let Some(newest) = self.fixes.newest() else {
            return false;
        };
        let rest_at = *self.rest_at.get_or_insert(newest);
        let turned_rad = wrap_angle_rad(newest.heading_rad - rest_at.heading_rad);
        let (position_m, heading_rad) = self.fixes.std_devs();
        let stays = rest_at.point().distance_m(newest.point())
            <= REST_DISTANCE_MAX_M.max(REST_STD_DEVS * position_m)
            && turned_rad.abs() <= REST_TURN_MAX_RAD.max(REST_STD_DEVS * heading_rad);
        if !stays {
            self.rest_at = None;
        }
        stays
    }
}

/// Span over which a robot must have stopped, seconds, and maximum speeds of its wheels in it,
/// metres and radians per second.
const REST_SPAN_S: f64 = 1.0;
const REST_M_S: f64 = 0.02;
const REST_RAD_S: f64 = 0.05;
/// Maximum distance of a stopped robot's fixes from the first one, metres and radians, or in
/// standard deviations of a fix if that is more.
const REST_DISTANCE_MAX_M: f64 = 0.3;
const REST_TURN_MAX_RAD: f64 = 0.1;
const REST_STD_DEVS: f64 = 7.0;

/// Window in which the turn gain is learned, seconds ago: a fault is found sooner than that.
const LEARN_FROM_S: f64 = 2.3;
const LEARN_TO_S: f64 = 2.0;
/// Time for which the accelerometer must contradict, seconds; evidence on its sign is accumulated
/// already.
const ACCELEROMETER_RAISE_S: f64 = 0.2;

fn finite(value: Option<f64>) -> Option<f64> {
    value.filter(|value| value.is_finite())
}
