//! `ros2`: whether the agent drives a ROS 2 robot that was written by others.
//!
//! The robot is `tests/ros2/robot.py`: keys, hashes, tokens and messages by `eclipse-zenoh` and `rosbags`, physics
//! of its own. A real server and a real agent drive it; an observer on its bus measures.
//!
//! 1. **missions**: a circle and waypoints, on it and on the simulated robot; how far from the path,
//!    and what the fleet learned of the ground.
//! 2. **bus**: from a sensor's message to the command that follows it; what the ROS graph shows; that
//!    ROS keys stay on the robot.
//! 3. **doctor**: `tread-agent doctor` on a healthy robot, and on robots with one planted fault each.
//! 4. **faults**: a dead, late, lying, restarting base; how soon the command is zero, what the agent says,
//!    and that it goes on.
//!
//! With `--behaviour` all of that happens too, at once and without the simulated robot, and what the agent does is
//! judged. Times and accuracy are shown then and judged without it: they are of an optimised build on
//! a machine that does nothing else.

mod doctor;
mod faults;
mod judgement;
mod missions;
mod observer;
mod python_robot;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use tread_tests::fleet::Fleet;
use tread_tests::process::node;
use tread_tests::report::{self, Check};

use self::judgement::Judgement;
use self::observer::Observer;
use self::python_robot::PythonRobot;

/// Drives a ROS 2 robot that was written by others.
#[derive(Debug, Parser)]
#[command(name = "ros2")]
struct Arguments {
    /// A Python with the packages of tests/ros2/requirements.txt
    #[arg(long, default_value = "python3")]
    python: PathBuf,
    /// Judge what the agent does, and only show what needs an optimised build on a quiet machine
    #[arg(long)]
    behaviour: bool,
    /// Only this part
    #[arg(long, value_enum)]
    only: Option<Part>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// What can be run alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Part {
    /// Missions and faults of one robot, with its bus
    Driven,
    /// The doctor's robots
    Doctor,
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = node()?;
    let is_wanted = |part| arguments.only.is_none_or(|only| only == part);
    let driven = async {
        if is_wanted(Part::Driven) {
            driven(&arguments, &node).await
        } else {
            Ok(Vec::new())
        }
    };
    let examined = async {
        if is_wanted(Part::Doctor) {
            doctor::measure(&arguments.python, &node).await
        } else {
            Ok(Vec::new())
        }
    };
    let checks = if arguments.behaviour {
        let (driven, examined) = tokio::join!(driven, examined);
        [driven?, examined?].concat()
    } else {
        // One after the other: the times of one are not to be those of both.
        [driven.await?, examined.await?].concat()
    };
    report::print(arguments.json, &checks)
}

/// Drives a robot on missions, then into faults.
async fn driven(arguments: &Arguments, node: &Path) -> anyhow::Result<Vec<Check>> {
    let judgement = if arguments.behaviour {
        Judgement::Behaviour
    } else {
        Judgement::Figures
    };
    let mut fleet = Fleet::start_with(node).await;
    let mut base = PythonRobot::start(&arguments.python, &[])?;
    let observer = Observer::start(base.endpoint())?;
    let robot = missions::start_robot(&mut fleet, &base).await?;
    let mut checks = missions::measure(&mut fleet, &robot, &observer, judgement).await;
    checks.extend(observer.graph(python_robot::DOMAIN).await?);
    checks.push(observer::stays_on_the_robot(&fleet).await?);
    checks.extend(faults::measure(&fleet, &robot, &mut base, &observer, judgement).await?);
    if !checks.iter().all(|check| check.holds) {
        for line in fleet.log_tail(robot.as_str()) {
            eprintln!("{line}");
        }
    }
    Ok(checks)
}
