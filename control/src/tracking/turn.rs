//! Steady turn of the four-wheel sum, with wheels beyond the peak of their friction curve.
//!
//! In a turn every wheel slips, by the geometry of the turn and by the lateral force. For a given
//! fraction of stiffness `k = μ(σ)/(Kσ)` of (7) at each wheel, the balances of longitudinal force
//! and of moment are linear in the inverse rim speeds, and the balance of lateral force gives the
//! sideslip. The fractions k follow by iteration. The result depends on curvature and `θv²/g` only.
//! `docs/control.md` has the equations.

use crate::friction::FrictionCurve;
use crate::robot::RobotModel;

/// Number of iterations of a turn in the linear range, where the sideslip enters the longitudinal
/// force.
const LINEAR_ROUNDS: u32 = 2;
/// Maximum number of iterations of the fractions of stiffness.
const SHARE_ROUNDS: u32 = 6;
/// Change of a fraction of stiffness below which the iteration ends.
const SHARE_STEP_MIN: f64 = 1.0e-6;
/// Bound of the sideslip, lateral over forward speed. Beyond it the robot slides, and turning the
/// heading further in makes it slide more.
pub(super) const SIDESLIP_MAX: f64 = 0.1;
/// Minimum fraction of stiffness of a wheel.
const SHARE_MIN: f64 = 0.05;
/// Bounds of the rim speeds over the forward speed.
const RIMS: std::ops::RangeInclusive<f64> = 0.05..=20.0;
/// Bound of the curvature, as a fraction of that at which the inner rims stop by kinematics alone.
const CURVATURE_SHARE_MAX: f64 = 0.7;

/// Steady turn, all speeds relative to the forward speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SteadyTurn {
    /// Lateral speed, positive to the left.
    pub(super) sideslip: f64,
    /// Rim speeds, `[left, right]`.
    pub(super) rims: [f64; 2],
}

/// Turn computed twice: with every wheel in the linear range, and with the friction loss beyond the
/// peak.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Turn {
    /// Curvature after its bound, 1/m.
    pub(super) curvature_1_m: f64,
    /// With every wheel in the linear range.
    pub(super) linear: SteadyTurn,
    /// With the friction loss beyond the peak.
    pub(super) beyond: SteadyTurn,
}

/// Turn to compute.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TurnSpec {
    /// Curvature, 1/m, finite.
    pub(super) curvature_1_m: f64,
    /// `θv²/g`, metres, ≥ 0.
    pub(super) compliance_m: f64,
}

impl Turn {
    /// Computes the turn of a finite curvature in 1/m; `compliance_m` is `θv²/g`, metres, ≥ 0. Only
    /// the shape of `friction_curve` is used, not its stiffness.
    pub(super) fn steady(
        model: &RobotModel,
        friction_curve: &FrictionCurve,
        spec: TurnSpec,
    ) -> Self {
        let bound_1_m = CURVATURE_SHARE_MAX * 2.0 / model.effective_track_m();
        let curvature_1_m = spec.curvature_1_m.clamp(-bound_1_m, bound_1_m);
        let bounded = TurnSpec {
            curvature_1_m,
            ..spec
        };
        let mut wheels = Wheels::new(model, bounded);
        for _ in 0..LINEAR_ROUNDS {
            wheels.balance();
        }
        let linear = wheels.turn();
        for _ in 0..SHARE_ROUNDS {
            if !wheels.update_shares(friction_curve) {
                break;
            }
            wheels.balance();
        }
        Self {
            curvature_1_m,
            linear,
            beyond: wheels.turn(),
        }
    }
}

/// State of the iteration over four wheels.
struct Wheels {
    curvature_1_m: f64,
    /// `4θv²/g`, metres: the lateral slip, over the curvature, of a single wheel if it carried the
    /// robot's whole lateral force.
    wheel_compliance_m: f64,
    /// Wheelbase over track width, L/W.
    slenderness: f64,
    /// Forward speed of the ground contacts, `[left, right]`.
    ground: [f64; 2],
    /// Lateral speed of the front contacts due to the turn.
    lateral: f64,
    /// Fractions of stiffness, `[[front, rear]; left, right]`.
    shares: [[f64; 2]; 2],
    /// Inverse rim speeds, `[left, right]`.
    per_rim: [f64; 2],
    sideslip: f64,
}

