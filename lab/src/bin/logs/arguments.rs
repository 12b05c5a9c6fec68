//! The command line.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, ensure};
use clap::Parser;
use tread_agent::drive::ros2::settings::Effort;
use tread_control::estimation::EstimatorPrior;
use tread_lab::logs::analysis::Options;
use tread_lab::logs::mapping::{JointNames, RequestedTopics};
use tread_lab::logs::robot::{Measures, Robot};
use tread_lab::logs::stretches::PASS_MIN;

/// Longest wanted pass, seconds.
const PASS_MAX_S: f64 = 3_600.0;

#[derive(Debug, Parser)]
#[command(
    name = "logs",
    about = "Says what Tread's estimator makes of recordings of other robots"
)]
#[expect(clippy::struct_excessive_bools, reason = "flags of a command line")]
pub(crate) struct Arguments {
    /// MCAP files, databases of rosbag2, or folders that `ros2 bag record` made
    #[arg(required = true, value_name = "FILE")]
    pub(crate) files: Vec<PathBuf>,
    /// Print topics, types and rates, and what is missing for an estimate
    #[arg(long)]
    pub(crate) list: bool,
    /// Print one JSON object
    #[arg(long)]
    pub(crate) json: bool,
    /// The robot's model, and its topics if it names them: a configuration of the agent
    #[arg(long, value_name = "ROBOT.TOML", conflicts_with_all = ["mass_kg", "track_m", "wheelbase_m", "wheel_radius_m", "yaw_inertia_kg_m2"])]
    robot: Option<PathBuf>,
    /// Mass of the data sheet, kilograms; a payload of 10 ± 12 % is assumed beside it
    #[arg(long)]
    mass_kg: Option<f64>,
    /// Distance of the centre lines of left and right wheels, metres
    #[arg(long)]
    track_m: Option<f64>,
    /// Distance of the axles, metres
    #[arg(long)]
    wheelbase_m: Option<f64>,
    /// Rolling radius of the wheels, metres
    #[arg(long)]
    wheel_radius_m: Option<f64>,
    /// Yaw inertia, kg m² [default: that of a box around the wheels]
    #[arg(long)]
    yaw_inertia_kg_m2: Option<f64>,
    /// Assume that the robot equals its model, on tyres that rise straight: a simulated robot
    #[arg(long)]
    exact: bool,
    /// Topic with the wheels' joints [default: the only one of its type]
    #[arg(long, value_name = "TOPIC")]
    wheels: Option<String>,
    /// Joints of both sides [default: by `left` and `right` in their names]
    #[arg(long, value_name = "LEFT,…/RIGHT,…")]
    joints: Option<JointNames>,
    /// The left joints turn backwards when the robot drives forward
    #[arg(long)]
    reverse_left: bool,
    /// The right joints turn backwards when the robot drives forward
    #[arg(long)]
    reverse_right: bool,
    /// Joint revolutions per wheel revolution [default: 1]
    #[arg(long)]
    gear_ratio: Option<f64>,
    /// What the joints' effort is: `none`, `torque` in N m, or the motor's torque constant in N m/A
    /// [default: none]
    #[arg(long, value_parser = parse_effort)]
    effort: Option<Effort>,
    /// Differentiate the joints' positions even where their speeds are given
    #[arg(long)]
    from_positions: bool,
    /// Topic of the inertial unit [default: the only one of its type]
    #[arg(long, value_name = "TOPIC")]
    imu: Option<String>,
    /// Angle of the inertial unit's x axis against the robot's, radians, positive to the left
    #[arg(long, allow_hyphen_values = true)]
    imu_yaw_rad: Option<f64>,
    /// The inertial unit is mounted upside down, rotated about its x axis
    #[arg(long)]
    imu_upside_down: bool,
    /// Topic of the odometry [default: none if there are joints]
    #[arg(long, value_name = "TOPIC")]
    odometry: Option<String>,
    /// The odometry is measured over ground, by camera, laser or satellite, and not by the wheels
    #[arg(long)]
    over_ground: bool,
    /// Track width with which the base computes its odometry, metres, multiplier included
    #[arg(long)]
    odometry_track_m: Option<f64>,
    /// Topic of the pose [default: the only one of its type]
    #[arg(long, value_name = "TOPIC")]
    pose: Option<String>,
    /// Begin, seconds after the first message
    #[arg(long, default_value_t = 0.0)]
    from_s: f64,
    /// End, seconds after the first message
    #[arg(long, default_value_t = f64::INFINITY, hide_default_value = true)]
    to_s: f64,
    /// Wanted length of a pass, seconds
    #[arg(long, default_value_t = 60.0)]
    pass_s: f64,
    /// Take wheel speeds of 3 to 11 Hz as changing evenly in between
    #[arg(long)]
    interpolate: bool,
    /// Largest χ² per pair of passes at which they count as consistent
    #[arg(long, default_value_t = 4.0)]
    chi_square_max: f64,
}

