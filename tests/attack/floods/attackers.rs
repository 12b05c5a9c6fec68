//! The attackers: every flood at the same time, in a process of its own, so that what honest clients
//! measure is the server and not the attackers' own tasks.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use serde::{Deserialize, Serialize};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tread_agent::membership::Membership;

use super::{http, robots};

/// How long the floods may take to end after their time.
const END_MAX: Duration = Duration::from_secs(15);

/// The attackers' side.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// File with the plan
    plan: PathBuf,
}

/// Whom to attack, and what the attackers have.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Plan {
    /// Where the server answers HTTP.
    pub(crate) http: SocketAddr,
    /// The robots' port.
    pub(crate) endpoint: String,
    /// A viewer's token.
    pub(crate) viewer: String,
    /// A robot that the viewer watches.
    pub(crate) watched: String,
    /// One robot for each of [`robots::Flood::ALL`].
    pub(crate) robots: Vec<Membership>,
    /// How long.
    pub(crate) seconds: u64,
    /// Where to say what was done.
    pub(crate) report: PathBuf,
    /// Parts of the names of floods that are left out.
    pub(crate) without: Vec<String>,
}

impl Plan {
    /// Whether the flood of that name is sent.
    pub(super) fn has(&self, flood: &str) -> bool {
        !self.without.iter().any(|part| flood.contains(part))
    }
}

/// What a flood has done.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Done {
    /// Which flood.
    pub(crate) flood: String,
    /// What is counted.
    pub(crate) of: String,
    /// How many.
    pub(crate) count: u64,
    /// How many a second.
    pub(crate) per_s: f64,
    /// How many a second it was to be, if there was a number.
    pub(crate) wanted_per_s: Option<f64>,
    /// What else there is to say.
    pub(crate) notes: String,
}

/// The counts of a flood that goes on.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    pub(crate) flood: &'static str,
    pub(crate) of: &'static str,
    pub(crate) count: u64,
    pub(crate) wanted_per_s: Option<f64>,
    pub(crate) notes: String,
}

impl Outcome {
    fn after(self, seconds: f64) -> Done {
        #[expect(clippy::cast_precision_loss, reason = "a count far below 2^53")]
        let per_s = self.count as f64 / seconds;
        Done {
            flood: self.flood.to_owned(),
            of: self.of.to_owned(),
            count: self.count,
            per_s,
            wanted_per_s: self.wanted_per_s,
            notes: self.notes,
        }
    }
}

pub(crate) async fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let plan: Plan = serde_json::from_slice(&std::fs::read(&arguments.plan)?)?;
    let sessions = robots::connect(&plan).await?;
    let begun = Instant::now();
    let until = begun + Duration::from_secs(plan.seconds);
    let mut floods: JoinSet<Outcome> = JoinSet::new();
    http::spawn(&mut floods, &plan, until);
    robots::spawn(&mut floods, sessions, until);
    let mut done = Vec::new();
    // One that hangs is left out, and missed by whoever reads this.
    while let Ok(Some(ended)) = tokio::time::timeout_at(until + END_MAX, floods.join_next()).await {
        if let Ok(outcome) = ended {
            done.push(outcome.after(begun.elapsed().as_secs_f64()));
        }
    }
    std::fs::write(&plan.report, serde_json::to_vec(&done)?)?;
    // Sessions that the server has cut may take long to close.
    std::process::exit(0);
}
