//! A simulated robot with noisy sensors around the plant, for closed-loop tests.

#![allow(
    dead_code,
    clippy::allow_attributes,
    reason = "each test binary uses its own part"
)]

pub(crate) mod figure_8;

use std::f64::consts::FRAC_PI_2;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tread_control::estimation::{Estimator, SensorNoise, SensorSample};
use tread_control::follower::{Follower, FollowerConfig, FollowerOutput, FollowerStatus};
use tread_control::friction::FrictionCurve;
use tread_control::gate::{GateInput, GateLimits, gate};
use tread_control::geometry::{Point, Pose};
use tread_control::localisation::{Localisation, LocalisationNoise, PositionFix};
use tread_control::measured::{BodyAcceleration, Measured, WheelSpeeds, WheelTorques};
use tread_control::plan::Plan;
use tread_control::plant::{Ground, Plant, PlantSpec};
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;
use tread_control::trajectory::{CircleSpec, Direction, Trajectory};

/// Control loop, seconds.
pub(crate) const LOOP_S: f64 = 0.01;
/// Sensor samples per loop tick.
pub(crate) const SAMPLES: u32 = 2;

/// A circle of 6 m about (1, −2) m at 0.6 m/s.
pub(crate) fn circle(direction: Direction, turns: f64) -> Trajectory {
    Trajectory::Circle(CircleSpec {
        center: Point {
            x_m: 1.0,
            y_m: -2.0,
        },
        radius_m: 6.0,
        speed_m_s: 0.6,
        direction,
        turns,
    })
}

/// On [`circle`], headed along it counter-clockwise.
pub(crate) const ON_CIRCLE: Pose = Pose {
    x_m: 7.0,
    y_m: -2.0,
    heading_rad: FRAC_PI_2,
};
/// Three metres outside it, headed likewise.
pub(crate) const OFF_CIRCLE: Pose = Pose {
    x_m: 10.0,
    ..ON_CIRCLE
};
/// On neither [`circle`] nor [`figure_8::figure_8`] in the right direction.
pub(crate) const OBLIQUE: Pose = Pose {
    x_m: 0.0,
    y_m: 0.0,
    heading_rad: 0.7,
};

/// Ticks of a mission at which it is paused, has come to rest, and is resumed.
pub(crate) struct Pause {
    pub(crate) from: u32,
    pub(crate) at_rest: u32,
    pub(crate) to: u32,
}

/// A robot's follower of a path from where it stands, at the defaults.
pub(crate) fn follower(trajectory: &Trajectory, start: Pose) -> Follower {
    let model = RobotModel::yi2007();
    let plan = Plan::new(trajectory, start, &model).expect("a path that can be driven");
    Follower::new(plan, model, FollowerConfig::default()).expect("valid gains")
}

pub(crate) fn curve(stiffness: f64) -> FrictionCurve {
    FrictionCurve::with_stiffness(stiffness).expect("a positive stiffness")
}

/// A seeded robot.
pub(crate) struct SimRobot {
    pub(crate) model: RobotModel,
    pub(crate) plant: Plant,
    pub(crate) ground: Ground,
    pub(crate) localisation: Localisation,
    pub(crate) estimator: Estimator,
    pub(crate) noise: SensorNoise,
    pub(crate) noisy: bool,
    pub(crate) torque: bool,
    pub(crate) ground_changes: u32,
    /// Errors of the left and right torque constants.
    pub(crate) torque_gain: [f64; 2],
    pub(crate) accelerometer_offset: f64,
    /// Delay of the gyro that its time stamps do not have, in samples.
    pub(crate) gyro_delay_samples: usize,
    /// Turn rates of the last samples, the newest one first.
    turn_rates_rad_s: std::collections::VecDeque<f64>,
    /// Torque of an obstacle on the left wheels, newton metres.
    pub(crate) struck_n_m: f64,
    limits: GateLimits,
    is_gated: bool,
    command: WheelSpeeds,
    rng: ChaCha8Rng,
    tick: u32,
}

impl SimRobot {
    pub(crate) fn new(start: Pose, stiffness: f64, seed: u64, noisy: bool) -> Self {
        Self::of(RobotModel::yi2007(), start, stiffness, seed, noisy)
    }

