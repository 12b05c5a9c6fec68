//! Estimates the robot's apparent mass from measured torque and acceleration.
//!
//! The longitudinal force balance does not depend on the tyres. With μ̄, the mean of both sides'
//! measured torques as friction coefficients of the model's mass,
//!
//! ```text
//! μ̄ = q a/g + c₀ + c₁ cos ψ + c₂ sin ψ,    q = s (m + j)/m_model
//! ```
//! q is the ratio of the apparent mass to the model's: torque scale s, true mass m with payload,
//! and inertia j of rotors and wheels at the rim. c₀ is the rolling resistance coefficient, c₁ and
//! c₂ are the slope in the directions of heading ψ = 0 and π/2; with the specific force as a, which
//! contains the slope, both are 0. Each row is a mean over a block.
//! c₀, c₁ and c₂ are marginalised in each window, because the slope may change between windows, and
//! the information on q is summed. Measured torques are relative to the model's mass, so q is also
//! the factor that corrects θ from torques, except for j.

use nalgebra::{Matrix3, Vector3};

use super::{BLOCK_S, ROLLING_STD_DEV, SensorNoise, SensorSample, ValueWithStdDev};
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Number of blocks of a window, over whose path the slope is assumed constant.
const WINDOW_BLOCKS: u32 = 25;
/// Prior standard deviation of the slope, radians.
const SLOPE_STD_DEV_RAD: f64 = 0.05;
/// Rim speed below which the sign of rolling resistance is uncertain, in metres per second; slower
/// blocks are not used.
const RIM_SPEED_MIN_M_S: f64 = 0.05;
/// Standard deviation of a block's mean force apart from sensor noise, as a friction coefficient;
/// models uneven ground.
const UNEVEN_MU: f64 = 0.002;

/// Sums over the samples of the current block.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct BlockSums {
    duration_s: f64,
    samples: f64,
    mu: f64,
    forward_m_s2: f64,
    /// Sign of the rim speeds.
    sign: f64,
    /// Whether the block is unusable, by a sample without torque or acceleration, at low speed, or
    /// with rim speeds of different signs.
    is_broken: bool,
}

/// Sums of the normal equations over a window. The unknowns other than q are c₀, c₁ and c₂.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Window {
    blocks: u32,
    force_square: f64,
    force_others: Vector3<f64>,
    others: Matrix3<f64>,
    force_response: f64,
    others_response: Vector3<f64>,
}

/// Estimator of the apparent mass.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct ApparentMass {
    block: BlockSums,
    window: Window,
    heading_rad: f64,
    /// Information on q of the closed windows, and its product with q.
    information: f64,
    weighted: f64,
}

impl ApparentMass {
    /// Adds a sample, `dt_s` seconds after the one before. Returns whether it ended a window.
    pub(super) fn add(
        &mut self,
        sample: &SensorSample,
        model: &RobotModel,
        noise: &SensorNoise,
        dt_s: f64,
    ) -> bool {
        self.heading_rad += sample.gyro_rad_s * dt_s;
        let block = &mut self.block;
        block.duration_s += dt_s;
        let radius_m = model.wheel_radius_m();
        let left_m_s = sample.wheel_speeds.left_rad_s * radius_m;
        let right_m_s = sample.wheel_speeds.right_rad_s * radius_m;
        let sign = left_m_s.signum();
        match (sample.wheel_torques, sample.acceleration) {
            (Some(torques), Some(acceleration))
                if left_m_s.abs().min(right_m_s.abs()) > RIM_SPEED_MIN_M_S
                    && sign * right_m_s > 0.0
                    && (block.samples == 0.0 || sign * block.sign > 0.0) =>
            {
                let scale = 0.5 / (radius_m * model.side_load_n());
                block.samples += 1.0;
                block.sign = sign;
                block.mu += scale * (torques.left_n_m + torques.right_n_m);
                block.forward_m_s2 += acceleration.forward_m_s2;
            }
            _ => block.is_broken = true,
        }
        if block.duration_s < BLOCK_S - 1.0e-6 {
            return false;
        }
        let block = std::mem::take(&mut self.block);
        !block.is_broken && self.add_block(&block, noise)
    }

