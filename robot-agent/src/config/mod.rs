//! Configuration of an agent: `robot.toml`, and flags that override it.
//!
//! Everything is read and checked before anything is opened. An error names file, line and key.

mod estimation;
mod file;
mod place;
mod realtime;
pub(crate) mod recording;
mod ros2;
mod servers;

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Parser;
use tread_api::ids::{OwnerId, RobotId, SiteId};
use tread_api::robot::RobotModel;
use tread_api::safety::LIMITS_MAX;
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;

use file::{DriveFile, DriveKind, FileConfig};
pub(crate) use place::place;

use self::recording::RecordingConfig;
pub use self::servers::{SERVERS_MAX, Servers};
use crate::drive::ros2::settings::{Effort, Ros2Settings};
use crate::geometry::{control_model, paper_robot};
use crate::membership::{Membership, MembershipFileError};
use crate::outbox;
use crate::realtime::RealtimeConfig;
use crate::sim::drive::{Individual, Stall};
use crate::sim::faults::Fault;
use crate::sim::scenario::{BUILT_IN_NAME, Scenario, ScenarioError};
use crate::sim::trace::Trace;
use tread_telemetry::{LOG_FILTER_DEFAULT, TelemetryError, TracingConfig};

/// Default endpoint of the server.
pub const SERVER_DEFAULT: &str = "tcp/127.0.0.1:7447";
/// Permitted silence of one of several servers before the agent connects to the next, seconds. A
/// server sends a message every 0.25 s.
pub const SERVER_TIMEOUT_S_RANGE: std::ops::RangeInclusive<f64> = 0.5..=60.0;
/// Default of it, seconds.
pub const SERVER_TIMEOUT_DEFAULT_S: f64 = 1.0;
/// Permitted rate of the loop, Hz.
pub const RATE_HZ_RANGE: std::ops::RangeInclusive<f64> = 20.0..=200.0;
/// Permitted rate of publication, Hz.
pub const PUBLISH_HZ_RANGE: std::ops::RangeInclusive<f64> = 0.1..=50.0;

