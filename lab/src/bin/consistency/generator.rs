//! A skid-steered robot of a few lines, with sensors and faults of its own: a second opinion on the
//! monitor that shares nothing with the plant of `tread_control::plant`.
//!
//! A point with a heading is pulled along by what its wheels slip, at most by μg; wheels lag behind
//! their command and saturate. Encoders count, the gyro's offset walks, poses come late at 10 Hz
//! with 2 cm of noise and wild ones among them, the accelerometer shakes and leans.

use std::collections::VecDeque;
use std::ops::RangeInclusive;
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tread_control::consistency::{Monitor, Sample};
use tread_control::geometry::{Pose, Twist};
use tread_control::measured::{BodyAcceleration, WheelSpeeds};
use tread_control::robot::{GRAVITY_M_S2, RobotModel};

/// Duration of a step, in which every fast sensor gives one sample, seconds.
pub(crate) const STEP_S: f64 = 0.01;

/// Simulated fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fault {
    GyroFrozen,
    GyroInverted,
    GyroScaled(f64),
    GyroBiased(f64),
    GyroAtLimit,
    WheelsFrozen,
    WheelsScaled(f64),
    /// Counts of one side stop while its wheels turn.
    LeftEncoderDead,
    /// The wheels of one side truly stand.
    LeftWheelsLocked,
    OdometryFrozen,
    OdometryScaled(f64),
    /// The twist is given in the frame of the site.
    OdometryInWorldFrame,
    PositionFrozen,
    PositionJumps,
    PositionRotated,
    PositionScaled(f64),
    AccelerometerFrozen,
    AccelerometerInverted,
    AccelerometerAtLimit,
    /// Wheels, gyro and position come from one source, and it says the same for ever.
    EverythingFrozen,
    /// The base drives its wheels by encoders that count too much.
    EncodersOfTheBaseScaled(f64),
}

/// Equipment and environment of a robot.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Equipment {
    pub(crate) has_odometry: bool,
    pub(crate) has_accelerometer: bool,
    /// Whether it drives onto ice at times.
    pub(crate) meets_ice: bool,
    /// Whether its base, its sensors and its courses are the usual ones, or drawn from its seed.
    pub(crate) make: Make,
}

/// Origin of a robot's parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Make {
    /// The parameters on which the monitor's bounds were chosen.
    Usual,
    /// Parameters drawn from the seed; no bound was chosen on them.
    Other,
}

/// Parameters of a robot's base, its sensors and its courses.
#[derive(Debug, Clone, Copy)]
struct RobotParameters {
    /// Encoder counts per revolution of a wheel.
    encoder_counts: f64,
    /// Time constant of the base's low-pass filter of the wheel speeds, seconds.
    wheels_filter_s: f64,
    /// Delay, lag and maximum acceleration with which wheels follow their command.
    command_delay_steps: usize,
    wheels_lag_s: f64,
    wheels_most_rad_s2: f64,
    /// Slip over the force that it gives, in seconds: forward and to the left, and in yaw.
    slip_s: (f64, f64),
    mu: f64,
    gyro_noise_rad_s: f64,
    acceleration_noise_m_s2: f64,
    odometry_noise_m_s: f64,
    steps_per_odometry: u64,
    steps_per_pose: u64,
    /// Range of the delay of poses, steps.
    pose_late: (f64, f64),
    pose_noise: (f64, f64),
    /// Slow part of the position error, metres.
    pose_wander_m: f64,
    /// Maximum commanded acceleration and angular acceleration, and maximum commanded speed.
    most_m_s2: f64,
    most_rad_s2: f64,
    fastest: f64,
    /// Maximum wheel speed with a low battery, radians per second.
    low_rad_s: f64,
}

impl RobotParameters {
    const USUAL: Self = Self {
        encoder_counts: 2_048.0,
        wheels_filter_s: 0.0,
        command_delay_steps: 0,
        wheels_lag_s: 0.08,
        wheels_most_rad_s2: 60.0,
        slip_s: (0.06, 0.06),
        mu: 0.6,
        gyro_noise_rad_s: 0.005,
        acceleration_noise_m_s2: 0.3,
        odometry_noise_m_s: 0.03,
        steps_per_odometry: 5,
        steps_per_pose: 10,
        pose_late: (5.0, 20.0),
        pose_noise: (0.02, 0.008),
        pose_wander_m: 0.0,
        most_m_s2: 0.8,
        most_rad_s2: 3.0,
        fastest: 1.0,
        low_rad_s: 9.0,
    };

