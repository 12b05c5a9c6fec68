//! Adaptive tracking law: wheel speeds from tracking errors. `docs/control.md` has the proof.
//!
//! The law adapts θ̂ as the paper does, for a base that slips laterally. Errors are taken in the
//! frame of the robot's *course*, which differs from its heading by the sideslip `β = −vωθ/g` (θ =
//! 1/K, steady turn of the four-wheel sum); then `ė_y = v sin e_θ + (v²ω/g) θ̃`. So
//! `V = ½k_y(e_x² + e_y²) + (1 − cos e_θ) + k_y θ̃²/(2ρ)` decreases under `θ̂̇ = ρ e_y v²ω/g`, a
//! gradient law of the form of the paper's (26). The law never inverts a measured velocity, so it
//! is regular at standstill.
//!
//! In tight bends wheels slip beyond the peak of their friction curve, whatever the speed, and the
//! sideslip is several times as large. The turn is therefore computed by the four-wheel sum itself,
//! once in its linear range and once with the loss beyond the peak of
//! [`TrackerConfig::friction_curve`]. The fraction χ̂ of that loss is adapted like θ̂, which covers
//! tyres with a curve of another shape.
//!
//! The command is the reference's motion, corrected by the errors (Kanayama's form, with integral
//! action over the distance driven), plus feed-forward with θ̂: the sideslip, the rim speeds that
//! the turn needs, lead for the wheel servo and half a sample, and lead for slip relaxation, `vθ/g`
//! along the path and `(vθ/g)·4 I_G/(m(W² + L²))` in yaw. An inner loop on the measured turn rate,
//! of gain below one, keeps the stability margin where slip is slow. Gains depend on the noise of
//! the pose, and on how steady the path's sideslip is.
//!
//! A slope and a rotation centre off the middle of the wheels cause sideslip too. Both are adapted
//! by the same function (`drift`). All that is adapted integrates the cross-track error, as the
//! integral does; their gains are shares of one integral gain (`action`).
//!
//! θ̂ starts at zero, which means no sideslip. A θ that is known from the start pulls it, weighted
//! by its confidence, and so does one that contradicts the previous one; after that errors lead θ̂.
//! χ̂ starts at one, and returns to one when a known θ contradicts the previous one. All are
//! bounded in range and rate, and held while the wheels saturate, a later stage reduces the
//! command, or the pose is stale. They serve this loop only; the map uses [`crate::estimation`].

mod action;
mod config;
mod drift;
mod knowledge;
mod noise;
mod output;
mod sideslip;
mod steadiness;
mod turn;

use crate::geometry::{Twist, wrap_angle_rad};
use crate::measured::{Measured, WheelSpeeds};
use crate::reference::ReferenceSample;
use crate::robot::{GRAVITY_M_S2, RobotModel};
use crate::twist_limits::{Change, TwistLimits};

use action::{CanFollow, IntegralAction};
pub use config::{CrossGains, TrackerConfig, TrackerError};
use drift::{AdaptationTick, Drift};
pub use knowledge::ThetaKnowledge;
use noise::NoiseLevel;
pub use output::{TrackerOutput, TrackingErrors};
use sideslip::{AdaptedGround, Sideslip};
use steadiness::Steadiness;

/// Maximum speed backwards, to come back to a reference that was overrun, metres per second.
const REVERSE_MAX_M_S: f64 = 0.15;
/// Maximum speed above the reference's of a robot that lags, metres per second. A higher speed
/// would be too fast for the next bend on slippery ground.
const CATCH_UP_MAX_M_S: f64 = 0.06;
/// Fraction of the speed limit up to which a robot that lags may drive faster than
/// [`CATCH_UP_MAX_M_S`] allows.
const CATCH_UP_SPEED_SHARE: f64 = 0.5;
/// Bound of the along-track error in the feedback, metres.
const ALONG_TRACK_MAX_M: f64 = 0.3;
/// Reference speed below which integral and adaptation are held, metres per second.
const INTEGRAL_SPEED_MIN_M_S: f64 = 0.05;
/// Minimum speed in the heading feedback, metres per second, so that it acts at standstill too.
const HEADING_SPEED_MIN_M_S: f64 = 0.15;
/// Cross-track error below which nothing is adapted, metres.
const ADAPTATION_DEAD_ZONE_M: f64 = 5.0e-4;
/// Maximum part that the acceleration limits cut off a command and that is added to the next
/// tick's. Without this noise would be cut on the side of speeding up only, and the mean speed and
/// turn rate would be too low.
const REMAINDER_MAX: Twist = Twist {
    linear_m_s: 0.05,
    angular_rad_s: 0.3,
};

