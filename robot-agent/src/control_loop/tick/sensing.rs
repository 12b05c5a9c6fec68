//! First stage: reads the samples of the base and checks them for consistency.
//!
//! A channel that contradicts the others holds or slows the robot; the checks are in
//! [`tread_control::consistency`].

use std::time::Duration;

use tread_control::consistency::{Consequence, Findings, Monitor, Sample, Subject};
use tread_control::estimation::SensorSample;
use tread_control::gate::teleoperation::BLIND_MAX_M_S;
use tread_control::geometry::Point;
use tread_control::localisation::PositionFix;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::TICK_MAX_S;
use crate::drive::{self, Feedback, SAMPLES_MAX};

/// Largest age of a measurement at which it counts as recent.
const BODY_SPEED_AGE_MAX: Duration = Duration::from_millis(150);
/// Speed limit of a robot whose sensors contradict each other, m/s.
const DOUBT_MAX_M_S: f64 = BLIND_MAX_M_S;

/// Input of the stage.
#[derive(Debug)]
pub(super) struct SensingInput<'tick> {
    /// Samples of the base since the last tick.
    pub(super) feedback: &'tick Feedback,
    /// Whether the drive reports the base as silent.
    pub(super) is_base_silent: bool,
    /// Wheel speeds that the last tick commanded; `None` before the first.
    pub(super) commanded: Option<WheelSpeeds>,
}

/// One checked sample, for the estimation stage.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CheckedSample {
    /// When it was measured.
    pub(super) at: Duration,
    /// Motion measured by gyro and wheels with the other sensors, and the time since the previous
    /// motion sample, seconds.
    pub(super) motion: Option<(SensorSample, f64)>,
    /// Position fix; may be non-finite.
    pub(super) fix: Option<PositionFix>,
    /// Whether no sensor contradicts another, so that the estimator may use the sample.
    pub(super) may_learn: bool,
    /// Whether neither wheels nor position are known to be wrong, so that they show whether the robot
    /// makes progress.
    pub(super) shows_progress: bool,
}

/// Output of the stage.
#[derive(Debug)]
pub(super) struct SensingOutput {
    samples: [CheckedSample; SAMPLES_MAX],
    count: usize,
    /// Samples that newer ones replaced before this tick.
    pub(super) lost_samples: u32,
    /// Sensors that contradict each other.
    pub(super) findings: Findings,
    /// Whether the drive reports the base as silent.
    pub(super) is_base_silent: bool,
    /// Time of the last valid sample of gyro and wheels.
    pub(super) last_sample: Option<Duration>,
    /// Last valid wheel speeds.
    pub(super) wheel_speeds: WheelSpeeds,
    /// Tilt against the vertical, if the base measures it.
    pub(super) tilt_rad: Option<f64>,
    /// Last yaw rate of the gyro in this tick; may be non-finite.
    pub(super) turn_rad_s: Option<f64>,
    /// The newest position of this tick.
    pub(super) fix: Option<Point>,
    body_speed: Option<(f64, Duration)>,
}

/// The stage's state.
#[derive(Debug)]
pub(super) struct Sensing {
    monitor: Monitor,
    findings: Findings,
    last_sample: Option<Duration>,
    wheel_speeds: WheelSpeeds,
    tilt_rad: Option<f64>,
    /// Speed by odometry over ground, m/s, and its measuring time.
    body_speed: Option<(f64, Duration)>,
}

impl Sensing {
    pub(super) fn new(model: RobotModel) -> Self {
        Self {
            monitor: Monitor::new(model),
            findings: Findings::default(),
            last_sample: None,
            wheel_speeds: WheelSpeeds::default(),
            tilt_rad: None,
            body_speed: None,
        }
    }

    /// Reads and checks the samples of this tick.
    pub(super) fn step(&mut self, input: &SensingInput<'_>) -> SensingOutput {
        if let Some(commanded) = input.commanded {
            self.monitor.command(commanded);
        }
        let received = input.feedback.samples();
        let mut samples = [CheckedSample::default(); SAMPLES_MAX];
        let (mut turn_rad_s, mut fix) = (None, None);
        for (checked, sample) in samples.iter_mut().zip(received) {
            *checked = self.check(sample);
            turn_rad_s = sample.yaw_rate_rad_s.or(turn_rad_s);
            if let Some(pose) = sample.position.filter(|pose| pose.is_finite()) {
                fix = Some(pose.point());
            }
        }
        SensingOutput {
            samples,
            count: received.len(),
            lost_samples: input.feedback.lost(),
            findings: self.findings,
            is_base_silent: input.is_base_silent,
            last_sample: self.last_sample,
            wheel_speeds: self.wheel_speeds,
            tilt_rad: self.tilt_rad,
            turn_rad_s,
            fix,
            body_speed: self.body_speed,
        }
    }

