//! First stage: what the base says, and whether it can be true.
//!
//! A channel that contradicts the others holds or slows whatever depends on it; the monitor itself
//! is [`tread_control::consistency`].

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

/// Oldest word of a sensor of the robot's own speed that says how fast it is now.
const BODY_SPEED_AGE_MAX: Duration = Duration::from_millis(150);
/// Fastest speed of a robot whose sensors contradict each other.
const DOUBT_MAX_M_S: f64 = BLIND_MAX_M_S;

/// What the stage takes.
#[derive(Debug)]
pub(super) struct SensingInput<'tick> {
    /// What the base has said since the last tick.
    pub(super) feedback: &'tick Feedback,
    /// Whether the drive says that the base is silent.
    pub(super) is_base_silent: bool,
    /// What the base was commanded by the last tick; none before the first.
    pub(super) commanded: Option<WheelSpeeds>,
}

/// One sample, as the estimation takes it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CheckedSample {
    /// When it was measured.
    pub(super) at: Duration,
    /// Gyro and wheels with the rest, and the seconds since they were heard before.
    pub(super) motion: Option<(SensorSample, f64)>,
    /// A position, finite or not.
    pub(super) fix: Option<PositionFix>,
    /// Whether no sensor contradicts another, so that something may be learned of the ground.
    pub(super) may_learn: bool,
}

/// What the stage gives.
#[derive(Debug)]
pub(super) struct Sensed {
    samples: [CheckedSample; SAMPLES_MAX],
    count: usize,
    /// Samples that gave way to newer ones.
    pub(super) lost_samples: u32,
    /// Sensors that contradict each other.
    pub(super) findings: Findings,
    /// Whether the drive says that the base is silent.
    pub(super) is_base_silent: bool,
    /// When gyro and wheels were measured last.
    pub(super) last_sample: Option<Duration>,
    /// Wheel speeds as measured last.
    pub(super) wheel_speeds: WheelSpeeds,
    /// How far the robot leans, if the base measures it.
    pub(super) tilt_rad: Option<f64>,
    /// What the gyro said last in this tick, finite or not.
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
    /// How fast the robot went by a sensor of its own, m/s, and when.
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

    /// Takes and checks what the base said.
    pub(super) fn step(&mut self, input: &SensingInput<'_>) -> Sensed {
        if let Some(commanded) = input.commanded {
            self.monitor.command(commanded);
        }
        let heard = input.feedback.samples();
        let mut samples = [CheckedSample::default(); SAMPLES_MAX];
        let (mut turn_rad_s, mut fix) = (None, None);
        for (checked, sample) in samples.iter_mut().zip(heard) {
            *checked = self.check(sample);
            turn_rad_s = sample.yaw_rate_rad_s.or(turn_rad_s);
            if let Some(pose) = sample.position.filter(|pose| pose.is_finite()) {
                fix = Some(pose.point());
            }
        }
        Sensed {
            samples,
            count: heard.len(),
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

    fn check(&mut self, sample: &drive::SensorSample) -> CheckedSample {
        self.monitor.take(&Sample {
            at: sample.at,
            gyro_rad_s: sample.yaw_rate_rad_s,
            wheel_speeds: sample.wheel_speeds,
            acceleration: sample.acceleration,
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
        // A position takes longer to be found than the motion since.
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
        }
    }

    /// Only what can be used counts as a word of the base: one that says nothing but nonsense is as
    /// good as silent.
    fn motion_of(&mut self, sample: &drive::SensorSample) -> Option<(SensorSample, f64)> {
        let gyro_rad_s = sample.yaw_rate_rad_s.filter(|rate| rate.is_finite())?;
        let wheel_speeds = sample.wheel_speeds.filter(|speeds| speeds.is_finite())?;
        let dt_s = self
            .last_sample
            .map_or(0.0, |last| sample.at.saturating_sub(last).as_secs_f64())
            .min(TICK_MAX_S);
        self.last_sample = Some(sample.at);
        self.wheel_speeds = wheel_speeds;
        let taken = SensorSample {
            wheel_speeds,
            gyro_rad_s,
            acceleration: sample.acceleration,
            body_speed_m_s: sample.body_speed_m_s,
            wheel_torques: sample.wheel_torques,
        };
        Some((taken, dt_s))
    }
}

impl Sensed {
    /// The samples of this tick, oldest first.
    pub(super) fn samples(&self) -> &[CheckedSample] {
        &self.samples[..self.count]
    }

    /// Whether nothing is wrong about a subject.
    pub(super) fn is_right(&self, subject: Subject) -> bool {
        self.findings.about(subject).is_none()
    }

    /// Whether the position may be wrong.
    pub(super) fn is_position_doubted(&self) -> bool {
        !(self.is_right(Subject::Position) && self.is_right(Subject::Motion))
    }

    /// Whether the robot must not drive by itself.
    pub(super) fn must_hold(&self) -> bool {
        self.findings.consequence() == Some(Consequence::Hold)
    }

    /// How fast a robot with these findings may be.
    pub(super) fn sensors_max_m_s(&self) -> Option<f64> {
        let consequence = self.findings.consequence()?;
        (consequence >= Consequence::Slow).then_some(DOUBT_MAX_M_S)
    }

    /// Whether gyro and wheels were heard of late.
    pub(super) fn is_heard(&self, now: Duration) -> bool {
        !self.is_base_silent && self.last_sample.is_some_and(|at| is_new(at, now))
    }

    /// How fast the robot goes by a sensor of its own that is believed, m/s.
    pub(super) fn odometry_m_s(&self, now: Duration) -> Option<f64> {
        let (speed_m_s, at) = self.body_speed?;
        (is_new(at, now) && self.is_right(Subject::Odometry)).then_some(speed_m_s)
    }
}

fn is_new(at: Duration, now: Duration) -> bool {
    now.saturating_sub(at) <= BODY_SPEED_AGE_MAX
}
