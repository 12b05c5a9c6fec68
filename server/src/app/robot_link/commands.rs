//! Commands to robots, and their answers.

use std::pin::Pin;
use std::sync::Arc;

use tokio::time::Instant;
use tracing::warn;
use tread_api::ids::BootId;
use tread_api::keys::Verb;
use tread_api::wire;
use tread_api::wire::reply::{Answer, Command};
use tread_api::wire::trace::TraceParent;

use super::NullTransport;
use crate::app::presence::{Presences, RobotKey};
use crate::counters::Counters;

/// Reason why the answer to a command is not known. The same command may be sent again without
/// harm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Undelivered {
    /// The command could not be sent.
    #[error("the network to the robot is not open")]
    Unreachable,
    /// No agent of this robot answered in time.
    #[error("the robot does not answer")]
    NoAnswer,
    /// The robot could not parse the command, or its answer cannot be parsed.
    #[error("robot and server do not understand each other")]
    Unreadable,
}

/// Future of the payload of an answer.
pub type Answering = Pin<Box<dyn Future<Output = Result<Vec<u8>, Undelivered>> + Send>>;

/// Sends one command to a robot and returns its answer.
pub trait CommandTransport: std::fmt::Debug + Send + Sync {
    /// Sends a payload for a robot's verb: to one run of its agent, or to any run under its name.
    fn send(
        &self,
        robot: &RobotKey,
        run: Option<BootId>,
        verb: Verb,
        payload: Vec<u8>,
    ) -> Answering;
}

impl CommandTransport for NullTransport {
    fn send(&self, _: &RobotKey, _: Option<BootId>, _: Verb, _: Vec<u8>) -> Answering {
        Box::pin(std::future::ready(Err(Undelivered::Unreachable)))
    }
}

/// Sends commands to robots; clones send through the same transport.
#[derive(Debug, Clone)]
pub struct Commands {
    transport: Arc<dyn CommandTransport>,
    presences: Arc<Presences>,
    counters: Arc<Counters>,
}

impl Commands {
    /// Creates a sender through a transport; `presences` give the present run of each agent.
    /// Undelivered commands are counted.
    pub(in crate::app) fn new(
        transport: Arc<dyn CommandTransport>,
        presences: Arc<Presences>,
        counters: Arc<Counters>,
    ) -> Self {
        Self {
            transport,
            presences,
            counters,
        }
    }

    /// Sends one command to a robot's present run and waits for its answer.
    ///
    /// # Errors
    /// [`Undelivered`]: the robot may have received the command nevertheless.
    pub async fn send<C: Command>(
        &self,
        robot: &RobotKey,
        command: &C,
    ) -> Result<Answer<C::Reply>, Undelivered> {
        let present = self.presences.get(robot).boot();
        let run = present.map(|(boot, _since)| boot);
        self.send_to(robot, run, command).await
    }

    /// Sends one command to one run of a robot's agent, or to all under its name, and waits for the
    /// first answer.
    ///
    /// # Errors
    /// [`Undelivered`]: the robot may have received the command nevertheless.
    pub async fn send_to<C: Command>(
        &self,
        robot: &RobotKey,
        run: Option<BootId>,
        command: &C,
    ) -> Result<Answer<C::Reply>, Undelivered> {
        let answer = self.exchange(robot, run, (command, None)).await;
        if answer.is_err() {
            self.counters.commands_unanswered.one();
        }
        answer
    }

    /// Sends one command to a robot's present run, with a trace context, and waits for its answer.
    ///
    /// # Errors
    /// [`Undelivered`]: the robot may have received the command nevertheless.
    pub async fn send_traced<C: Command>(
        &self,
        robot: &RobotKey,
        command: &C,
        traceparent: Option<TraceParent>,
    ) -> Result<Answer<C::Reply>, Undelivered> {
        let present = self.presences.get(robot).boot();
        let run = present.map(|(boot, _since)| boot);
        let answer = self.exchange(robot, run, (command, traceparent)).await;
        if answer.is_err() {
            self.counters.commands_unanswered.one();
        }
        answer
    }

    async fn exchange<C: Command>(
        &self,
        robot: &RobotKey,
        run: Option<BootId>,
        (command, traceparent): (&C, Option<TraceParent>),
    ) -> Result<Answer<C::Reply>, Undelivered> {
        let verb = C::VERB.as_str();
        let payload = wire::encode_traced(command, traceparent).map_err(|error| {
            warn!("cannot write a `{verb}` command for `{}`: {error}", robot.1);
            Undelivered::Unreachable
        })?;
        let sent_at = Instant::now();
        let answer = self.transport.send(robot, run, C::VERB, payload).await?;
        // A robot plans before it answers an offer.
        if C::VERB != Verb::Offer {
            self.presences.round_trip(robot, sent_at.elapsed());
        }
        wire::decode(&answer).map_err(|error| {
            warn!(
                error = &error as &dyn std::error::Error,
                "the answer of `{}` to a `{verb}` command was refused", robot.1
            );
            Undelivered::Unreadable
        })
    }
}