    fn is_right(&self, subject: Subject) -> bool {
        self.findings.about(subject).is_none()
    }

    fn check(&mut self, sample: &drive::SensorSample) -> CheckedSample {
        self.monitor.take(&Sample {
            at: sample.at,
            gyro_rad_s: sample.yaw_rate_rad_s,
            wheel_speeds: sample.wheel_speeds,
            acceleration: sample.acceleration,
            is_specific_force: sample.is_specific_force,
            odometry_m_s: sample.body_speed_m_s,
            position: sample.position,
            position_noise: sample.position_noise,
        });
        self.findings = self.monitor.findings();
        if sample.tilt_rad.is_some() {
            self.tilt_rad = sample.tilt_rad;
        }
        if let Some(speed_m_s) = sample.body_speed_m_s.filter(|speed| speed.is_finite()) {
            self.body_speed = Some((speed_m_s, sample.at));
        }
        let motion = self.motion_of(sample);
        // A position fix is older than the motion measured since.
        let age_s = self
            .last_sample
            .map_or(0.0, |last| last.saturating_sub(sample.at).as_secs_f64());
        CheckedSample {
            at: sample.at,
            motion,
            fix: sample.position.map(|pose| PositionFix {
                pose,
                age_s,
                noise: sample.position_noise,
            }),
            may_learn: self.findings.consequence().is_none(),
            shows_progress: self.is_right(Subject::Wheels) && self.is_right(Subject::Position),
        }
    }

    /// Returns the sample's motion, if gyro and wheels are finite. Only such a sample counts as a
    /// message of the base: one that sends only non-finite values becomes silent.
    fn motion_of(&mut self, sample: &drive::SensorSample) -> Option<(SensorSample, f64)> {
        let motion = drive::motion_of(sample)?;
        let dt_s = self
            .last_sample
            .map_or(0.0, |last| sample.at.saturating_sub(last).as_secs_f64())
            .min(TICK_MAX_S);
        self.last_sample = Some(sample.at);
        self.wheel_speeds = motion.wheel_speeds;
        Some((motion, dt_s))
    }
}

impl SensingOutput {
    /// Returns the samples of this tick, oldest first.
    pub(super) fn samples(&self) -> &[CheckedSample] {
        &self.samples[..self.count]
    }

    /// Whether there is no finding about a subject.
    pub(super) fn is_right(&self, subject: Subject) -> bool {
        self.findings.about(subject).is_none()
    }

    /// Whether the position may be wrong.
    pub(super) fn is_position_doubted(&self) -> bool {
        !(self.is_right(Subject::Position) && self.is_right(Subject::Motion))
    }

    /// Whether the findings hold a robot on a mission.
    pub(super) fn must_hold(&self) -> bool {
        self.findings.consequence() == Some(Consequence::Hold)
    }

    /// Returns the speed limit for these findings, m/s.
    pub(super) fn sensors_max_m_s(&self) -> Option<f64> {
        let consequence = self.findings.consequence()?;
        (consequence >= Consequence::Slow).then_some(DOUBT_MAX_M_S)
    }

    /// Whether gyro and wheels were measured within [`BODY_SPEED_AGE_MAX`].
    pub(super) fn is_heard(&self, now: Duration) -> bool {
        let is_new = |at: Duration| now.saturating_sub(at) <= BODY_SPEED_AGE_MAX;
        !self.is_base_silent && self.last_sample.is_some_and(is_new)
    }

    /// Returns the speed by odometry over ground, m/s, if recent and without a finding.
    pub(super) fn odometry_m_s(&self, now: Duration) -> Option<f64> {
        let (speed_m_s, at) = self.body_speed?;
        let is_new = now.saturating_sub(at) <= BODY_SPEED_AGE_MAX;
        (is_new && self.is_right(Subject::Odometry)).then_some(speed_m_s)
    }
}