/// Ratio of the standard deviations of a new θ and of the one under which χ̂ was adapted, below
/// which the new one replaces it.
const MORE_PRECISE_RATIO: f64 = 0.6;
/// Time for which a newly known θ pulls θ̂, seconds.
const PULL_TIME_S: f64 = 2.0;
/// Distance driven while adapting up to which a first known θ pulls θ̂, metres.
const KNOWN_FROM_START_M: f64 = 1.0;
/// Maximum magnitude of χ̂'s rate of change, per second.
const BEYOND_RATE_MAX_1_S: f64 = 1.0;

/// Speed limits that a requested command exceeds.
#[derive(Debug, Clone, Copy)]
struct Saturation {
    /// A wheel speed limit.
    by_wheels: bool,
    /// The turn rate limit.
    in_yaw: bool,
}

/// Pull of θ̂ to a known θ.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Pull {
    /// Remaining time, seconds.
    left_s: f64,
    /// Whether there was a pull before.
    has_acted: bool,
    /// Whether slope and rotation centre return to zero during the pull.
    resets_drift: bool,
}

/// Tracking law with its state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tracker {
    model: RobotModel,
    config: TrackerConfig,
    /// Integral term, as curvature.
    integral_1_m: f64,
    /// θ̂.
    theta: f64,
    /// χ̂, the fraction of the loss beyond the peak of the friction curve.
    beyond: f64,
    drift: Drift,
    /// Known θ under which χ̂ was adapted, and the newest one.
    known: Option<ThetaKnowledge>,
    last: Option<ThetaKnowledge>,
    /// Whether χ̂ is returning to one.
    resets_beyond: bool,
    pull: Pull,
    /// Distance driven while adapting, metres.
    adapted_m: f64,
    noise: NoiseLevel,
    steadiness: Steadiness,
    /// Whether a speed limit cut the last command.
    was_saturated: bool,
    /// Whether [`Tracker::hold_adaptation`] holds all that is adapted.
    is_held_externally: bool,
    /// Part that the acceleration limits cut off the last command.
    remainder: Twist,
    /// Last commanded twist; None before the first tick.
    commanded: Option<Twist>,
}

