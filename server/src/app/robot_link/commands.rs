//! Commands to robots, and their answers.

use std::pin::Pin;
use std::sync::Arc;

use serde::Serialize;
use tracing::warn;
use tread_api::ids::BootId;
use tread_api::keys::Verb;
use tread_api::wire;
use tread_api::wire::command::Answer;

use super::Unconnected;
use crate::app::presence::{Presences, RobotKey};

/// An answer that is awaited.
pub type Answering = Pin<Box<dyn Future<Output = Option<Answer>> + Send>>;

/// Carries one command to a robot and its answer back.
pub trait CommandTransport: std::fmt::Debug + Send + Sync {
    /// Sends a payload to a robot's verb: to one run of its agent, or to whatever runs under its
    /// name. `None` means not delivered, as far as anyone knows.
    fn send(
        &self,
        robot: &RobotKey,
        run: Option<BootId>,
        verb: Verb,
        payload: Vec<u8>,
    ) -> Answering;
}

impl CommandTransport for Unconnected {
    fn send(&self, _: &RobotKey, _: Option<BootId>, _: Verb, _: Vec<u8>) -> Answering {
        Box::pin(std::future::ready(None))
    }
}

/// Sends commands to robots; clones send through the same transport.
#[derive(Debug, Clone)]
pub struct Commands {
    transport: Arc<dyn CommandTransport>,
    presences: Arc<Presences>,
}

impl Commands {
    /// Commands through a transport; `presences` tell which run of an agent is the present one.
    pub(in crate::app) fn new(
        transport: Arc<dyn CommandTransport>,
        presences: Arc<Presences>,
    ) -> Self {
        Self {
            transport,
            presences,
        }
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
        self.transport.send(robot, run, verb, payload).await
    }
}
