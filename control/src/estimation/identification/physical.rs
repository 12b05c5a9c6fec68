//! The parameters of a robot, its tyres and its ground in SI units.

use super::dual::Real;
use super::parameters::{MODELLED, SHAPE_MIN, index};
use crate::robot::RobotModel;

/// The parameters of a robot in SI units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Robot<T> {
    pub(super) track_m: f64,
    pub(super) wheelbase_m: f64,
    /// Rolling radius as it is configured, metres.
    pub(super) nominal_radius_m: f64,
    pub(super) stiffness: T,
    pub(super) mass_kg: T,
    pub(super) inertia_kg_m2: T,
    /// Centre of mass from the wheels' centre: forward, left, up, metres.
    pub(super) centre_m: [T; 3],
    /// Relaxation length at zero slip, metres.
    pub(super) relaxation_m: T,
    /// Decrease of the relaxation length with slip.
    pub(super) relaxation_decrease: T,
    pub(super) slope: [T; 2],
    /// Ratio of measured to true torque, left and right.
    pub(super) torque_scale: [T; 2],
    /// Inertia of one side's rotors and wheels over the square of the wheel radius, kilograms.
    pub(super) rotors_kg: T,
    pub(super) gear_loss: T,
    /// Coefficients of rolling resistance and of motion resistance.
    pub(super) resistance: T,
    pub(super) motion_resistance: T,
    /// Lateral over longitudinal stiffness of the tyres.
    pub(super) lateral_stiffness_ratio: T,
    /// Rolling radius, left and right, metres.
    pub(super) radius_m: [T; 2],
    pub(super) peak: T,
    /// `K/μ_p`, the reciprocal of the slip at which a straight curve would reach `μ_p`.
    pub(super) per_peak_slip: T,
    /// n of the curve.
    pub(super) sharpness: T,
    pub(super) bend: T,
    /// 0 for theoretical, 1 for practical slip.
    pub(super) practical_slip: T,
    pub(super) gyro_offset_rad_s: T,
    pub(super) acceleration_offset_m_s2: [T; 2],
    pub(super) speed_offset_m_s: T,
}

impl<T: Real> Robot<T> {
    /// Converts parameters in the units of [`index`] for a robot of this configured model.
    pub(super) fn new(values: &[T; MODELLED], model: &RobotModel) -> Self {
        let of = |place: usize| values[place];
        let mass_kg = of(index::MASS).exp() * model.mass_kg();
        let (track_m, wheelbase_m) = (model.track_width_m(), model.wheelbase_m());
        let nominal_radius_m = model.wheel_radius_m();
        let side = |sign: f64| of(index::TORQUE_SCALE) + of(index::TORQUE_DIFFERENCE) * sign + 1.0;
        let radius = |half: f64| {
            (of(index::RADIUS) + of(index::RADIUS_DIFFERENCE) * half + 1.0) * nominal_radius_m
        };
        let shape = of(index::SHAPE);
        let sharpness = if shape.value() > SHAPE_MIN {
            shape.recip()
        } else {
            T::constant(SHAPE_MIN.recip())
        };
        let bend = of(index::BEND);
        let (stiffness, peak) = (of(index::STIFFNESS).exp(), of(index::PEAK).exp());
        Self {
            track_m,
            wheelbase_m,
            nominal_radius_m,
            stiffness,
            mass_kg,
            inertia_kg_m2: (of(index::MASS) + of(index::INERTIA)).exp() * model.yaw_inertia_kg_m2(),
            centre_m: [
                of(index::CENTRE_FORWARD) * wheelbase_m,
                of(index::CENTRE_LEFT) * track_m,
                of(index::HEIGHT) * track_m,
            ],
            relaxation_m: of(index::RELAXATION) * of(index::RELAXATION),
            relaxation_decrease: of(index::RELAXATION_DECREASE),
            slope: [of(index::SLOPE_X), of(index::SLOPE_Y)],
            torque_scale: [side(-1.0), side(1.0)],
            rotors_kg: of(index::ROTORS) * (0.5 * model.mass_kg()),
            gear_loss: of(index::GEAR_LOSS),
            resistance: of(index::RESISTANCE),
            motion_resistance: of(index::MOTION_RESISTANCE),
            lateral_stiffness_ratio: of(index::LATERAL_STIFFNESS).exp(),
            radius_m: [radius(-0.5), radius(0.5)],
            peak,
            per_peak_slip: stiffness / peak,
            sharpness,
            bend: if bend.value() < 0.0 {
                T::constant(0.0)
            } else {
                bend
            },
            practical_slip: of(index::PRACTICAL_SLIP),
            gyro_offset_rad_s: of(index::GYRO_OFFSET),
            acceleration_offset_m_s2: [of(index::FORWARD_OFFSET), of(index::LEFT_OFFSET)],
            speed_offset_m_s: of(index::SPEED_OFFSET),
        }
    }
}
