//! The shipped tracking law: wheel speeds from tracking errors. `docs/control.md` has the proof.
//!
//! The paper's idea on a base that really slips. With errors in the frame of the robot's *course*,
//! which differs from its heading by the sideslip `β = −vωθ/g` (θ = 1/K, steady turn of the
//! four-wheel sum), the error's own motion holds `ė_y = v sin e_θ + (v²ω/g) θ̃`. So
//! `V = ½k_y(e_x² + e_y²) + (1 − cos e_θ) + k_y θ̃²/(2ρ)` falls under `θ̂̇ = ρ e_y v²ω/g`, the
//! adaptation (26) of the paper, on a law that never inverts a measured velocity: it is regular at
//! standstill.
//!
//! In tight bends wheels slip beyond the peak of their friction curve, whatever the speed, and the
//! sideslip is several times as large. The turn is therefore computed with the four-wheel sum
//! itself, in its linear range and with the loss beyond the peak of
//! [`TrackerConfig::friction_curve`]; a share χ̂ of that loss is believed, adapted like θ̂, so that
//! tyres of another shape are found out.
//!
//! The command is the reference's motion, corrected by the errors (Kanayama's form, with integral
//! action over the distance driven), plus feed-forward with θ̂: the sideslip, the rims that the
//! turn needs, lead for the wheel servo and half a sample, and lead for slip relaxation, `vθ/g`
//! along and `(vθ/g)·4 I_G/(m(W² + L²))` in yaw. An inner loop on the measured turn rate, of gain
//! below one, keeps margin where slip is slow. Gains follow the noise of the pose.
//!
//! θ̂ starts at zero: no knowledge, no sideslip. A known θ pulls it, by the confidence in it. χ̂
//! starts at one, and goes back to it when a known θ contradicts the one before. Both are bounded
//! in range and rate, and held while the wheels saturate, something outside cuts the command, or
//! the pose is stale. They serve this loop only; what the map gets comes from
//! [`crate::estimation`].

mod config;
mod knowledge;
mod noise;
mod sideslip;
mod turn;

use crate::geometry::{Twist, wrap_angle_rad};
use crate::measured::{Measured, WheelSpeeds};
use crate::reference::ReferenceSample;
use crate::robot::{GRAVITY_M_S2, RobotModel};
use crate::twist_limits::TwistLimits;

pub use config::{CrossGains, TrackerConfig, TrackerError};
pub use knowledge::ThetaKnowledge;
use noise::NoiseLevel;
use sideslip::{Belief, Sideslip};

/// Fastest drive backwards, to come back to a point that was overrun, metres per second.
const REVERSE_MAX_M_S: f64 = 0.15;
/// How much faster than its reference a robot that lags drives at the most, metres per second. One
/// that gathers more speed comes to the next bend too fast for slippery ground.
const CATCH_UP_MAX_M_S: f64 = 0.06;
/// Share of the robot's speed limit up to which it may drive faster than that.
const CATCH_UP_SPEED_SHARE: f64 = 0.5;
/// Largest error along the path that acts, metres.
const ALONG_TRACK_MAX_M: f64 = 0.3;
/// Reference speed below which the integral is held, metres per second.
const INTEGRAL_SPEED_MIN_M_S: f64 = 0.05;
/// Heading feedback acts as if driving at least this fast, so that it holds at rest too.
const HEADING_SPEED_MIN_M_S: f64 = 0.15;
/// Cross-track errors smaller than this move neither θ̂ nor χ̂, metres.
const ADAPTATION_DEAD_ZONE_M: f64 = 5.0e-4;
/// Most of what the acceleration limits cut that is carried into the next tick. Noise would be cut
/// on the side of speeding up alone, and the robot would turn and drive too slowly in the mean.
const CARRIED_MAX: Twist = Twist {
    linear_m_s: 0.05,
    angular_rad_s: 0.3,
};

/// How much smaller the standard deviation of a word is that replaces the one χ̂ was adapted under.
const BETTER_WORD: f64 = 0.5;
/// Fastest change of the share of the loss beyond the peak that is believed, per second.
const BEYOND_RATE_MAX_1_S: f64 = 1.0;

/// How far the robot is from its reference.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TrackingErrors {
    /// How far the reference is ahead along its path, metres.
    pub along_track_m: f64,
    /// How far the reference is to the left of the robot, across its path, metres.
    pub cross_track_m: f64,
    /// Reference heading minus the robot's, radians.
    pub heading_rad: f64,
}

