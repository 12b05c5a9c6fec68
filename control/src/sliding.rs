//! Detects from gyro and wheel speeds that the ground gives less friction than the plan assumes.
//!
//! In the linear range the turn rate of the wheels leads that of the body by
//! `θ (u/g) (4 I_G/(m(W² + L²))) ω̇`, u the rim speed. With `θ = λ_m/μ` of the assumed peak
//! friction coefficient μ this is the lead that slip explains. The rest, less tolerances for
//! rolling radii, effective track and noise, is integrated to an angle; a large angle means
//! sliding:
//!
//! ```text
//! rolling ─ angle large, demonstrated acceleration small ─► sliding (never back)
//! ```
//! The motion of the body gives a lower bound of friction: four wheels of equal load that
//! accelerate the body with `a_y = vω` and turn it with `I_G ω̇` have a mean square of at least
//! `a_y² + (2 I_G ω̇/(m √(W² + L²)))²`, so at least one wheel had its root over g as friction
//! coefficient μ. A hit gives the same for an instant. So the sustained acceleration rises to that
//! of the body at a limited rate and falls with it at once, and the demonstrated acceleration is
//! the largest sustained one: hits do not add up. The bound is too high where the heading turns
//! without the course, or where turn rates are noisy. The result only ever slows the robot.

use crate::friction::SLIP_LINEAR;
use crate::measured::Measured;
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Time constant of the low-pass filter of turn rates, seconds.
const SMOOTHING_S: f64 = 0.05;
/// Shortest time in which the sustained acceleration rises to what the plan needs along the path,
/// seconds. A hit shows for about 0.1 s after the low-pass filter, a bend for longer.
const SUSTAINED_S: f64 = 0.3;
/// Factor by which the lead that linear slip explains is enlarged.
const EXPLAINED_RATIO: f64 = 1.2;
/// Tolerated relative difference of left and right rolling radius before it is measured.
const RADII_RATIO: f64 = 0.04;
/// Tolerated relative difference of left and right rolling radius after it is measured.
const RADII_MEASURED_RATIO: f64 = 0.004;
/// Turn rate below which driving counts as straight and measures the rolling radii, radians per
/// second.
const STRAIGHT_RAD_S: f64 = 0.03;
/// `∫ u² dt` at which the measured difference of radii has weight one half, metres squared per
/// second.
const RADII_MIDDLE_M2_S: f64 = 0.002;
/// Tolerated relative error of the effective track width, which grows in tight turns.
const TRACK_RATIO: f64 = 0.1;
/// Tolerated noise of the turn rates, radians per second.
const NOISE_RAD_S: f64 = 0.01;
/// Integrated unexplained angle above which the robot counts as sliding, radians.
const SLIDING_RAD: f64 = 0.007;
/// Lowest rim speed used to compute the explained lead, metres per second.
const RIM_MIN_M_S: f64 = 0.05;
/// Fraction of the demonstrated acceleration that a sliding robot may use along and across the
/// path.
const SHARE: f64 = 0.5;
/// Fraction of the demonstrated acceleration that a sliding robot may use in yaw, where wheels
/// scrub.
const SHARE_YAW: f64 = 0.35;
/// Lower bound of the demonstrated acceleration, as a fraction of the assumed `μg`.
const DEMONSTRATED_RATIO_MIN: f64 = 0.2;

/// Maximum accelerations on ground where the robot slides.
#[expect(
    clippy::struct_field_names,
    reason = "all are accelerations, and units stand last"
)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SlidingBounds {
    /// Deceleration along the path before a bend, metres per second squared.
    pub(crate) longitudinal_m_s2: f64,
    /// Acceleration across the path, metres per second squared.
    pub(crate) lateral_m_s2: f64,
    /// Acceleration in yaw, radians per second squared.
    pub(crate) yaw_rad_s2: f64,
}

/// Turn rate of the body, and turn rate of the wheels minus that of the body, both low-pass
/// filtered.
#[derive(Debug, Clone, Copy, PartialEq)]
struct FilteredRates {
    turn_rad_s: f64,
    lead_rad_s: f64,
}

/// Slide detector of one robot on its approach to a trajectory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sliding {
    model: RobotModel,
    assumed_mu: f64,
    filtered: Option<FilteredRates>,
    /// `∫ (ω of the wheels − ω of the body) u dt` and `∫ u² dt` over straight driving.
    straight: [f64; 2],
    /// Acceleration that is sustained at present, and the largest one so far: the demonstrated one.
    sustained_m_s2: f64,
    demonstrated_m_s2: f64,
    /// Integral of the unexplained lead of the wheels' turn rate, at least 0.
    unexplained_rad: f64,
    /// Whether the robot counts as sliding; never reset.
    slides: bool,
}

