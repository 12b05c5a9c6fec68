//! Whether the sensors agree: each channel is predicted from the others all the time.
//!
//! The turn rate is seen by gyro, wheels and the heading of position fixes; the speed ahead by
//! wheels, odometry over ground and position; changes of both by the accelerometer. The wheels'
//! command is one more word on the wheels. What contradicts the others beyond noise, for long
//! enough, is a [`Finding`]:
//!
//! * Gyro, odometry and position say how the *body* moves, so that two of them which disagree mean a
//!   fault of one. It is the one that the wheels, or else the command, contradict more.
//! * Wheels that contradict the body are a fault of their sensor where they contradict their command
//!   too and the body obeys it. Where they obey it, they may as well slip: the finding is then
//!   [`Subject::WheelsAndMotion`], and nobody is blamed.
//! * A channel that repeats its word to the last bit while it should not is frozen.
//!
//! ```text
//!            contradicts for RAISE_S                       agrees for CLEAR_S, while excited
//! consistent ───────────────────────► finding that stands ──────────────────────────────► consistent
//! ```
//! Pure, without allocation.

mod accelerometer;
mod fixes;
mod history;
mod repeats;
mod verdict;

use std::time::Duration;

use crate::geometry::{Pose, Twist};
use crate::localisation::FixNoise;
use crate::measured::{BodyAcceleration, WheelSpeeds};
use crate::robot::RobotModel;
use accelerometer::Accelerometer;
use fixes::{Fixes, Seen};
use history::{BIN_S, History};
use repeats::Repeats;
use verdict::Verdicts;

/// Longest pause between two samples over which motion is followed.
const GAP_MAX: Duration = Duration::from_millis(250);
/// Oldest fix that still says how the robot moves, seconds.
const FIX_AGE_MAX_S: f64 = 0.8;
/// Spans over which fixes are compared, seconds: quick for large errors, slow for small ones.
const SPANS_S: [f64; 2] = [1.0, 2.0];
/// How long a channel must agree until its finding ends, seconds.
const CLEAR_S: f64 = 2.0;

/// What a finding is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Subject {
    /// The wheels' measured speeds.
    Wheels,
    /// The gyro.
    Gyro,
    /// The accelerometer.
    Accelerometer,
    /// Odometry: the measured speed of the body over ground.
    Odometry,
    /// The position fixes.
    Position,
    /// The left wheels stand though they are commanded to turn.
    LeftWheels,
    /// The right wheels do.
    RightWheels,
    /// Wheels and body disagree, by slip or by a sensor: nothing distinguishes them.
    WheelsAndMotion,
    /// Channels that say how the body moves disagree, and nothing tells which is right.
    Motion,
}

impl Subject {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::Wheels,
        Self::Gyro,
        Self::Accelerometer,
        Self::Odometry,
        Self::Position,
        Self::LeftWheels,
        Self::RightWheels,
        Self::WheelsAndMotion,
        Self::Motion,
    ];

    /// For people.
    pub fn text(self) -> &'static str {
        match self {
            Self::Wheels => "wheel speeds",
            Self::Gyro => "gyro",
            Self::Accelerometer => "accelerometer",
            Self::Odometry => "odometry speed",
            Self::Position => "position",
            Self::LeftWheels => "left wheels",
            Self::RightWheels => "right wheels",
            Self::WheelsAndMotion => "wheels and motion",
            Self::Motion => "gyro, odometry and position",
        }
    }

    /// What a robot with this finding may still do.
    pub fn consequence(self) -> Consequence {
        match self {
            Self::Accelerometer | Self::Odometry => Consequence::NoLearning,
            Self::WheelsAndMotion => Consequence::Slow,
            Self::Wheels
            | Self::Gyro
            | Self::Position
            | Self::LeftWheels
            | Self::RightWheels
            | Self::Motion => Consequence::Hold,
        }
    }
}

/// What a finding asks for; later ones are stricter and include the earlier.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Consequence {
    /// Nothing is learned of the ground.
    NoLearning,
    /// The robot drives slowly.
    Slow,
    /// The robot does not drive by itself.
    Hold,
}

