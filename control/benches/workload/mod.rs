//! What is measured: one robot on its way, everything prepared, so that one call is one piece of
//! work.

use tread_control::estimation::{Estimator, EstimatorPrior, SensorNoise, SensorSample};
use tread_control::fence::{Fence, FenceInput, FenceSpec};
use tread_control::follower::{Follower, FollowerConfig, FollowerOutput};
use tread_control::friction::FrictionCurve;
use tread_control::gate::{GateInput, GateLimits, Reasons, gate_with};
use tread_control::geometry::{Point, Pose};
use tread_control::localisation::{Localisation, LocalisationNoise, PositionFix};
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::plan::Plan;
use tread_control::plant::{Ground, Plant, PlantSpec};
use tread_control::reference::{Governor, GovernorInput, ReferenceSample};
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;
use tread_control::trajectory::{Trajectory, Waypoint, WaypointsSpec};

/// Control loop, seconds.
pub(crate) const LOOP_S: f64 = 0.01;
/// Sensor samples per loop.
const SAMPLES: u32 = 2;

/// A figure-8 of waypoints, many times round.
pub(crate) fn plan() -> Plan {
    let points = (0..=960_u16)
        .map(|index| {
            let angle_rad = f64::from(index) / 24.0 * std::f64::consts::TAU;
            Waypoint::from(Point {
                x_m: 4.0 * angle_rad.sin(),
                y_m: 2.0 * (2.0 * angle_rad).sin(),
            })
        })
        .collect();
    let trajectory = Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.6,
    });
    let start = Pose {
        heading_rad: std::f64::consts::FRAC_PI_4,
        ..Pose::default()
    };
    Plan::new(&trajectory, start, &RobotModel::yi2007()).expect("a path that can be driven")
}

/// The corners of a regular polygon.
fn ring(x_m: f64, y_m: f64, radius_m: f64, corners: u32) -> Vec<Point> {
    let corner = |index: u32| {
        let angle_rad = f64::from(index) / f64::from(corners) * std::f64::consts::TAU;
        Point {
            x_m: x_m + radius_m * angle_rad.cos(),
            y_m: y_m + radius_m * angle_rad.sin(),
        }
    };
    (0..corners).map(corner).collect()
}

/// A robot with plant, estimator, localisation, law, fence and gate.
pub(crate) struct Robot {
    pub(crate) plant: Plant,
    pub(crate) ground: Ground,
    pub(crate) command: WheelSpeeds,
    localisation: Localisation,
    estimator: Estimator,
    follower: Follower,
    limits: GateLimits,
    model: RobotModel,
    fence: Fence,
    samples: [SensorSample; SAMPLES as usize],
    ticks: u32,
}

impl Robot {
    /// A robot that has been under way for some seconds on ground of a stiffness.
    pub(crate) fn under_way(stiffness: f64) -> Self {
        let model = RobotModel::yi2007();
        let plan = plan();
        let start = plan.sample(0.0).path.pose;
        let curve = FrictionCurve::with_stiffness(stiffness).expect("a positive stiffness");
        let mut robot = Self {
            plant: Plant::new(model, PlantSpec::default(), start).expect("a valid plant"),
            ground: Ground::uniform(curve),
            command: WheelSpeeds::default(),
            localisation: Localisation::new(model, LocalisationNoise::default()),
            estimator: Estimator::new(model, SensorNoise::default()),
            follower: Follower::new(plan, model, FollowerConfig::default()).expect("valid gains"),
            limits: GateLimits::of(&model),
            model,
            fence: Fence::default(),
            samples: [SensorSample::default(); SAMPLES as usize],
            ticks: 0,
        };
        for _ in 0..1000 {
            robot.sense();
            robot.tick();
        }
        robot
    }

    /// The same robot with an agent that knows its data sheet only, and identifies the rest.
    pub(crate) fn identified(mut self) -> Self {
        let (model, noise) = (RobotModel::yi2007(), SensorNoise::default());
        self.estimator = Estimator::with_prior(model, noise, EstimatorPrior::default());
        self
    }