impl TrackingErrors {
    /// Errors in the frame of the reference.
    pub fn between(reference: &ReferenceSample, measured: &Measured) -> Self {
        let robot = reference.pose.body_from_site(measured.pose.point());
        Self {
            along_track_m: -robot.x_m,
            cross_track_m: -robot.y_m,
            heading_rad: wrap_angle_rad(reference.pose.heading_rad - measured.pose.heading_rad),
        }
    }

    /// Distance to the reference, metres.
    pub fn distance_m(&self) -> f64 {
        self.along_track_m.hypot(self.cross_track_m)
    }
}

/// What the law gives in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TrackerOutput {
    /// Wheel speeds to command.
    pub wheel_speeds: WheelSpeeds,
    /// The twist behind them.
    pub twist: Twist,
    /// Errors in the frame of the reference.
    pub errors: TrackingErrors,
    /// θ̂ in the loop; never a measurement.
    pub theta_loop: f64,
    /// How much of the friction that is lost beyond the peak is believed in the loop, χ̂, 0 to 1.
    pub beyond_loop: f64,
    /// How much the known θ is believed, 0 to 1.
    pub confidence: f64,
    /// Whether the wheel limits cut the command.
    pub saturated: bool,
}

/// What a speed limit cut from a command.
#[derive(Debug, Clone, Copy)]
struct Cut {
    /// A wheel's.
    by_wheels: bool,
    /// That of the turn rate.
    in_yaw: bool,
}

/// The law and its memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tracker {
    model: RobotModel,
    config: TrackerConfig,
    integral_1_m: f64,
    theta: f64,
    /// Share of the loss beyond the peak of the friction curve that is believed, χ̂.
    beyond: f64,
    /// The θ under which χ̂ was adapted.
    known: Option<ThetaKnowledge>,
    /// χ̂ is on its way back to one.
    forgets: bool,
    noise: NoiseLevel,
    was_cut: bool,
    held_from_outside: bool,
    /// What the acceleration limits cut from the last command.
    carried: Twist,
    /// What was commanded last; none before the first tick.
    commanded: Option<Twist>,
}

impl Tracker {
    /// A law at rest, with θ̂ at zero.
    ///
    /// # Errors
    /// [`TrackerError`] names a gain or bound that is out of its range.
    pub fn new(model: RobotModel, config: TrackerConfig) -> Result<Self, TrackerError> {
        config.check()?;
        Ok(Self {
            model,
            config,
            integral_1_m: 0.0,
            theta: 0.0,
            beyond: 1.0,
            known: None,
            forgets: false,
            noise: NoiseLevel::default(),
            was_cut: false,
            held_from_outside: false,
            carried: Twist::default(),
            commanded: None,
        })
    }

    /// Holds θ̂ and the integral while something outside, such as the gate, cuts the command.
    pub fn hold_adaptation(&mut self, held: bool) {
        self.held_from_outside = held;
    }

    /// Tells the law what the base was commanded last, where that is not what it gave itself: it
    /// speeds up from there.
    pub fn set_commanded(&mut self, commanded: WheelSpeeds) {
        self.commanded =
            Some(self.model.twist_from_wheel_speeds(commanded)).filter(|twist| twist.is_finite());
    }

    /// Starts with what a map or an earlier run knows, at its full weight from the first metre.
    pub fn warm_start(&mut self, knowledge: ThetaKnowledge) {
        if knowledge.confidence() > 0.0 {
            self.theta = (knowledge.confidence() * knowledge.theta).min(self.config.theta_max);
        }
    }

    /// θ̂ in the loop.
    pub fn theta_loop(&self) -> f64 {
        self.theta
    }