    fn other(random: &mut ChaCha8Rng) -> Self {
        let mut between = |range: RangeInclusive<f64>| {
            range.start() + (range.end() - range.start()) * random.random::<f64>()
        };
        let one_of = |of: &[f64], at: f64| {
            #[expect(
                clippy::cast_precision_loss,
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "an index into a few"
            )]
            let index = (at * of.len() as f64) as usize;
            of[index.min(of.len() - 1)]
        };
        let encoder_counts = one_of(&[512.0, 1_024.0, 4_096.0, 16_384.0], between(0.0..=1.0));
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few steps"
        )]
        let steps = |steps: f64| steps as u64;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few steps"
        )]
        let command_delay_steps = between(0.0..=8.0) as usize;
        Self {
            encoder_counts,
            wheels_filter_s: between(0.0..=0.06),
            command_delay_steps,
            wheels_lag_s: between(0.04..=0.14),
            wheels_most_rad_s2: between(30.0..=100.0),
            slip_s: (between(0.03..=0.1), between(0.03..=0.1)),
            mu: between(0.35..=0.9),
            gyro_noise_rad_s: between(0.001..=0.02),
            acceleration_noise_m_s2: between(0.05..=0.4),
            odometry_noise_m_s: between(0.01..=0.05),
            steps_per_odometry: steps(one_of(&[2.0, 5.0, 10.0], between(0.0..=1.0))),
            steps_per_pose: steps(one_of(&[5.0, 10.0, 10.0, 20.0], between(0.0..=1.0))),
            pose_late: (between(1.0..=8.0), between(9.0..=25.0)),
            pose_noise: (between(0.005..=0.025), between(0.002..=0.01)),
            pose_wander_m: between(0.0..=0.02),
            most_m_s2: between(0.4..=1.5),
            most_rad_s2: between(1.5..=4.0),
            fastest: between(0.6..=1.2),
            low_rad_s: between(7.0..=12.0),
        }
    }
}

/// Time constant of the part of a pose's noise that lasts, seconds.
const WANDER_S: f64 = 4.0;

/// The robot.
pub(crate) struct Robot {
    pub(crate) model: RobotModel,
    pub(crate) monitor: Monitor,
    kit: Equipment,
    build: RobotParameters,
    random: ChaCha8Rng,
    step: u64,
    // What is true.
    pose: Pose,
    forward_m_s: f64,
    left_m_s: f64,
    turn_rad_s: f64,
    acceleration: BodyAcceleration,
    wheels: [f64; 2],
    angles: [f64; 2],
    mu: f64,
    ice_until: u64,
    ice_ended: u64,
    // How it is driven.
    target: Twist,
    commanded: Twist,
    /// Commands that the base has received and does not follow yet.
    on_the_way: VecDeque<Twist>,
    until: u64,
    // How its sensors are.
    track_ratio: f64,
    radius_ratio: [f64; 2],
    counts: [f64; 2],
    said_wheels: WheelSpeeds,
    odometry_ratio: f64,
    wander: [f64; 2],
    gyro_bias_rad_s: f64,
    lean_m_s2: f64,
    poses: VecDeque<(u64, Sample)>,
    // What is wrong, and what was said when that began.
    fault: Option<Fault>,
    held: Sample,
    said: Sample,
    rotated_about: Pose,
}

impl Robot {
    pub(crate) fn new(seed: u64, kit: Equipment) -> Self {
        let model = RobotModel::yi2007();
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let build = match kit.make {
            Make::Usual => RobotParameters::USUAL,
            Make::Other => RobotParameters::other(&mut random),
        };
        let mut within = |most: f64| most * (2.0 * random.random::<f64>() - 1.0);
        let track_ratio = 1.0 + within(0.12);
        let radius_ratio = [1.0 + within(0.015), 1.0 + within(0.015)];
        let gyro_bias_rad_s = within(0.01);
        let pose = Pose {
            x_m: within(20.0),
            y_m: within(20.0),
            heading_rad: within(3.0),
        };
        Self {
            monitor: Monitor::new(model),
            model,
            kit,
            build,
            random,
            step: 0,
            pose,
            forward_m_s: 0.0,
            left_m_s: 0.0,
            turn_rad_s: 0.0,
            acceleration: BodyAcceleration::default(),
            wheels: [0.0; 2],
            angles: [0.0; 2],
            mu: build.mu,
            ice_until: 0,
            ice_ended: 0,
            target: Twist::default(),
            commanded: Twist::default(),
            on_the_way: VecDeque::new(),
            until: 0,
            track_ratio,
            radius_ratio,
            counts: [0.0; 2],
            said_wheels: WheelSpeeds::default(),
            odometry_ratio: 1.0,
            wander: [0.0; 2],
            gyro_bias_rad_s,
            lean_m_s2: 0.0,
            poses: VecDeque::new(),
            fault: None,
            held: Sample::default(),
            said: Sample::default(),
            rotated_about: pose,
        }
    }

