//! `tread-agent doctor`: checks the installation on a ROS 2 robot before it drives.
//!
//! The doctor listens to the stopped robot ([`listening`]). With `--move` it turns the robot slowly
//! on the spot, drives it forward for a metre, and compares commands with measurements
//! ([`moving`]): frozen sensors ([`frozen`]), sides and signs ([`signs`]), the frame of the
//! odometry's twist ([`twist_frame`]), the tracks ([`track`]), and the joints' effort against the
//! robot's mass ([`effort`]). It estimates mass, inertia and centre of mass ([`parameters`]). Each
//! finding names the key of `robot.toml` to check and, if there are any, the lines that correct it.

mod drive_summary;
mod effort;
mod finding;
mod frozen;
mod joint_names;
mod listening;
mod message_buffer;
mod moving;
mod parameters;
mod signs;
mod track;
mod twist_frame;

use std::io::Write as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use tread_control::gate::{GateInput, GateLimits, gate};
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;
use tread_control::twist_limits::TwistLimits;

use self::drive_summary::{DriveSummary, Drives, MotionMessages};
use self::finding::{Finding, Key};
use self::message_buffer::MessageBuffer;
use self::parameters::Parameters;
use crate::clock::{SharedClock, SystemClock};
use crate::config::{AgentConfig, DriveConfig, Flags};
use crate::drive::Drive as _;
use crate::drive::ros2::Ros2Drive;
use crate::drive::ros2::settings::Ros2Settings;
use crate::drive::ros2::topic_receiver::MessageObserver;
use crate::geometry::control_model;

/// Time for which the doctor listens to the stopped robot.
const LISTEN_FOR: Duration = Duration::from_secs(3);
/// Maximum wait for the first message.
const FIRST_MESSAGE_WAIT_MAX: Duration = Duration::from_secs(5);
/// Time between two commands.
const PERIOD: Duration = Duration::from_millis(10);
/// Duration of the ramp from zero to full speed, and back.
const RAMP: Duration = Duration::from_millis(500);
/// Time after the ramp in which the servos reach the commanded speed.
const SETTLE: Duration = Duration::from_millis(500);
/// Time at full speed before the steady part of a motion begins.
const STEADY_AFTER: Duration = Duration::from_millis(1_500);
/// Duration of the steady part of a motion.
const STEADY_FOR: Duration = Duration::from_secs(2);
/// Time at zero speed between two motions.
const REST: Duration = Duration::from_secs(1);
/// Maximum number of attempts at a motion if the base falls silent during it.
const TRIES_MAX: u32 = 5;
/// Maximum distance that a rim covers in all attempts at one motion, metres: two metres are to be free
/// around the robot.
const MOTION_MAX_M: f64 = 1.9;
/// Maximum wait for closing the session on the robot's bus.
const CLOSE_MAX: Duration = Duration::from_secs(2);
/// Rim speed of the motions, metres per second.
const RIM_M_S: f64 = 0.2;

