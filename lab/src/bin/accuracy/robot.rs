//! A simulated robot with seeded sensor errors, its localisation and its estimator.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tread_control::estimation::{
    Estimator, EstimatorPrior, SensorNoise, SensorSample, TyrePrior, UpdateOutcome,
};
use tread_control::friction::{FrictionCurve, FrictionSpec};
use tread_control::geometry::Pose;
use tread_control::localisation::{Localisation, LocalisationNoise, PositionFix};
use tread_control::measured::{BodyAcceleration, Measured, WheelSpeeds, WheelTorques};
use tread_control::plant::{Ground, Plant, PlantMeans, PlantSpec, TyreRise, Tyres};
use tread_control::robot::RobotModel;
use tread_lab::parallel::in_parallel;

/// Sampling period of the sensors, seconds.
pub(crate) const SAMPLE_S: f64 = 0.005;
/// Period of the control loop, seconds.
pub(crate) const LOOP_S: f64 = 0.01;
const SAMPLES_PER_BODY_SPEED: u32 = 20;
const SAMPLES_PER_FIX: u32 = 10;
/// Standard deviations of a position fix: metres, and radians of heading.
const FIX_NOISE: (f64, f64) = (0.01, 0.005);

/// Robot and ground of a scenario, and the estimator's configuration.
#[derive(Clone, Copy)]
pub(crate) struct RobotSpec {
    pub(crate) model: RobotModel,
    pub(crate) curve: FrictionCurve,
    /// Noise of the sensors, with which the estimator is configured too.
    pub(crate) noise: SensorNoise,
    /// Bound of the relative error of each side's rolling radius, drawn uniformly from ± this
    /// value.
    pub(crate) radius_error_max: f64,
    pub(crate) has_torque: bool,
    /// Wheel speed, gyro and accelerometer give the value of the moment, not the mean since the
    /// last sample: what happens between two samples aliases.
    pub(crate) aliases: bool,
    pub(crate) servo_lag_s: f64,
    pub(crate) tyres: Tyres,
    /// Range of the curvature κ of brush tyres, per slip, drawn uniformly; `None` for linear tyres.
    pub(crate) curvatures: Option<[f64; 2]>,
    pub(crate) configured_tyres: TyrePrior,
}

impl RobotSpec {
    /// Creates a robot with default sensors on isotropic ground of this stiffness K.
    pub(crate) fn on(stiffness: f64) -> Self {
        Self {
            model: RobotModel::yi2007(),
            curve: FrictionCurve::with_stiffness(stiffness).expect("stiffness is positive"),
            noise: SensorNoise::default(),
            radius_error_max: 0.02,
            has_torque: false,
            aliases: false,
            servo_lag_s: 0.05,
            tyres: Tyres::default(),
            curvatures: None,
            configured_tyres: TyrePrior::default(),
        }
    }
}

/// Simulated robot with the state of its sensors, localisation and estimator.
pub(crate) struct SeededRobot {
    pub(crate) model: RobotModel,
    pub(crate) plant: Plant,
    pub(crate) ground: Ground,
    pub(crate) estimator: Estimator,
    localisation: Localisation,
    spec: RobotSpec,
    torque_gain: [f64; 2],
    gyro_offset_rad_s: f64,
    accelerometer_offset: [f64; 2],
    rng: ChaCha8Rng,
    spare: Option<f64>,
    samples: u32,
}

impl SeededRobot {
    pub(crate) fn new(mut spec: RobotSpec, start: Pose, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        if let Some([least, most]) = spec.curvatures {
            spec.tyres.rise = TyreRise::Brush;
            let curvature = least + (most - least) * rng.random::<f64>();
            let curve = FrictionSpec {
                peak_slip: 1.0 / (3.0 * curvature),
                ..spec.curve.into()
            };
            spec.curve = curve.try_into().expect("the peak is between 0 and 1");
        }
        let most = spec.radius_error_max;
        let mut radius = || 1.0 + most * (2.0 * rng.random::<f64>() - 1.0);
        let plant_spec = PlantSpec {
            servo_lag_s: spec.servo_lag_s,
            left_radius_ratio: radius(),
            right_radius_ratio: radius(),
            tyres: spec.tyres,
            ..PlantSpec::default()
        };
        let model = spec.model;
        let prior = EstimatorPrior {
            tyres: spec.configured_tyres,
            ..EstimatorPrior::exact()
        };
        let mut robot = Self {
            model,
            plant: Plant::new(model, plant_spec, start).expect("a scenario's plant is valid"),
            ground: Ground::uniform(spec.curve),
            estimator: Estimator::with_prior(model, spec.noise, prior),
            localisation: Localisation::new(model, LocalisationNoise::default()),
            spec,
            torque_gain: [1.0; 2],
            gyro_offset_rad_s: 0.0,
            accelerometer_offset: [0.0; 2],
            rng,
            spare: None,
            samples: 0,
        };
        let noise = spec.noise;
        robot.torque_gain = [0, 1].map(|_| 1.0 + robot.gauss(noise.torque_gain_ratio));
        robot.gyro_offset_rad_s = robot.gauss(noise.gyro_offset_rad_s);
        robot.accelerometer_offset = [0, 1].map(|_| robot.gauss(noise.accelerometer_offset_m_s2));
        robot.fix();
        robot
    }