    pub(crate) fn time_s(&self) -> f64 {
        #[expect(clippy::cast_precision_loss, reason = "hours are few steps")]
        let steps = self.step as f64;
        steps * STEP_S
    }

    pub(crate) fn chance(&mut self) -> f64 {
        self.random.random::<f64>()
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.chance()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.chance()).cos()
    }

    fn between(&mut self, range: RangeInclusive<f64>) -> f64 {
        range.start() + (range.end() - range.start()) * self.chance()
    }

    /// Whether it is on ice, or left it a moment ago.
    pub(crate) fn is_on_ice(&self) -> bool {
        self.step < self.ice_until + 400
    }

    pub(crate) fn break_with(&mut self, fault: Fault) {
        self.fault = Some(fault);
        self.held = self.said;
        self.rotated_about = self.pose;
    }

    /// Nothing is wrong any more.
    #[cfg_attr(
        not(test),
        expect(dead_code, reason = "the report program never repairs, a test does")
    )]
    pub(crate) fn repair(&mut self) {
        self.fault = None;
    }

    /// Sets whether the robot stands or drives.
    #[cfg_attr(
        not(test),
        expect(dead_code, reason = "the report program lets it drive")
    )]
    pub(crate) fn rest(&mut self, is_to: bool) {
        self.target = Twist::default();
        self.until = if is_to { u64::MAX } else { self.step };
    }

    /// Odometry says so many times what is true.
    #[cfg_attr(
        not(test),
        expect(dead_code, reason = "the report program breaks one channel at a time")
    )]
    pub(crate) fn scale_odometry(&mut self, ratio: f64) {
        self.odometry_ratio = ratio;
    }

    /// Whether what is said is wrong by at least 0.2 rad/s or m/s, or by 0.5 m/s².
    pub(crate) fn is_excited(&self) -> bool {
        let Some(fault) = self.fault else {
            return false;
        };
        let (forward, turn) = (self.forward_m_s, self.turn_rad_s);
        let held = &self.held;
        let twist = held.wheel_speeds.map_or(Twist::default(), |wheels| {
            self.model.twist_from_wheel_speeds(wheels)
        });
        let is_off = |by: f64| by.abs() >= 0.2;
        let felt = self
            .acceleration
            .forward_m_s2
            .abs()
            .max((forward * turn).abs());
        match fault {
            Fault::GyroFrozen => is_off(turn - held.gyro_rad_s.unwrap_or(0.0)),
            Fault::GyroInverted => is_off(2.0 * turn),
            Fault::GyroScaled(scale) => is_off((scale - 1.0) * turn),
            Fault::GyroBiased(_)
            | Fault::GyroAtLimit
            | Fault::PositionJumps
            | Fault::PositionRotated
            | Fault::AccelerometerAtLimit => true,
            Fault::WheelsFrozen => {
                is_off(forward - twist.linear_m_s) || is_off(turn - twist.angular_rad_s)
            }
            Fault::LeftEncoderDead | Fault::LeftWheelsLocked => {
                let wheels = self.model.wheel_speeds_from_twist(self.commanded);
                is_off(wheels.left_rad_s * self.model.wheel_radius_m())
            }
            Fault::OdometryFrozen => is_off(forward - held.odometry_m_s.unwrap_or(0.0)),
            Fault::OdometryInWorldFrame => is_off(forward * (self.pose.heading_rad.cos() - 1.0)),
            Fault::WheelsScaled(scale)
            | Fault::OdometryScaled(scale)
            | Fault::PositionScaled(scale)
            | Fault::EncodersOfTheBaseScaled(scale) => is_off((scale - 1.0) * forward),
            Fault::PositionFrozen => is_off(forward),
            Fault::AccelerometerFrozen | Fault::AccelerometerInverted => felt >= 0.5,
            Fault::EverythingFrozen => {
                is_off(self.commanded.linear_m_s - twist.linear_m_s) || is_off(twist.linear_m_s)
            }
        }
    }

    fn drive(&mut self) {
        if self.step >= self.until {
            let chance = self.chance();
            self.target = if chance < 0.12 {
                Twist::default()
            } else if chance < 0.22 {
                Twist {
                    linear_m_s: 0.0,
                    angular_rad_s: self.between(-1.2..=1.2),
                }
            } else if chance < 0.3 {
                Twist {
                    linear_m_s: self.between(-0.6..=-0.2),
                    angular_rad_s: self.between(-0.5..=0.5),
                }
            } else {
                Twist {
                    linear_m_s: self.between(0.25..=self.build.fastest),
                    angular_rad_s: self.between(-0.9..=0.9),
                }
            };
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "small"
            )]
            let steps = self.between(100.0..=600.0) as u64;
            self.until = self.step + steps;
        }
        let toward = |from: f64, to: f64, most: f64| from + (to - from).clamp(-most, most);
        self.commanded = Twist {
            linear_m_s: toward(
                self.commanded.linear_m_s,
                self.target.linear_m_s,
                self.build.most_m_s2 * STEP_S,
            ),
            angular_rad_s: toward(
                self.commanded.angular_rad_s,
                self.target.angular_rad_s,
                self.build.most_rad_s2 * STEP_S,
            ),
        };
        if self.kit.meets_ice && self.step >= self.ice_until {
            self.mu = self.build.mu;
            if self.chance() < 0.0002 {
                self.mu = self.between(0.015..=0.06);
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "small"
                )]
                let steps = self.between(200.0..=2_000.0) as u64;
                self.ice_until = self.step + steps;
                self.ice_ended = self.ice_until;
            }
        }
    }

    fn move_on(&mut self) {
        self.on_the_way.push_back(self.commanded);
        let heard = if self.on_the_way.len() > self.build.command_delay_steps {
            self.on_the_way.pop_front().unwrap_or_default()
        } else {
            Twist::default()
        };
        let wanted = self.model.wheel_speeds_from_twist(heard);
        let mut wanted = [wanted.left_rad_s, wanted.right_rad_s];
        if let Some(Fault::EncodersOfTheBaseScaled(scale)) = self.fault {
            wanted = wanted.map(|speed| speed / scale);
        }
        if self.fault == Some(Fault::LeftWheelsLocked) {
            wanted[0] = 0.0;
        }
        // A battery that is low for a while: the motors reach less than was asked.
        let most = if self.step % 60_000 < 6_000 {
            self.build.low_rad_s
        } else {
            20.0
        };
        for (wheel, wanted) in self.wheels.iter_mut().zip(wanted) {
            let change = (wanted.clamp(-most, most) - *wheel) * (STEP_S / self.build.wheels_lag_s);
            let most = self.build.wheels_most_rad_s2 * STEP_S;
            *wheel += change.clamp(-most, most);
        }
        let radius_m = self.model.wheel_radius_m();
        let rims = [0, 1].map(|side| self.wheels[side] * radius_m * self.radius_ratio[side]);
        let rim_m_s = 0.5 * (rims[0] + rims[1]);
        let track_m = self.model.effective_track_m() * self.track_ratio;
        let rim_rad_s = (rims[1] - rims[0]) / track_m;
        // Slip pulls, at most as hard as the ground can.
        let most_m_s2 = self.mu * GRAVITY_M_S2;
        let (mut x, mut y) = (
            (rim_m_s - self.forward_m_s) / self.build.slip_s.0,
            -self.left_m_s / 0.08,
        );
        let size = x.hypot(y);
        if size > most_m_s2 {
            (x, y) = (x * most_m_s2 / size, y * most_m_s2 / size);
        }
        let most_rad_s2 = 2.5 * most_m_s2;
        let yaw =
            ((rim_rad_s - self.turn_rad_s) / self.build.slip_s.1).clamp(-most_rad_s2, most_rad_s2);
        self.acceleration = BodyAcceleration {
            forward_m_s2: x,
            left_m_s2: y,
        };
        let (forward, left, turn) = (self.forward_m_s, self.left_m_s, self.turn_rad_s);
        self.forward_m_s += STEP_S * (x + turn * left);
        self.left_m_s += STEP_S * (y - turn * forward);
        self.turn_rad_s += STEP_S * yaw;
        let (sin, cos) = (self.pose.heading_rad + 0.5 * STEP_S * turn).sin_cos();
        self.pose.x_m += STEP_S * (self.forward_m_s * cos - self.left_m_s * sin);
        self.pose.y_m += STEP_S * (self.forward_m_s * sin + self.left_m_s * cos);
        self.pose.heading_rad += STEP_S * turn;
        for (angle, wheel) in self.angles.iter_mut().zip(self.wheels) {
            *angle += STEP_S * wheel;
        }
    }

    fn fast_sample(&mut self) -> Sample {
        let walk = 3.0e-4 * STEP_S.sqrt() * self.normal();
        self.gyro_bias_rad_s = (self.gyro_bias_rad_s + walk).clamp(-0.02, 0.02);
        let gyro =
            self.turn_rad_s + self.gyro_bias_rad_s + self.build.gyro_noise_rad_s * self.normal();
        let of_a_turn = self.build.encoder_counts;
        let counts = self
            .angles
            .map(|angle| (angle / std::f64::consts::TAU * of_a_turn).floor());
        let rate = |side: usize| {
            (counts[side] - self.counts[side]) / of_a_turn * std::f64::consts::TAU / STEP_S
        };
        let share = STEP_S / (STEP_S + self.build.wheels_filter_s);
        let filtered = |before: f64, now: f64| before + share * (now - before);
        let wheels = WheelSpeeds {
            left_rad_s: filtered(self.said_wheels.left_rad_s, rate(0)),
            right_rad_s: filtered(self.said_wheels.right_rad_s, rate(1)),
        };
        self.said_wheels = wheels;
        self.counts = counts;
        let acceleration = self.kit.has_accelerometer.then(|| {
            self.lean_m_s2 = 0.5 * (0.05 * self.time_s()).sin();
            BodyAcceleration {
                forward_m_s2: self.acceleration.forward_m_s2
                    + self.lean_m_s2
                    + self.build.acceleration_noise_m_s2 * self.normal(),
                left_m_s2: self.acceleration.left_m_s2 - 0.1
                    + self.build.acceleration_noise_m_s2 * self.normal(),
            }
        });
        let says_odometry =
            self.kit.has_odometry && self.step.is_multiple_of(self.build.steps_per_odometry);
        let odometry = says_odometry.then(|| {
            let said_m_s = self.forward_m_s + self.build.odometry_noise_m_s * self.normal();
            self.odometry_ratio * said_m_s
        });
        Sample {
            at: Duration::from_millis(10 * self.step),
            gyro_rad_s: Some(gyro),
            wheel_speeds: Some(wheels),
            acceleration,
            odometry_m_s: odometry,
            ..Sample::default()
        }
    }

    fn measure_pose(&mut self) {
        let (noise_m, noise_rad) = self.build.pose_noise;
        #[expect(clippy::cast_precision_loss, reason = "a few steps")]
        let since_s = self.build.steps_per_pose as f64 * STEP_S;
        let keep = (-since_s / WANDER_S).exp();
        let new_m = (1.0 - keep * keep).sqrt() * self.build.pose_wander_m;
        for axis in 0..2 {
            self.wander[axis] = keep * self.wander[axis] + new_m * self.normal();
        }
        let mut pose = Pose {
            x_m: self.pose.x_m + self.wander[0] + noise_m * self.normal(),
            y_m: self.pose.y_m + self.wander[1] + noise_m * self.normal(),
            heading_rad: self.pose.heading_rad + noise_rad * self.normal(),
        };
        let said = pose;
        if self.chance() < 0.005 {
            pose.x_m += self.between(-3.0..=3.0);
            pose.y_m += self.between(-3.0..=3.0);
        }
        let about = self.rotated_about;
        match self.fault {
            Some(Fault::PositionFrozen | Fault::EverythingFrozen) => {
                pose = self.held.position.unwrap_or(pose);
            }
            Some(Fault::PositionJumps) => pose.x_m += 5.0,
            Some(Fault::PositionRotated) => {
                pose = Pose {
                    x_m: -pose.y_m,
                    y_m: pose.x_m,
                    heading_rad: pose.heading_rad + std::f64::consts::FRAC_PI_2,
                };
            }
            Some(Fault::PositionScaled(scale)) => {
                pose.x_m = about.x_m + scale * (pose.x_m - about.x_m);
                pose.y_m = about.y_m + scale * (pose.y_m - about.y_m);
            }
            _ => {}
        }
        if self.fault.is_none() {
            self.said.position = Some(said);
        }
        let late = self.between(self.build.pose_late.0..=self.build.pose_late.1);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "small"
        )]
        let due = self.step + late as u64;
        let sample = Sample {
            at: Duration::from_millis(10 * self.step),
            position: Some(pose),
            ..Sample::default()
        };
        self.poses.push_back((due, sample));
    }

    fn distort(&mut self, sample: &mut Sample) {
        let held = self.held;
        match self.fault {
            Some(Fault::GyroFrozen) => sample.gyro_rad_s = held.gyro_rad_s,
            Some(Fault::GyroInverted) => sample.gyro_rad_s = sample.gyro_rad_s.map(|rate| -rate),
            Some(Fault::GyroScaled(scale)) => {
                sample.gyro_rad_s = sample.gyro_rad_s.map(|rate| scale * rate);
            }
            Some(Fault::GyroBiased(bias)) => {
                sample.gyro_rad_s = sample.gyro_rad_s.map(|rate| rate + bias);
            }
            Some(Fault::GyroAtLimit) => sample.gyro_rad_s = Some(4.363),
            Some(Fault::WheelsFrozen) => sample.wheel_speeds = held.wheel_speeds,
            Some(Fault::WheelsScaled(scale) | Fault::EncodersOfTheBaseScaled(scale)) => {
                sample.wheel_speeds = sample.wheel_speeds.map(|wheels| WheelSpeeds {
                    left_rad_s: scale * wheels.left_rad_s,
                    right_rad_s: scale * wheels.right_rad_s,
                });
            }
            Some(Fault::LeftEncoderDead) => {
                sample.wheel_speeds = sample.wheel_speeds.map(|wheels| WheelSpeeds {
                    left_rad_s: 0.0,
                    ..wheels
                });
            }
            Some(Fault::OdometryFrozen) => {
                sample.odometry_m_s = sample.odometry_m_s.and(held.odometry_m_s);
            }
            Some(Fault::OdometryScaled(scale)) => {
                sample.odometry_m_s = sample.odometry_m_s.map(|speed| scale * speed);
            }
            Some(Fault::OdometryInWorldFrame) => {
                let cos = self.pose.heading_rad.cos();
                sample.odometry_m_s = sample.odometry_m_s.map(|speed| cos * speed);
            }
            Some(Fault::AccelerometerFrozen) => sample.acceleration = held.acceleration,
            Some(Fault::AccelerometerInverted) => {
                sample.acceleration = sample.acceleration.map(|felt| BodyAcceleration {
                    forward_m_s2: -felt.forward_m_s2,
                    left_m_s2: -felt.left_m_s2,
                });
            }
            Some(Fault::AccelerometerAtLimit) => {
                sample.acceleration = Some(BodyAcceleration {
                    forward_m_s2: 19.6,
                    left_m_s2: 19.6,
                });
            }
            Some(Fault::EverythingFrozen) => {
                sample.gyro_rad_s = held.gyro_rad_s;
                sample.wheel_speeds = held.wheel_speeds;
            }
            Some(
                Fault::LeftWheelsLocked
                | Fault::PositionFrozen
                | Fault::PositionJumps
                | Fault::PositionRotated
                | Fault::PositionScaled(_),
            )
            | None => {}
        }
    }

    /// One step: it moves, and the monitor hears of it.
    pub(crate) fn step(&mut self) {
        self.step += 1;
        self.drive();
        self.move_on();
        let mut sample = self.fast_sample();
        self.distort(&mut sample);
        self.said = Sample {
            odometry_m_s: sample.odometry_m_s.or(self.said.odometry_m_s),
            position: self.said.position,
            ..sample
        };
        self.monitor.take(&sample);
        if self.step.is_multiple_of(self.build.steps_per_pose) {
            self.measure_pose();
        }
        while self.poses.front().is_some_and(|(due, _)| *due <= self.step) {
            if let Some((_, pose)) = self.poses.pop_front() {
                self.monitor.take(&pose);
            }
        }
        self.monitor
            .command(self.model.wheel_speeds_from_twist(self.commanded));
    }
}