/// Key of `robot.toml` with its table, such as `drive.ros2.command.topic`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Key(pub(crate) &'static str);

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error(
        "the configuration `{file}` cannot be read: it must exist, and the user that the agent runs \
         as must be able to read it"
    )]
    Unreadable {
        /// The file.
        file: String,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// The file is not text.
    #[error("the configuration `{file}` is not text in UTF-8: save it as UTF-8")]
    NotText {
        /// The file.
        file: String,
    },
    /// The text does not parse, or a key is not known.
    #[error("in the configuration `{file}`: {problem}")]
    Malformed {
        /// The file.
        file: String,
        /// Line, column, key and what is wrong with it.
        problem: String,
    },
    /// `[tracing]` is invalid.
    #[error(transparent)]
    Tracing(#[from] TelemetryError),
    /// A value without a default is missing.
    #[error("`{key}` is missing: give it in the configuration or as `--{flag}`")]
    Missing {
        /// The key in the file.
        key: &'static str,
        /// The flag.
        flag: &'static str,
    },
    /// A value is out of its range.
    #[error("`{key}`: {problem}")]
    OutOfRange {
        /// The key.
        key: &'static str,
        /// What is wrong with it.
        problem: String,
    },
    /// The robot's membership cannot be used.
    #[error("the robot's place in the fleet is not known")]
    Membership(#[from] MembershipFileError),
    /// The robot has joined under another identifier.
    #[error("the robot has joined the fleet as `{0}`: give that name, or join again")]
    OtherRobot(String),
    /// The endpoint requires a certificate, and the robot has none.
    #[error("`{0}` requires a certificate: join the fleet with `tread-agent enroll`")]
    NotEnrolled(String),
    /// The endpoint is a URL of the REST API.
    #[error(
        "`{0}` is an address of the REST API; `server` is where robots connect: `tls/HOST:7447`, or \
         `tcp/127.0.0.1:7447` on the server's own machine"
    )]
    RestAddress(String),
    /// The endpoint is another machine without encryption.
    #[error("`{0}` is another machine without TLS: join the fleet with `tread-agent enroll`")]
    ClearText(String),
    /// The scenario cannot be used.
    #[error("the simulated drive has no ground")]
    Scenario(#[from] ScenarioError),
}

/// Flags of the agent.
#[derive(Debug, Clone, Default, Parser)]
#[command(
    name = "tread-agent",
    version,
    about = "Drives one robot and measures the friction of the ground"
)]
pub struct Flags {
    /// Configuration file
    #[arg(long, env = "TREAD_AGENT_CONFIG")]
    pub config: Option<PathBuf>,
    /// Site of the robot
    #[arg(long)]
    pub site: Option<SiteId>,
    /// Identifier of the robot within its site
    #[arg(long)]
    pub robot: Option<RobotId>,
    /// zenoh endpoint of the server, or several of one fleet separated by commas, the preferred one
    /// first [default: that of `enroll`, or tcp/127.0.0.1:7447]
    #[arg(long, value_delimiter = ',')]
    pub server: Vec<String>,
    /// Folder of the outbox: measurements that wait for upload
    #[arg(long)]
    pub data_dir: Option<PathBuf>,
    /// Rate of the control loop, 20 to 200 Hz [default: 100]
    #[arg(long)]
    pub rate_hz: Option<f64>,
    /// Scenario of the simulated base: a file, or `yard` for the built-in one
    #[arg(long)]
    pub scenario: Option<PathBuf>,
    /// Start of the simulated base: x, y in metres and heading in radians, separated by commas
    #[arg(long, value_parser = parse_start, allow_hyphen_values = true)]
    pub start: Option<Pose>,
    /// Seed of the simulated base
    #[arg(long)]
    pub seed: Option<u64>,
    /// Charge of the simulated battery at the start, 0 to 1 [default: 1]
    #[arg(long)]
    pub battery_charge: Option<f64>,
    /// Error of the simulated robot's wall clock, seconds, positive if it is ahead [default: 0]
    #[arg(long, allow_hyphen_values = true)]
    pub clock_ahead_s: Option<i64>,
    /// Simulated fault of the base, two numbers separated by a comma: seconds until reading from it
    /// blocks, and duration of the block in seconds
    #[arg(long, value_parser = parse_stall)]
    pub stall_s: Option<Stall>,
    /// Log filter, such as `info,tread_agent=debug`; zenoh logs only errors unless the filter names
    /// it, as in `info,zenoh=warn`
    #[arg(long, env = "RUST_LOG", default_value = LOG_FILTER_DEFAULT)]
    pub log: String,
    /// Format of log lines
    #[arg(long, value_enum, default_value_t)]
    pub log_format: LogFormat,
}

/// Format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum LogFormat {
    /// Lines for people.
    #[default]
    Human,
    /// One JSON object a line.
    Json,
}

/// Settings of the simulated base.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedConfig {
    /// Scenario with the true ground.
    pub scenario: Scenario,
    /// Start pose in the site frame.
    pub start: Pose,
    /// Individual properties of its sensors, wheels and tyres.
    pub individual: Individual,
    /// Charge of its battery at the start, 0 to 1.
    pub battery_charge_ratio: f64,
    /// Offset of its wall clock, seconds, positive for ahead.
    pub clock_ahead_s: i64,
    /// A stall of its reads, if any.
    pub stall: Option<Stall>,
    /// Faults of its sensors and wheels, from the scenario.
    pub faults: Vec<Fault>,
    /// Recorder of its true state.
    pub trace: Option<Trace>,
}

/// Settings of the base.
#[derive(Debug, Clone, PartialEq)]
pub enum DriveConfig {
    /// A simulated one.
    Simulated(Box<SimulatedConfig>),
    /// A ROS 2 robot.
    Ros2(Box<Ros2Settings>),
}

impl DriveConfig {
    /// Returns the settings of a simulated base; `None` for another one.
    pub fn simulated(&self) -> Option<&SimulatedConfig> {
        match self {
            Self::Simulated(simulated) => Some(simulated),
            Self::Ros2(_) => None,
        }
    }

