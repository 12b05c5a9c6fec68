//! Publishes drive commands to robots: only the newest counts, and a command that does not fit on a
//! link at once is dropped, since the next one follows soon.

use std::sync::{Arc, Mutex, PoisonError};

use tracing::{debug, warn};
use tread_api::keys;
use tread_api::wire;
use tread_api::wire::safety::DriveCommand;
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};

use super::routers::Routers;
use crate::app::presence::RobotKey;
use crate::app::robot_link::{DrivePublisher, DriveTransport, Opening};
use crate::supervisor::Supervisor;

/// Opens publishers of drive commands on the routers of this server.
#[derive(Debug)]
pub(super) struct ZenohDrive {
    pub(super) routers: Arc<Routers>,
    pub(super) supervisor: Supervisor,
}

/// Publisher to one robot, on whichever router it is connected to.
#[derive(Debug)]
struct RobotPublisher {
    routers: Arc<Routers>,
    robot: RobotKey,
    declared: Mutex<Declared>,
}

/// One publisher on each router that the robot may be connected to, of one version of their list.
#[derive(Debug)]
struct Declared {
    version: u64,
    publishers: Vec<Publisher<'static>>,
}

impl Declared {
    /// Declares the publishers. Blocks its thread, for a moment.
    fn on(routers: &Routers, robot: &RobotKey) -> zenoh::Result<Self> {
        let version = routers.version();
        let key = keys::teleop(&robot.0, &robot.1);
        let declare = |session: &zenoh::Session| {
            session
                .declare_publisher(key.clone())
                .congestion_control(CongestionControl::Drop)
                .priority(Priority::RealTime)
                .express(true)
                .wait()
        };
        let reaching = routers.reaching(robot);
        let (mut publishers, mut failure) = (Vec::new(), None);
        // One that is closing fails; the robot may be on another.
        for router in reaching {
            match declare(&router.session) {
                Ok(publisher) => publishers.push(publisher),
                Err(error) => failure = Some(error),
            }
        }
        match failure {
            Some(error) if publishers.is_empty() => Err(error),
            Some(_) | None => Ok(Self {
                version,
                publishers,
            }),
        }
    }
}

impl DriveTransport for ZenohDrive {
    fn open(&self, robot: &RobotKey) -> Opening {
        let robot = robot.clone();
        let (routers, supervisor) = (Arc::clone(&self.routers), self.supervisor.clone());
        Box::pin(async move {
            // While a router is being opened again there is no network.
            routers.newest()?;
            let (on, of) = (Arc::clone(&routers), robot.clone());
            // Declaring blocks its thread.
            let declared = supervisor.blocking(move || Declared::on(&on, &of));
            match declared.await? {
                Ok(declared) => {
                    let declared = Mutex::new(declared);
                    let publisher = RobotPublisher {
                        routers,
                        robot,
                        declared,
                    };
                    Some(Box::new(publisher) as Box<dyn DrivePublisher>)
                }
                Err(error) => {
                    warn!("cannot publish drive commands to `{}`: {error}", robot.1);
                    None
                }
            }
        })
    }
}

impl DrivePublisher for RobotPublisher {
    /// Takes at most a millisecond, a few when there is a new router.
    fn publish(&self, command: &DriveCommand) -> bool {
        let Ok(payload) = wire::encode(command) else {
            return false;
        };
        let mut declared = self.declared.lock().unwrap_or_else(PoisonError::into_inner);
        if declared.version != self.routers.version() {
            match Declared::on(&self.routers, &self.robot) {
                Ok(present) => *declared = present,
                Err(error) => debug!("cannot declare drive commands on a new router: {error}"),
            }
        }
        let mut is_taken = false;
        for publisher in &declared.publishers {
            match publisher.put(payload.clone()).wait() {
                Ok(()) => is_taken = true,
                Err(error) => debug!("a drive command did not go out: {error}"),
            }
        }
        is_taken
    }
}