/// Arguments of `tread-agent doctor`.
#[derive(Debug, Clone, Args)]
pub(crate) struct DoctorArgs {
    /// Configuration file of the robot
    #[arg(long, env = "TREAD_AGENT_CONFIG")]
    config: PathBuf,
    /// Move the robot at 0.2 m/s: it turns on the spot and drives 1 m forward, or 2 m if the base
    /// falls silent and the motion is repeated
    #[arg(long = "move")]
    moves: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Examines the robot and prints the findings. Returns whether no problem was found.
///
/// # Errors
/// Standard output cannot be written. A configuration that cannot be read, or a base that cannot be
/// examined, is a finding.
pub(crate) fn run(args: &DoctorArgs) -> anyhow::Result<bool> {
    let findings = examine(args);
    let robot_toml = finding::robot_toml(&findings);
    let mut out = std::io::stdout().lock();
    if args.json {
        let report = serde_json::json!({ "checks": findings, "robot_toml": robot_toml });
        serde_json::to_writer(&mut out, &report)?;
        writeln!(out)?;
    } else {
        for finding in &findings {
            writeln!(out, "{} {}: {}", finding.mark(), finding.name, finding.text)?;
            if let Some(key) = finding.key {
                writeln!(out, "      look at `{key}` in robot.toml")?;
            }
        }
        if !robot_toml.is_empty() {
            writeln!(
                out,
                "\n# These lines in robot.toml correct that:\n{robot_toml}"
            )?;
        }
    }
    Ok(findings.iter().all(|finding| finding.holds))
}

fn examine(args: &DoctorArgs) -> Vec<Finding> {
    let loaded = AgentConfig::load(&Flags {
        config: Some(args.config.clone()),
        ..Flags::default()
    });
    let config = match loaded {
        Ok(config) => config,
        Err(cause) => {
            let text = format!("{:#}", anyhow::Error::from(cause));
            return vec![Finding::on("configuration").unexaminable(text)];
        }
    };
    let DriveConfig::Ros2(settings) = &config.drive else {
        let text = "the robot of this configuration is simulated: there is nothing to examine";
        return vec![Finding::on("configuration").unexaminable(text)];
    };
    examine_base(args, &config, settings)
        .unwrap_or_else(|cause| vec![Finding::on("base").unexaminable(format!("{cause:#}"))])
}

fn examine_base(
    args: &DoctorArgs,
    config: &AgentConfig,
    settings: &Ros2Settings,
) -> anyhow::Result<Vec<Finding>> {
    let model = control_model(&config.model)?;
    let clock = SystemClock::shared();
    let buffer = Arc::new(MessageBuffer::default());
    let observer: Arc<dyn MessageObserver> = Arc::<MessageBuffer>::clone(&buffer);
    let (drive, bus) = Ros2Drive::examined(settings.clone(), &clock, &observer)?;
    let bus_thread = std::thread::Builder::new()
        .name("robot's bus".to_owned())
        .spawn(move || bus.run())
        .context("no thread")?;
    let mut examined = ExaminedDrive {
        drive,
        clock,
        limits: GateLimits::of(&model),
        command: WheelSpeeds::default(),
        parameters: Parameters::new(model, config.prior),
    };
    let until = examined.clock.monotonic() + FIRST_MESSAGE_WAIT_MAX;
    while buffer.is_empty() && examined.clock.monotonic() < until {
        examined.hold(WheelSpeeds::default(), PERIOD);
    }
    buffer.clear();
    examined.hold(WheelSpeeds::default(), LISTEN_FOR);
    let at_rest = buffer.drain();
    let mut findings = listening::findings(settings, &at_rest, LISTEN_FOR);
    findings.extend(examined.other_commander(settings));
    if args.moves {
        let bias_rad_s = listening::gyro_at_rest_rad_s(settings, &at_rest).unwrap_or(0.0);
        findings = examined.examine_in_motion(settings, &model, &buffer, bias_rad_s, findings);
    }
    let until = examined.clock.monotonic() + CLOSE_MAX;
    let clock = Arc::clone(&examined.clock);
    drop(examined);
    // A session that does not close is left to the end of the process.
    while !bus_thread.is_finished() && clock.monotonic() < until {
        std::thread::sleep(PERIOD);
    }
    Ok(findings)
}

/// Drive of the examined robot, with the command in effect.
struct ExaminedDrive {
    drive: Ros2Drive,
    clock: SharedClock,
    limits: GateLimits,
    command: WheelSpeeds,
    parameters: Parameters,
}

impl ExaminedDrive {
    /// Returns a finding if another node publishes on the command topic.
    fn other_commander(&self, settings: &Ros2Settings) -> Option<Finding> {
        let times = self.drive.counts().foreign_commands();
        (times > 0).then(|| {
            let text = format!(
                "another node writes on `{}` ({times} commands while it was listened to), and the base obeys both: \
                 stop it, or let both write on topics of their own and put a twist_mux behind them",
                settings.command.topic
            );
            Finding::on("command").wrong(Key("drive.ros2.command.topic"), text)
        })
    }

    /// Turns and drives the robot, unless a finding forbids it; returns all findings.
    fn examine_in_motion(
        &mut self,
        settings: &Ros2Settings,
        model: &RobotModel,
        buffer: &MessageBuffer,
        bias_rad_s: f64,
        mut findings: Vec<Finding>,
    ) -> Vec<Finding> {
        let is_unusable =
            self.drive.is_rest_required() && findings.iter().any(|finding| !finding.holds);
        if is_unusable || self.other_commander(settings).is_some() {
            let text = "the robot was not moved: correct the findings above first";
            findings.push(Finding::on("moving").skipped(text));
            return findings;
        }
        let rim_rad_s = RIM_M_S / model.wheel_radius_m();
        let speeds = |left: f64, right: f64| {
            let requested = WheelSpeeds {
                left_rad_s: left * rim_rad_s,
                right_rad_s: right * rim_rad_s,
            };
            let twist = model.twist_from_wheel_speeds(requested);
            let share = TwistLimits::of(model).share_within(twist);
            WheelSpeeds {
                left_rad_s: share * requested.left_rad_s,
                right_rad_s: share * requested.right_rad_s,
            }
        };
        buffer.clear();
        let mut turned = self.drive_for(speeds(-1.0, 1.0), settings, buffer);
        // Along the x axis of the odometry's frame, a twist in that frame equals one in the robot
        // frame.
        if turned.twist.is_some() && heads_along_x(settings, buffer) {
            turned = self.drive_for(speeds(-1.0, 1.0), settings, buffer);
        }
        let forward = self.drive_for(speeds(1.0, 1.0), settings, buffer);
        // Motion commanded by two nodes shows nothing about signs and tracks.
        if let Some(finding) = self.other_commander(settings) {
            findings.push(finding);
            return findings;
        }
        let drives = Drives { turned, forward };
        findings.extend(moving::findings(settings, model, &drives, bias_rad_s));
        findings.push(if findings.iter().all(|finding| finding.holds) {
            self.parameters.finding()
        } else {
            parameters::spoiled()
        });
        findings
    }

