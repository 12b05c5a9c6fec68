//! Real agents in this process, on simulated ground.

use std::path::Path;

use anyhow::Context;
use tread_agent::sim::scenario::{Scenario, ScenarioText};
use tread_agent::{Agent, AgentConfig, RunningAgent};
use tread_api::ids::RobotId;
use tread_tests::fleet::{GROUND_THETA, SITE};

/// Distance between two robots, metres.
pub(crate) const APART_M: f64 = 20.0;

/// The name of a robot.
pub(crate) fn name(number: u32) -> anyhow::Result<RobotId> {
    Ok(format!("rover-{number}").parse()?)
}

/// Starts an agent that reaches the server at `endpoint`; its robot stands at a place of its own.
pub(crate) fn start(number: u32, endpoint: &str, folder: &Path) -> anyhow::Result<RunningAgent> {
    let robot = name(number)?;
    let x_m = APART_M * f64::from(number);
    let stiffness = GROUND_THETA.recip();
    let text = format!(
        "site = \"{SITE}\"\ncell_m = 1.0\nterrains = []\n[ground]\nstiffness = {stiffness}\n\
         [[robots]]\nid = \"{robot}\"\nx_m = {x_m:?}\ny_m = 0.0\nheading_rad = 0.0\nseed = {number}\n"
    );
    let scenario = Scenario::parse(ScenarioText {
        file: "scenario",
        text: &text,
    })?;
    let data_dir = folder.join(robot.as_str());
    let config = AgentConfig::simulated(scenario, robot, endpoint.to_owned(), data_dir)?;
    Agent::start(config).context("an agent does not start")
}
