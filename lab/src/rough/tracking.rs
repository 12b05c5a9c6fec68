//! Compares tracking laws with realistic sensors and the shipped localisation.
//!
//! No law has exact inputs: wheel speeds are quantised, the turn rate is the gyro's minus the
//! estimated offset, poses are delayed and noisy, the servo's lag is random. The robot is of the
//! agent's simulator or of the rough world. Plans, seeds, localisation, governor, gate and rate are
//! equal for all laws.

use std::time::Duration;

use tread_agent::drive::Feedback;
use tread_control::estimation::{Estimator, EstimatorPrior, SensorNoise, SensorSample};
use tread_control::friction::{FrictionCurve, FrictionSpec};
use tread_control::gate::{GateCause, GateInput, GateLimits, gate};
use tread_control::geometry::Pose;
use tread_control::localisation::{FixOutcome, Localisation, LocalisationNoise, PositionFix};
use tread_control::measured::{BodyAcceleration, Measured, WheelSpeeds};
use tread_control::plan::Plan;
use tread_control::plant::{Ground, Plant as OwnPlant, PlantSpec};
use tread_control::reference::{Governor, GovernorInput, ReferenceSample};
use tread_control::robot::RobotModel;
use tread_control::tracking::{ThetaKnowledge, TrackerConfig, TrackingErrors};

use super::means::Means;
use super::plant::{Plant, STEP_S, State, Truth};
use super::run::SETTLES;
use super::sensors::{SAMPLE_PERIOD, SensorSpec, Sensors};
use super::spec::{Deviations, Make};
use crate::bench::{Course, Driver, Law, LawInput};
use crate::random::Random;

/// Time after the start from which errors are evaluated, in seconds.
pub const COUNTED_FROM_S: f64 = 10.0;
/// Maximum duration of a drive relative to the plan's; a robot that takes longer counts as lost.
const LATE_MAX: f64 = 2.0;
/// Cross-track error at which a drive is aborted and the robot counts as lost, in metres.
const GIVEN_UP_M: f64 = 5.0;
/// Age of the last sample and of the last position in the inputs of gate and law, in seconds.
const FRESH_S: f64 = 0.0;
/// Mask of the seed for drawing the robot, so that robot and sensor noise are independent.
const ROBOT_SEED: u64 = 0x7ac4;

/// Simulator of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum World {
    /// The agent's simulator.
    Own,
    /// The rough world.
    Rough,
}

impl World {
    /// For people.
    pub fn text(self) -> &'static str {
        match self {
            Self::Own => "own",
            Self::Rough => "rough",
        }
    }
}

/// Quality of measured poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Poses {
    /// 2 mm at 50 Hz with a delay of 20 ms, as of a motion-capture system.
    Fine,
    /// 2 cm at 10 Hz with a delay of 50 ms and a slow error of 1 cm, as of a good GNSS receiver.
    Coarse,
}

impl Poses {
    /// For people.
    pub fn text(self) -> &'static str {
        match self {
            Self::Fine => "2 mm, 50 Hz",
            Self::Coarse => "2 cm, 10 Hz",
        }
    }

    fn sensors(self, has_torque: bool) -> SensorSpec {
        let usual = SensorSpec::usual(has_torque);
        match self {
            Self::Coarse => usual,
            Self::Fine => SensorSpec {
                position_m: 0.002,
                heading_rad: 0.002,
                position_wander_m: 0.0,
                position_period: Duration::from_millis(20),
                position_delay: Duration::from_millis(20),
                ..usual
            },
        }
    }
}

/// Estimate of θ that the shipped law receives during the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ThetaSource {
    /// No estimate.
    Nothing,
    /// The estimate of the robot's own estimator, from wheel torques.
    Own,
}

/// Specification of a drive.
#[derive(Debug, Clone, Copy)]
pub struct Trial<'a> {
    /// Simulator of the drive.
    pub world: World,
    /// Quality of measured poses.
    pub poses: Poses,
    /// Make of the robot.
    pub make: Make,
    /// Friction stiffness K of the ground.
    pub stiffness: f64,
    /// Plan to drive, from rest to rest.
    pub plan: &'a Plan,
    /// Seed of robot and sensor noise.
    pub seed: u64,
    /// Tracking law.
    pub law: Law,
    /// Gains of the shipped law.
    pub config: TrackerConfig,
    /// Estimate of θ that the law receives.
    pub knowing: ThetaSource,
}

/// Errors of a drive from [`COUNTED_FROM_S`] on, metres; infinite if the robot was lost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Errors {
    /// Root mean square of the true cross-track error.
    pub rms_m: f64,
    /// Maximum of the true cross-track error's magnitude.
    pub most_m: f64,
    /// Root mean square of the localisation's error across the course.
    pub localisation_rms_m: f64,
}

