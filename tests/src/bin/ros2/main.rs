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

mod doctor;
mod faults;
mod missions;
mod observer;
mod python_robot;

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use serde::Serialize;
use tread_tests::fleet::Fleet;

use self::observer::Observer;
use self::python_robot::PythonRobot;

/// Drives a ROS 2 robot that was written by others.
#[derive(Debug, Parser)]
#[command(name = "ros2")]
struct Arguments {
    /// A Python with the packages of tests/ros2/requirements.txt
    #[arg(long, default_value = "python3")]
    python: PathBuf,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// A figure with what it must be.
#[derive(Debug, Serialize)]
struct Check {
    name: String,
    goal: String,
    value: f64,
    holds: bool,
}

impl Check {
    /// A figure that must be at most `most`.
    fn at_most(name: impl Into<String>, most: f64, value: f64) -> Self {
        Self {
            name: name.into(),
            goal: format!("<= {most}"),
            value,
            holds: value <= most,
        }
    }

    /// Something that must be so.
    fn so(name: impl Into<String>, holds: bool) -> Self {
        Self {
            name: name.into(),
            goal: "1".to_owned(),
            value: f64::from(u8::from(holds)),
            holds,
        }
    }
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    // The executables of this package stand beside each other.
    let node = std::env::current_exe()?.with_file_name("node");
    anyhow::ensure!(
        node.exists(),
        "{} is missing: build it with `cargo build --release -p tread-tests --bins`",
        node.display()
    );
    let mut fleet = Fleet::start_with(&node).await;
    let mut base = PythonRobot::start(&arguments.python, &[])?;
    let observer = Observer::start(base.endpoint())?;
    let robot = missions::start_robot(&mut fleet, &base).await?;
    let mut checks = missions::measure(&mut fleet, &robot, &observer).await;
    checks.extend(observer.graph(python_robot::DOMAIN)?);
    checks.push(observer::stays_on_the_robot(&fleet).await?);
    checks.extend(faults::measure(&fleet, &robot, &mut base, &observer).await?);
    drop(base);
    checks.extend(doctor::measure(&arguments.python, &node).await?);
    print(&arguments, &checks)?;
    let all_hold = checks.iter().all(|check| check.holds);
    if !all_hold {
        for line in fleet.log_tail(robot.as_str()) {
            eprintln!("{line}");
        }
    }
    Ok(if all_hold {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn print(arguments: &Arguments, checks: &[Check]) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    if arguments.json {
        serde_json::to_writer(&mut out, &serde_json::json!({ "checks": checks }))?;
        writeln!(out)?;
        return Ok(());
    }
    for check in checks {
        let verdict = if check.holds { "ok" } else { "FAILED" };
        writeln!(
            out,
            "{verdict:<7}{:<56}{:>12.4}   goal {}",
            check.name, check.value, check.goal
        )?;
    }
    Ok(())
}
