//! What may only slow the robot down, in the loop: stops, hands, limits, fences, and the gate.
//!
//! The view of [`crate::safety`] is copied at the start of each tick, if nobody is writing it; the
//! last copy carries its own ends, so that nothing lasts longer for being read late.

use std::time::Duration;

use tread_api::robot::PauseCause;
use tread_control::fence::{FenceInput, MU_UNKNOWN};
use tread_control::gate::teleoperation::{BLIND_MAX_M_S, approach, no_faster, no_faster_than_real};
use tread_control::gate::{GateCause, GateInput, GateOutput, Reasons, gate_with};
use tread_control::geometry::Twist;
use tread_control::measured::WheelSpeeds;

use super::sensors::sensors_max_m_s;
use super::{LoopCore, STANDING, age_s};
use crate::control_loop::BRAKING_MAX;
use crate::control_loop::active::{Active, Hold};
use crate::control_loop::channels::{EndReason, Fault, GateSnapshot};
use crate::safety::{LoopView, microseconds};

/// What the guard knows between two ticks.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Guard {
    view: LoopView,
    now_us: u64,
    judged: Duration,
    /// The number of the stop in force; 0 for none.
    stop: u64,
    /// How long the server has been silent.
    server_silence: Duration,
    gate: GateSnapshot,
    last_cause: Option<GateCause>,
}

impl Guard {
    /// Whether a stop is in force.
    pub(super) fn is_stopped(&self) -> bool {
        self.stop != 0
    }

    /// Whether somebody has the lease of teleoperation.
    pub(super) fn is_leased(&self) -> bool {
        self.view.teleoperation.is_leased(self.now_us)
    }

    /// Judges what carries its own end by this time from now on.
    pub(super) fn judge(&mut self, now: Duration) {
        self.judged = now;
        self.now_us = microseconds(now);
    }

    /// The time by which it judges.
    pub(super) fn judged(&self) -> Duration {
        self.judged
    }

    /// What the gate did so far.
    pub(super) fn gate(&self) -> GateSnapshot {
        self.gate
    }

    /// What it looked at in this tick: the number of the stop in force, how long the server had
    /// been silent, and the rest.
    pub(super) fn looked_at(&self) -> (u64, Duration, LoopView) {
        (self.stop, self.server_silence, self.view)
    }

    fn count(&mut self, gated: &GateOutput) {
        let cause = gated.cause;
        self.gate.cause = cause;
        self.gate.target_rests = gated.target == WheelSpeeds::default();
        self.gate.reduced_ticks += u64::from(cause.is_some());
        if let Some(cause) = cause.filter(|cause| self.last_cause != Some(*cause)) {
            self.gate.counts[cause as usize] += 1;
        }
        self.last_cause = cause;
    }
}

/// What drives in this tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted {
    pub(super) wheels: WheelSpeeds,
    is_teleoperated: bool,
    is_driver_silent: bool,
}

impl LoopCore {
    /// Looks at stops, leases and limits, and holds the active mission where they ask for it.
    pub(super) fn check_safety(&mut self, now: Duration) {
        if let Some(watch) = &mut self.overrun {
            watch.note(now);
        }
        let is_loop_late = self.overrun().is_some();
        let shared = &self.ends.shared;
        self.guard.judge(now);
        self.guard.stop = shared.safety.stop();
        self.guard.server_silence = shared.server_silence(now);
        if let Some(view) = shared.safety.try_view() {
            self.guard.view = view;
        }
        let guard = &self.guard;
        let Some(active) = &mut self.active else {
            return;
        };
        if guard.is_stopped() {
            active.pause(PauseCause::Stop, now);
        } else if guard.is_leased() {
            active.pause(PauseCause::Teleoperation, now);
        }
        let limits = &guard.view.limits;
        let most_m_s = limits.linear_max_m_s(guard.now_us);
        let is_on_hold = limits.holds(guard.now_us) || most_m_s.is_some_and(|most| most < STANDING);
        active.hold(Hold::Outside, is_on_hold);
        active.hold(Hold::Overrun, is_loop_late);
        let sensors = sensors_max_m_s(&self.findings);
        let most_m_s = most_m_s.into_iter().chain(sensors).reduce(f64::min);
        active.limit_speed(most_m_s);
    }

    /// What the wheels are to do: what the teleoperator wants, or what the mission wants.
    pub(super) fn choose(
        &self,
        now: Duration,
        by_mission: Option<WheelSpeeds>,
        dt_s: f64,
    ) -> Wanted {
        let teleoperation = &self.guard.view.teleoperation;
        // A mission that is still braking for the lease comes to rest first.
        let is_mission_at_rest = self.active.as_ref().is_none_or(Active::rests);
        if !(teleoperation.is_leased(self.guard.now_us) && is_mission_at_rest) {
            return Wanted {
                wheels: by_mission.unwrap_or_default(),
                is_teleoperated: false,
                is_driver_silent: false,
            };
        }
        let wanted = teleoperation.wanted_at(self.guard.now_us);
        let previous = self.model.twist_from_wheel_speeds(self.command);
        let mut target = wanted.unwrap_or_default();
        let ends_soon = teleoperation.ends_soon(self.guard.now_us);
        if ends_soon {
            target = no_faster(previous, target);
        }
        let mut twist = approach(previous, target, &self.model, dt_s);
        if ends_soon {
            twist = no_faster_than_real(twist, self.real_m_s(now));
        }
        Wanted {
            wheels: self.model.wheel_speeds_from_twist(twist),
            is_teleoperated: true,
            is_driver_silent: wanted.is_none(),
        }
    }

