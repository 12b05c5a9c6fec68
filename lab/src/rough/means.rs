//! Means of the plant's motion over integration steps, from which sensor values are made.

use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

/// Means over one call of [`super::plant::Plant::advance`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Means {
    /// Turn rate, in radians per second.
    pub yaw_rate_rad_s: f64,
    /// Acceleration of the centre of mass, without gravity.
    pub acceleration: BodyAcceleration,
    /// Wheel speeds.
    pub wheel_speeds: WheelSpeeds,
    /// Motor torques per side.
    pub torques: WheelTorques,
}

/// Values of one integration step.
pub(super) struct Moment {
    pub(super) yaw_rate_rad_s: f64,
    /// Acceleration of the centre of mass without gravity, `[forward, left]`.
    pub(super) acceleration_m_s2: [f64; 2],
    /// Wheel speeds `[left, right]`.
    pub(super) wheels_rad_s: [f64; 2],
    /// Motor torques `[left, right]`.
    pub(super) motor_n_m: [f64; 2],
}

#[derive(Debug, Default)]
pub(super) struct Sums {
    count: f64,
    yaw_rate: f64,
    acceleration: [f64; 2],
    wheels: [f64; 2],
    torques: [f64; 2],
}

impl Sums {
    pub(super) fn add(&mut self, moment: &Moment) {
        self.count += 1.0;
        self.yaw_rate += moment.yaw_rate_rad_s;
        let add = |sums: &mut [f64; 2], values: [f64; 2]| {
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += value;
            }
        };
        add(&mut self.acceleration, moment.acceleration_m_s2);
        add(&mut self.wheels, moment.wheels_rad_s);
        add(&mut self.torques, moment.motor_n_m);
    }

    pub(super) fn means(&self) -> Means {
        let count = self.count.max(1.0);
        Means {
            yaw_rate_rad_s: self.yaw_rate / count,
            acceleration: BodyAcceleration {
                forward_m_s2: self.acceleration[0] / count,
                left_m_s2: self.acceleration[1] / count,
            },
            wheel_speeds: WheelSpeeds {
                left_rad_s: self.wheels[0] / count,
                right_rad_s: self.wheels[1] / count,
            },
            torques: WheelTorques {
                left_n_m: self.torques[0] / count,
                right_n_m: self.torques[1] / count,
            },
        }
    }
}