/// How a channel is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// It repeats its word to the last bit.
    Frozen,
    /// Its sign is wrong.
    Inverted,
    /// It leapt.
    Jumped,
    /// It contradicts the others otherwise: biased, scaled, rotated.
    Inconsistent,
    /// It stands though it is commanded to turn.
    Locked,
}

/// What the figures of a finding are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// m
    Metres,
    /// rad
    Radians,
    /// m/s
    MetresPerSecond,
    /// rad/s
    RadiansPerSecond,
    /// m/s²
    MetresPerSecondSquared,
}

impl Unit {
    /// Its symbol.
    pub fn symbol(self) -> &'static str {
        match self {
            Self::Metres => "m",
            Self::Radians => "rad",
            Self::MetresPerSecond => "m/s",
            Self::RadiansPerSecond => "rad/s",
            Self::MetresPerSecondSquared => "m/s²",
        }
    }
}

/// A contradiction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finding {
    /// What it is about.
    pub subject: Subject,
    /// How it is wrong.
    pub kind: Kind,
    /// What it says.
    pub observed: f64,
    /// What the others say.
    pub predicted: f64,
    /// The unit of both.
    pub unit: Unit,
}

/// The findings that stand, in the order of [`Subject::ALL`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Findings {
    standing: [Option<Finding>; Subject::ALL.len()],
}

impl Findings {
    /// Each of them.
    pub fn iter(&self) -> impl Iterator<Item = &Finding> {
        self.standing.iter().flatten()
    }

    /// The one about a subject.
    pub fn about(&self, subject: Subject) -> Option<&Finding> {
        self.standing[subject as usize].as_ref()
    }

    /// The strictest consequence.
    pub fn consequence(&self) -> Option<Consequence> {
        self.iter()
            .map(|finding| finding.subject.consequence())
            .max()
    }
}

/// What the sensors said at one moment; absent where one said nothing.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sample {
    /// When it was measured.
    pub at: Duration,
    /// Gyro, radians per second.
    pub gyro_rad_s: Option<f64>,
    /// Wheel speeds as measured.
    pub wheel_speeds: Option<WheelSpeeds>,
    /// Acceleration without gravity.
    pub acceleration: Option<BodyAcceleration>,
    /// Speed of the body over ground, metres per second.
    pub odometry_m_s: Option<f64>,
    /// A position fix; it may be older than the samples before it.
    pub position: Option<Pose>,
    /// How good that fix is, if that is known.
    pub position_noise: Option<FixNoise>,
}

/// Words that repeat, by channel.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct AllRepeats {
    gyro: Repeats,
    wheels: Repeats,
    acceleration: Repeats,
    odometry: Repeats,
    position: Repeats,
}

/// Evidence on one subject.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Track {
    against_s: f64,
    agreeing_s: f64,
    standing: Option<Finding>,
}

/// Watches one robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Monitor {
    model: RobotModel,
    history: History,
    fixes: Fixes,
    /// What the fixes of each span say, judged at the last fix.
    seen: [Option<Seen>; SPANS_S.len()],
    last_fix: Option<Duration>,
    last: Option<Duration>,
    repeats: AllRepeats,
    accelerometer: Accelerometer,
    tracks: [Track; Subject::ALL.len()],
}

impl Monitor {
    /// A robot of which nothing was heard yet.
    pub fn new(model: RobotModel) -> Self {
        Self {
            model,
            history: History::default(),
            fixes: Fixes::default(),
            seen: [None; SPANS_S.len()],
            last_fix: None,
            last: None,
            repeats: AllRepeats::default(),
            accelerometer: Accelerometer::default(),
            tracks: [Track::default(); Subject::ALL.len()],
        }
    }

    /// The findings that stand.
    pub fn findings(&self) -> Findings {
        Findings {
            standing: self.tracks.map(|track| track.standing),
        }
    }

    /// Notes what the wheels are commanded from now on.
    pub fn command(&mut self, command: WheelSpeeds) {
        if command.is_finite() {
            let twist = self.model.twist_from_wheel_speeds(command);
            self.history.command(twist);
        }
    }

