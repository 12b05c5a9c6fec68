//! Commands to robots: zenoh queries with an application answer.

use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::Serialize;
use tokio::sync::oneshot;
use tracing::{debug, warn};
use tread_api::ids::BootId;
use tread_api::keys::{self, Verb};
use tread_api::wire::command::Answer;
use tread_api::wire::{self, Refusal};
use zenoh::Session;
use zenoh::Wait as _;
use zenoh::qos::Priority;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};

use super::presence::{Presences, RobotKey};
use super::routers::Routers;
use crate::supervisor::Supervisor;

/// How long a robot may take to answer.
pub const COMMAND_TIMEOUT: Duration = Duration::from_millis(800);
/// How long the query itself may take beyond that before it counts as not delivered.
const MARGIN: Duration = Duration::from_millis(200);

/// An answer on its way.
pub type Carrying = Pin<Box<dyn Future<Output = Option<Answer>> + Send>>;

/// Carries one command to a robot and its answer back; `None` is not delivered, as far as anyone
/// knows. The network of a fleet is one, a simulated network in a test another.
pub trait Carrier: std::fmt::Debug + Send + Sync {
    /// Carries a payload to what answers at a robot's verb: to that run of its agent alone, or to
    /// whatever runs under its name.
    fn carry(
        &self,
        robot: &RobotKey,
        run: Option<BootId>,
        verb: Verb,
        payload: Vec<u8>,
    ) -> Carrying;
}

/// Sends commands to robots; clones send through the same carrier.
#[derive(Debug, Clone)]
pub struct Commands {
    carrier: Arc<dyn Carrier>,
    presences: Arc<Presences>,
}

impl Commands {
    /// Commands through a carrier; `presences` tell which run of an agent is the present one.
    pub fn new(carrier: Arc<dyn Carrier>, presences: Arc<Presences>) -> Self {
        Self { carrier, presences }
    }

    /// Sends one command to a robot's present run and waits for its answer.
    ///
    /// `None` as for [`Commands::send_to`].
    pub async fn send<T: Serialize>(
        &self,
        robot: &RobotKey,
        verb: Verb,
        command: &T,
    ) -> Option<Answer> {
        let present = self.presences.get(robot).boot();
        let run = present.map(|(boot, _since)| boot);
        self.send_to(robot, run, verb, command).await
    }

    /// Sends one command to one run of a robot's agent, or to all under its name, and waits for
    /// the first answer.
    ///
    /// `None` means not delivered, as far as anyone knows: no robot answered in time, or its
    /// answer does not read. The same may be sent again without harm.
    pub async fn send_to<T: Serialize>(
        &self,
        robot: &RobotKey,
        run: Option<BootId>,
        verb: Verb,
        command: &T,
    ) -> Option<Answer> {
        let payload = wire::encode(command)
            .inspect_err(|error| warn!("cannot write a command for `{}`: {error}", robot.1))
            .ok()?;
        self.carrier.carry(robot, run, verb, payload).await
    }
}

/// The fleet's network as a carrier.
#[derive(Debug)]
pub(super) struct Network {
    pub(super) routers: Arc<Routers>,
    pub(super) supervisor: Supervisor,
}

impl Carrier for Network {
    fn carry(
        &self,
        (site, robot): &RobotKey,
        run: Option<BootId>,
        verb: Verb,
        payload: Vec<u8>,
    ) -> Carrying {
        let mut key = keys::command(site, robot, verb);
        if let Some(boot) = run {
            key = keys::to_run(&key, boot);
        }
        // A robot is on one of them; the others know nobody of its name and say nothing.
        let routers = self.routers.all();
        let sessions = routers.iter().map(|router| router.session.clone());
        let sessions: Vec<Session> = sessions.collect();
        let supervisor = self.supervisor.clone();
        Box::pin(query(
            sessions,
            supervisor,
            key,
            (priority_of(verb), payload),
        ))
    }
}

/// What slows a robot down goes before everything else on its link.
const fn priority_of(verb: Verb) -> Priority {
    match verb {
        Verb::Stop => Priority::RealTime,
        Verb::Clear | Verb::Lease | Verb::Limit | Verb::Pause | Verb::Cancel => {
            Priority::InteractiveHigh
        }
        Verb::Offer | Verb::Resume | Verb::Site => Priority::Data,
    }
}

async fn query(
    sessions: Vec<Session>,
    supervisor: Supervisor,
    key: String,
    (priority, payload): (Priority, Vec<u8>),
) -> Option<Answer> {
    let (answer, answered) = oneshot::channel();
    let query_key = key.clone();
    // Sending blocks its thread when the robot's link is full.
    let sent = supervisor.blocking(move || {
        let answer = Arc::new(Mutex::new(Some(answer)));
        for session in sessions {
            let answer = Arc::clone(&answer);
            session
                .get(&query_key)
                .payload(payload.clone())
                .priority(priority)
                .express(priority == Priority::RealTime)
                // A second agent under the same name must not swallow what is for the first.
                .target(QueryTarget::All)
                .consolidation(ConsolidationMode::None)
                .timeout(COMMAND_TIMEOUT)
                .callback(move |reply| {
                    // Only the first reply counts: the robot's key belongs to one robot.
                    let waiting = answer.lock().unwrap_or_else(PoisonError::into_inner).take();
                    if let Some(waiting) = waiting {
                        let _ = waiting.send(reply);
                    }
                })
                .wait()?;
        }
        Ok::<(), zenoh::Error>(())
    });
    let exchange = async {
        sent.await?
            .inspect_err(|error| warn!("cannot query `{key}`: {error}"))
            .ok()?;
        answered.await.ok()
    };
    let reply = tokio::time::timeout(COMMAND_TIMEOUT + MARGIN, exchange)
        .await
        .ok()??;
    read_answer(&key, &reply)
}

fn read_answer(key: &str, reply: &Reply) -> Option<Answer> {
    match reply.result() {
        Ok(sample) => wire::decode(&sample.payload().to_bytes())
            .inspect_err(|error| warn!("the answer on `{key}` was refused: {error}"))
            .ok(),
        Err(error) => {
            // A robot's refusal to read, or the plain text with which zenoh says "timeout".
            match wire::decode::<Refusal>(&error.payload().to_bytes()) {
                Ok(refusal) => warn!("`{key}` could not be read there: {}", refusal.detail),
                Err(_not_a_refusal) => debug!("`{key}` was not answered"),
            }
            None
        }
    }
}
