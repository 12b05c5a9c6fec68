//! Fourth stage: takes the wheel speeds of the mission or of the teleoperator through speed limits and gate.

use std::time::Duration;

use tread_control::fence::{FenceInput, MU_UNKNOWN};
use tread_control::gate::teleoperation::{BLIND_MAX_M_S, approach, no_faster, no_faster_than_real};
use tread_control::gate::{GateCause, GateInput, GateLimits, GateOutput, Reasons, gate_with};
use tread_control::geometry::Twist;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;
use tread_control::twist_limits::Change;

use super::demands::Demands;
use super::estimation::{EstimationOutput, real_m_s};
use super::mission::MissionOutput;
use super::sensing::SensingOutput;
use super::{Tick, age_s};
use crate::control_loop::channels::{Fault, GateSnapshot};
use crate::safety::microseconds;

/// Input of the stage.
#[derive(Debug)]
pub(super) struct SafetyInput<'tick> {
    pub(super) tick: Tick,
    /// Time by which inputs with an expiry are judged, by the monotonic clock.
    pub(super) judged: Duration,
    pub(super) sensed: &'tick SensingOutput,
    pub(super) estimated: &'tick EstimationOutput<'tick>,
    pub(super) demands: &'tick Demands,
    pub(super) followed: MissionOutput,
}

/// Output of the stage.
#[derive(Debug, Clone, Copy)]
pub(super) struct SafetyOutput {
    /// Time by which inputs with an expiry were judged, by the monotonic clock.
    pub(super) judged: Duration,
    /// Wheel speeds of the mission or the teleoperator, before the gate.
    pub(super) requested: WheelSpeeds,
    /// Output of the gate.
    pub(super) output: GateOutput,
    /// Action of the gate and its counters.
    pub(super) gate: GateSnapshot,
    /// Whether the lease of teleoperation is taken.
    pub(super) is_leased: bool,
}

/// Wheel speeds before the gate, and their source.
#[derive(Debug, Clone, Copy)]
struct RequestedSpeeds {
    wheels: WheelSpeeds,
    is_teleoperated: bool,
    is_driver_silent: bool,
}

/// The stage's state.
#[derive(Debug)]
pub(super) struct Safety {
    model: RobotModel,
    limits: GateLimits,
    /// Whether the robot may be teleoperated inside a fence without a known position.
    blind_within_fence: bool,
    /// Wheel speeds that the base was commanded last.
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

    /// Sets whether the robot may be teleoperated inside a fence without a known position.
    pub(super) fn set_blind_within_fence(&mut self, may: bool) {
        self.blind_within_fence = may;
    }

    /// Sets the time after which the base counts as silent.
    pub(super) fn set_silent_after(&mut self, silent_after: Duration) {
        self.limits.feedback_age_max_s = silent_after.as_secs_f64();
    }

    /// Returns the wheel speeds that the base was commanded last; `None` before the first tick.
    pub(super) fn commanded(&self) -> Option<WheelSpeeds> {
        self.command
    }