    /// Returns the kind of the base, as in the file.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Simulated(_) => "simulated",
            Self::Ros2(_) => "ros2",
        }
    }

    /// Whether the base measures its battery.
    pub fn measures_battery(&self) -> bool {
        match self {
            Self::Simulated(_) => true,
            Self::Ros2(settings) => settings.battery.is_some(),
        }
    }

    /// Whether the base measures its wheel torques.
    pub fn measures_torque(&self) -> bool {
        match self {
            Self::Simulated(simulated) => simulated.individual.has_torque,
            Self::Ros2(settings) => settings
                .joints
                .as_ref()
                .is_some_and(|joints| joints.effort != Effort::None),
        }
    }

    /// Returns the settings of a simulated base for changes; `None` for another one.
    #[cfg(any(test, feature = "testing"))]
    pub fn simulated_mut(&mut self) -> Option<&mut SimulatedConfig> {
        match self {
            Self::Simulated(simulated) => Some(simulated),
            Self::Ros2(_) => None,
        }
    }
}

/// A checked configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct AgentConfig {
    /// The site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// The servers' zenoh endpoints.
    pub servers: Servers,
    /// Silence of one of several servers after which the agent connects to the next, within
    /// [`SERVER_TIMEOUT_S_RANGE`].
    pub server_timeout: Duration,
    /// The robot's certificate, for an endpoint that requires one.
    pub membership: Option<Membership>,
    /// Folder of the files that outlive the process.
    pub data_dir: PathBuf,
    /// Rate of the control loop, Hz, within [`RATE_HZ_RANGE`].
    pub rate_hz: f64,
    /// Rate at which the state is published, Hz.
    pub state_rate_hz: f64,
    /// Rate at which friction is published, Hz.
    pub friction_rate_hz: f64,
    /// Model and tyres, as declared to the server.
    pub model: RobotModel,
    /// The base.
    pub drive: DriveConfig,
    /// Owners of external limits whose silence holds the robot, at most
    /// [`LIMITS_MAX`].
    pub required_owners: Vec<OwnerId>,
    /// Whether the robot may be teleoperated, slowly, inside a fence without a known position.
    pub blind_within_fence: bool,
    /// Bounds of the outbox.
    pub outbox: outbox::Limits,
    /// Destination of records of the loop; `None` for no records.
    pub recording: Option<RecordingConfig>,
    /// Real-time priority of the loop's thread, and whether the memory is locked.
    pub realtime: RealtimeConfig,
    /// Estimator's prior of the robot's and the tyres' parameters.
    pub prior: EstimatorPrior,
    /// Where traces of missions are sent.
    pub tracing: TracingConfig,
}

impl AgentConfig {
    /// Creates the configuration of a robot of a scenario, otherwise with defaults.
    ///
    /// # Errors
    /// [`ConfigError`] if the scenario has no such robot.
    pub fn simulated(
        scenario: Scenario,
        robot: RobotId,
        server: String,
        data_dir: PathBuf,
    ) -> Result<Self, ConfigError> {
        let flags = Flags {
            site: Some(scenario.site.clone()),
            robot: Some(robot),
            server: vec![server],
            data_dir: Some(data_dir),
            ..Flags::default()
        };
        assemble(&flags, FileConfig::default(), || Ok(scenario))
    }

    /// Reads the file that the flags name, if any; flags override it.
    ///
    /// # Errors
    /// [`ConfigError`] names file, line and key.
    pub fn load(flags: &Flags) -> Result<Self, ConfigError> {
        let file = read_file(flags)?;
        let from_file = file.drive.as_ref().and_then(|drive| drive.scenario.clone());
        let scenario = || match flags.scenario.as_ref().or(from_file.as_ref()) {
            None => Scenario::built_in(),
            Some(name) if name == Path::new(BUILT_IN_NAME) => Scenario::built_in(),
            Some(path) => {
                // Paths in a configuration are relative to its file.
                let folder = flags.config.as_deref().and_then(Path::parent);
                let is_from_flag = flags.scenario.is_some();
                let folder = folder.filter(|_| !is_from_flag).unwrap_or(Path::new(""));
                Scenario::load(&folder.join(path))
            }
        };
        assemble(flags, file, scenario)
    }

    /// Returns the period of the loop.
    pub fn period(&self) -> Duration {
        Duration::from_secs_f64(self.rate_hz.recip())
    }
}

fn read_file(flags: &Flags) -> Result<FileConfig, ConfigError> {
    let Some(path) = &flags.config else {
        return Ok(FileConfig::default());
    };
    let file = path.display().to_string();
    let text = std::fs::read_to_string(path).map_err(|source| {
        let file = file.clone();
        if source.kind() == std::io::ErrorKind::InvalidData {
            ConfigError::NotText { file }
        } else {
            ConfigError::Unreadable { file, source }
        }
    })?;
    file::parse(&text).map_err(|refused| ConfigError::Malformed {
        file,
        problem: refused.to_string(),
    })
}

