//! Drive commands to robots: published, the newest counts, and what does not fit on a link at
//! once is dropped, since the next comes soon.

use std::sync::Arc;

use tracing::{debug, warn};
use tread_api::keys;
use tread_api::wire;
use tread_api::wire::safety::DriveCommand;
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};

use super::presence::RobotKey;
use super::router::Current;
use crate::supervisor::Supervisor;

/// Opens lines to robots; clones open them through the same network.
#[derive(Debug, Clone)]
pub struct Teleop {
    /// `None` where the network is simulated: it has no lines.
    session: Option<Arc<Current>>,
    supervisor: Supervisor,
}

/// The way of drive commands to one robot. It belongs to one opening of the router.
#[derive(Debug)]
pub struct Line {
    publisher: Publisher<'static>,
}

impl Teleop {
    pub(super) fn new(session: Arc<Current>, supervisor: Supervisor) -> Self {
        Self {
            session: Some(session),
            supervisor,
        }
    }

    /// Without a network: no line can be opened.
    pub fn without_network(supervisor: Supervisor) -> Self {
        Self {
            session: None,
            supervisor,
        }
    }

    /// Opens the line to a robot; `None` if the network refuses.
    pub async fn open(&self, (site, robot): &RobotKey) -> Option<Line> {
        let (session, key) = (self.session.as_ref()?.get(), keys::teleop(site, robot));
        // Declaring blocks its thread.
        let declared = self.supervisor.blocking(move || {
            session
                .declare_publisher(key)
                .congestion_control(CongestionControl::Drop)
                .priority(Priority::RealTime)
                .express(true)
                .wait()
        });
        match declared.await? {
            Ok(publisher) => Some(Line { publisher }),
            Err(error) => {
                warn!("cannot open the line of drive commands to `{robot}`: {error}");
                None
            }
        }
    }
}

impl Line {
    /// Sends a command; it takes a millisecond at most. Whether the network took it.
    pub fn send(&self, command: &DriveCommand) -> bool {
        let Ok(payload) = wire::encode(command) else {
            return false;
        };
        let put = self.publisher.put(payload).wait();
        put.inspect_err(|error| debug!("a drive command did not go out: {error}"))
            .is_ok()
    }
}