impl Wheels {
    fn new(model: &RobotModel, spec: TurnSpec) -> Self {
        let TurnSpec {
            curvature_1_m,
            compliance_m,
        } = spec;
        let half_track_m = 0.5 * model.track_width_m();
        let half_base_m = 0.5 * model.wheelbase_m();
        let outward = curvature_1_m * half_track_m;
        Self {
            curvature_1_m,
            wheel_compliance_m: 4.0 * compliance_m,
            slenderness: half_base_m / half_track_m,
            ground: [1.0 - outward, 1.0 + outward],
            lateral: curvature_1_m * half_base_m,
            shares: [[1.0; 2]; 2],
            per_rim: [1.0; 2],
            sideslip: 0.0,
        }
    }

    fn turn(&self) -> SteadyTurn {
        SteadyTurn {
            sideslip: self.sideslip,
            rims: self.per_rim.map(f64::recip),
        }
    }

    /// Solves the balances of longitudinal force, moment and lateral force for the present
    /// fractions of stiffness; sets rim speeds and sideslip.
    fn balance(&mut self) {
        let sums = self.shares.map(|[front, rear]| front + rear);
        let gaps = self.shares.map(|[front, rear]| front - rear);
        // Longitudinal force: equals mass times −v²κ times sideslip, the acceleration along the
        // robot.
        let longitudinal = [sums[0] * self.ground[0], sums[1] * self.ground[1]];
        let force =
            sums[0] + sums[1] + self.wheel_compliance_m * self.sideslip * self.curvature_1_m;
        // Moment over half the track width: difference of the sides' longitudinal forces less the
        // axles' scrubbing.
        let scrubs = [0, 1].map(|side| {
            self.slenderness * (gaps[side] * self.sideslip + sums[side] * self.lateral)
        });
        let (left, right) = (longitudinal[0] - scrubs[0], -longitudinal[1] - scrubs[1]);
        let moment = sums[0] - sums[1];
        let determinant = longitudinal[0] * right - longitudinal[1] * left;
        self.per_rim = [
            (force * right - longitudinal[1] * moment) / determinant,
            (longitudinal[0] * moment - force * left) / determinant,
        ]
        .map(|per_rim| per_rim.clamp(RIMS.end().recip(), RIMS.start().recip()));
        // Lateral force.
        let stiffness = self.per_rim[0] * sums[0] + self.per_rim[1] * sums[1];
        let unequal = self.per_rim[0] * gaps[0] + self.per_rim[1] * gaps[1];
        let sideslip =
            -(self.wheel_compliance_m * self.curvature_1_m + unequal * self.lateral) / stiffness;
        self.sideslip = sideslip.clamp(-SIDESLIP_MAX, SIDESLIP_MAX);
    }