    /// The fastest speed within the fence; none where there is no fence, or nobody knows where the
    /// robot is.
    fn fence_max_m_s(&self, wanted: Twist) -> Option<f64> {
        let site = self.site.as_ref().filter(|site| !site.fence().is_empty())?;
        let pose = self.localisation.pose()?;
        let seen = self.estimate.mu_peak_lower_bound;
        // Ground that has not slipped yet is taken for no worse than unknown ground.
        let mu_lower = if self.slips {
            seen
        } else {
            seen.map(|mu| mu.max(MU_UNKNOWN))
        };
        let input = FenceInput {
            pose,
            position_std_dev_m: self.localisation.position_std_dev_m(),
            present: self.localisation.twist(),
            wanted,
            mu_lower,
        };
        site.fence().judge(&input, &self.model).speed_max_m_s
    }

    /// Whether the robot must stand for not knowing where it is, or else how fast it may be driven.
    ///
    /// A mission needs a position. A teleoperator sees where the robot is: it goes slowly, and
    /// within a fence only if its configuration says so.
    fn blindness(&self, fault: Option<Fault>, wanted: &Wanted) -> (bool, Option<f64>) {
        let is_lost = fault == Some(Fault::PositionLost)
            || self.localisation.pose().is_none()
            || self.is_position_doubted();
        if !is_lost {
            return (false, None);
        }
        let is_fenced = self
            .site
            .as_ref()
            .is_some_and(|site| !site.fence().is_empty());
        let must_stand = if wanted.is_teleoperated {
            is_fenced && !self.blind_within_fence
        } else {
            is_fenced || self.active.is_some()
        };
        (must_stand, wanted.is_teleoperated.then_some(BLIND_MAX_M_S))
    }

    fn reasons(&self, now: Duration, fault: Option<Fault>, wanted: &Wanted) -> Reasons {
        let guard = &self.guard;
        let rest = WheelSpeeds::default();
        let is_moving = wanted.wheels != rest || self.command != rest;
        let twist = self.model.twist_from_wheel_speeds(wanted.wheels);
        let fence_max_m_s = if is_moving {
            self.fence_max_m_s(twist)
        } else {
            None
        };
        let is_driving = is_moving || self.active.is_some() || wanted.is_teleoperated;
        let (is_position_lost, blind_max_m_s) = if is_driving {
            self.blindness(fault, wanted)
        } else {
            (false, None)
        };
        let share = guard.view.teleoperation.speed_share;
        let linear_max_m_s = self.model.limits().linear_max_m_s;
        Reasons {
            is_stopped: guard.is_stopped(),
            tilt_rad: self.tilt_rad,
            is_position_lost,
            is_loop_late: self.overrun().is_some(),
            is_sensor_wrong: self.must_hold() && !wanted.is_teleoperated,
            is_held_outside: guard.view.limits.holds(guard.now_us),
            is_link_silent: self.is_long_silent(),
            is_driver_silent: wanted.is_driver_silent,
            fence_max_m_s,
            outside_max_m_s: guard.view.limits.linear_max_m_s(guard.now_us),
            command_age_max_m_s: (wanted.is_teleoperated && share < 1.0)
                .then_some(share * linear_max_m_s),
            blind_max_m_s,
            sensors_max_m_s: sensors_max_m_s(&self.findings),
            real_m_s: Some(self.real_m_s(now)),
        }
    }

    /// Whether the mission should long have ended for the server's silence.
    fn is_long_silent(&self) -> bool {
        let silence = self.guard.server_silence;
        let active = self.active.as_ref();
        active.is_some_and(|active| active.minds_silence(silence.saturating_sub(BRAKING_MAX)))
    }

    /// Lets through what may be, reduced.
    pub(super) fn pass(
        &mut self,
        now: Duration,
        fault: Option<Fault>,
        wanted: &Wanted,
        stop: bool,
        dt_s: f64,
    ) -> GateOutput {
        let reasons = self.reasons(now, fault, wanted);
        let gated = gate_with(
            &GateInput {
                // A robot without a mission holds still: that is a command, not the lack of one.
                command: Some(wanted.wheels),
                previous: self.command,
                stop,
                feedback_age_s: if self.is_base_silent {
                    f64::INFINITY
                } else {
                    age_s(now, self.last_sample)
                },
                dt_s,
            },
            &reasons,
            &self.limits,
        );
        self.guard.count(&gated);
        gated
    }

    /// The base has the command: a stop that the gate knew of has set the target to zero.
    pub(super) fn note_written(&self) {
        if self.guard.is_stopped() {
            self.ends.shared.safety.note_zeroed(self.guard.stop);
        }
    }

    /// What must not last for ever: the server's silence, and waiting for a revision.
    pub(super) fn check_bounds(&mut self, now: Duration) {
        let Some(active) = &mut self.active else {
            self.replacement_until = None;
            return;
        };
        if active.minds_silence(self.guard.server_silence) {
            active.stop(EndReason::ServerSilent);
        }
        if self.replacement_until.is_some_and(|until| now > until) {
            active.hold(Hold::Replacement, false);
            self.replacement_until = None;
        }
    }
}
