//! Whether what the base says can be true, and whether the robot stands where it is to.
//!
//! A channel that contradicts the others holds or slows whatever depends on it; the monitor itself
//! is [`tread_control::consistency`], the watch over standstill [`crate::control_loop::standing`].

use std::time::Duration;

use tread_control::consistency::{Consequence, Findings, Kind, Sample, Subject};
use tread_control::gate::GateOutput;
use tread_control::gate::teleoperation::BLIND_MAX_M_S;
use tread_control::measured::WheelSpeeds;

use super::LoopCore;
use super::sensing::BODY_SPEED_AGE_MAX;
use crate::control_loop::active::Hold;
use crate::control_loop::channels::EndReason;
use crate::control_loop::segments::Moment;
use crate::drive::SensorSample;

/// Longest time that a mission is held for sensors; then it fails. A finding on the place that ends
/// at rest, after 10 s, leaves time for the mission to go on.
const SENSORS_HOLD_MAX: Duration = Duration::from_secs(15);
/// The same where the position leapt: nobody drives on by a place that was believed meanwhile.
const LEAPT_HOLD_MAX: Duration = Duration::from_secs(10);
/// Fastest speed of a robot whose sensors contradict each other.
const DOUBT_MAX_M_S: f64 = BLIND_MAX_M_S;

/// How fast a robot with these findings may be.
pub(super) fn sensors_max_m_s(findings: &Findings) -> Option<f64> {
    let consequence = findings.consequence()?;
    (consequence >= Consequence::Slow).then_some(DOUBT_MAX_M_S)
}

impl LoopCore {
    /// Shows a sample to the monitor.
    pub(super) fn check_sensors(&mut self, sample: &SensorSample) {
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
        if sample.yaw_rate_rad_s.is_some() {
            self.motion.turn_rad_s = sample.yaw_rate_rad_s.filter(|rate| rate.is_finite());
        }
        let fix = sample.position.filter(|pose| pose.is_finite());
        if let Some(pose) = fix {
            self.motion.fix = Some(pose.point());
        }
    }

    /// Whether anything may be learned of the ground.
    pub(super) fn may_learn(&self) -> bool {
        self.findings.consequence().is_none()
    }

    /// Whether the speed over ground that the base says is believed.
    pub(super) fn is_odometry_right(&self) -> bool {
        self.findings.about(Subject::Odometry).is_none()
    }

    /// Whether the position may be wrong.
    pub(super) fn is_position_doubted(&self) -> bool {
        [Subject::Position, Subject::Motion]
            .into_iter()
            .any(|subject| self.findings.about(subject).is_some())
    }

    /// Whether the robot must not drive by itself.
    pub(super) fn must_hold(&self) -> bool {
        self.findings.consequence() == Some(Consequence::Hold)
    }

    /// Holds the mission while a sensor that it drives by is wrong, and ends it when that lasts.
    ///
    /// A faulty base may never be seen to stand, so that the mission ends as it is.
    pub(super) fn hold_for_sensors(&mut self, at: Moment) {
        let now = at.monotonic;
        let is_on_hold = self.must_hold() && self.active.is_some();
        self.sensors_hold_since = is_on_hold.then(|| self.sensors_hold_since.unwrap_or(now));
        let since = self.sensors_hold_since;
        let position = self.findings.about(Subject::Position);
        let most = if position.is_some_and(|found| found.kind == Kind::Jumped) {
            LEAPT_HOLD_MAX
        } else {
            SENSORS_HOLD_MAX
        };
        let is_over = since.is_some_and(|since| now.saturating_sub(since) > most);
        if let Some(active) = &mut self.active {
            active.hold(Hold::Sensors, is_on_hold);
        }
        if is_over {
            self.sensors_hold_since = None;
            self.end_mission(at, EndReason::SensorFault);
        }
    }

    /// Tells the monitor what the wheels are commanded, and looks whether a robot that is to stand
    /// does.
    pub(super) fn check_standstill(&mut self, now: Duration, gated: &GateOutput) {
        self.monitor.command(self.command);
        let is_new = |at: Duration| now.saturating_sub(at) <= BODY_SPEED_AGE_MAX;
        let (wheels, gyro) = (Subject::Wheels, Subject::Gyro);
        let is_right = |subject: Subject| self.findings.about(subject).is_none();
        let odometry = self.body_speed.filter(|(_, at)| is_new(*at));
        let is_heard = !self.is_base_silent && self.last_sample.is_some_and(is_new);
        self.motion.wheels_m_s = (is_heard && is_right(wheels))
            .then(|| self.measured_wheels.magnitude_max_rad_s() * self.model.wheel_radius_m());
        self.motion.odometry_m_s = odometry
            .map(|(speed_m_s, _)| speed_m_s)
            .filter(|_| is_right(Subject::Odometry));
        if !(is_heard && is_right(gyro)) {
            self.motion.turn_rad_s = None;
        }
        if self.is_position_doubted() {
            self.motion.fix = None;
        }
        // What is not heard does not stand: it is not known.
        let is_to_stand = gated.target == WheelSpeeds::default();
        if is_heard || self.motion.odometry_m_s.is_some() || self.motion.fix.is_some() {
            self.standing.step(now, is_to_stand, &self.motion);
        } else if is_to_stand {
            self.standing.forget();
        } else {
            self.standing.step(now, false, &self.motion);
        }
    }
}