    /// Computes the fractions of stiffness from the present slip; returns whether any has changed.
    fn update_shares(&mut self, friction_curve: &FrictionCurve) -> bool {
        let mut has_moved = false;
        for side in [0, 1] {
            let forward = self.ground[side] * self.per_rim[side] - 1.0;
            for (axle, lateral) in [self.lateral, -self.lateral].into_iter().enumerate() {
                let left = (self.sideslip + lateral) * self.per_rim[side];
                let slip = (forward * forward + left * left).sqrt();
                let share =
                    (friction_curve.mu_over_slip(slip) / friction_curve.stiffness()).max(SHARE_MIN);
                has_moved |= (share - self.shares[side][axle]).abs() > SHARE_STEP_MIN;
                self.shares[side][axle] = share;
            }
        }
        has_moved
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::friction::FrictionSpec;
    use crate::geometry::Pose;
    use crate::measured::WheelSpeeds;
    use crate::plant::{Ground, Plant, PlantSpec};
    use crate::robot::GRAVITY_M_S2;

    fn friction_curve(stiffness: f64, peak_slip: f64) -> FrictionCurve {
        let shape = FrictionCurve::yi2007().into();
        let spec = FrictionSpec {
            stiffness,
            peak_slip,
            ..shape
        };
        spec.try_into().unwrap()
    }

    /// Returns forward speed, sideslip and curvature of the simulated base after a long time on
    /// these rim speeds.
    fn driven(curve: FrictionCurve, rims_m_s: [f64; 2]) -> (f64, f64, f64) {
        let model = RobotModel::yi2007();
        let spec = PlantSpec {
            rolling_resistance_ratio: 0.0,
            ..PlantSpec::default()
        };
        let mut plant = Plant::new(model, spec, Pose::default()).unwrap();
        let rims = rims_m_s.map(|rim_m_s| rim_m_s / model.wheel_radius_m());
        let command = WheelSpeeds {
            left_rad_s: rims[0],
            right_rad_s: rims[1],
        };
        for _ in 0..3_000 {
            plant.step(command, &Ground::uniform(curve), 0.01);
        }
        let state = plant.state();
        let forward_m_s = state.forward_m_s;
        (
            forward_m_s,
            state.left_m_s / forward_m_s,
            state.yaw_rate_rad_s / forward_m_s,
        )
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn a_simulated_base_turns_as_modelled(
            stiffness in (-0.7..3.0_f64).prop_map(f64::exp), peak_slip in 0.15..0.9_f64,
            curvature in -1.4..1.4_f64, speed_m_s in 0.3..0.6_f64,
        ) {
            let curve = friction_curve(stiffness, peak_slip);
            let compliance_m = speed_m_s * speed_m_s / (stiffness * GRAVITY_M_S2);
            // Excludes ground that cannot hold the turn at all.
            let lateral_m_s2 = speed_m_s * speed_m_s * curvature.abs();
            prop_assume!(lateral_m_s2 < 0.5 * curve.mu_peak() * GRAVITY_M_S2);
            let model = RobotModel::yi2007();
            let spec = TurnSpec { curvature_1_m: curvature, compliance_m };
            let turn = Turn::steady(&model, &curve, spec);
            prop_assume!(turn.beyond.sideslip.abs() < SIDESLIP_MAX);
            let rims = turn.beyond.rims.map(|rim| rim * speed_m_s);
            let (forward_m_s, sideslip, driven) = driven(curve, rims);
            let speed_ratio = forward_m_s / speed_m_s;
            prop_assert!((speed_ratio - 1.0).abs() < 0.02, "{forward_m_s} of {speed_m_s}");
            prop_assert!((driven - curvature).abs() < 0.03, "{driven} of {curvature}");
            let off = (sideslip - turn.beyond.sideslip).abs();
            prop_assert!(off < 2.0e-3 + 0.1 * turn.beyond.sideslip.abs(), "{sideslip} of {turn:?}");
        }

        #[test]
        fn a_turn_to_the_right_is_the_mirror_of_one_to_the_left(
            curvature in -5.0..5.0_f64, compliance_m in 0.0..0.3_f64, peak_slip in 0.05..0.9_f64,
            sliding_ratio in 0.0..=1.0_f64,
        ) {
            let model = RobotModel::yi2007();
            let spec = FrictionSpec { stiffness: 1.0, peak_slip, sliding_ratio };
            let friction_curve = spec.try_into().unwrap();
            let turn = |curvature_1_m| {
                let spec = TurnSpec { curvature_1_m, compliance_m };
                Turn::steady(&model, &friction_curve, spec)
            };
            let (one, other) = (turn(curvature), turn(-curvature));
            for (one, other) in [(one.linear, other.linear), (one.beyond, other.beyond)] {
                prop_assert!((one.sideslip + other.sideslip).abs() < 1.0e-9);
                prop_assert!((one.rims[0] - other.rims[1]).abs() < 1.0e-9);
                prop_assert!(one.rims.into_iter().all(|rim| RIMS.contains(&rim)));
                prop_assert!(one.sideslip.abs() <= SIDESLIP_MAX);
            }
        }
    }

    #[test]
    fn without_compliance_there_is_no_sideslip_and_on_a_straight_no_slip() {
        let model = RobotModel::yi2007();
        let bend = Turn::steady(
            &model,
            &friction_curve(1.0, 0.2),
            TurnSpec {
                curvature_1_m: 1.2,
                compliance_m: 0.0,
            },
        );
        assert!(bend.beyond.sideslip.abs() < 1.0e-12, "{bend:?}");
        assert!(bend.beyond != bend.linear, "{bend:?}");
        let straight = Turn::steady(
            &model,
            &friction_curve(1.0, 0.2),
            TurnSpec {
                curvature_1_m: 0.0,
                compliance_m: 0.1,
            },
        );
        let rolls = SteadyTurn {
            sideslip: 0.0,
            rims: [1.0, 1.0],
        };
        assert_eq!(straight.linear, rolls);
        assert_eq!(straight.linear, straight.beyond);
    }

    #[test]
    fn in_the_linear_range_a_tight_turn_takes_from_the_sideslip_what_the_square_of_the_base_says() {
        let model = RobotModel::yi2007();
        let (curvature_1_m, compliance_m) = (1.2, 1.0e-3);
        let turn = Turn::steady(
            &model,
            &friction_curve(1.0, 0.9),
            TurnSpec {
                curvature_1_m,
                compliance_m,
            },
        );
        let square_m2 = model.track_width_m().powi(2) + model.wheelbase_m().powi(2);
        let left = 1.0 - 0.25 * square_m2 * curvature_1_m * curvature_1_m;
        let expected = -compliance_m * curvature_1_m * left;
        assert!(
            (turn.linear.sideslip / expected - 1.0).abs() < 1.0e-3,
            "{turn:?}"
        );
        assert!(left < 0.92);
        assert_eq!(turn.linear, turn.beyond);
    }
}
