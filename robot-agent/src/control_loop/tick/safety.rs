//! Fourth stage: what of a command the base is given: who drives, how fast at most, and the gate.

use std::time::Duration;

use tread_control::fence::{FenceInput, MU_UNKNOWN};
use tread_control::gate::teleoperation::{BLIND_MAX_M_S, approach, no_faster, no_faster_than_real};
use tread_control::gate::{GateCause, GateInput, GateLimits, GateOutput, Reasons, gate_with};
use tread_control::geometry::Twist;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::demands::Demands;
use super::estimation::{Estimated, real_m_s};
use super::mission::Followed;
use super::sensing::Sensed;
use super::{Tick, age_s};
use crate::control_loop::channels::{Fault, GateSnapshot};
use crate::safety::microseconds;

/// What the stage takes.
#[derive(Debug)]
pub(super) struct SafetyInput<'tick> {
    pub(super) tick: Tick,
    /// The time by which is judged what carries its own end.
    pub(super) judged: Duration,
    pub(super) sensed: &'tick Sensed,
    pub(super) estimated: &'tick Estimated<'tick>,
    pub(super) demands: &'tick Demands,
    pub(super) followed: Followed,
}

/// What the stage gives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gated {
    /// The time by which was judged what carries its own end.
    pub(super) judged: Duration,
    /// What the mission or the teleoperator wants.
    pub(super) wanted: WheelSpeeds,
    /// What the gate lets through.
    pub(super) output: GateOutput,
    /// What the gate did so far.
    pub(super) gate: GateSnapshot,
    /// Whether somebody has the lease of teleoperation.
    pub(super) is_leased: bool,
}

/// What drives in this tick.
#[derive(Debug, Clone, Copy)]
struct Wanted {
    wheels: WheelSpeeds,
    is_teleoperated: bool,
    is_driver_silent: bool,
}

/// The stage's state.
#[derive(Debug)]
pub(super) struct Safety {
    model: RobotModel,
    limits: GateLimits,
    /// Whether the robot may be teleoperated within a fence without knowing where it is.
    blind_within_fence: bool,
    /// What the base was commanded last.
    command: Option<WheelSpeeds>,
    gate: GateSnapshot,
    last_cause: Option<GateCause>,
}

impl Safety {
    pub(super) fn new(model: RobotModel) -> Self {
        Self {
            model,
            limits: GateLimits::of(&model),
            blind_within_fence: false,
            command: None,
            gate: GateSnapshot::default(),
            last_cause: None,
        }
    }

    /// Whether the robot may be teleoperated within a fence without knowing where it is.
    pub(super) fn set_blind_within_fence(&mut self, may: bool) {
        self.blind_within_fence = may;
    }

    /// A base counts as silent after this.
    pub(super) fn set_silent_after(&mut self, silent_after: Duration) {
        self.limits.feedback_age_max_s = silent_after.as_secs_f64();
    }

    /// What the base was commanded last; none before the first tick.
    pub(super) fn commanded(&self) -> Option<WheelSpeeds> {
        self.command
    }