    /// Returns a normally distributed number of mean zero and this standard deviation.
    pub(crate) fn gauss(&mut self, std_dev: f64) -> f64 {
        if let Some(spare) = self.spare.take() {
            return std_dev * spare;
        }
        // Box and Muller; the first number is in (0, 1], so that its logarithm is finite.
        let radius = (-2.0 * (1.0 - self.rng.random::<f64>()).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * self.rng.random::<f64>()).sin_cos();
        self.spare = Some(radius * sin);
        std_dev * radius * cos
    }

    fn fix(&mut self) {
        let pose = self.plant.state().pose;
        let pose = Pose {
            x_m: pose.x_m + self.gauss(FIX_NOISE.0),
            y_m: pose.y_m + self.gauss(FIX_NOISE.0),
            heading_rad: pose.heading_rad + self.gauss(FIX_NOISE.1),
        };
        self.localisation.correct(&PositionFix {
            pose,
            age_s: 0.0,
            noise: None,
        });
    }

    /// Returns the measured pose and motion, the input of the tracking law.
    pub(crate) fn measured(&self) -> Measured {
        Measured {
            pose: self.localisation.pose().unwrap_or_default(),
            twist: self.localisation.twist(),
            wheel_speeds: self.plant.state().wheel_speeds,
            pose_age_s: self.localisation.fix_age_s(),
            position_std_dev_m: self.localisation.position_std_dev_m(),
        }
    }

    /// Advances the robot by one tick of the loop under a command, and returns the estimator's
    /// outcome.
    pub(crate) fn act(&mut self, command: WheelSpeeds) -> UpdateOutcome {
        let mut outcome = UpdateOutcome::default();
        let mut left_s = LOOP_S;
        while left_s > 0.5 * SAMPLE_S {
            let one = self.sample(command);
            outcome.ground_changed |= one.ground_changed;
            outcome.block_done |= one.block_done;
            left_s -= SAMPLE_S;
        }
        outcome
    }

    fn sample(&mut self, command: WheelSpeeds) -> UpdateOutcome {
        self.plant.step(command, &self.ground, SAMPLE_S);
        let state = *self.plant.state();
        let noise = self.spec.noise;
        let moment = PlantMeans {
            wheel_speeds: state.wheel_speeds,
            yaw_rate_rad_s: state.yaw_rate_rad_s,
            acceleration: self.plant.body_acceleration(),
        };
        let seen = if self.spec.aliases {
            moment
        } else {
            *self.plant.means()
        };
        let wheel_speeds = WheelSpeeds {
            left_rad_s: seen.wheel_speeds.left_rad_s + self.gauss(noise.wheel_speed_rad_s),
            right_rad_s: seen.wheel_speeds.right_rad_s + self.gauss(noise.wheel_speed_rad_s),
        };
        let gyro_rad_s =
            seen.yaw_rate_rad_s + self.gyro_offset_rad_s + self.gauss(noise.gyro_rad_s);
        let felt = seen.acceleration;
        let torques = self.plant.wheel_torques();
        let torque_noise = noise.torque_mu * self.model.wheel_radius_m() * self.model.side_load_n();
        let has_body_speed = self.samples.is_multiple_of(SAMPLES_PER_BODY_SPEED);
        let sample = SensorSample {
            wheel_speeds,
            gyro_rad_s,
            is_specific_force: false,
            acceleration: Some(BodyAcceleration {
                forward_m_s2: felt.forward_m_s2
                    + self.accelerometer_offset[0]
                    + self.gauss(noise.accelerometer_m_s2),
                left_m_s2: felt.left_m_s2
                    + self.accelerometer_offset[1]
                    + self.gauss(noise.accelerometer_m_s2),
            }),
            body_speed_m_s: has_body_speed
                .then(|| state.forward_m_s + self.gauss(noise.body_speed_m_s)),
            wheel_torques: self.spec.has_torque.then(|| WheelTorques {
                left_n_m: self.torque_gain[0] * torques.left_n_m + self.gauss(torque_noise),
                right_n_m: self.torque_gain[1] * torques.right_n_m + self.gauss(torque_noise),
            }),
        };
        self.localisation.predict(&sample, SAMPLE_S);
        self.samples += 1;
        if self.samples.is_multiple_of(SAMPLES_PER_FIX) {
            self.fix();
        }
        self.estimator.update(&sample, SAMPLE_S)
    }
}

/// Calls `one` with each seed from 0 to `runs` − 1 in parallel, and returns the results in the
/// order of the seeds.
pub(crate) fn run_seeded<T: Send>(runs: u32, one: impl Fn(u64) -> T + Sync + Send) -> Vec<T> {
    let seeds: Vec<u64> = (0..u64::from(runs)).collect();
    in_parallel(&seeds, |&seed| one(seed))
}
