//! What holds a mission: stops, leases, limits, a silent base, sensors, and what bounds a hold.

use std::time::Duration;

use tread_api::robot::PauseCause;
use tread_control::consistency::{Kind, Subject};

use super::{MissionInput, MissionStage};
use crate::control_loop::active::Hold;
use crate::control_loop::channels::{EndReason, Fault};
use crate::control_loop::outgoing::Outgoing;
use crate::control_loop::segments::Moment;
use crate::control_loop::tick::STANDING;
use crate::control_loop::tick::sensing::Sensed;
use crate::safety::microseconds;

/// How long a base that was silent must be heard before its mission goes on.
const HEARD_AGAIN_FOR: Duration = Duration::from_millis(500);
/// Longest time that a mission is held for sensors; then it fails. A finding on the place that ends
/// at rest, after 10 s, leaves time for the mission to go on.
const SENSORS_HOLD_MAX: Duration = Duration::from_secs(15);
/// The same where the position leapt: nobody drives on by a place that was believed meanwhile.
const LEAPT_HOLD_MAX: Duration = Duration::from_secs(10);

impl MissionStage {
    /// Pauses, holds or slows the mission where stops, leases, limits or sensors ask for it.
    pub(super) fn hold_for_demands(&mut self, input: &MissionInput<'_>) {
        let now = input.tick.now.monotonic;
        let now_us = microseconds(now);
        let demands = input.demands;
        let Some(active) = &mut self.active else {
            return;
        };
        if demands.is_stopped() {
            active.pause(PauseCause::Stop, now);
        } else if demands.is_leased(now_us) {
            active.pause(PauseCause::Teleoperation, now);
        }
        let limits = &demands.view.limits;
        let most_m_s = limits.linear_max_m_s(now_us);
        let is_on_hold = limits.holds(now_us) || most_m_s.is_some_and(|most| most < STANDING);
        active.hold(Hold::Outside, is_on_hold);
        active.hold(Hold::Overrun, demands.overrun.is_some());
        let sensors = input.sensed.sensors_max_m_s();
        let most_m_s = most_m_s.into_iter().chain(sensors).reduce(f64::min);
        active.limit_speed(most_m_s);
    }

    /// What must not last for ever: the server's silence, and waiting for a revision.
    pub(super) fn check_bounds(&mut self, now: Duration, server_silence: Duration) {
        let Some(active) = &mut self.active else {
            self.replacement_until = None;
            return;
        };
        if active.minds_silence(server_silence) {
            active.stop(EndReason::ServerSilent);
        }
        if self.replacement_until.is_some_and(|until| now > until) {
            active.hold(Hold::Replacement, false);
            self.replacement_until = None;
        }
    }

    /// Holds the mission of a base that is silent, and lets it go on when that is heard again for a
    /// while.
    pub(super) fn hold_for_base(&mut self, now: Duration, fault: Option<Fault>) {
        if fault == Some(Fault::BaseSilent) {
            self.base_silent_at = Some(now);
        }
        let is_on_hold = self
            .base_silent_at
            .is_some_and(|silent_at| now.saturating_sub(silent_at) < HEARD_AGAIN_FOR);
        if !is_on_hold {
            self.base_silent_at = None;
        }
        if let Some(active) = &mut self.active {
            active.hold(Hold::Base, is_on_hold);
        }
    }

    /// Holds the mission while a sensor that it drives by is wrong, and ends it when that lasts.
    ///
    /// A faulty base may never be seen to stand, so that the mission ends as it is.
    pub(super) fn hold_for_sensors(&mut self, at: Moment, sensed: &Sensed, events: &mut Outgoing) {
        let now = at.monotonic;
        let is_on_hold = sensed.must_hold() && self.active.is_some();
        self.sensors_hold_since = is_on_hold.then(|| self.sensors_hold_since.unwrap_or(now));
        let since = self.sensors_hold_since;
        let position = sensed.findings.about(Subject::Position);
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
            self.end(at, EndReason::SensorFault, events);
        }
    }
}
