//! `sensor_msgs`.

use super::common::Header;
use super::geometry::{Quaternion, Vector3};
use super::{message, record};
use crate::cdr::Sequence;

record! {
    /// What an inertial unit felt. A covariance that begins with -1 says that its value is not
    /// measured.
    Imu<'a> {
        /// When; the frame of everything below.
        header: Header<'a>,
        /// How it stands.
        orientation: Quaternion,
        /// Three by three, rad².
        orientation_covariance: [f64; 9],
        /// How it turns, radians per second.
        angular_velocity: Vector3,
        /// Three by three.
        angular_velocity_covariance: [f64; 9],
        /// How it accelerates, with what carries it against gravity, metres per second squared.
        linear_acceleration: Vector3,
        /// Three by three.
        linear_acceleration_covariance: [f64; 9],
    }
}
message!(
    Imu<'a>,
    "sensor_msgs",
    "Imu",
    "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
);

record! {
    /// How joints stand, turn and pull. Each list is as long as that of names, or empty.
    JointState<'a> {
        /// When.
        header: Header<'a>,
        /// The joints.
        name: Sequence<'a, &'a str>,
        /// Radians.
        position: Sequence<'a, f64>,
        /// Radians per second.
        velocity: Sequence<'a, f64>,
        /// Newton metres, though many bases write amperes or a duty.
        effort: Sequence<'a, f64>,
    }
}
message!(
    JointState<'a>,
    "sensor_msgs",
    "JointState",
    "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
);

record! {
    /// A battery; what is not measured is no number.
    BatteryState<'a> {
        /// When.
        header: Header<'a>,
        /// Volts.
        voltage: f32,
        /// Degrees Celsius.
        temperature: f32,
        /// Amperes, negative while it gives.
        current: f32,
        /// Ampere hours left.
        charge: f32,
        /// Ampere hours when it was last full.
        capacity: f32,
        /// Ampere hours as it was made.
        design_capacity: f32,
        /// Charge, 0 to 1.
        percentage: f32,
        /// What it does.
        power_supply_status: u8,
        /// How it is.
        power_supply_health: u8,
        /// What it is made of.
        power_supply_technology: u8,
        /// Whether it is there.
        present: bool,
        /// Volts of each cell.
        cell_voltage: Sequence<'a, f32>,
        /// Degrees Celsius of each cell.
        cell_temperature: Sequence<'a, f32>,
        /// Where it is.
        location: &'a str,
        /// Its number.
        serial_number: &'a str,
    }
}
message!(
    BatteryState<'a>,
    "sensor_msgs",
    "BatteryState",
    "4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741"
);