    /// Chooses who drives, and lets through what may be, reduced.
    pub(super) fn step(&mut self, input: &SafetyInput<'_>) -> Gated {
        let wanted = self.choose(input);
        let reasons = self.reasons(input, &wanted);
        let sensed = input.sensed;
        let output = gate_with(
            &GateInput {
                // A robot without a mission holds still: that is a command, not the lack of one.
                command: Some(wanted.wheels),
                previous: self.command.unwrap_or_default(),
                stop: input.tick.stop,
                feedback_age_s: if sensed.is_base_silent {
                    f64::INFINITY
                } else {
                    age_s(input.judged, sensed.last_sample)
                },
                dt_s: input.tick.dt_s,
            },
            &reasons,
            &self.limits,
        );
        self.count(&output);
        self.command = Some(output.wheel_speeds);
        Gated {
            judged: input.judged,
            wanted: wanted.wheels,
            output,
            gate: self.gate,
            is_leased: input.demands.is_leased(microseconds(input.judged)),
        }
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

    /// What the wheels are to do: what the teleoperator wants, or what the mission wants.
    fn choose(&self, input: &SafetyInput<'_>) -> Wanted {
        let judged_us = microseconds(input.judged);
        let teleoperation = &input.demands.view.teleoperation;
        // A mission that is still braking for the lease comes to rest first.
        if !(teleoperation.is_leased(judged_us) && input.followed.rests) {
            return Wanted {
                wheels: input.followed.wanted.unwrap_or_default(),
                is_teleoperated: false,
                is_driver_silent: false,
            };
        }
        let wanted = teleoperation.wanted_at(judged_us);
        let command = self.command.unwrap_or_default();
        let previous = self.model.twist_from_wheel_speeds(command);
        let mut target = wanted.unwrap_or_default();
        let ends_soon = teleoperation.ends_soon(judged_us);
        if ends_soon {
            target = no_faster(previous, target);
        }
        let mut twist = approach(previous, target, &self.model, input.tick.dt_s);
        if ends_soon {
            twist = no_faster_than_real(twist, input.real_m_s());
        }
        Wanted {
            wheels: self.model.wheel_speeds_from_twist(twist),
            is_teleoperated: true,
            is_driver_silent: wanted.is_none(),
        }
    }

    /// The fastest speed within the fence; none where there is no fence, or nobody knows where the
    /// robot is.
    fn fence_max_m_s(&self, estimated: &Estimated<'_>, wanted: Twist) -> Option<f64> {
        let site = estimated.site.filter(|site| !site.fence().is_empty())?;
        let pose = estimated.pose?;
        let seen = estimated.estimate.mu_peak_lower_bound;
        // Ground that has not slipped yet is taken for no worse than unknown ground.
        let mu_lower = if estimated.slips {
            seen
        } else {
            seen.map(|mu| mu.max(MU_UNKNOWN))
        };
        let input = FenceInput {
            pose,
            position_std_dev_m: estimated.position_std_dev_m,
            present: estimated.twist,
            wanted,
            mu_lower,
        };
        site.fence().judge(&input, &self.model).speed_max_m_s
    }

    /// Whether the robot must stand for not knowing where it is, or else how fast it may be driven.
    ///
    /// A mission needs a position. A teleoperator sees where the robot is: it goes slowly, and
    /// within a fence only if its configuration says so.
    fn blindness(&self, input: &SafetyInput<'_>, wanted: &Wanted) -> (bool, Option<f64>) {
        let estimated = input.estimated;
        let is_lost = estimated.fault == Some(Fault::PositionLost)
            || estimated.pose.is_none()
            || input.sensed.is_position_doubted();
        if !is_lost {
            return (false, None);
        }
        let is_fenced = estimated.site.is_some_and(|site| !site.fence().is_empty());
        let must_stand = if wanted.is_teleoperated {
            is_fenced && !self.blind_within_fence
        } else {
            is_fenced || input.followed.is_active
        };
        (must_stand, wanted.is_teleoperated.then_some(BLIND_MAX_M_S))
    }

    fn reasons(&self, input: &SafetyInput<'_>, wanted: &Wanted) -> Reasons {
        let demands = input.demands;
        let limits = &demands.view.limits;
        let judged_us = microseconds(input.judged);
        let rest = WheelSpeeds::default();
        let is_moving = wanted.wheels != rest || self.command.unwrap_or_default() != rest;
        let twist = self.model.twist_from_wheel_speeds(wanted.wheels);
        let fence_max_m_s = if is_moving {
            self.fence_max_m_s(input.estimated, twist)
        } else {
            None
        };
        let is_driving = is_moving || input.followed.is_active || wanted.is_teleoperated;
        let (is_position_lost, blind_max_m_s) = if is_driving {
            self.blindness(input, wanted)
        } else {
            (false, None)
        };
        let share = demands.view.teleoperation.speed_share;
        let linear_max_m_s = self.model.limits().linear_max_m_s;
        Reasons {
            is_stopped: demands.is_stopped(),
            tilt_rad: input.sensed.tilt_rad,
            is_position_lost,
            is_loop_late: demands.overrun.is_some(),
            is_sensor_wrong: input.sensed.must_hold() && !wanted.is_teleoperated,
            is_held_outside: limits.holds(judged_us),
            is_link_silent: input.followed.is_long_silent,
            is_driver_silent: wanted.is_driver_silent,
            fence_max_m_s,
            outside_max_m_s: limits.linear_max_m_s(judged_us),
            command_age_max_m_s: (wanted.is_teleoperated && share < 1.0)
                .then_some(share * linear_max_m_s),
            blind_max_m_s,
            sensors_max_m_s: input.sensed.sensors_max_m_s(),
            real_m_s: Some(input.real_m_s()),
        }
    }
}

impl SafetyInput<'_> {
    fn real_m_s(&self) -> f64 {
        real_m_s(self.sensed, self.estimated.twist, self.judged)
    }
}