    /// Chooses mission or teleoperator, and passes the wheel speeds through the gate.
    pub(super) fn step(&mut self, input: &SafetyInput<'_>) -> SafetyOutput {
        let requested = self.choose(input);
        let reasons = self.reasons(input, &requested);
        let sensed = input.sensed;
        let output = gate_with(
            &GateInput {
                // A robot without a mission is commanded to zero, which is not a missing command.
                command: Some(requested.wheels),
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
        SafetyOutput {
            judged: input.judged,
            requested: requested.wheels,
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

    /// Returns the wheel speeds of the teleoperator or of the mission.
    fn choose(&self, input: &SafetyInput<'_>) -> RequestedSpeeds {
        let judged_us = microseconds(input.judged);
        let teleoperation = &input.demands.view.teleoperation;
        // A mission that is still braking for the lease stops first.
        if !(teleoperation.is_leased(judged_us) && input.followed.rests) {
            return RequestedSpeeds {
                wheels: input.followed.wheel_speeds.unwrap_or_default(),
                is_teleoperated: false,
                is_driver_silent: false,
            };
        }
        let requested = teleoperation.wanted_at(judged_us);
        let command = self.command.unwrap_or_default();
        let mut change = Change {
            from: self.model.twist_from_wheel_speeds(command),
            to: requested.unwrap_or_default(),
        };
        let ends_soon = teleoperation.ends_soon(judged_us);
        if ends_soon {
            change.to = no_faster(change);
        }
        let mut twist = approach(change, &self.model, input.tick.dt_s);
        if ends_soon {
            twist = no_faster_than_real(twist, input.real_m_s());
        }
        RequestedSpeeds {
            wheels: self.model.wheel_speeds_from_twist(twist),
            is_teleoperated: true,
            is_driver_silent: requested.is_none(),
        }
    }

    /// Returns the largest speed allowed by the fence, m/s; `None` without a fence or a pose.
    fn fence_max_m_s(&self, estimated: &EstimationOutput<'_>, requested: Twist) -> Option<f64> {
        let site = estimated.site.filter(|site| !site.fence().is_empty())?;
        let pose = estimated.pose?;
        let seen = estimated.estimate.mu_peak_lower_bound;
        // Ground without slip so far is assumed to be at least as good as unknown ground.
        let mu_lower = if estimated.slips {
            seen
        } else {
            seen.map(|mu| mu.max(MU_UNKNOWN))
        };
        let input = FenceInput {
            pose,
            position_std_dev_m: estimated.position_std_dev_m,
            present: estimated.twist,
            requested,
            mu_lower,
        };
        site.fence().limit_speed(&input, &self.model).speed_max_m_s
    }

    /// Returns whether the robot must stop because its position is unknown, and otherwise the speed
    /// limit, m/s.
    ///
    /// A mission needs a position. A teleoperator sees the robot and may drive it slowly, inside a
    /// fence only if the agent's configuration allows it.
    fn position_restriction(
        &self,
        input: &SafetyInput<'_>,
        requested: &RequestedSpeeds,
    ) -> (bool, Option<f64>) {
        let estimated = input.estimated;
        let is_lost = estimated.fault == Some(Fault::PositionLost)
            || estimated.pose.is_none()
            || input.sensed.is_position_doubted();
        if !is_lost {
            return (false, None);
        }
        let is_fenced = estimated.site.is_some_and(|site| !site.fence().is_empty());
        let must_stand = if requested.is_teleoperated {
            is_fenced && !self.blind_within_fence
        } else {
            is_fenced || input.followed.is_active
        };
        (
            must_stand,
            requested.is_teleoperated.then_some(BLIND_MAX_M_S),
        )
    }

    fn reasons(&self, input: &SafetyInput<'_>, requested: &RequestedSpeeds) -> Reasons {
        let demands = input.demands;
        let limits = &demands.view.limits;
        let judged_us = microseconds(input.judged);
        let rest = WheelSpeeds::default();
        let is_moving = requested.wheels != rest || self.command.unwrap_or_default() != rest;
        let twist = self.model.twist_from_wheel_speeds(requested.wheels);
        let fence_max_m_s = if is_moving {
            self.fence_max_m_s(input.estimated, twist)
        } else {
            None
        };
        let is_driving = is_moving || input.followed.is_active || requested.is_teleoperated;
        let (is_position_lost, blind_max_m_s) = if is_driving {
            self.position_restriction(input, requested)
        } else {
            (false, None)
        };
        let share = demands.view.teleoperation.speed_ratio;
        let linear_max_m_s = self.model.limits().linear_max_m_s;
        Reasons {
            is_stopped: demands.is_stopped(),
            tilt_rad: input.sensed.tilt_rad,
            is_position_lost,
            is_loop_late: demands.overrun.is_some(),
            is_sensor_wrong: input.sensed.must_hold() && !requested.is_teleoperated,
            is_held_outside: limits.holds(judged_us),
            is_link_silent: input.followed.is_long_silent,
            is_driver_silent: requested.is_driver_silent,
            fence_max_m_s,
            outside_max_m_s: limits.linear_max_m_s(judged_us),
            command_age_max_m_s: (requested.is_teleoperated && share < 1.0)
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