    /// One tick: the command for this reference from what is measured and known.
    pub fn step(
        &mut self,
        reference: &ReferenceSample,
        measured: &Measured,
        knowledge: Option<ThetaKnowledge>,
        dt_s: f64,
    ) -> TrackerOutput {
        let config = self.config;
        let knowledge = knowledge.filter(|known| known.confidence() > 0.0);
        self.apply_knowledge(knowledge, dt_s);
        let theta = self.theta;
        let density = self.noise.update(measured, dt_s);
        let noise = density / config.noise_middle_m_sqrt_s.powi(2)
            + (measured.position_std_dev_m / config.position_middle_m).powi(2);
        let gains = CrossGains::blend(config.quiet, config.noisy, 1.0 / (1.0 + noise));

        let speed_m_s = reference.speed_m_s;
        let belief = Belief {
            theta,
            beyond: self.beyond,
        };
        let sideslip = Sideslip::of(reference, belief, &config.friction_curve, &self.model);
        let mut course = measured.pose;
        course.heading_rad += sideslip.angle_rad;
        let forward = course.body_from_site(reference.pose.point());
        let heading_rad = wrap_angle_rad(reference.pose.heading_rad - course.heading_rad);
        let catch_up_m_s = (CATCH_UP_SPEED_SHARE * self.model.limits().linear_max_m_s - speed_m_s)
            .max(CATCH_UP_MAX_M_S);
        let catch_up_m = catch_up_m_s / config.along_track_gain_1_s;
        let along_track_m = forward
            .x_m
            .clamp(-ALONG_TRACK_MAX_M, catch_up_m.min(ALONG_TRACK_MAX_M));
        // Bounded so that a far-off robot comes in at a bounded angle instead of spinning.
        let cross_max_m = 0.8 * gains.heading_1_m / gains.cross_1_m2;
        let cross_track_m = forward.y_m.clamp(-cross_max_m, cross_max_m);

        let held = self.was_cut
            || self.held_from_outside
            || measured.pose_age_s > config.pose_age_max_s
            || speed_m_s < INTEGRAL_SPEED_MIN_M_S;
        if !held {
            self.integrate(gains.integral_1_m3 * cross_track_m * speed_m_s * dt_s);
            self.adapt(&sideslip, cross_track_m, knowledge, dt_s);
        }

        let slip_lead_s = speed_m_s * theta / GRAVITY_M_S2;
        let yaw_shape = 4.0 * self.model.yaw_inertia_kg_m2()
            / (self.model.mass_kg()
                * (self.model.track_width_m().powi(2) + self.model.wheelbase_m().powi(2)));
        let lead_s = config.servo_lag_s + 0.5 * dt_s;
        let linear_m_s = speed_m_s * heading_rad.cos()
            + config.along_track_gain_1_s * along_track_m
            + (lead_s + slip_lead_s) * reference.acceleration_m_s2
            + sideslip.rims.linear_m_s;
        let wanted_rad_s = reference.turn_rad_s - sideslip.rate_rad_s
            + speed_m_s * (gains.cross_1_m2 * cross_track_m + self.integral_1_m)
            + speed_m_s.max(HEADING_SPEED_MIN_M_S) * gains.heading_1_m * heading_rad.sin();
        let angular_rad_s = wanted_rad_s
            + gains.yaw_rate * (wanted_rad_s - measured.twist.angular_rad_s)
            + (lead_s + slip_lead_s * yaw_shape) * reference.turn_acceleration_rad_s2
            + sideslip.rims.angular_rad_s;
        let wanted = Twist {
            linear_m_s,
            angular_rad_s,
        };
        let before = self
            .commanded
            .unwrap_or_else(|| self.model.twist_from_wheel_speeds(measured.wheel_speeds));
        let (wheel_speeds, cut) = self.within_limits(before, wanted, dt_s);
        self.commanded = Some(self.model.twist_from_wheel_speeds(wheel_speeds));
        self.was_cut = cut.by_wheels || cut.in_yaw;
        TrackerOutput {
            wheel_speeds,
            twist: self.model.twist_from_wheel_speeds(wheel_speeds),
            errors: TrackingErrors::between(reference, measured),
            theta_loop: self.theta,
            beyond_loop: self.beyond,
            confidence: knowledge.map_or(0.0, |known| known.confidence()),
            saturated: cut.by_wheels,
        }
    }

    /// What was adapted under a θ that is now contradicted says nothing: χ̂ goes back to one.
    fn apply_knowledge(&mut self, knowledge: Option<ThetaKnowledge>, dt_s: f64) {
        if let Some(now) = knowledge {
            let anchor = *self.known.get_or_insert(now);
            self.forgets |= anchor.contradicts(now);
            // A better word on the same ground takes its place; many slightly better ones would
            // carry it along with a θ that moves.
            if anchor.contradicts(now) || now.std_dev < BETTER_WORD * anchor.std_dev {
                self.known = Some(now);
            }
        }
        if self.forgets {
            self.beyond = (self.beyond + BEYOND_RATE_MAX_1_S * dt_s).min(1.0);
            self.forgets = self.beyond < 1.0;
        }
    }

    /// Bounded, so that it cannot wind up.
    fn integrate(&mut self, change_1_m: f64) {
        let bound = self.config.integral_max_1_m;
        self.integral_1_m = (self.integral_1_m + change_1_m).clamp(-bound, bound);
    }