/// Parses `x,y,heading` of the simulated base: metres and radians.
fn parse_start(text: &str) -> Result<Pose, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    match numbers.map_err(|refused| refused.to_string())?.as_slice() {
        &[x_m, y_m, heading_rad] => Ok(Pose {
            x_m,
            y_m,
            heading_rad,
        }),
        others => Err(format!(
            "three numbers are needed, these are {}",
            others.len()
        )),
    }
}

/// Parses `after,lasting` of the simulated base's stall, seconds.
fn parse_stall(text: &str) -> Result<Stall, String> {
    let span = |part: &str| {
        let number: f64 = part
            .trim()
            .parse()
            .map_err(|_| format!("`{part}` is not a number"))?;
        let in_range = (0.0..=3_600.0).contains(&number);
        let outside = || format!("{number} is not within 0 to 3600 s");
        in_range
            .then(|| Duration::from_secs_f64(number))
            .ok_or_else(outside)
    };
    let (after, lasting) = text.split_once(',').ok_or("two numbers are needed")?;
    Ok(Stall {
        after: span(after)?,
        lasting: span(lasting)?,
    })
}

fn assemble(
    flags: &Flags,
    file: FileConfig,
    scenario: impl FnOnce() -> Result<Scenario, ScenarioError>,
) -> Result<AgentConfig, ConfigError> {
    let data_dir = flags.data_dir.clone().or(file.data_dir);
    let membership = match &data_dir {
        Some(folder) => Membership::load(folder)?,
        None => None,
    };
    let joined = membership.as_ref();
    let site = flags
        .site
        .clone()
        .or(file.site)
        .or(joined.map(|joined| joined.site.clone()))
        .ok_or(ConfigError::Missing {
            key: "site",
            flag: "site",
        })?;
    let robot = flags
        .robot
        .clone()
        .or(file.robot)
        .or(joined.map(|joined| joined.robot.clone()))
        .ok_or(ConfigError::Missing {
            key: "robot",
            flag: "robot",
        })?;
    let data_dir = data_dir.ok_or(ConfigError::Missing {
        key: "data_dir",
        flag: "data-dir",
    })?;
    let rate_hz = flags.rate_hz.or(file.rate_hz).unwrap_or(100.0);
    within("rate_hz", rate_hz, &RATE_HZ_RANGE)?;
    let state_rate_hz = file.state_rate_hz.unwrap_or(5.0);
    within("state_rate_hz", state_rate_hz, &PUBLISH_HZ_RANGE)?;
    let friction_rate_hz = file.friction_rate_hz.unwrap_or(2.0);
    within("friction_rate_hz", friction_rate_hz, &PUBLISH_HZ_RANGE)?;
    let model = file.model.map_or_else(paper_robot, RobotModel::from);
    control_model(&model).map_err(|refused| ConfigError::OutOfRange {
        key: "model",
        problem: refused.to_string(),
    })?;
    let named = Some(flags.server.clone()).filter(|named| !named.is_empty());
    let servers = named
        .or(file.server.map(Vec::from))
        .or(joined.map(|joined| vec![joined.endpoint.clone()]))
        .unwrap_or_else(|| vec![SERVER_DEFAULT.to_owned()]);
    let servers = Servers::new(servers)?;
    let membership = servers.credentials(&site, &robot, membership)?;
    let server_timeout_s = file.server_timeout_s.unwrap_or(SERVER_TIMEOUT_DEFAULT_S);
    within(
        "server_timeout_s",
        server_timeout_s,
        &SERVER_TIMEOUT_S_RANGE,
    )?;
    let required_owners = file.required_owners.unwrap_or_default();
    if required_owners.len() > LIMITS_MAX {
        return Err(ConfigError::OutOfRange {
            key: "required_owners",
            problem: format!("at most {LIMITS_MAX} programs may limit a robot"),
        });
    }
    let drive = match file.drive {
        Some(drive) if drive.kind == DriveKind::Ros2 => ros2_drive(drive, &model)?,
        drive => {
            let simulated = simulated(flags, drive, scenario()?, &robot)?;
            DriveConfig::Simulated(Box::new(simulated))
        }
    };
    let recording = recording::checked(file.recording.unwrap_or_default(), &data_dir)?;
    let tracing = file.tracing.unwrap_or_default();
    tracing.check()?;
    let realtime = realtime::checked(file.realtime.unwrap_or_default())?;
    Ok(AgentConfig {
        recording,
        tracing,
        realtime,
        prior: estimation::checked(
            file.estimation.unwrap_or_default(),
            estimation::default_of(&drive),
        )?,
        drive,
        site,
        robot,
        servers,
        server_timeout: Duration::from_secs_f64(server_timeout_s),
        membership,
        data_dir,
        rate_hz,
        state_rate_hz,
        friction_rate_hz,
        model,
        required_owners,
        blind_within_fence: file.blind_within_fence.unwrap_or(false),
        outbox: outbox::Limits::default(),
    })
}

