//! One seeded run of a law on a course, with the sensors that the estimator gets.

use std::ops::Range;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tread_control::estimation::{Estimator, SensorNoise, SensorSample};
use tread_control::friction::FrictionCurve;
use tread_control::geometry::Pose;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use tread_control::plant::{Ground, Plant};
use tread_control::robot::RobotModel;
use tread_control::tracking::{ThetaKnowledge, TrackerConfig};
use tread_lab::bench::{Course, Law, Run, Scenario, TickInput};

/// Noise of the pose in the noisy runs: 2 cm per axis, 0.01 rad.
const NOISE_M: f64 = 0.02;
const NOISE_RAD: f64 = 0.01;
/// Relative standard deviation of a map's prior.
pub(crate) const PRIOR_DEVIATION: f64 = 0.1;

/// Friction stiffness K of the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Terrain {
    /// The same stiffness everywhere.
    Uniform(f64),
    /// Two stiffnesses, in turn, ten seconds each.
    Switching([f64; 2]),
    /// One stiffness for x below a border, another from there on.
    Border { at_m: f64, pair: [f64; 2] },
}

impl Terrain {
    fn stiffness(self, time_s: f64, pose: Pose) -> f64 {
        match self {
            Self::Uniform(stiffness) => stiffness,
            Self::Switching(pair) => {
                if time_s.rem_euclid(20.0) < 10.0 {
                    pair[0]
                } else {
                    pair[1]
                }
            }
            Self::Border { at_m, pair } => {
                if pose.x_m < at_m {
                    pair[0]
                } else {
                    pair[1]
                }
            }
        }
    }
}

/// Source of the θ given to the shipped law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum ThetaSource {
    /// No θ.
    Nothing,
    /// θ measured from wheel torques; none at the start.
    Own,
    /// θ of the map's prior until the robot has measured its own; the prior changes at once at a
    /// border.
    Map,
    /// θ wrong by a factor until a time, then the robot's own from wheel torques.
    Wrong { factor: f64, until_s: f64 },
}

/// One run.
#[derive(Debug, Clone)]
pub(crate) struct Case<'a> {
    pub(crate) model: RobotModel,
    pub(crate) course: &'a Course,
    pub(crate) terrain: Terrain,
    pub(crate) lag_s: f64,
    pub(crate) noisy: bool,
    pub(crate) seed: u64,
    pub(crate) tracker: TrackerConfig,
}

/// Time, true cross-track error and place of every tick.
pub(crate) struct Trace {
    pub(crate) ticks: Vec<Tick>,
    pub(crate) duration_s: f64,
    pub(crate) lost: bool,
}

/// One tick of a trace.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tick {
    pub(crate) time_s: f64,
    pub(crate) cross_track_m: f64,
    pub(crate) pose: Pose,
}

impl Trace {
    /// Returns the root mean square of the cross-track error in a range of times in seconds, in
    /// metres; infinite if the robot was lost.
    pub(crate) fn rms_m(&self, times_s: Range<f64>) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0_f64);
        for tick in &self.ticks {
            if times_s.contains(&tick.time_s) {
                sum += tick.cross_track_m * tick.cross_track_m;
                count += 1.0;
            }
        }
        if self.lost {
            f64::INFINITY
        } else {
            (sum / count.max(1.0)).sqrt()
        }
    }

    /// Returns the root mean square of the cross-track error over the second half of the time, in
    /// metres; infinite if the robot was lost.
    pub(crate) fn second_half_rms_m(&self) -> f64 {
        self.rms_m(0.5 * self.duration_s..f64::INFINITY)
    }

    /// Largest cross-track error of the second half, metres; infinite if lost.
    pub(crate) fn second_half_most_m(&self) -> f64 {
        self.most_m(0.5 * self.duration_s)
    }

    /// Largest cross-track error from a time on, metres; infinite if lost.
    pub(crate) fn most_m(&self, from_s: f64) -> f64 {
        if self.lost {
            return f64::INFINITY;
        }
        self.ticks
            .iter()
            .filter(|tick| tick.time_s >= from_s)
            .fold(0.0, |most: f64, tick| most.max(tick.cross_track_m.abs()))
    }
}

fn curve(stiffness: f64) -> FrictionCurve {
    FrictionCurve::with_stiffness(stiffness).expect("the scenarios' stiffnesses are positive")
}

/// Returns a standard normal random number.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let first: f64 = rng.random_range(f64::MIN_POSITIVE..1.0);
    let second: f64 = rng.random();
    (-2.0 * first.ln()).sqrt() * (std::f64::consts::TAU * second).cos()
}

/// The robot's sensors at 200 Hz, with their default noise.
struct Sensors {
    noise: SensorNoise,
    model: RobotModel,
    rng: ChaCha8Rng,
    count: u32,
}

