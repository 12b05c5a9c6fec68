//! Holds the mission for stops, leases, limits, a silent base or sensors, and bounds these holds.

use std::time::Duration;

use tread_api::robot::PauseCause;
use tread_control::consistency::{Kind, Subject};

use super::{MissionInput, MissionStage};
use crate::control_loop::channels::Hold;
use crate::control_loop::channels::{EndReason, Fault};
use crate::control_loop::outgoing::Outgoing;
use crate::control_loop::segments::Moment;
use crate::control_loop::tick::STANDING;
use crate::control_loop::tick::sensing::SensingOutput;
use crate::safety::microseconds;

/// Time for which a base must send messages after a silence before its mission goes on.
const BASE_RECOVERY_TIME: Duration = Duration::from_millis(500);
/// Longest hold for sensors, after which the mission fails. A position finding that ends at
/// standstill, after 10 s, leaves time for the mission to go on.
const SENSORS_HOLD_MAX: Duration = Duration::from_secs(15);
/// Longest hold for sensors where the position jumped, after which the mission fails: it must not
/// go on from a position that was accepted meanwhile.
const LEAPT_HOLD_MAX: Duration = Duration::from_secs(10);

impl MissionStage {
    /// Pauses, holds or slows the mission for stops, leases, limits, a late loop and sensors.
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

    /// Ends the mission after the longest silence of the server, and the hold for a revision after
    /// its bound.
    pub(super) fn check_bounds(&mut self, input: &MissionInput<'_>) {
        let now = input.tick.now.monotonic;
        let Some(active) = &mut self.active else {
            self.replacement_until = None;
            return;
        };
        if active.is_server_silent_too_long(input.demands.server_silence) {
            active.stop(EndReason::ServerSilent);
        }
        if self.replacement_until.is_some_and(|until| now > until) {
            active.withdraw_replacement();
            self.replacement_until = None;
        }
    }

    /// Holds the mission while the base is silent and for [`BASE_RECOVERY_TIME`] afterwards.
    pub(super) fn hold_for_base(&mut self, now: Duration, fault: Option<Fault>) {
        if fault == Some(Fault::BaseSilent) {
            self.base_silent_at = Some(now);
        }
        let is_on_hold = self
            .base_silent_at
            .is_some_and(|silent_at| now.saturating_sub(silent_at) < BASE_RECOVERY_TIME);
        if !is_on_hold {
            self.base_silent_at = None;
        }
        if let Some(active) = &mut self.active {
            active.hold(Hold::Base, is_on_hold);
        }
    }

    /// Holds the mission while a sensor that it needs is contradicted, and fails it when that
    /// lasts.
    ///
    /// The mission ends without braking along the path, since a faulty base may never be measured
    /// at standstill.
    pub(super) fn hold_for_sensors(
        &mut self,
        at: Moment,
        sensed: &SensingOutput,
        events: &mut Outgoing,
    ) {
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
