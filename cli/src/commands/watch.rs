//! `tread watch`: robots and missions as they change.

use std::io::{self, IsTerminal};
use std::process::ExitCode;

use serde::Serialize;
use tread_api::mission::Mission;
use tread_api::robot::Robot;

use super::{missions, robots};
use crate::args::WatchArguments;
use crate::client::Client;
use crate::output::Output;

/// Missions shown below the robots.
const MISSIONS_SHOWN: u32 = 10;
/// Moves to the top left corner and clears what is below.
const CLEAR_SCREEN: &str = "\x1b[H\x1b[J";

#[derive(Serialize)]
struct Look {
    robots: Vec<Robot>,
    missions: Vec<Mission>,
}

pub(super) async fn run(
    arguments: &WatchArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let mut ticks = tokio::time::interval(arguments.every);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = ticks.tick() => show(arguments, client, output).await?,
            _ = tokio::signal::ctrl_c() => return Ok(ExitCode::SUCCESS),
        }
    }
}

async fn show(arguments: &WatchArguments, client: &Client, output: Output) -> anyhow::Result<()> {
    let site = &arguments.connection.site;
    let robots = client.robots(site).await?;
    let missions = client.missions(site, None, MISSIONS_SHOWN).await?.items;
    output.show(&Look { robots, missions }, |look| {
        let screen = if io::stdout().is_terminal() {
            CLEAR_SCREEN
        } else {
            ""
        };
        format!(
            "{screen}site {site} on {}\n\n{}\n\n{}\n",
            client.address(),
            robots::list(&look.robots),
            missions::list(&look.missions)
        )
    })
}