impl Tracker {
    /// Creates a law in its initial state: χ̂ = 1, all others 0.
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
            drift: Drift::default(),
            known: None,
            last: None,
            resets_beyond: false,
            pull: Pull::default(),
            adapted_m: 0.0,
            noise: NoiseLevel::default(),
            steadiness: Steadiness::default(),
            was_saturated: false,
            is_held_externally: false,
            remainder: Twist::default(),
            commanded: None,
        })
    }

    /// Holds all that is adapted, and the integral, while another stage, such as the gate, reduces
    /// the command.
    pub fn hold_adaptation(&mut self, held: bool) {
        self.is_held_externally = held;
    }

    /// Sets the last command to the base if it differs from this law's own; the next tick's
    /// acceleration limits start from it.
    pub fn set_commanded(&mut self, commanded: WheelSpeeds) {
        self.commanded =
            Some(self.model.twist_from_wheel_speeds(commanded)).filter(|twist| twist.is_finite());
    }

    /// Sets θ̂ at once to θ times its confidence, at most [`TrackerConfig::theta_max`]. Does
    /// nothing at zero confidence.
    pub fn warm_start(&mut self, knowledge: ThetaKnowledge) {
        if knowledge.confidence() > 0.0 {
            self.theta = (knowledge.confidence() * knowledge.theta).min(self.config.theta_max);
        }
    }

    /// Returns the adapted θ̂, 0 to [`TrackerConfig::theta_max`]; not a measurement of θ.
    pub fn theta_loop(&self) -> f64 {
        self.theta
    }

    /// Computes the command of one tick of `dt_s` seconds, above 0 and finite, and adapts.
    /// `knowledge` with zero confidence counts as None.
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
        let speed_m_s = reference.speed_m_s;
        let adapted_ground = AdaptedGround {
            theta,
            beyond: self.beyond,
        };
        let sideslip = Sideslip::of(
            reference,
            adapted_ground,
            &config.friction_curve,
            &self.model,
        );
        let drift = self.drift.sideslip(reference);
        let density = self.noise.update(measured, dt_s);
        let noise = density / config.noise_middle_m_sqrt_s.powi(2)
            + (measured.position_std_dev_m / config.position_middle_m).powi(2);
        let quiet_share = 1.0 / (1.0 + noise);
        let moving = config.noisy.towards(config.quiet, quiet_share);
        let steadiness = self
            .steadiness
            .update(reference, adapted_ground, &drift, &config, dt_s);
        let gains = moving.towards(config.steady, (1.0 - quiet_share) * steadiness);
        let mut course = measured.pose;
        course.heading_rad += sideslip.angle_rad + drift.angle_rad;
        let forward = course.body_from_site(reference.pose.point());
        let heading_rad = wrap_angle_rad(reference.pose.heading_rad - course.heading_rad);
        let catch_up_m_s = (CATCH_UP_SPEED_SHARE * self.model.limits().linear_max_m_s - speed_m_s)
            .max(CATCH_UP_MAX_M_S);
        let catch_up_m = catch_up_m_s / config.along_track_gain_1_s;
        let along_track_m = forward
            .x_m
            .clamp(-ALONG_TRACK_MAX_M, catch_up_m.min(ALONG_TRACK_MAX_M));
        // Bounded so that a robot far off approaches at a bounded angle instead of spinning.
        let cross_max_m = 0.8 * gains.heading_1_m / gains.cross_1_m2;
        let cross_track_m = forward.y_m.clamp(-cross_max_m, cross_max_m);

        let held = self.was_saturated
            || self.is_held_externally
            || measured.pose_age_s > config.pose_age_max_s
            || speed_m_s < INTEGRAL_SPEED_MIN_M_S;
        let confidence = knowledge.map_or(0.0, |known| known.confidence());
        if !held {
            self.adapted_m += speed_m_s * dt_s;
            let free = self.adaptable(&sideslip, cross_track_m);
            let action =
                IntegralAction::divide(&gains, &config, reference, (&sideslip, &drift), free);
            self.integrate(action.integral_1_m3 * cross_track_m * speed_m_s * dt_s);
            let tick = AdaptationTick {
                error_m: action.adaptation_share * outside_dead_zone(cross_track_m),
                dt_s,
            };
            self.adapt(&sideslip, knowledge, tick);
            if free.drift {
                self.drift.adapt(&drift, &config, tick);
            }
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
        let wanted_rad_s = reference.turn_rad_s - sideslip.rate_rad_s - drift.rate_rad_s
            + speed_m_s * (gains.cross_1_m2 * cross_track_m + self.integral_1_m)
            + speed_m_s.max(HEADING_SPEED_MIN_M_S) * gains.heading_1_m * heading_rad.sin();
        let angular_rad_s = wanted_rad_s
            + gains.yaw_rate * (wanted_rad_s - measured.twist.angular_rad_s)
            + (lead_s + slip_lead_s * yaw_shape) * reference.turn_acceleration_rad_s2
            + sideslip.rims.angular_rad_s;
        let change = Change {
            from: self
                .commanded
                .unwrap_or_else(|| self.model.twist_from_wheel_speeds(measured.wheel_speeds)),
            to: Twist {
                linear_m_s,
                angular_rad_s,
            },
        };
        let (wheel_speeds, saturation) = self.within_limits(change, dt_s);
        self.commanded = Some(self.model.twist_from_wheel_speeds(wheel_speeds));
        self.was_saturated = saturation.by_wheels || saturation.in_yaw;
        TrackerOutput {
            wheel_speeds,
            twist: self.model.twist_from_wheel_speeds(wheel_speeds),
            errors: TrackingErrors::between(reference, measured),
            theta_loop: self.theta,
            beyond_loop: self.beyond,
            slope_loop_rad: self.drift.slope_rad,
            center_loop_m: self.drift.center_forward_m,
            confidence,
            saturated: saturation.by_wheels,
        }
    }

    /// Starts a pull of θ̂ to a known θ that is new: one that is known from the start, that refines
    /// or corrects one that pulled, or that jumps to another value, as on other ground. What was
    /// adapted under another θ is forgotten: χ̂ moves back to one, slope and rotation centre to
    /// zero.
    fn apply_knowledge(&mut self, knowledge: Option<ThetaKnowledge>, dt_s: f64) {
        if let Some(now) = knowledge {
            let is_first = self.known.is_none();
            let anchor = *self.known.get_or_insert(now);
            let is_contradicted = anchor.contradicts(now);
            // An estimate that drifts away was wrong before, which matters only if it pulled. On
            // other ground it jumps.
            let has_jumped = self.last.is_some_and(|last| last.contradicts(now));
            let is_corrected = is_contradicted && (has_jumped || self.pull.has_acted);
            // A much better value for the same ground replaces the stored one; replacing it by many
            // slightly better ones would let it follow a θ that changes.
            let is_better = now.std_dev < MORE_PRECISE_RATIO * anchor.std_dev;
            let is_refined = self.pull.has_acted && is_better;
            let is_other = is_corrected || is_refined && anchor.differs_by_ground(now);
            self.resets_beyond |= is_other;
            // After that distance θ̂ has adapted to the tracking errors, which suits the loop more.
            let is_from_start = is_first && self.adapted_m < KNOWN_FROM_START_M;
            if is_corrected || is_refined || is_from_start {
                self.pull.left_s = PULL_TIME_S;
                self.pull.has_acted = true;
                self.pull.resets_drift = is_other;
            }
            if is_contradicted || is_better {
                self.known = Some(now);
            }
            self.last = Some(now);
            if self.pull.left_s > 0.0 && self.pull.resets_drift {
                let share = now.confidence() * self.config.adaptation_pull_1_s * dt_s;
                self.drift.decay(share.min(1.0));
            }
        }
        self.pull.left_s = (self.pull.left_s - dt_s).max(0.0);
        if self.resets_beyond {
            self.beyond = (self.beyond + BEYOND_RATE_MAX_1_S * dt_s).min(1.0);
            self.resets_beyond = self.beyond < 1.0;
        }
    }

    /// Returns which adapted values can follow the present cross-track error.
    fn adaptable(&self, sideslip: &Sideslip, cross_track_m: f64) -> CanFollow {
        let within = |value: f64, most: f64, drift_m_s: f64| {
            let rises = cross_track_m * drift_m_s > 0.0;
            if rises { value < most } else { value > 0.0 }
        };
        CanFollow {
            theta: within(
                self.theta,
                self.config.theta_max,
                sideslip.drift_per_theta_m_s,
            ),
            beyond: !self.resets_beyond && within(self.beyond, 1.0, sideslip.drift_per_beyond_m_s),
            // Slope and rotation centre are not adapted while they return to zero.
            drift: self.pull.left_s <= 0.0 || !self.pull.resets_drift,
        }
    }

    /// Adds to the integral within its bound, so that it cannot wind up.
    fn integrate(&mut self, change_1_m: f64) {
        let bound = self.config.integral_max_1_m;
        self.integral_1_m = (self.integral_1_m + change_1_m).clamp(-bound, bound);
    }

    /// Adapts `θ̂̇ = ρ e_y φ + pull·c (cθ − θ̂)` and `χ̂̇ = ρ_χ e_y φ_χ`, c the confidence, φ and
    /// `φ_χ` the drifts per θ and per χ; bounded in rate and range.
    fn adapt(
        &mut self,
        sideslip: &Sideslip,
        knowledge: Option<ThetaKnowledge>,
        tick: AdaptationTick,
    ) {
        let AdaptationTick { error_m, dt_s } = tick;
        let config = &self.config;
        // At the bound of the modelled sideslip a larger θ̂ or χ̂ has no effect and would wind up.
        let most = if sideslip.is_at_bound {
            0.0
        } else {
            f64::INFINITY
        };
        let gradient = (config.adaptation_gain * error_m * sideslip.drift_per_theta_m_s).min(most);
        let pull = knowledge
            .filter(|_| self.pull.left_s > 0.0)
            .map_or(0.0, |known| {
                let weight = known.confidence();
                weight * config.adaptation_pull_1_s * (weight * known.theta - self.theta)
            });
        let bound = config.adaptation_rate_max_1_s;
        // The pull is not limited to the rate bound of the gradient.
        let rate = gradient.clamp(-bound, bound) + pull;
        self.theta = (self.theta + rate * dt_s).clamp(0.0, config.theta_max);
        // χ̂ is not adapted while it returns to one.
        if !self.resets_beyond {
            let gradient = (config.beyond_gain * error_m * sideslip.drift_per_beyond_m_s).min(most);
            let rate = gradient.clamp(-BEYOND_RATE_MAX_1_S, BEYOND_RATE_MAX_1_S);
            self.beyond = (self.beyond + rate * dt_s).clamp(0.0, 1.0);
        }
    }

    /// Returns the wheel speeds nearest to the requested twist within every limit, and which speed
    /// limit cut it.
    fn within_limits(&mut self, change: Change<Twist>, dt_s: f64) -> (WheelSpeeds, Saturation) {
        let Change { from, to: target } = change;
        let limits = self.model.limits();
        let reverse_max_m_s = REVERSE_MAX_M_S.min(limits.linear_max_m_s);
        let angular_max_rad_s = limits.angular_max_rad_s;
        let bounded = Twist {
            linear_m_s: (target.linear_m_s + self.remainder.linear_m_s)
                .clamp(-reverse_max_m_s, limits.linear_max_m_s),
            angular_rad_s: (target.angular_rad_s + self.remainder.angular_rad_s)
                .clamp(-angular_max_rad_s, angular_max_rad_s),
        };
        let turns_too_fast = target.angular_rad_s.abs() > angular_max_rad_s;
        let (wheels, saturated) = desaturated(&self.model, bounded);
        let to = self.model.twist_from_wheel_speeds(wheels);
        let twist_limits = TwistLimits::of(&self.model);
        let next = twist_limits.step(Change { from, to }, twist_limits.slowing_by_wheels(), dt_s);
        let most = REMAINDER_MAX;
        self.remainder = Twist {
            linear_m_s: (to.linear_m_s - next.linear_m_s).clamp(-most.linear_m_s, most.linear_m_s),
            angular_rad_s: (to.angular_rad_s - next.angular_rad_s)
                .clamp(-most.angular_rad_s, most.angular_rad_s),
        };
        (
            self.model.wheel_speeds_from_twist(next),
            Saturation {
                by_wheels: saturated,
                in_yaw: turns_too_fast,
            },
        )
    }
}

/// Returns the wheel speeds for a twist within the wheel speed limit, and whether that limit
/// changed the command. The turn rate is kept as far as the limit allows, and the forward speed
/// reduced.
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

/// Returns the cross-track error that adapts, metres: 0 within [`ADAPTATION_DEAD_ZONE_M`].
fn outside_dead_zone(cross_track_m: f64) -> f64 {
    if cross_track_m.abs() < ADAPTATION_DEAD_ZONE_M {
        0.0
    } else {
        cross_track_m
    }
}