    /// Commands these wheel speeds for `span`, even if the base is silent.
    fn hold(&mut self, command: WheelSpeeds, span: Duration) {
        self.command_while(command, span, |_| true);
    }

    /// Commands these wheel speeds for `span`; returns false at once if the base falls silent.
    fn hold_unless_silent(&mut self, command: WheelSpeeds, span: Duration) -> bool {
        self.command_while(command, span, |drive| !drive.is_rest_required())
    }

    fn command_while(
        &mut self,
        command: WheelSpeeds,
        span: Duration,
        may: impl Fn(&Ros2Drive) -> bool,
    ) -> bool {
        let until = self.clock.monotonic() + span;
        while self.clock.monotonic() < until {
            let feedback = self.drive.read(self.clock.monotonic());
            self.parameters.take(&feedback);
            let input = GateInput {
                command: Some(command),
                previous: self.command,
                stop: false,
                // The drive itself commands zero to a silent base.
                feedback_age_s: 0.0,
                dt_s: PERIOD.as_secs_f64(),
            };
            self.command = gate(&input, &self.limits).wheel_speeds;
            self.drive.write(self.command);
            if !may(&self.drive) {
                return false;
            }
            std::thread::sleep(PERIOD);
        }
        true
    }

    /// Changes the command linearly to `to`; returns false at once if the base falls silent.
    fn ramp(&mut self, to: WheelSpeeds) -> bool {
        let from = self.command;
        let steps = u32::try_from(RAMP.as_millis() / PERIOD.as_millis()).unwrap_or(1);
        (1..=steps).all(|step| {
            let share = f64::from(step) / f64::from(steps);
            let between = |from: f64, to: f64| from + share * (to - from);
            let command = WheelSpeeds {
                left_rad_s: between(from.left_rad_s, to.left_rad_s),
                right_rad_s: between(from.right_rad_s, to.right_rad_s),
            };
            self.hold_unless_silent(command, PERIOD)
        })
    }

    /// Drives with these wheel speeds and summarises the messages. If the base falls silent, it is
    /// commanded to zero and the motion is repeated from there, at most [`TRIES_MAX`] times and within
    /// [`MOTION_MAX_M`].
    fn drive_for(
        &mut self,
        command: WheelSpeeds,
        settings: &Ros2Settings,
        buffer: &MessageBuffer,
    ) -> DriveSummary {
        let mut driven_m = 0.0;
        for _ in 0..TRIES_MAX {
            if !has_room(driven_m) {
                break;
            }
            let began = self.clock.monotonic();
            let messages = self.try_to_drive(command, buffer);
            self.ramp(WheelSpeeds::default());
            let moved = self.clock.monotonic().saturating_sub(began);
            driven_m += RIM_M_S * moved.as_secs_f64();
            self.hold(WheelSpeeds::default(), REST);
            if let Some(messages) = messages {
                return drive_summary::summarise(command, settings, &messages);
            }
        }
        DriveSummary::default()
    }

    /// Returns the messages of the acceleration and of the steady motion; `None` if the base fell
    /// silent.
    fn try_to_drive(
        &mut self,
        command: WheelSpeeds,
        buffer: &MessageBuffer,
    ) -> Option<MotionMessages> {
        buffer.clear();
        let mut is_heard = self.ramp(command) && self.hold_unless_silent(command, SETTLE);
        let starting = buffer.drain();
        is_heard = is_heard && self.hold_unless_silent(command, STEADY_AFTER);
        buffer.clear();
        is_heard = is_heard && self.hold_unless_silent(command, STEADY_FOR);
        is_heard.then(|| MotionMessages {
            starting,
            steady: buffer.drain(),
        })
    }
}

/// Whether a whole motion stays within [`MOTION_MAX_M`] after rims have covered `driven_m` metres.
fn has_room(driven_m: f64) -> bool {
    let whole = 2 * RAMP + SETTLE + STEADY_AFTER + STEADY_FOR;
    driven_m + RIM_M_S * whole.as_secs_f64() <= MOTION_MAX_M
}

/// Whether the newest odometry pose heads along the x axis of its frame.
fn heads_along_x(settings: &Ros2Settings, buffer: &MessageBuffer) -> bool {
    let heading_rad = drive_summary::newest_heading_rad(settings, &buffer.drain());
    heading_rad.is_some_and(twist_frame::is_along_x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_that_is_repeated_stays_within_the_free_space() {
        assert!(has_room(0.0));
        // Once more after a whole motion, and not a third time.
        assert!(has_room(0.9));
        assert!(!has_room(1.0));
    }
}