impl Sliding {
    /// Creates a detector in state rolling, for a plan that assumes the peak friction coefficient
    /// `assumed_mu`.
    pub(crate) fn new(model: RobotModel, assumed_mu: f64) -> Self {
        Self {
            model,
            assumed_mu,
            filtered: None,
            straight: [0.0; 2],
            sustained_m_s2: 0.0,
            demonstrated_m_s2: 0.0,
            unexplained_rad: 0.0,
            slides: false,
        }
    }

    /// Updates the detector with the measurements of one tick of `dt_s` seconds.
    pub(crate) fn step(&mut self, measured: &Measured, dt_s: f64) {
        let model = &self.model;
        let turn_rad_s = measured.twist.angular_rad_s;
        let wheels = measured.wheel_speeds;
        let lead_rad_s = model.twist_from_wheel_speeds(wheels).angular_rad_s - turn_rad_s;
        let before = self.filtered.unwrap_or(FilteredRates {
            turn_rad_s,
            lead_rad_s,
        });
        let share = (dt_s / SMOOTHING_S).min(1.0);
        let change_rad_s = turn_rad_s - before.turn_rad_s;
        let filtered = FilteredRates {
            turn_rad_s: before.turn_rad_s + share * change_rad_s,
            lead_rad_s: before.lead_rad_s + share * (lead_rad_s - before.lead_rad_s),
        };
        self.filtered = Some(filtered);
        let yaw_rad_s2 = change_rad_s / SMOOTHING_S;
        let lateral_m_s2 = measured.twist.linear_m_s * filtered.turn_rad_s;
        let used_m_s2 = lateral_m_s2.hypot(yaw_rad_s2 * Self::lever_m(model));
        let enough_m_s2 = RobotModel::longitudinal_traction_m_s2(self.assumed_mu);
        let rise_m_s2 = enough_m_s2 * dt_s / SUSTAINED_S;
        self.sustained_m_s2 = used_m_s2.min(self.sustained_m_s2 + rise_m_s2);
        self.demonstrated_m_s2 = self.demonstrated_m_s2.max(self.sustained_m_s2);

        let rim_m_s =
            0.5 * model.wheel_radius_m() * (wheels.left_rad_s.abs() + wheels.right_rad_s.abs());
        if turn_rad_s.abs() < STRAIGHT_RAD_S {
            self.straight[0] += lead_rad_s * rim_m_s * dt_s;
            self.straight[1] += rim_m_s * rim_m_s * dt_s;
        }
        let known_m2_s = RADII_MIDDLE_M2_S + self.straight[1];
        // A larger lead than tolerated radii can cause counts as sliding.
        let radii_most_rad_s = RADII_RATIO * rim_m_s / model.effective_track_m();
        let radii_rad_s =
            (self.straight[0] / known_m2_s * rim_m_s).clamp(-radii_most_rad_s, radii_most_rad_s);
        let radii_ratio = RADII_RATIO * RADII_MIDDLE_M2_S / known_m2_s + RADII_MEASURED_RATIO;
        let square_m2 = model.track_width_m().powi(2) + model.wheelbase_m().powi(2);
        let inertia_ratio = 4.0 * model.yaw_inertia_kg_m2() / (model.mass_kg() * square_m2);
        let theta = SLIP_LINEAR / self.assumed_mu;
        let lag_s = theta * inertia_ratio * rim_m_s.max(RIM_MIN_M_S) / GRAVITY_M_S2;
        let explained_rad_s = EXPLAINED_RATIO * lag_s * yaw_rad_s2.abs()
            + radii_ratio * rim_m_s / model.effective_track_m()
            + TRACK_RATIO * turn_rad_s.abs()
            + NOISE_RAD_S;
        let unexplained_rad_s = (filtered.lead_rad_s - radii_rad_s).abs() - explained_rad_s;
        self.unexplained_rad = (self.unexplained_rad + unexplained_rad_s * dt_s).max(0.0);
        // The ground has given what the plan needs along the path, so it is as good as assumed.
        let is_enough = self.demonstrated_m_s2 >= enough_m_s2;
        self.slides |= self.unexplained_rad > SLIDING_RAD && !is_enough;
    }

    /// Returns the acceleration bounds if the robot slides, else None. They grow with the
    /// demonstrated acceleration.
    pub(crate) fn bounds(&self) -> Option<SlidingBounds> {
        let least_m_s2 = DEMONSTRATED_RATIO_MIN * self.assumed_mu * GRAVITY_M_S2;
        let demonstrated_m_s2 = self.demonstrated_m_s2.max(least_m_s2);
        self.slides.then(|| SlidingBounds {
            longitudinal_m_s2: SHARE * demonstrated_m_s2,
            lateral_m_s2: SHARE * demonstrated_m_s2,
            yaw_rad_s2: SHARE_YAW * demonstrated_m_s2 / Self::lever_m(&self.model),
        })
    }