fn parse_effort(text: &str) -> Result<Effort, String> {
    match text {
        "none" => Ok(Effort::None),
        "torque" => Ok(Effort::Torque),
        other => match other.parse::<f64>() {
            Ok(constant) if constant.is_finite() && constant > 0.0 => Ok(Effort::Current(constant)),
            Ok(_) | Err(_) => Err("`none`, `torque`, or a torque constant above zero".to_owned()),
        },
    }
}

impl Arguments {
    /// Returns the robot's model and what is known of it.
    pub(crate) fn robot(&self) -> anyhow::Result<Robot> {
        if let Some(file) = &self.robot {
            return Ok(Robot::of_file(file)?);
        }
        let missing = "the robot's model is missing: give --robot robot.toml, or --mass-kg, --track-m, --wheelbase-m and --wheel-radius-m";
        Ok(Robot::of_measures(Measures {
            mass_kg: self.mass_kg.context(missing)?,
            track_m: self.track_m.context(missing)?,
            wheelbase_m: self.wheelbase_m.context(missing)?,
            wheel_radius_m: self.wheel_radius_m.context(missing)?,
            yaw_inertia_kg_m2: self.yaw_inertia_kg_m2,
        })?)
    }

    /// Returns which topics are asked for.
    pub(crate) fn requested_topics(&self) -> RequestedTopics {
        RequestedTopics {
            wheels: self.wheels.clone(),
            joints: self.joints.clone(),
            reversed: [self.reverse_left, self.reverse_right],
            gear_ratio: self.gear_ratio,
            effort: self.effort,
            imu: self.imu.clone(),
            imu_yaw_rad: self.imu_yaw_rad,
            is_imu_upside_down: self.imu_upside_down,
            odometry: self.odometry.clone(),
            is_over_ground: self.over_ground,
            odometry_track_m: self.odometry_track_m,
            pose: self.pose.clone(),
        }
    }

    /// Returns what to do with the recording.
    pub(crate) fn options(&self) -> anyhow::Result<Options> {
        let least_s = PASS_MIN.as_secs_f64();
        ensure!(
            (least_s..=PASS_MAX_S).contains(&self.pass_s),
            "--pass-s is {least_s} to {PASS_MAX_S}, not {}",
            self.pass_s
        );
        let positive = |value: f64| value.is_finite() && value > 0.0;
        ensure!(self.from_s < self.to_s, "--from-s must be before --to-s");
        ensure!(
            self.gear_ratio.is_none_or(positive),
            "--gear-ratio must be above zero"
        );
        ensure!(
            positive(self.chi_square_max),
            "--chi-square-max must be above zero"
        );
        ensure!(
            self.odometry_track_m.is_none_or(positive),
            "--odometry-track-m must be above zero"
        );
        Ok(Options {
            from_s: self.from_s,
            to_s: self.to_s,
            pass: Duration::from_secs_f64(self.pass_s),
            interpolates: self.interpolate,
            is_by_positions: self.from_positions,
            chi_square_max: self.chi_square_max,
            prior: self.exact.then(EstimatorPrior::exact),
        })
    }
}