    /// Adds a block to the window. Returns whether it ended the window.
    fn add_block(&mut self, block: &BlockSums, noise: &SensorNoise) -> bool {
        let force = block.forward_m_s2 / block.samples / GRAVITY_M_S2;
        let (sin, cos) = self.heading_rad.sin_cos();
        let others = Vector3::new(block.sign, cos, sin);
        let response = block.mu / block.samples - ROLLING_STD_DEV * block.sign;
        let force_noise = (noise.accelerometer_m_s2 / GRAVITY_M_S2).powi(2) / block.samples;
        let variance =
            0.5 * noise.torque_mu.powi(2) / block.samples + force_noise + UNEVEN_MU.powi(2);
        let window = &mut self.window;
        window.force_square += (force * force - force_noise) / variance;
        window.force_others += others * (force / variance);
        window.others += others * others.transpose() / variance;
        window.force_response += force * response / variance;
        window.others_response += others * (response / variance);
        window.blocks += 1;
        if window.blocks >= WINDOW_BLOCKS {
            let (information, weighted) = self.window.marginalised();
            self.information += information;
            self.weighted += weighted;
            self.window = Window::default();
            return true;
        }
        false
    }

    /// Restarts the current block after a gap between samples.
    pub(super) fn interrupt(&mut self) {
        self.block = BlockSums::default();
    }

    /// Returns q with the standard deviation of its noise; `None` before the robot has accelerated.
    pub(super) fn value(&self) -> Option<ValueWithStdDev> {
        let (information, weighted) = self.window.marginalised();
        let information = self.information + information;
        (information > 0.0).then(|| ValueWithStdDev {
            value: (self.weighted + weighted) / information,
            std_dev: information.sqrt().recip(),
        })
    }
}

impl Window {
    /// Returns the information on q and its product with q, with the other unknowns marginalised.
    fn marginalised(&self) -> (f64, f64) {
        let known = Vector3::new(
            ROLLING_STD_DEV.powi(-2),
            SLOPE_STD_DEV_RAD.powi(-2),
            SLOPE_STD_DEV_RAD.powi(-2),
        );
        let Some(factors) = (self.others + Matrix3::from_diagonal(&known)).cholesky() else {
            return (0.0, 0.0);
        };
        let solved = factors.solve(&self.force_others);
        let information = self.force_square - solved.dot(&self.force_others);
        if information > 0.0 {
            (
                information,
                self.force_response - solved.dot(&self.others_response),
            )
        } else {
            (0.0, 0.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

    const DT_S: f64 = 0.01;

    /// Simulates a robot with an apparent mass and rolling resistance on a slope, with varying or
    /// constant speed.
    fn driven(
        apparent: f64,
        rolling: f64,
        slope: f64,
        turn_rad_s: f64,
        variation: f64,
    ) -> ApparentMass {
        let (model, noise) = (RobotModel::yi2007(), SensorNoise::default());
        let mut found = ApparentMass::default();
        let newton_metres = model.wheel_radius_m() * model.side_load_n();
        for tick in 0..2_000 {
            let time_s = DT_S * f64::from(tick);
            let forward_m_s2 = 0.6 * variation * (3.0 * time_s).cos();
            let rim_m_s = 0.6 + 0.2 * variation * (3.0 * time_s).sin();
            let mu = apparent * forward_m_s2 / GRAVITY_M_S2
                + rolling
                + slope * (turn_rad_s * time_s).cos();
            let side = |sign: f64| (mu + sign * 0.1) * newton_metres;
            let rad_s = rim_m_s / model.wheel_radius_m();
            let sample = SensorSample {
                wheel_speeds: WheelSpeeds {
                    left_rad_s: rad_s,
                    right_rad_s: rad_s,
                },
                gyro_rad_s: turn_rad_s,
                is_specific_force: false,
                acceleration: Some(BodyAcceleration {
                    forward_m_s2,
                    left_m_s2: 0.0,
                }),
                body_speed_m_s: None,
                wheel_torques: Some(WheelTorques {
                    left_n_m: side(-1.0),
                    right_n_m: side(1.0),
                }),
            };
            found.add(&sample, &model, &noise, DT_S);
        }
        found
    }

    proptest! {
        #[test]
        fn payload_shows_whatever_the_slope_and_the_rolling_resistance(
            apparent in 0.8..1.6_f64, rolling in 0.0..0.04_f64, slope in -0.08..0.08_f64,
            turn_rad_s in -0.6..0.6_f64,
        ) {
            let found = driven(apparent, rolling, slope, turn_rad_s, 1.0).value();
            let found = found.expect("the robot accelerates");
            prop_assert!(found.std_dev < 0.02, "± {}", found.std_dev);
            prop_assert!((found.value - apparent).abs() < 0.02, "{} for {apparent}", found.value);
        }

        #[test]
        fn a_steady_speed_says_next_to_nothing_of_the_mass(
            slope in -0.08..0.08_f64, turn_rad_s in -0.6..0.6_f64,
        ) {
            let found = driven(1.3, 0.02, slope, turn_rad_s, 0.0).value();
            prop_assert!(found.is_none_or(|found| found.std_dev > 0.3), "{found:?}");
        }
    }
}
