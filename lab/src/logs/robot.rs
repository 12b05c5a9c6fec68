//! The model of the recorded robot: from a configuration of the agent, or from its measures.

use std::path::{Path, PathBuf};

use tread_agent::AgentConfig;
use tread_agent::config::{ConfigError, DriveConfig, Flags};
use tread_agent::drive::ros2::settings::Ros2Settings;
use tread_agent::geometry::control_model;
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;
use tread_control::robot::{Limits, RobotModel, RobotModelError, RobotModelSpec};

/// Rate of the agent's loop by default, hertz.
const RATE_HZ: f64 = 100.0;
/// Limits of a robot of which only measures are given: rims at most this fast, metres per second.
/// The estimator takes three times as much for impossible.
const RIM_MAX_M_S: f64 = 5.0;
/// Rim acceleration, metres per second squared. The estimator takes ten times as much for a leap.
const RIM_MAX_M_S2: f64 = 5.0;

/// Measures of a robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measures {
    /// Mass, kilograms.
    pub mass_kg: f64,
    /// Distance of the left and right wheels' centre lines, metres.
    pub track_m: f64,
    /// Distance of the axles, metres.
    pub wheelbase_m: f64,
    /// Rolling radius of the wheels, metres.
    pub wheel_radius_m: f64,
    /// Yaw inertia, kg m²; absent: that of a homogeneous box around the wheels.
    pub yaw_inertia_kg_m2: Option<f64>,
}

impl Measures {
    /// Returns the yaw inertia: the given one, or that of a box as long as the wheels reach and as
    /// wide as the track.
    pub fn yaw_inertia_kg_m2(&self) -> f64 {
        self.yaw_inertia_kg_m2.unwrap_or_else(|| {
            let length_m = self.wheelbase_m + 2.0 * self.wheel_radius_m;
            self.mass_kg * (length_m * length_m + self.track_m * self.track_m) / 12.0
        })
    }
}

/// What is known of the recorded robot.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Its model.
    pub model: RobotModel,
    /// What the estimator assumes of its parameters and tyres.
    pub prior: EstimatorPrior,
    /// Topics, joints and frames, where a configuration of a ROS 2 robot names them.
    pub settings: Option<Ros2Settings>,
    /// Rate of its control loop, hertz.
    pub rate_hz: f64,
}

impl Robot {
    /// Returns a robot that is known by its measures, on unknown tyres.
    ///
    /// # Errors
    /// [`RobotModelError`] names the measure that is not above zero.
    pub fn of_measures(measures: Measures) -> Result<Self, RobotModelError> {
        let radius_m = measures.wheel_radius_m;
        let model = RobotModel::try_from(RobotModelSpec {
            mass_kg: measures.mass_kg,
            track_width_m: measures.track_m,
            wheelbase_m: measures.wheelbase_m,
            wheel_radius_m: radius_m,
            yaw_inertia_kg_m2: measures.yaw_inertia_kg_m2(),
            limits: Limits {
                wheel_speed_max_rad_s: RIM_MAX_M_S / radius_m,
                wheel_acceleration_max_rad_s2: RIM_MAX_M_S2 / radius_m,
                linear_max_m_s: RIM_MAX_M_S,
                angular_max_rad_s: 2.0 * RIM_MAX_M_S / measures.track_m,
                linear_acceleration_max_m_s2: RIM_MAX_M_S2,
                linear_jerk_max_m_s3: 10.0 * RIM_MAX_M_S2,
                lateral_acceleration_max_m_s2: RIM_MAX_M_S2,
            },
        })?;
        Ok(Self {
            model,
            prior: EstimatorPrior::default(),
            settings: None,
            rate_hz: RATE_HZ,
        })
    }

    /// Reads a robot from a configuration of the agent, `robot.toml`.
    ///
    /// `[estimation]` and `[drive.ros2]` count for a robot with `kind = "ros2"`; of a simulated one
    /// the agent assumes that it equals its model, which no recorded robot does.
    ///
    /// # Errors
    /// [`ConfigError`] names file, line and key.
    pub fn of_file(file: &Path) -> Result<Self, ConfigError> {
        // Nothing is connected and nothing is written: what the agent needs for that stands in
        // for what a file may leave out, and for the fleet's certificate.
        let flags = Flags {
            config: Some(file.to_owned()),
            site: "recorded".parse().ok(),
            robot: "recorded".parse().ok(),
            server: vec!["tcp/127.0.0.1:7447".to_owned()],
            data_dir: Some(PathBuf::from("no-such-folder")),
            start: Some(Pose::default()),
            ..Flags::default()
        };
        let config = AgentConfig::load(&flags)?;
        let model = control_model(&config.model).map_err(|refused| ConfigError::OutOfRange {
            key: "model",
            problem: refused.to_string(),
        })?;
        let (prior, settings) = match config.drive {
            DriveConfig::Ros2(settings) => (config.prior, Some(*settings)),
            DriveConfig::Simulated(_) => (EstimatorPrior::default(), None),
        };
        Ok(Self {
            model,
            prior,
            settings,
            rate_hz: config.rate_hz,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HUSKY_LIKE: Measures = Measures {
        mass_kg: 50.0,
        track_m: 0.57,
        wheelbase_m: 0.51,
        wheel_radius_m: 0.165,
        yaw_inertia_kg_m2: None,
    };

    #[test]
    fn a_robot_without_its_yaw_inertia_counts_as_a_box() {
        let box_kg_m2 = 50.0 * (0.84_f64.powi(2) + 0.57_f64.powi(2)) / 12.0;
        assert!((HUSKY_LIKE.yaw_inertia_kg_m2() - box_kg_m2).abs() < 1.0e-12);
        let measured = Measures {
            yaw_inertia_kg_m2: Some(7.0),
            ..HUSKY_LIKE
        };
        let robot = Robot::of_measures(measured).unwrap();
        assert!((robot.model.yaw_inertia_kg_m2() - 7.0).abs() < 1.0e-12);
    }

    #[test]
    fn a_measure_that_is_none_is_refused_by_its_name() {
        let refused = Robot::of_measures(Measures {
            track_m: f64::NAN,
            ..HUSKY_LIKE
        });
        assert!(refused.unwrap_err().to_string().contains("track_width_m"));
    }

    #[test]
    fn the_agents_example_is_read_without_its_certificate_and_its_folder() {
        // Tests run in the folder of their crate.
        let example = Path::new("../robot-agent/robot.example.toml");
        let robot = Robot::of_file(example).unwrap();
        assert!((robot.model.track_width_m() - 0.43).abs() < 1.0e-12);
        assert_eq!(robot.prior, EstimatorPrior::default());
        let missing = Robot::of_file(Path::new("no-such-robot.toml")).unwrap_err();
        assert!(
            missing.to_string().contains("no-such-robot.toml"),
            "{missing}"
        );
    }
}