    /// Returns the tangential acceleration at the wheels per yaw acceleration,
    /// `2 I_G/(m √(W² + L²))`, metres.
    fn lever_m(model: &RobotModel) -> f64 {
        let half_m = 0.5 * model.track_width_m().hypot(model.wheelbase_m());
        model.yaw_inertia_kg_m2() / (model.mass_kg() * half_m)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Twist;
    use crate::measured::WheelSpeeds;

    const DT_S: f64 = 0.01;
    const ASSUMED_MU: f64 = 0.14;

    fn measured(turn_rad_s: f64, wheels: Twist, radii: [f64; 2]) -> Measured {
        let wheels = RobotModel::yi2007().wheel_speeds_from_twist(wheels);
        Measured {
            twist: Twist {
                linear_m_s: 0.5,
                angular_rad_s: turn_rad_s,
            },
            wheel_speeds: WheelSpeeds {
                left_rad_s: wheels.left_rad_s / radii[0],
                right_rad_s: wheels.right_rad_s / radii[1],
            },
            ..Measured::default()
        }
    }

    /// Measurements of a robot that accelerates to 0.5 m/s in 1 s, then oscillates in yaw; the body
    /// lags its wheels by `lag_s`.
    fn driven(swing_rad_s: f64, pace_1_s: f64, lag_s: f64, radii: [f64; 2]) -> Vec<Measured> {
        (0..300)
            .map(|tick| {
                let time_s = DT_S * f64::from(tick);
                let phase = pace_1_s * (time_s - 1.0).max(0.0);
                let turn_rad_s = swing_rad_s * (1.0 - phase.cos());
                let wheels = Twist {
                    linear_m_s: 0.5 * time_s.min(1.0),
                    angular_rad_s: turn_rad_s + lag_s * swing_rad_s * pace_1_s * phase.sin(),
                };
                measured(turn_rad_s, wheels, radii)
            })
            .collect()
    }

    proptest! {
        #[test]
        fn wheels_of_unequal_radii_on_firm_ground_do_not_slide(
            swing_rad_s in -0.8..0.8_f64, pace_1_s in 0.5..4.0_f64, lag_s in 0.0..0.03_f64,
            left in 0.98..1.02_f64, right in 0.98..1.02_f64,
        ) {
            let mut sliding = Sliding::new(RobotModel::yi2007(), ASSUMED_MU);
            for tick in driven(swing_rad_s, pace_1_s, lag_s, [left, right]) {
                sliding.step(&tick, DT_S);
                prop_assert!(sliding.bounds().is_none());
            }
        }

        #[test]
        fn bounds_never_fall_and_sliding_never_ends(
            swing_rad_s in 0.1..0.4_f64, pace_1_s in 0.5..2.0_f64, lag_s in 0.1..2.0_f64,
        ) {
            let mut sliding = Sliding::new(RobotModel::yi2007(), ASSUMED_MU);
            let mut before_m_s2 = 0.0;
            for tick in driven(swing_rad_s, pace_1_s, lag_s, [1.0; 2]) {
                sliding.step(&tick, DT_S);
                if let Some(bounds) = sliding.bounds() {
                    prop_assert!(bounds.lateral_m_s2 >= before_m_s2 && bounds.yaw_rad_s2 > 0.0);
                    before_m_s2 = bounds.lateral_m_s2;
                } else {
                    prop_assert!(before_m_s2 <= 0.0, "a robot that slides stays one that slides");
                }
            }
        }
    }

    #[test]
    fn hits_are_not_taken_for_friction() {
        let mut drive = driven(0.4, 2.0, 0.5, [1.0; 2]);
        let bounds = |drive: &[Measured]| {
            let mut sliding = Sliding::new(RobotModel::yi2007(), ASSUMED_MU);
            for tick in drive {
                sliding.step(tick, DT_S);
            }
            sliding.bounds().expect("slides")
        };
        let without = bounds(&drive);
        // 3 rad/s for 0.03 s each, as from hits on a corner.
        for hit in [20, 50, 80, 110, 140] {
            for tick in &mut drive[hit..hit + 3] {
                tick.twist.angular_rad_s += 3.0;
            }
        }
        let with = bounds(&drive);
        assert!(
            with.lateral_m_s2 < 1.5 * without.lateral_m_s2,
            "{with:?}, without the hit {without:?}"
        );
    }

    #[test]
    fn a_body_that_stays_behind_its_wheels_slides() {
        let mut sliding = Sliding::new(RobotModel::yi2007(), ASSUMED_MU);
        for tick in driven(0.4, 2.0, 0.5, [1.0; 2]) {
            sliding.step(&tick, DT_S);
        }
        let bounds = sliding.bounds().unwrap();
        assert!(bounds.lateral_m_s2 < 0.5, "{bounds:?}");
    }
}