impl Errors {
    /// Errors of a robot that was lost or did not arrive in time.
    const LOST: Self = Self {
        rms_m: f64::INFINITY,
        most_m: f64::INFINITY,
        localisation_rms_m: f64::INFINITY,
    };
}

/// Simulated robot of either simulator.
enum Base {
    Own {
        plant: Box<OwnPlant>,
        ground: Ground,
        turned_rad: [f64; 2],
    },
    Rough(Box<Plant>),
}

impl Base {
    fn new(trial: &Trial<'_>, model: &RobotModel, start: Pose) -> anyhow::Result<Self> {
        let mut random = Random::new(trial.seed ^ ROBOT_SEED);
        let mut drawn = Deviations::drawn(&mut random);
        drawn.curve.stiffness = trial.stiffness;
        drawn.curve.mu_peak = drawn.curve.mu_peak.min(0.9 * trial.stiffness);
        Ok(match trial.world {
            World::Own => Self::Own {
                plant: Box::new(OwnPlant::new(
                    *model,
                    PlantSpec {
                        servo_lag_s: drawn.servo_lag_s,
                        ..PlantSpec::default()
                    },
                    start,
                )?),
                ground: Ground::uniform(FrictionCurve::try_from(FrictionSpec {
                    stiffness: trial.stiffness,
                    peak_slip: FrictionCurve::yi2007().peak_slip(),
                    sliding_ratio: FrictionCurve::yi2007().sliding_ratio(),
                })?),
                turned_rad: [0.0; 2],
            },
            World::Rough => Self::Rough(Box::new(
                Plant::new(model, drawn, start)
                    .ok_or_else(|| anyhow::anyhow!("the wheels are no rectangle"))?,
            )),
        })
    }

    fn advance(&mut self, command: WheelSpeeds) -> Means {
        match self {
            Self::Rough(plant) => {
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "a small whole number"
                )]
                let steps = (SAMPLE_PERIOD.as_secs_f64() / STEP_S).round() as u32;
                plant.advance(command, steps)
            }
            Self::Own {
                plant,
                ground,
                turned_rad,
            } => {
                let dt_s = SAMPLE_PERIOD.as_secs_f64();
                plant.step(command, ground, dt_s);
                let means = *plant.means();
                turned_rad[0] += dt_s * means.wheel_speeds.left_rad_s;
                turned_rad[1] += dt_s * means.wheel_speeds.right_rad_s;
                Means {
                    yaw_rate_rad_s: means.yaw_rate_rad_s,
                    acceleration: means.acceleration,
                    wheel_speeds: means.wheel_speeds,
                    torques: plant.wheel_torques(),
                }
            }
        }
    }

    fn truth(&self) -> Truth {
        match self {
            Self::Rough(plant) => plant.truth(),
            Self::Own {
                plant, turned_rad, ..
            } => {
                let state = plant.state();
                Truth {
                    state: State {
                        pose: state.pose,
                        forward_m_s: state.forward_m_s,
                        left_m_s: state.left_m_s,
                        yaw_rate_rad_s: state.yaw_rate_rad_s,
                    },
                    turned_rad: *turned_rad,
                    torque_scale: [1.0; 2],
                    tilt_rad: 0.0,
                    gravity_m_s2: [0.0; 2],
                }
            }
        }
    }
}

/// Estimators of the robot, and its last measurements.
struct Known {
    localisation: Localisation,
    estimator: Estimator,
    last_at: Option<Duration>,
    wheels: WheelSpeeds,
    felt: BodyAcceleration,
}

impl Known {
    fn receive(&mut self, feedback: &Feedback) {
        for sample in feedback.samples() {
            if let (Some(gyro_rad_s), Some(wheel_speeds)) =
                (sample.yaw_rate_rad_s, sample.wheel_speeds)
            {
                let dt_s = self
                    .last_at
                    .replace(sample.at)
                    .map_or(0.0, |last| sample.at.saturating_sub(last).as_secs_f64());
                self.wheels = wheel_speeds;
                self.felt = sample.acceleration.unwrap_or(self.felt);
                let taken = SensorSample {
                    wheel_speeds,
                    gyro_rad_s,
                    acceleration: sample.acceleration,
                    is_specific_force: sample.is_specific_force,
                    body_speed_m_s: sample.body_speed_m_s,
                    wheel_torques: sample.wheel_torques,
                };
                self.localisation.predict(&taken, dt_s);
                if self.estimator.update(&taken, dt_s).ground_changed {
                    // As the agent does.
                    self.estimator.close_segment();
                    self.estimator.begin_ground();
                }
            }
            if let Some(pose) = sample.position {
                let age_s = self
                    .last_at
                    .map_or(0.0, |last| last.saturating_sub(sample.at).as_secs_f64());
                let fix = PositionFix {
                    pose,
                    age_s,
                    noise: sample.position_noise,
                };
                let _: FixOutcome = self.localisation.correct(&fix);
            }
        }
    }

