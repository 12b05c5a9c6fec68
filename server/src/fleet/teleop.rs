//! Drive commands to robots: published, the newest counts, and what does not fit on a link at
//! once is dropped, since the next comes soon.

use std::sync::{Arc, Mutex, PoisonError};

use tracing::{debug, warn};
use tread_api::keys;
use tread_api::wire;
use tread_api::wire::safety::DriveCommand;
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};

use super::presence::RobotKey;
use super::routers::Routers;
use crate::supervisor::Supervisor;

/// Opens lines to robots; clones open them through the same network.
#[derive(Debug, Clone)]
pub struct Teleop {
    routers: Arc<Routers>,
    supervisor: Supervisor,
}

/// The way of drive commands to one robot, by whichever router it comes to be on.
#[derive(Debug)]
pub struct Line {
    routers: Arc<Routers>,
    key: String,
    ways: Mutex<Ways>,
}

/// One publisher on each router that was open at some version of their list.
#[derive(Debug)]
struct Ways {
    version: u64,
    publishers: Vec<Publisher<'static>>,
}

impl Ways {
    /// Declares the publishers. Blocks its thread, for a moment.
    fn declare(routers: &Routers, key: &str) -> zenoh::Result<Self> {
        let version = routers.version();
        let declare = |session: &zenoh::Session| {
            session
                .declare_publisher(key.to_owned())
                .congestion_control(CongestionControl::Drop)
                .priority(Priority::RealTime)
                .express(true)
                .wait()
        };
        let all = routers.all();
        let publishers = all.iter().map(|router| declare(&router.session));
        let publishers = publishers.collect::<zenoh::Result<Vec<_>>>()?;
        Ok(Self {
            version,
            publishers,
        })
    }
}

impl Teleop {
    pub(super) fn new(routers: Arc<Routers>, supervisor: Supervisor) -> Self {
        Self {
            routers,
            supervisor,
        }
    }

    /// Without a network: no line can be opened.
    pub fn without_network(supervisor: Supervisor) -> Self {
        Self {
            routers: Arc::default(),
            supervisor,
        }
    }

    /// Opens the line to a robot; `None` if the network refuses.
    pub async fn open(&self, (site, robot): &RobotKey) -> Option<Line> {
        // Where the network is simulated, or a router is being opened again, there is no line.
        self.routers.newest()?;
        let key = keys::teleop(site, robot);
        let (routers, of) = (Arc::clone(&self.routers), key.clone());
        // Declaring blocks its thread.
        let declared = self
            .supervisor
            .blocking(move || Ways::declare(&routers, &of));
        match declared.await? {
            Ok(ways) => Some(Line {
                routers: Arc::clone(&self.routers),
                key,
                ways: Mutex::new(ways),
            }),
            Err(error) => {
                warn!("cannot open the line of drive commands to `{robot}`: {error}");
                None
            }
        }
    }
}

impl Line {
    /// Sends a command; it takes a millisecond at most, a few when there is a new router. Whether
    /// the network took it.
    pub fn send(&self, command: &DriveCommand) -> bool {
        let Ok(payload) = wire::encode(command) else {
            return false;
        };
        let mut ways = self.ways.lock().unwrap_or_else(PoisonError::into_inner);
        if ways.version != self.routers.version() {
            match Ways::declare(&self.routers, &self.key) {
                Ok(present) => *ways = present,
                Err(error) => debug!("cannot declare drive commands on a new router: {error}"),
            }
        }
        let mut is_taken = false;
        for publisher in &ways.publishers {
            match publisher.put(payload.clone()).wait() {
                Ok(()) => is_taken = true,
                Err(error) => debug!("a drive command did not go out: {error}"),
            }
        }
        is_taken
    }
}