    /// The same robot within a fence of a thousand corners, the most that there may be, most of
    /// them near its path.
    pub(crate) fn fenced(mut self) -> Self {
        let keep_out = [(2.7, 0.0), (-2.7, 0.0), (0.0, 2.6), (0.0, -2.6)];
        let keep_out = keep_out.map(|(x_m, y_m)| ring(x_m, y_m, 0.25, 100));
        self.fence = Fence::new(&FenceSpec {
            keep_in: vec![ring(0.0, 0.0, 4.8, 600)],
            keep_out: keep_out.to_vec(),
        });
        self
    }

    /// Lets the plant run for a tick and reads its sensors; no part of the measured work.
    pub(crate) fn sense(&mut self) {
        for index in 0..SAMPLES as usize {
            self.plant
                .step(self.command, &self.ground, LOOP_S / f64::from(SAMPLES));
            let state = self.plant.state();
            self.samples[index] = SensorSample {
                wheel_speeds: state.wheel_speeds,
                gyro_rad_s: state.yaw_rate_rad_s,
                is_specific_force: false,
                acceleration: Some(self.plant.body_acceleration()),
                body_speed_m_s: self.ticks.is_multiple_of(10).then_some(state.forward_m_s),
                wheel_torques: Some(self.plant.wheel_torques()),
            };
        }
    }

    /// One step of the estimator.
    pub(crate) fn estimate(&mut self) {
        let sample = self.samples[0];
        self.estimator.update(&sample, LOOP_S / f64::from(SAMPLES));
    }

    /// One whole tick: localisation, estimator, law and gate.
    pub(crate) fn tick(&mut self) -> FollowerOutput {
        let dt_s = LOOP_S / f64::from(SAMPLES);
        for sample in self.samples {
            self.localisation.predict(&sample, dt_s);
            self.estimator.update(&sample, dt_s);
        }
        if self.ticks.is_multiple_of(5) {
            let pose = self.plant.state().pose;
            self.localisation.correct(&PositionFix {
                pose,
                age_s: 0.0,
                noise: None,
            });
        }
        self.ticks += 1;
        let knowledge = self.estimator.estimate().theta.map(|found| ThetaKnowledge {
            theta: found.theta,
            std_dev: found.std_dev,
        });
        let measured = Measured {
            pose: self.localisation.pose().unwrap_or_default(),
            twist: self.localisation.twist(),
            wheel_speeds: self.samples[SAMPLES as usize - 1].wheel_speeds,
            pose_age_s: self.localisation.fix_age_s(),
            position_std_dev_m: self.localisation.position_std_dev_m(),
        };
        let output = self.follower.step(&measured, knowledge, LOOP_S);
        let input = GateInput {
            command: Some(output.wheel_speeds),
            previous: self.command,
            stop: false,
            feedback_age_s: 0.0,
            dt_s: LOOP_S,
        };
        let fence = FenceInput {
            pose: measured.pose,
            position_std_dev_m: self.localisation.position_std_dev_m(),
            present: measured.twist,
            requested: self.model.twist_from_wheel_speeds(output.wheel_speeds),
            mu_lower: None,
        };
        let reasons = Reasons {
            fence_max_m_s: self.fence.limit_speed(&fence, &self.model).speed_max_m_s,
            ..Reasons::default()
        };
        self.command = gate_with(&input, &reasons, &self.limits).wheel_speeds;
        output
    }

    /// One second of the plant at 200 Hz under the present command.
    pub(crate) fn plant_second(&mut self) {
        for _ in 0..200 {
            self.plant.step(self.command, &self.ground, 0.005);
        }
    }
}

/// A reference that walks along a plan.
pub(crate) struct Walk {
    plan: Plan,
    governor: Governor,
}

impl Walk {
    pub(crate) fn new() -> Self {
        Self {
            plan: plan(),
            governor: Governor::new(&RobotModel::yi2007()),
        }
    }

    /// One sample of the reference.
    pub(crate) fn sample(&mut self) -> ReferenceSample {
        self.governor
            .step(&self.plan, &GovernorInput::default(), LOOP_S)
    }
}
