//! `tread_msgs`: messages for values that no standard ROS message has. They occur in recordings alone,
//! which contain their definitions.
//!
//! A value that is absent has its bit of `present` cleared. A number then holds NaN, and `fault` and
//! `gate` hold 0, which is also their first value; so check the bit first. A number that is present may
//! be NaN too.

use super::record;
use crate::cdr::Sequence;

/// The package.
pub const PACKAGE: &str = "tread_msgs";
/// The name of [`LoopTick`]'s type.
pub const LOOP_TICK: &str = "LoopTick";

/// What is there of a [`LoopSample`].
pub mod sample_bits {
    /// The gyro's turn rate.
    pub const YAW_RATE: u32 = 1;
    /// Both accelerations.
    pub const ACCELERATION: u32 = 1 << 1;
    /// Both wheel speeds.
    pub const WHEELS: u32 = 1 << 2;
    /// Both wheel torques.
    pub const TORQUES: u32 = 1 << 3;
    /// The body's speed over ground.
    pub const BODY_SPEED: u32 = 1 << 4;
    /// The lean.
    pub const TILT: u32 = 1 << 5;
    /// The position fix.
    pub const POSITION: u32 = 1 << 6;
    /// How good the fix is.
    pub const POSITION_NOISE: u32 = 1 << 7;
    /// The accelerations are the specific force; without this bit they are without gravity.
    pub const SPECIFIC_FORCE: u32 = 1 << 8;
}

/// What is there, or true, of a [`LoopTick`].
pub mod tick_bits {
    /// The agent was requested to stop.
    pub const STOP_REQUESTED: u32 = 1;
    /// The drive itself took the base for silent.
    pub const BASE_SILENT: u32 = 1 << 1;
    /// What the base says of its gyro's noise.
    pub const NOISE_GYRO: u32 = 1 << 2;
    /// What it says of its accelerometer's.
    pub const NOISE_ACCELEROMETER: u32 = 1 << 3;
    /// What it says of its body speed's.
    pub const NOISE_BODY_SPEED: u32 = 1 << 4;
    /// The battery.
    pub const BATTERY: u32 = 1 << 5;
    /// The estimated pose.
    pub const POSE: u32 = 1 << 6;
    /// The tracking law's own θ̂.
    pub const THETA_LOOP: u32 = 1 << 7;
    /// θ as it was measured.
    pub const THETA: u32 = 1 << 8;
    /// Progress along a mission and the distance from its path.
    pub const MISSION: u32 = 1 << 9;
    /// How much the wheels slip.
    pub const SLIP: u32 = 1 << 10;
    /// Sums of a segment that was closed.
    pub const SEGMENT: u32 = 1 << 11;
    /// Something is broken.
    pub const FAULT: u32 = 1 << 12;
    /// The gate reduced the command.
    pub const GATE: u32 = 1 << 13;
}

record! {
    /// What the base's sensors said at one moment.
    LoopSample {
        /// When, nanoseconds of the agent's monotonic clock.
        at_ns: u64,
        /// Bits of [`sample_bits`].
        present: u32,
        /// Turn rate, radians per second.
        yaw_rate_rad_s: f64,
        /// Forward acceleration, metres per second squared.
        forward_m_s2: f64,
        /// Acceleration to the left.
        left_m_s2: f64,
        /// Speed of the left wheels, radians per second.
        wheel_left_rad_s: f64,
        /// Speed of the right wheels.
        wheel_right_rad_s: f64,
        /// Torque of the left wheels, newton metres.
        torque_left_n_m: f64,
        /// Torque of the right wheels.
        torque_right_n_m: f64,
        /// Forward speed over ground, metres per second.
        body_speed_m_s: f64,
        /// Lean from level, radians.
        tilt_rad: f64,
        /// Position, site frame, metres.
        x_m: f64,
        /// The same.
        y_m: f64,
        /// Heading, radians.
        heading_rad: f64,
        /// Standard deviation of the position per axis, metres.
        position_noise_m: f64,
        /// Standard deviation of the heading, radians.
        heading_noise_rad: f64,
    }
}

record! {
    /// One tick of the control loop: what it took, and what it gave.
    LoopTick<'a> {
        /// Its number since the loop's start, from one on.
        number: u64,
        /// When it began, nanoseconds of the agent's monotonic clock.
        monotonic_ns: u64,
        /// The same, nanoseconds of its wall clock since 1970.
        wall_ns: i64,
        /// Bits of [`tick_bits`].
        present: u32,
        /// Commands that it took, which are on their own channel.
        commands: u32,
        /// Samples that gave way before it.
        lost_samples: u32,
        /// The number of the stop in force; 0 for none.
        stop: u64,
        /// How long the server had been silent, nanoseconds.
        server_silence_ns: u64,
        /// Standard deviation of the gyro, radians per second.
        noise_gyro_rad_s: f64,
        /// Standard deviation of the accelerometer, metres per second squared.
        noise_accelerometer_m_s2: f64,
        /// Standard deviation of the body's speed, metres per second.
        noise_body_speed_m_s: f64,
        /// Charge, 0 to 1.
        battery_charge_ratio: f64,
        /// Volts.
        battery_voltage_v: f64,
        /// What the sensors said since the last tick, oldest first.
        samples: Sequence<'a, LoopSample>,
        /// What mission or driver wanted of the left wheels, radians per second.
        wanted_left_rad_s: f64,
        /// The same of the right wheels.
        wanted_right_rad_s: f64,
        /// What the left wheels were commanded, behind the gate.
        command_left_rad_s: f64,
        /// The same of the right wheels.
        command_right_rad_s: f64,
        /// Estimated position, site frame, metres.
        x_m: f64,
        /// The same.
        y_m: f64,
        /// Estimated heading, radians.
        heading_rad: f64,
        /// Estimated forward speed, metres per second.
        linear_m_s: f64,
        /// Estimated turn rate, radians per second.
        angular_rad_s: f64,
        /// θ̂ of the tracking law.
        theta_loop: f64,
        /// θ as it was measured.
        theta: f64,
        /// Its standard deviation.
        theta_std_dev: f64,
        /// Distance along the mission's path, metres.
        driven_m: f64,
        /// Distance from it, metres, positive to the left.
        cross_track_m: f64,
        /// Slip of the left wheels.
        slip_left_ratio: f64,
        /// Slip of the right wheels.
        slip_right_ratio: f64,
        /// Information on θ of the segment that was closed.
        segment_information: f64,
        /// The same, weighted by θ.
        segment_weighted: f64,
        /// What the agent did: 0 idle, 1 tracking, 2 teleoperated, 3 stopped, 4 at fault.
        mode: u8,
        /// Fault: 0 the base is silent, 1 the position is lost. Valid only if `present` has its bit.
        fault: u8,
        /// Number of the strictest cause for which the gate reduced the command, as the agent's recording
        /// codec assigns it for good. Valid only if `present` has its bit.
        gate: u8,
        /// When commands of a driver were judged in it, nanoseconds of the agent's monotonic clock.
        judged_ns: u64,
    }
}