fn ros2_drive(file: DriveFile, model: &RobotModel) -> Result<DriveConfig, ConfigError> {
    let refused = |problem: &str| ConfigError::OutOfRange {
        key: "drive",
        problem: problem.to_owned(),
    };
    let is_simulated = file.scenario.is_some()
        || file.x_m.or(file.y_m).or(file.heading_rad).is_some()
        || file.battery_charge_ratio.is_some()
        || file.seed.is_some()
        || file.clock_ahead_s.is_some();
    if is_simulated {
        return Err(refused("a ROS 2 robot has no keys of a simulated one"));
    }
    let settings = file
        .ros2
        .ok_or_else(|| refused("`kind = \"ros2\"` needs [drive.ros2]"))?;
    Ok(DriveConfig::Ros2(Box::new(settings.checked(model)?)))
}

fn simulated(
    flags: &Flags,
    file: Option<DriveFile>,
    scenario: Scenario,
    robot: &RobotId,
) -> Result<SimulatedConfig, ConfigError> {
    let listed = scenario.robot(robot);
    let from_scenario = listed.map(|listed| Pose {
        x_m: listed.x_m,
        y_m: listed.y_m,
        heading_rad: listed.heading_rad,
    });
    let from_file = file.as_ref().and_then(|drive| {
        Some(Pose {
            x_m: drive.x_m?,
            y_m: drive.y_m?,
            heading_rad: drive.heading_rad.unwrap_or(0.0),
        })
    });
    let start = flags
        .start
        .or(from_file)
        .or(from_scenario)
        .ok_or(ConfigError::Missing {
            key: "drive.x_m",
            flag: "start",
        })?;
    if !start.is_finite() {
        let problem = "the start must be finite numbers".to_owned();
        return Err(ConfigError::OutOfRange {
            key: "drive",
            problem,
        });
    }
    let from_file = |pick: fn(&DriveFile) -> Option<f64>| file.as_ref().and_then(pick);
    let battery_charge_ratio = flags
        .battery_charge
        .or(from_file(|drive| drive.battery_charge_ratio))
        .unwrap_or(1.0);
    within(
        "drive.battery_charge_ratio",
        battery_charge_ratio,
        &(0.0..=1.0),
    )?;
    let clock_ahead_s = flags
        .clock_ahead_s
        .or(file.as_ref().and_then(|drive| drive.clock_ahead_s))
        .unwrap_or(0);
    let seed = flags
        .seed
        .or(file.and_then(|drive| drive.seed))
        .or(listed.map(|listed| listed.seed))
        .unwrap_or(1);
    let usual = Individual::of_seed(seed);
    let individual = listed.map_or(usual, |listed| Individual {
        seed,
        stiffness_ratio: listed.stiffness_ratio,
        has_torque: listed.wheel_torque,
    });
    let faults = listed
        .map(|listed| listed.faults.clone())
        .unwrap_or_default();
    Ok(SimulatedConfig {
        scenario,
        start,
        individual,
        battery_charge_ratio,
        clock_ahead_s,
        stall: flags.stall_s,
        faults,
        trace: None,
    })
}

fn within(
    key: &'static str,
    value: f64,
    range: &std::ops::RangeInclusive<f64>,
) -> Result<(), ConfigError> {
    if range.contains(&value) {
        return Ok(());
    }
    let problem = format!("{value} is not within {} to {}", range.start(), range.end());
    Err(ConfigError::OutOfRange { key, problem })
}

#[cfg(test)]
mod tests;