    /// Takes what the sensors said; samples come in the order of their arrival.
    pub fn take(&mut self, sample: &Sample) {
        let at = sample.at;
        if let Some(odometry_m_s) = finite(sample.odometry_m_s) {
            self.repeats.odometry.take(at, [odometry_m_s, 0.0, 0.0]);
            self.history.odometry(odometry_m_s);
        }
        if let Some(felt) = sample.acceleration
            && felt.ahead_m_s2.is_finite()
            && felt.left_m_s2.is_finite()
        {
            let words = [felt.ahead_m_s2, felt.left_m_s2, 0.0];
            self.repeats.acceleration.take(at, words);
            self.accelerometer.take(felt);
        }
        let wheels = sample.wheel_speeds.filter(|wheels| wheels.is_finite());
        if let (Some(gyro_rad_s), Some(wheels)) = (finite(sample.gyro_rad_s), wheels) {
            self.repeats.gyro.take(at, [gyro_rad_s, 0.0, 0.0]);
            let words = [wheels.left_rad_s, wheels.right_rad_s, 0.0];
            self.repeats.wheels.take(at, words);
            self.follow(at, gyro_rad_s, self.model.twist_from_wheel_speeds(wheels));
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
                    self.seen = SPANS_S.map(|span_s| self.fixes.seen(span_s));
                }
            }
        }
    }

    fn follow(&mut self, at: Duration, gyro_rad_s: f64, wheels: Twist) {
        let is_gap = self
            .last
            .is_none_or(|last| at.saturating_sub(last) > GAP_MAX);
        self.last = self.last.max(Some(at));
        if is_gap {
            // Where the robot went meanwhile, nobody knows.
            self.history.restart(at);
            self.fixes.restart();
            self.seen = [None; SPANS_S.len()];
            self.last_fix = None;
            self.accelerometer.restart();
            for track in &mut self.tracks {
                track.against_s = 0.0;
            }
            return;
        }
        if self.history.add(at, gyro_rad_s, wheels) {
            self.judge();
        }
    }

    /// Looks at all channels at the end of a bin.
    fn judge(&mut self) {
        let now_s = self.history.now().at_s;
        if let Some(recent) = self.history.means(now_s - BIN_S, now_s) {
            self.accelerometer.step(
                recent.wheels.linear_m_s,
                recent.gyro_rad_s,
                &self.repeats.acceleration,
            );
        }
        let fix_age_s = self
            .last_fix
            .map_or(f64::INFINITY, |fix| now_s - fix.as_secs_f64());
        let seen = if fix_age_s <= FIX_AGE_MAX_S {
            self.seen
        } else {
            [None; SPANS_S.len()]
        };
        let mut verdicts = Verdicts::default();
        verdict::judge(
            &verdict::View {
                model: &self.model,
                history: &self.history,
                seen: &seen,
                jump: self.fixes.jump(),
                repeats: &self.repeats,
                tracks: &self.tracks,
            },
            &mut verdicts,
        );
        // A part of the wheels' motion that is not the body's would be felt as a wrong gain.
        let is_quiet = self
            .tracks
            .iter()
            .zip(Subject::ALL)
            .all(|(track, subject)| subject == Subject::Accelerometer || track.against_s <= 0.0);
        if is_quiet && verdicts.is_consistent() {
            if let Some(finding) = self.accelerometer.verdict() {
                verdicts.contradict(finding, ACCELEROMETER_RAISE_S);
            } else if self.accelerometer.is_healthy() {
                verdicts.agree(Subject::Accelerometer);
            }
        }
        for (track, (against, agrees)) in self.tracks.iter_mut().zip(verdicts.each()) {
            track.step(against, agrees);
        }
    }
}

/// How long the accelerometer must contradict, seconds.
const ACCELEROMETER_RAISE_S: f64 = 0.2;

impl Track {
    fn step(&mut self, against: Option<(Finding, f64)>, agrees: bool) {
        if let Some((finding, raise_s)) = against {
            self.agreeing_s = 0.0;
            self.against_s += BIN_S;
            if self.against_s >= raise_s - 0.5 * BIN_S && self.standing.is_none() {
                self.standing = Some(finding);
            }
            return;
        }
        self.against_s = (self.against_s - 2.0 * BIN_S).max(0.0);
        if agrees {
            self.agreeing_s += BIN_S;
        }
        if self.agreeing_s >= CLEAR_S {
            *self = Self::default();
        }
    }
}

fn finite(value: Option<f64>) -> Option<f64> {
    value.filter(|value| value.is_finite())
}