impl Sensors {
    fn sample(&mut self, plant: &Plant) -> SensorSample {
        self.count += 1;
        let noise = self.noise;
        let mut gauss = |std_dev: f64| std_dev * normal(&mut self.rng);
        let (state, seen, torques) = (plant.state(), plant.means(), plant.wheel_torques());
        let felt = seen.acceleration;
        let torque_noise = noise.torque_mu * self.model.wheel_radius_m() * self.model.side_load_n();
        SensorSample {
            wheel_speeds: WheelSpeeds {
                left_rad_s: seen.wheel_speeds.left_rad_s + gauss(noise.wheel_speed_rad_s),
                right_rad_s: seen.wheel_speeds.right_rad_s + gauss(noise.wheel_speed_rad_s),
            },
            gyro_rad_s: seen.yaw_rate_rad_s + gauss(noise.gyro_rad_s),
            is_specific_force: false,
            acceleration: Some(BodyAcceleration {
                forward_m_s2: felt.forward_m_s2 + gauss(noise.accelerometer_m_s2),
                left_m_s2: felt.left_m_s2 + gauss(noise.accelerometer_m_s2),
            }),
            body_speed_m_s: self
                .count
                .is_multiple_of(20)
                .then(|| state.forward_m_s + gauss(noise.body_speed_m_s)),
            wheel_torques: Some(WheelTorques {
                left_n_m: torques.left_n_m + gauss(torque_noise),
                right_n_m: torques.right_n_m + gauss(torque_noise),
            }),
        }
    }
}

/// Simulates one law until the end of the course, or until the robot is lost.
pub(crate) fn simulate(case: &Case, law: Law, knowing: ThetaSource) -> Trace {
    let model = case.model;
    let start_pose = case.course.sample(0.0).pose;
    let first = curve(case.terrain.stiffness(0.0, start_pose));
    let scenario = Scenario {
        servo_lag_s: case.lag_s,
        tracker: TrackerConfig {
            servo_lag_s: case.lag_s,
            ..case.tracker
        },
        ..Scenario::usual(first)
    };
    let mut run = Run::new(case.course.clone(), model, scenario, law)
        .expect("the scenarios are within the plant's range");
    let mut pose_rng = ChaCha8Rng::seed_from_u64(case.seed);
    let noise = SensorNoise::default();
    let mut sensors = Sensors {
        noise,
        model,
        rng: ChaCha8Rng::seed_from_u64(case.seed ^ 0x5eed_0000),
        count: 0,
    };
    let mut estimator = Estimator::new(model, noise);
    let shipped = matches!(law, Law::Shipped(_));
    let mut ticks = Vec::new();
    let mut before = first;
    loop {
        let (time_s, pose) = (run.time_s(), run.plant().state().pose);
        let here = curve(case.terrain.stiffness(time_s, pose));
        // A border that the map knows begins a new ground; one it does not must be noticed.
        if knowing == ThetaSource::Map && here != before {
            estimator.close_segment();
            estimator.begin_ground();
        }
        before = here;
        let own = shipped
            .then(|| estimator.estimate().theta)
            .flatten()
            .map(|found| ThetaKnowledge {
                theta: found.theta,
                std_dev: found.std_dev,
            });
        let claim = |factor: f64, std_dev: f64| ThetaKnowledge {
            theta: factor * here.theta(),
            std_dev: std_dev * factor * here.theta(),
        };
        let knowledge = match knowing {
            ThetaSource::Nothing => None,
            ThetaSource::Map => {
                let prior = claim(1.0, PRIOR_DEVIATION);
                Some(own.map_or(prior, |own| own.fused(prior)))
            }
            ThetaSource::Wrong { factor, until_s } if time_s < until_s => {
                Some(claim(factor, PRIOR_DEVIATION))
            }
            ThetaSource::Own | ThetaSource::Wrong { .. } => own,
        };
        let mut gauss = |std_dev: f64| {
            let drawn = normal(&mut pose_rng);
            if case.noisy { std_dev * drawn } else { 0.0 }
        };
        let pose_error = Pose {
            x_m: gauss(NOISE_M),
            y_m: gauss(NOISE_M),
            heading_rad: gauss(NOISE_RAD),
        };
        let ground = Ground::uniform(here);
        let input = TickInput {
            ground: &ground,
            pose_error,
            knowledge,
        };
        let output = run.tick(&input, |plant, dt_s| {
            if shipped
                && estimator
                    .update(&sensors.sample(plant), dt_s)
                    .ground_changed
            {
                estimator.close_segment();
                estimator.begin_ground();
            }
        });
        let Some(output) = output else {
            break;
        };
        ticks.push(Tick {
            time_s,
            cross_track_m: output.cross_track_m,
            pose,
        });
    }
    Trace {
        ticks,
        duration_s: case.course.duration_s(),
        lost: run.is_given_up(),
    }
}
