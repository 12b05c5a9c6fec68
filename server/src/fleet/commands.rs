//! Commands to robots, sent as zenoh queries; the reply is the robot's answer.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;
use tracing::{debug, warn};
use tread_api::ids::BootId;
use tread_api::keys::{self, Verb};
use tread_api::wire::{self, Refusal};
use zenoh::Session;
use zenoh::Wait as _;
use zenoh::qos::Priority;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};

use super::routers::Routers;
use crate::app::presence::RobotKey;
use crate::app::robot_link::{Answering, CommandTransport, Undelivered};
use crate::supervisor::Supervisor;

/// Maximum time for a robot's answer.
const COMMAND_TIMEOUT: Duration = Duration::from_millis(800);
/// Additional time of the query beyond that, after which it counts as not delivered.
const MARGIN: Duration = Duration::from_millis(200);

/// Sends commands as queries through the routers of this server.
#[derive(Debug)]
pub(super) struct ZenohCommands {
    pub(super) routers: Arc<Routers>,
    pub(super) supervisor: Supervisor,
}

impl CommandTransport for ZenohCommands {
    fn send(
        &self,
        (site, robot): &RobotKey,
        run: Option<BootId>,
        verb: Verb,
        payload: Vec<u8>,
    ) -> Answering {
        let mut key = keys::command(site, robot, verb);
        if let Some(boot) = run {
            key = keys::to_run(&key, boot);
        }
        // A robot is connected to one of them; on the others the query gets no reply.
        let routers = self.routers.reaching(&(site.clone(), robot.clone()));
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

/// Commands that slow a robot down have priority over everything else on its link.
const fn priority_of(verb: Verb) -> Priority {
    match verb {
        Verb::Stop => Priority::RealTime,
        Verb::Clear | Verb::Lease | Verb::Limit | Verb::Pause | Verb::Cancel => {
            Priority::InteractiveHigh
        }
        Verb::Offer | Verb::Resume | Verb::Site | Verb::StateRate | Verb::Outcomes => {
            Priority::Data
        }
    }
}

async fn query(
    sessions: Vec<Session>,
    supervisor: Supervisor,
    key: String,
    (priority, payload): (Priority, Vec<u8>),
) -> Result<Vec<u8>, Undelivered> {
    let (answer, answered) = oneshot::channel();
    let query_key = key.clone();
    // Sending blocks its thread when the robot's link is full.
    let sent = supervisor.blocking(move || {
        let answer = Arc::new(Mutex::new(Some(answer)));
        let (mut is_sent, mut failure) = (false, None);
        // One that is closing fails; the robot may be on another.
        for session in sessions.iter().rev() {
            let answer = Arc::clone(&answer);
            let queried = session
                .get(&query_key)
                .payload(payload.clone())
                .priority(priority)
                .express(priority == Priority::RealTime)
                // A second agent under the same name must not take the query from the first.
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
                .wait();
            match queried {
                Ok(()) => is_sent = true,
                Err(error) => failure = Some(error),
            }
        }
        failure.filter(|_| !is_sent).map_or(Ok(()), Err)
    });
    let exchange = async {
        let sent = sent.await.ok_or(Undelivered::Unreachable)?;
        sent.map_err(|error| {
            warn!("cannot query `{key}`: {error}");
            Undelivered::Unreachable
        })?;
        answered.await.map_err(|_nobody| Undelivered::NoAnswer)
    };
    let reply = tokio::time::timeout(COMMAND_TIMEOUT + MARGIN, exchange)
        .await
        .map_err(|_elapsed| Undelivered::NoAnswer)??;
    payload_of(&key, &reply)
}

fn payload_of(key: &str, reply: &Reply) -> Result<Vec<u8>, Undelivered> {
    match reply.result() {
        Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
        Err(error) => {
            // Either a refusal by the robot, or the plain text "timeout" by zenoh.
            match wire::decode::<Refusal>(&error.payload().to_bytes()) {
                Ok(refusal) => {
                    warn!("`{key}` could not be read there: {}", refusal.detail);
                    Err(Undelivered::Unreadable)
                }
                Err(_not_a_refusal) => {
                    debug!("`{key}` was not answered");
                    Err(Undelivered::NoAnswer)
                }
            }
        }
    }
}