    /// The same of another model.
    pub(crate) fn of(
        model: RobotModel,
        start: Pose,
        stiffness: f64,
        seed: u64,
        noisy: bool,
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let sensors = SensorNoise::default();
        let mut spec = PlantSpec::default();
        let (mut torque_gain, mut accelerometer_offset) = ([1.0; 2], 0.0);
        if noisy {
            spec.left_radius_ratio = rng.random_range(0.98..1.02);
            spec.right_radius_ratio = rng.random_range(0.98..1.02);
            torque_gain = [0, 1].map(|_| 1.0 + sensors.torque_gain_ratio * normal(&mut rng));
            accelerometer_offset = sensors.accelerometer_offset_m_s2 * normal(&mut rng);
        }
        let mut robot = Self {
            model,
            plant: Plant::new(model, spec, start).expect("a valid plant"),
            ground: Ground::uniform(curve(stiffness)),
            localisation: Localisation::new(model, LocalisationNoise::default()),
            estimator: Estimator::new(model, sensors),
            noise: sensors,
            noisy,
            torque: true,
            ground_changes: 0,
            torque_gain,
            accelerometer_offset,
            gyro_delay_samples: 0,
            turn_rates_rad_s: std::collections::VecDeque::new(),
            struck_n_m: 0.0,
            limits: GateLimits::of(&model),
            is_gated: true,
            command: WheelSpeeds::default(),
            rng,
            tick: 0,
        };
        robot.fix();
        robot
    }

    /// From now on each side's wheels follow their command as fast as they may, without the gate:
    /// for tests that excite the robot by steps.
    pub(crate) fn drive_wheel_by_wheel(&mut self) {
        self.is_gated = false;
    }

    fn stepped(&self, wanted: WheelSpeeds) -> WheelSpeeds {
        let most = self.limits.wheel_acceleration_max_rad_s2 * LOOP_S;
        let side = |from: f64, to: f64| from + (to - from).clamp(-most, most);
        WheelSpeeds {
            left_rad_s: side(self.command.left_rad_s, wanted.left_rad_s),
            right_rad_s: side(self.command.right_rad_s, wanted.right_rad_s),
        }
    }

    fn gauss(&mut self, std_dev: f64) -> f64 {
        if self.noisy {
            std_dev * normal(&mut self.rng)
        } else {
            0.0
        }
    }

    fn fix(&mut self) {
        let pose = self.plant.state().pose;
        let pose = Pose {
            x_m: pose.x_m + self.gauss(0.01),
            y_m: pose.y_m + self.gauss(0.01),
            heading_rad: pose.heading_rad + self.gauss(0.005),
        };
        self.localisation.correct(&PositionFix {
            pose,
            age_s: 0.0,
            noise: None,
        });
    }

    /// What the loop sees now.
    pub(crate) fn measured(&self) -> Measured {
        let true_motion = self.true_motion();
        if !self.noisy {
            return true_motion;
        }
        Measured {
            pose: self.localisation.pose().expect("a first fix was taken"),
            twist: self.localisation.twist(),
            wheel_speeds: true_motion.wheel_speeds,
            pose_age_s: self.localisation.fix_age_s(),
            position_std_dev_m: self.localisation.position_std_dev_m(),
        }
    }

    /// What a loop with perfect sensors would see.
    pub(crate) fn true_motion(&self) -> Measured {
        let state = self.plant.state();
        Measured {
            pose: state.pose,
            twist: state.twist(),
            wheel_speeds: state.wheel_speeds,
            pose_age_s: 0.0,
            position_std_dev_m: 0.0,
        }
    }

    pub(crate) fn knowledge(&self) -> Option<ThetaKnowledge> {
        self.estimator.estimate().theta.map(|found| ThetaKnowledge {
            theta: found.theta,
            std_dev: found.std_dev,
        })
    }

    /// Commands wheel speeds for one loop tick, through the gate.
    pub(crate) fn act(&mut self, wanted: WheelSpeeds) {
        let input = GateInput {
            command: Some(wanted),
            previous: self.command,
            stop: false,
            feedback_age_s: 0.0,
            dt_s: LOOP_S,
        };
        self.command = if self.is_gated {
            gate(&input, &self.limits).wheel_speeds
        } else {
            self.stepped(wanted)
        };
        for _ in 0..SAMPLES {
            self.sample(LOOP_S / f64::from(SAMPLES));
        }
        self.tick += 1;
        if self.tick.is_multiple_of(5) {
            self.fix();
        }
    }