    fn measured(&self) -> Option<Measured> {
        Some(Measured {
            pose: self.localisation.pose()?,
            twist: self.localisation.twist(),
            wheel_speeds: self.wheels,
            pose_age_s: FRESH_S,
            position_std_dev_m: self.localisation.position_std_dev_m(),
        })
    }

    fn theta(&self) -> Option<ThetaKnowledge> {
        self.estimator.estimate().theta.map(|found| ThetaKnowledge {
            theta: found.theta,
            std_dev: found.own_std_dev,
        })
    }
}

/// Runs a drive.
///
/// # Errors
/// Robot, ground or gains are impossible.
pub fn run(trial: &Trial<'_>) -> anyhow::Result<Errors> {
    let model = trial.make.model()?;
    let start = ReferenceSample::from(&trial.plan.sample(0.0)).pose;
    let mut base = Base::new(trial, &model, start)?;
    let sensors = trial.poses.sensors(true);
    let mut sensors = Sensors::new(sensors, &model, Random::new(trial.seed));
    let mut known = Known {
        localisation: Localisation::new(model, LocalisationNoise::default()),
        estimator: Estimator::with_prior(model, SensorNoise::default(), EstimatorPrior::default()),
        last_at: None,
        wheels: WheelSpeeds::default(),
        felt: BodyAcceleration::default(),
    };
    let mut driver = Driver::new(model, trial.config, FrictionCurve::yi2007(), trial.law)?;
    let limits = GateLimits::of(&model);
    let dt_s = SAMPLE_PERIOD.as_secs_f64();
    let mut command = WheelSpeeds::default();
    let mut now = Duration::ZERO;
    let (mut nearest_s, mut most_m) = (0.0, 0.0_f64);
    let (mut squares, mut located, mut count) = (0.0, 0.0, 0.0);
    let mut governor = Governor::new(&model);
    let course = Course::Plan(trial.plan.clone());
    let mut governed = GovernorInput::default();
    let end_s = LATE_MAX * trial.plan.duration_s();
    while !governor.is_at_end(trial.plan) {
        let time_s = now.as_secs_f64() - SETTLES.as_secs_f64();
        if time_s > end_s {
            return Ok(Errors::LOST);
        }
        now += SAMPLE_PERIOD;
        let means = base.advance(command);
        let truth = base.truth();
        let mut feedback = Feedback::default();
        sensors.sample(&truth, &means, now, &mut feedback);
        known.receive(&feedback);
        let Some(measured) = known.measured().filter(|_| time_s >= 0.0) else {
            continue;
        };
        let nearest = course.nearest(truth.state.pose.point(), nearest_s);
        nearest_s = nearest.time_s;
        let off_m = nearest.cross_track_m.abs();
        if off_m.is_nan() || off_m > GIVEN_UP_M {
            return Ok(Errors::LOST);
        }
        if time_s > COUNTED_FROM_S {
            let along = course.sample(nearest_s).pose;
            let seen_m = along.body_from_site(measured.pose.point()).y_m;
            squares += nearest.cross_track_m.powi(2);
            located += (seen_m - nearest.cross_track_m).powi(2);
            most_m = most_m.max(nearest.cross_track_m.abs());
            count += 1.0;
        }
        let knowledge = match trial.knowing {
            ThetaSource::Nothing => None,
            ThetaSource::Own => known.theta(),
        };
        let reference = governor.step(trial.plan, &governed, dt_s);
        // Pure pursuit follows the path without a time reference.
        if !matches!(trial.law, Law::Pursuit(_)) {
            let errors = TrackingErrors::between(&reference, &measured);
            governed.lag_m = errors.distance_m();
            governed.along_track_m = errors.along_track_m;
        }
        let input = LawInput {
            course: &course,
            time_s: governor.clock_s(),
            reference: &reference,
            measured: &measured,
            knowledge,
            felt: known.felt,
        };
        let (wanted, output) = driver.step(&input, dt_s);
        governed.saturated = output.is_some_and(|output| output.saturated);
        let passed = gate(
            &GateInput {
                command: Some(wanted),
                previous: command,
                stop: false,
                feedback_age_s: FRESH_S,
                dt_s,
            },
            &limits,
        );
        driver.hold_adaptation(
            passed
                .cause
                .is_some_and(|cause| cause > GateCause::Acceleration),
        );
        command = passed.wheel_speeds;
    }
    let mean = |sum: f64| (sum / f64::max(count, 1.0)).sqrt();
    Ok(Errors {
        rms_m: mean(squares),
        most_m,
        localisation_rms_m: mean(located),
    })
}
