//! `tread watch`: robots and missions as they change, by the server's stream of events.
//!
//! A stream that breaks off is opened again where it ended, so nothing is missed; while no server
//! answers, that is said.

use std::collections::BTreeMap;
use std::io::{self, IsTerminal};
use std::process::ExitCode;
use std::time::Duration;

use serde::Serialize;
use tokio::time::{Instant, timeout};
use tread_api::event::{Event, StreamEnd};
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::Mission;
use tread_api::robot::Robot;

use super::{missions, robots};
use crate::args::WatchArguments;
use crate::client::{Client, ClientError};
use crate::output::{Output, json_line, note};

/// Missions shown below the robots.
const MISSIONS_SHOWN: usize = 10;
/// Missions kept.
const MISSIONS_KEPT: usize = 1_000;
/// Rest before the stream is opened again.
const REOPEN_REST: Duration = Duration::from_secs(1);
/// Longest line of a stream, bytes: a mission of the most waypoints.
const LINE_MAX: usize = 32 * 1024 * 1024;
/// Moves to the top left corner and clears what is below.
const CLEAR_SCREEN: &str = "\x1b[H\x1b[J";

#[derive(Serialize)]
struct Look<'watch> {
    robots: Vec<&'watch Robot>,
    missions: Vec<&'watch Mission>,
}

/// What is known by the events so far.
#[derive(Debug, Default)]
struct Known {
    robots: BTreeMap<RobotId, Robot>,
    missions: BTreeMap<MissionId, Mission>,
    last: Option<String>,
    whole: bool,
}

pub(super) async fn run(
    arguments: &WatchArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let watching = async {
        let mut known = Known::default();
        loop {
            match follow(arguments, client, output, &mut known).await {
                Ok(()) => {}
                // Nobody was there from the start, or the filter is wrong.
                Err(error) if known.last.is_none() => return Err(error),
                Err(error) => note(&format!("{error:#}; trying again")),
            }
            tokio::time::sleep(REOPEN_REST).await;
        }
    };
    tokio::select! {
        ended = watching => ended,
        _ = tokio::signal::ctrl_c() => Ok(ExitCode::SUCCESS),
    }
}

/// Follows one stream until it breaks off.
async fn follow(
    arguments: &WatchArguments,
    client: &Client,
    output: Output,
    known: &mut Known,
) -> anyhow::Result<()> {
    let site = &arguments.connection.site;
    let last = known.last.clone();
    let mut stream = client
        .events(site, arguments.robot.as_ref(), last.as_deref())
        .await?;
    let mut text = Vec::new();
    let mut shown_at: Option<Instant> = None;
    let mut is_new = false;
    loop {
        match timeout(arguments.every, stream.chunk()).await {
            Ok(Ok(Some(chunk))) => text.extend_from_slice(&chunk),
            Ok(Ok(None)) => return Ok(()),
            Ok(Err(cause)) => {
                let address = client.address().to_owned();
                return Err(ClientError::Unreachable { address, cause }.into());
            }
            Err(_elapsed) => {}
        }
        anyhow::ensure!(text.len() <= LINE_MAX, "an event is too long");
        while let Some(end) = text.windows(2).position(|pair| pair == b"\n\n") {
            let block: Vec<u8> = text.drain(..end + 2).collect();
            is_new |= known.take(&String::from_utf8_lossy(&block), output)?;
        }
        let due = shown_at.is_none_or(|at| at.elapsed() >= arguments.every);
        if is_new && known.whole && due && !output.is_json() {
            show(arguments, client, output, known)?;
            shown_at = Some(Instant::now());
            is_new = false;
        }
    }
}

impl Known {
    /// A mission with the progress that its robot said last; missions are sent when they step.
    fn fresh(&self, mission: &Mission) -> Mission {
        let live = self.robots.get(&mission.robot);
        let said = live.and_then(|robot| robot.live.as_ref()?.mission);
        let progress = said.filter(|said| said.id == mission.id && !mission.state.is_terminal());
        Mission {
            progress: progress.or(mission.progress),
            ..mission.clone()
        }
    }

    /// Takes one event; `true` if it tells something new.
    fn take(&mut self, block: &str, output: Output) -> anyhow::Result<bool> {
        let field = |name: &str| block.lines().find_map(|line| line.strip_prefix(name));
        if let Some(id) = field("id: ") {
            self.last = Some(id.to_owned());
        }
        let Some(text) = field("data: ") else {
            return Ok(false);
        };
        // Events of a newer server that are not known here are passed over.
        let Ok(event) = serde_json::from_str::<Event>(text) else {
            return Ok(false);
        };
        if output.is_json() {
            json_line(&event)?;
        }
        match event {
            Event::SnapshotBegin => *self = Self::default(),
            Event::SnapshotEnd => self.whole = true,
            Event::Robot(robot) => {
                self.robots.insert(robot.id.clone(), *robot);
            }
            Event::Mission(mission) => {
                self.missions.insert(mission.id, *mission);
                if self.missions.len() > MISSIONS_KEPT {
                    self.missions.pop_first();
                }
            }
            Event::Step(_) | Event::Alert(_) | Event::Map(_) => return Ok(false),
            Event::End(StreamEnd::TooSlow) => note("the server ended the stream: read too slowly"),
            Event::End(StreamEnd::Stopping) => note("the server stops"),
        }
        Ok(true)
    }
}

fn show(
    arguments: &WatchArguments,
    client: &Client,
    output: Output,
    known: &Known,
) -> anyhow::Result<()> {
    let site = &arguments.connection.site;
    let look = Look {
        robots: known.robots.values().collect(),
        missions: known.missions.values().rev().take(MISSIONS_SHOWN).collect(),
    };
    output.show(&look, |look| {
        let screen = if io::stdout().is_terminal() {
            CLEAR_SCREEN
        } else {
            ""
        };
        let robots: Vec<Robot> = look.robots.iter().map(|&robot| robot.clone()).collect();
        let missions: Vec<Mission> = look
            .missions
            .iter()
            .map(|&seen| known.fresh(seen))
            .collect();
        format!(
            "{screen}site {site} on {}\n\n{}\n\n{}\n",
            client.address(),
            robots::list(&robots),
            missions::list(&missions)
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_snapshot_forgets_what_was_known_and_an_id_is_kept() {
        let mut known = Known::default();
        let output = Output::new(false);
        let begin = "event: snapshot_begin\ndata: \"snapshot_begin\"\n\n";
        assert!(known.take(begin, output).unwrap());
        assert!(!known.whole);
        let end = "event: snapshot_end\ndata: \"snapshot_end\"\nid: 5-7\n\n";
        assert!(known.take(end, output).unwrap());
        assert_eq!((known.whole, known.last.as_deref()), (true, Some("5-7")));
        assert!(!known.take(": keep-alive\n\n", output).unwrap());
        assert!(!known.take("data: {\"weather\":{}}\n\n", output).unwrap());
    }
}