    fn sample(&mut self, dt_s: f64) {
        self.plant.step(self.command, &self.ground, dt_s);
        let state = *self.plant.state();
        let noise = self.noise;
        let seen = *self.plant.means();
        let wheel_speeds = WheelSpeeds {
            left_rad_s: seen.wheel_speeds.left_rad_s + self.gauss(noise.wheel_speed_rad_s),
            right_rad_s: seen.wheel_speeds.right_rad_s + self.gauss(noise.wheel_speed_rad_s),
        };
        self.turn_rates_rad_s.push_front(seen.yaw_rate_rad_s);
        self.turn_rates_rad_s.truncate(self.gyro_delay_samples + 1);
        let turn_rad_s = self.turn_rates_rad_s.back().copied().unwrap_or_default();
        let gyro_rad_s = turn_rad_s + self.gauss(noise.gyro_rad_s);
        let felt = seen.acceleration;
        let torques = self.plant.wheel_torques();
        let torque_noise = noise.torque_mu * self.model.wheel_radius_m() * self.model.side_load_n();
        let body_speed = self.tick.is_multiple_of(10);
        let sample = SensorSample {
            wheel_speeds,
            gyro_rad_s,
            is_specific_force: false,
            acceleration: Some(BodyAcceleration {
                forward_m_s2: felt.forward_m_s2
                    + self.accelerometer_offset
                    + self.gauss(noise.accelerometer_m_s2),
                left_m_s2: felt.left_m_s2 + self.gauss(noise.accelerometer_m_s2),
            }),
            body_speed_m_s: (body_speed && self.rng.random::<bool>())
                .then(|| state.forward_m_s + self.gauss(noise.body_speed_m_s)),
            wheel_torques: self.torque.then(|| WheelTorques {
                left_n_m: self.torque_gain[0] * torques.left_n_m
                    + self.struck_n_m
                    + self.gauss(torque_noise),
                right_n_m: self.torque_gain[1] * torques.right_n_m + self.gauss(torque_noise),
            }),
        };
        self.localisation.predict(&sample, dt_s);
        if self.estimator.update(&sample, dt_s).ground_changed {
            self.ground_changes += 1;
            self.estimator.close_segment();
            self.estimator.begin_ground();
        }
    }

    /// Drives a mission to its end, or for `bound_s` at most.
    pub(crate) fn drive(
        &mut self,
        follower: &mut Follower,
        bound_s: f64,
        mut each: impl FnMut(&mut Follower, &FollowerOutput, &Self),
    ) -> FollowerOutput {
        let mut time_s = 0.0;
        loop {
            let output = follower.step(&self.measured(), self.knowledge(), LOOP_S);
            each(follower, &output, self);
            self.act(output.wheel_speeds);
            time_s += LOOP_S;
            if output.status.is_final() || time_s > bound_s {
                return output;
            }
        }
    }
}

impl SimRobot {
    /// Drives a mission with a pause to its end; its status at the begin of the pause, the progress from
    /// where the robot was at rest, metres, and the end.
    pub(crate) fn drive_with_pause(
        &mut self,
        follower: &mut Follower,
        pause: &Pause,
    ) -> (Option<FollowerStatus>, f64, FollowerOutput) {
        let (mut tick, mut paused_in) = (0, None);
        let (mut first_m, mut last_m) = (None, 0.0);
        let last = self.drive(follower, 120.0, |follower, output, _| {
            tick += 1;
            if tick == pause.from {
                paused_in = Some(output.status);
                follower.set_pace(0.0);
            } else if tick == pause.to {
                follower.set_pace(1.0);
            } else if (pause.at_rest..pause.to).contains(&tick) {
                first_m.get_or_insert(output.progress_m);
                last_m = output.progress_m;
            }
        });
        let crept_m = last_m - first_m.expect("the mission lasts longer than its pause");
        (paused_in, crept_m, last)
    }
}

/// A standard normal number.
pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let first: f64 = rng.random_range(f64::MIN_POSITIVE..1.0);
    let second: f64 = rng.random();
    (-2.0 * first.ln()).sqrt() * (std::f64::consts::TAU * second).cos()
}