    /// `θ̂̇ = ρ e_y φ + pull·c (cθ − θ̂)` and `χ̂̇ = ρ_χ e_y φ_χ`, c the confidence, φ and `φ_χ`
    /// the drifts per θ and per χ; bounded in rate and range.
    fn adapt(
        &mut self,
        sideslip: &Sideslip,
        cross_track_m: f64,
        knowledge: Option<ThetaKnowledge>,
        dt_s: f64,
    ) {
        let config = &self.config;
        let error_m = if cross_track_m.abs() < ADAPTATION_DEAD_ZONE_M {
            0.0
        } else {
            cross_track_m
        };
        // More changes nothing at the end of what is assumed, and would wind up.
        let most = if sideslip.is_at_end {
            0.0
        } else {
            f64::INFINITY
        };
        let gradient = (config.adaptation_gain * error_m * sideslip.drift_per_theta_m_s).min(most);
        let pull = knowledge.map_or(0.0, |known| {
            let weight = known.confidence();
            let apart = weight * known.theta - self.theta;
            let band = config.adaptation_band_ratio * known.theta + known.std_dev;
            let outside = apart - apart.clamp(-band, band);
            weight * (config.adaptation_pull_1_s * apart + config.adaptation_return_1_s * outside)
        });
        let bound = config.adaptation_rate_max_1_s;
        // The pull is a way back, not a drift: it may act faster than the gradient.
        let rate = gradient.clamp(-bound, bound) + pull;
        self.theta = (self.theta + rate * dt_s).clamp(0.0, config.theta_max);
        // On its way back to one nothing leads it off.
        if !self.forgets {
            let gradient = (config.beyond_gain * error_m * sideslip.drift_per_beyond_m_s).min(most);
            let rate = gradient.clamp(-BEYOND_RATE_MAX_1_S, BEYOND_RATE_MAX_1_S);
            self.beyond = (self.beyond + rate * dt_s).clamp(0.0, 1.0);
        }
    }

    /// The wheel speeds that come nearest to what is wanted within every limit, and which speed
    /// limit cut it.
    fn within_limits(&mut self, before: Twist, wanted: Twist, dt_s: f64) -> (WheelSpeeds, Cut) {
        let limits = self.model.limits();
        let reverse_max_m_s = REVERSE_MAX_M_S.min(limits.linear_max_m_s);
        let angular_max_rad_s = limits.angular_max_rad_s;
        let bounded = Twist {
            linear_m_s: (wanted.linear_m_s + self.carried.linear_m_s)
                .clamp(-reverse_max_m_s, limits.linear_max_m_s),
            angular_rad_s: (wanted.angular_rad_s + self.carried.angular_rad_s)
                .clamp(-angular_max_rad_s, angular_max_rad_s),
        };
        let turns_too_fast = wanted.angular_rad_s.abs() > angular_max_rad_s;
        let (wheels, saturated) = desaturated(&self.model, bounded);
        let target = self.model.twist_from_wheel_speeds(wheels);
        let twist_limits = TwistLimits::of(&self.model);
        let next = twist_limits.step(before, target, twist_limits.slowing_by_wheels(), dt_s);
        let cut = |wanted: f64, got: f64, most: f64| (wanted - got).clamp(-most, most);
        self.carried = Twist {
            linear_m_s: cut(target.linear_m_s, next.linear_m_s, CARRIED_MAX.linear_m_s),
            angular_rad_s: cut(
                target.angular_rad_s,
                next.angular_rad_s,
                CARRIED_MAX.angular_rad_s,
            ),
        };
        (
            self.model.wheel_speeds_from_twist(next),
            Cut {
                by_wheels: saturated,
                in_yaw: turns_too_fast,
            },
        )
    }
}

/// Wheel speeds for a twist within the wheel limit: the turn is kept, the speed gives way. True if
/// it had to.
pub fn desaturated(model: &RobotModel, twist: Twist) -> (WheelSpeeds, bool) {
    let limit_rad_s = model.limits().wheel_speed_max_rad_s;
    let free = model.wheel_speeds_from_twist(twist);
    if free.magnitude_max_rad_s() <= limit_rad_s {
        return (free, false);
    }
    let middle = 0.5 * (free.left_rad_s + free.right_rad_s);
    let half = 0.5 * (free.right_rad_s - free.left_rad_s);
    let half = half.clamp(-limit_rad_s, limit_rad_s);
    let room = limit_rad_s - half.abs();
    let middle = middle.clamp(-room, room);
    (
        WheelSpeeds {
            left_rad_s: middle - half,
            right_rad_s: middle + half,
        },
        true,
    )
}
