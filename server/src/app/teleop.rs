//! Teleoperation: one session for each connection, of which at most one has a robot's lease.
//!
//! The robot grants the lease and decides who has it. A session only forwards: it puts the robot's
//! own time and the lease's epoch into commands, so that the robot refuses late commands of an old
//! lease or of another run of the agent. A session that ends in any way while it has the lease
//! commands the robot to stop at once and releases the lease.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;
use tokio_util::task::task_tracker::TaskTrackerToken;
use tracing::{info, warn};
use tread_api::drive::{
    DRIVE_FOR_DEFAULT_MS, DRIVE_FOR_MAX_MS, DRIVE_FOR_MIN_MS, Drive, DriveRefusal, DriveView,
    ReleaseCause,
};
use tread_api::geometry::Twist;
use tread_api::ids::{BootId, RobotId, SiteId};
use tread_api::safety::{BY_LENGTH_MAX, Driver, Lease};
use tread_api::stop::Stop;
use tread_api::wire::reply::{CommandRefusal, CommandRefusalCode};
use tread_api::wire::safety::{AcquireLease, DriveCommand, ReleaseLease};
use uuid::Uuid;

use super::identity::Credential;
use super::missions::control::hold_all;
use super::robot_link::DrivePublisher;
use super::shares::{Bounds, Place};
use super::stops::StopReason;
use super::watched::Watch;
use super::{App, AppError};
use crate::app::presence::RobotKey;
use crate::db;

/// Maximum number of drive connections at once.
pub const SESSIONS_MAX: usize = 512;
/// Maximum number of drive connections of viewers, who may watch and stop but not drive.
pub const WATCHERS_MAX: usize = 256;
/// Maximum number of drive connections of one token, with its sessions.
pub const SESSIONS_PER_IDENTITY_MAX: usize = 64;
/// Limits on drive connections.
pub(super) const SHARES: Bounds = Bounds {
    all: SESSIONS_MAX,
    viewers: WATCHERS_MAX,
    each: SESSIONS_PER_IDENTITY_MAX,
};
/// Number of attempts to release a lease after its connection was lost; the robot frees it by
/// itself.
const RELEASE_TRIES: u32 = 5;
/// Wait between two attempts.
const RELEASE_RETRY: Duration = Duration::from_millis(300);
/// Validity of a command with zero velocity: as long as the robot would take to stop by itself.
const STOP_COMMAND_VALIDITY: Duration = Duration::from_millis(250);
/// Maximum time that a new driver waits until holding the missions is stored.
const HOLD_WAIT_MAX: Duration = Duration::from_millis(300);
/// Wait between two attempts to store it.
const HOLD_RETRY: Duration = Duration::from_millis(500);
/// Time after a lease was given in which the robot's states may still show another one: they were
/// sent before the answer.
const LEASE_GRACE: Duration = Duration::from_secs(1);

/// Reason why a request of a session was refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused {
    /// For programs.
    pub cause: DriveRefusal,
    /// For people.
    pub detail: String,
}

fn refused(cause: DriveRefusal, detail: impl Into<String>) -> Refused {
    Refused {
        cause,
        detail: detail.into(),
    }
}

fn refused_by_robot(refusal: CommandRefusal) -> Refused {
    let cause = if refusal.code == CommandRefusalCode::Leased {
        DriveRefusal::Leased
    } else if refusal.code == CommandRefusalCode::Stopped {
        DriveRefusal::Stopped
    } else {
        DriveRefusal::Refused
    };
    refused(cause, refusal.detail)
}

/// Robots whose missions are being held for a driver, until that is stored: at most one task per
/// robot.
#[derive(Debug, Default)]
pub(super) struct Holds {
    /// Whether holding was requested again since the last attempt began.
    requests: Mutex<HashMap<RobotKey, bool>>,
}

impl Holds {
    fn lock(&self) -> MutexGuard<'_, HashMap<RobotKey, bool>> {
        self.requests.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Requests holding; returns true if no task is working on it.
    fn request_hold(&self, key: &RobotKey) -> bool {
        self.lock().insert(key.clone(), true).is_none()
    }

    /// Returns whether holding was requested since the last attempt; if not, removes the robot.
    fn take_request(&self, key: &RobotKey) -> bool {
        let mut requests = self.lock();
        match requests.get_mut(key) {
            Some(again) if *again => {
                *again = false;
                true
            }
            Some(_) | None => {
                requests.remove(key);
                false
            }
        }
    }
}

/// A lease in the robot's presence, until it is dropped: no mission is resumed or begun meanwhile.
#[derive(Debug)]
struct LeaseGuard {
    app: App,
    key: RobotKey,
    id: Uuid,
}

impl Drop for LeaseGuard {
    fn drop(&mut self) {
        self.app.presences().lease_over(&self.key, self.id);
    }
}

/// A lease that the robot granted to this session.
#[derive(Debug)]
struct ActiveLease {
    lease: Lease,
    granted: LeaseGuard,
    boot: BootId,
    since: Duration,
    publisher: Box<dyn DrivePublisher>,
    next_seq: u64,
}

/// One teleoperation connection to one robot.
#[derive(Debug)]
pub struct Session {
    app: App,
    key: RobotKey,
    client: Uuid,
    active: Option<ActiveLease>,
    _watch: Watch,
    /// The server's stop waits until the session has commanded the robot to stop; dropped last.
    _attended: TaskTrackerToken,
}

impl App {
    /// Begins a session that only observes.
    ///
    /// # Errors
    /// The robot has never sent a hello, or the network is not open.
    pub async fn begin_drive(&self, site: &SiteId, robot: &RobotId) -> Result<Session, AppError> {
        self.known_robot(site, robot).await?;
        Ok(Session {
            app: self.clone(),
            _attended: self.supervisor().task_token(),
            _watch: self.watched().begin((site.clone(), robot.clone())),
            key: (site.clone(), robot.clone()),
            client: Uuid::new_v4(),
            active: None,
        })
    }

    /// Returns the number of drive connections.
    pub(crate) fn drive_clients(&self) -> usize {
        self.inner.drive_shares.taken()
    }

    /// Takes a place for one more drive connection of this credential.
    ///
    /// # Errors
    /// [`AppError::TooMany`]: all [`SESSIONS_MAX`] are taken, or the [`WATCHERS_MAX`] of viewers,
    /// or the [`SESSIONS_PER_IDENTITY_MAX`] of this token.
    pub fn drive_slot(&self, of: &Credential) -> Result<Place, AppError> {
        self.inner.drive_shares.take(of, "drive connections")
    }

    /// Holds all active and queued missions of a robot while somebody teleoperates it.
    async fn hold_for_driver(&self, key: &RobotKey, name: &str) -> Result<(), AppError> {
        let mut tx = self.db().write("teleop").await?;
        if let Some(robot_pk) = db::robots::pk_of(&mut tx, &key.0, &key.1).await? {
            let reason = format!("`{name}` teleoperates the robot");
            hold_all(&mut tx, robot_pk, &reason, self.clock().now()).await?;
        }
        Ok(self.commit_recalling(tx).await?)
    }
}

impl Session {
    /// Returns the session's identifier in leases.
    pub fn client(&self) -> Uuid {
        self.client
    }

    /// Returns a token that is cancelled when the server stops.
    pub fn stop_token(&self) -> CancellationToken {
        self.app.supervisor().stop_token()
    }

    /// Ends the session: a robot that it teleoperates is commanded to stop, and the lease is
    /// released.
    pub fn end(&mut self) {
        if self.active.is_some() {
            let robot = &self.key.1;
            warn!(robot.id = %robot, "the driver of robot `{robot}` is gone; it is commanded to rest");
            self.app.counters().drivers_lost.one();
            self.release();
        }
    }

    /// Requests the lease from the robot; with `take` even if somebody else has it.
    ///
    /// # Errors
    /// [`DriveRefusal::Leased`] names the driver who has it; other causes if the robot does not
    /// answer or refuses.
    pub async fn acquire(&mut self, name: &str, take: bool) -> Result<Lease, Refused> {
        let name: String = name.trim().chars().take(BY_LENGTH_MAX).collect();
        if name.is_empty() {
            let detail = "whoever drives says who that is";
            return Err(refused(DriveRefusal::Refused, detail));
        }
        let driver = Driver {
            client: self.client,
            name,
        };
        let command = AcquireLease {
            request: Uuid::new_v4(),
            holder: driver.clone(),
            take,
        };
        let answer = self.app.commands().send(&self.key, &command).await;
        let answer = answer
            .map_err(|undelivered| refused(DriveRefusal::Unreachable, undelivered.to_string()))?;
        let epoch = answer.reply.into_result().map_err(refused_by_robot)?;
        let lease = Lease { epoch, driver };
        // The same lease continues with its sequence numbers.
        let is_same =
            |active: &&mut ActiveLease| (active.lease.epoch, active.boot) == (epoch, answer.boot);
        if let Some(active) = self.active.as_mut().filter(is_same) {
            active.lease = lease.clone();
            return Ok(lease);
        }
        // Before the missions are held: what is created later is held at once.
        let granted = LeaseGuard {
            id: self
                .app
                .presences()
                .lease_granted(&self.key, &lease.driver.name),
            app: self.app.clone(),
            key: self.key.clone(),
        };
        let publisher = self.app.robot_link().drive.open(&self.key).await;
        let Some(publisher) = publisher else {
            self.return_lease(lease, granted);
            let detail = "the network to the robot is not open";
            return Err(refused(DriveRefusal::Unreachable, detail));
        };
        let name = &lease.driver.name;
        info!(robot.id = %self.key.1, "robot `{}` is teleoperated by `{name}`", self.key.1);
        self.active = Some(ActiveLease {
            lease: lease.clone(),
            granted,
            boot: answer.boot,
            since: self.app.clock().elapsed(),
            publisher,
            next_seq: 1,
        });
        self.hold_missions(name.clone()).await;
        Ok(lease)
    }

    /// Stores in the background that missions are held for a driver, and waits for it at most
    /// [`HOLD_WAIT_MAX`].
    async fn hold_missions(&self, name: String) {
        let (app, key) = (self.app.clone(), self.key.clone());
        let (written, is_written) = oneshot::channel();
        let ending = self.app.supervisor().stop_token();
        // The task that is working on it does it once more.
        if !app.holds().request_hold(&key) {
            return;
        }
        self.app.supervisor().spawn_passing("hold", async move {
            while app.holds().take_request(&key) {
                if let Err(error) = db::limited(app.hold_for_driver(&key, &name)).await {
                    app.log_failure("write down that missions are held for a driver", &error);
                    app.holds().request_hold(&key);
                    tokio::select! {
                        () = ending.cancelled() => return,
                        () = tokio::time::sleep(HOLD_RETRY) => {}
                    }
                }
            }
            // Fails if the driver no longer waits.
            let _ = written.send(());
        });
        let _ = tokio::time::timeout(HOLD_WAIT_MAX, is_written).await;
    }

    /// Forwards one command, valid for its own duration limited to the allowed range.
    ///
    /// # Errors
    /// This session has no lease, the robot is stopped, or its clock is not known.
    pub fn drive(&mut self, drive: Drive) -> Result<(), Refused> {
        let asked_ms = drive.for_ms.unwrap_or(DRIVE_FOR_DEFAULT_MS);
        let for_ms = asked_ms.clamp(DRIVE_FOR_MIN_MS, DRIVE_FOR_MAX_MS);
        let twist = Twist {
            linear_m_s: drive.linear_m_s,
            angular_rad_s: drive.angular_rad_s,
        };
        self.send(twist, Duration::from_millis(for_ms))?;
        let presence = self.app.presences().get(&self.key);
        let stop = presence.state().and_then(|state| state.safety.stop.clone());
        // The robot would not move, and the driver must see why.
        stop.map_or(Ok(()), |stop| {
            let detail = format!("stopped by {}: {}", stop.by, stop.reason);
            Err(refused(DriveRefusal::Stopped, detail))
        })
    }

    fn send(&mut self, twist: Twist, lasting: Duration) -> Result<(), Refused> {
        let no_lease = || refused(DriveRefusal::NoLease, "acquire the lease first");
        let active = self.active.as_mut().ok_or_else(no_lease)?;
        let now = self.app.clock().elapsed();
        let clock = self.app.presences().get(&self.key).robot_clock_us(now);
        let (boot, sent_us) = clock.ok_or_else(|| {
            refused(
                DriveRefusal::Unreachable,
                "the robot has not been heard yet",
            )
        })?;
        if boot != active.boot {
            return Err(no_lease());
        }
        let lasting_us = u64::try_from(lasting.as_micros()).unwrap_or(0);
        let command = DriveCommand {
            boot,
            epoch: active.lease.epoch,
            seq: active.next_seq,
            sent_us,
            until_us: sent_us.saturating_add(lasting_us),
            twist,
        };
        active.next_seq += 1;
        self.app.counters().drive_commands_sent.one();
        if active.publisher.publish(&command) {
            Ok(())
        } else {
            let detail = "the network to the robot is not open";
            Err(refused(DriveRefusal::Unreachable, detail))
        }
    }

    /// Releases the lease, after a command with zero velocity. Returns whether the session had one.
    pub fn release(&mut self) -> bool {
        // If the robot's clock is not known, the robot stops when its last command ends.
        let _ = self.send(Twist::default(), STOP_COMMAND_VALIDITY);
        match self.active.take() {
            Some(active) => {
                self.return_lease(active.lease, active.granted);
                true
            }
            None => false,
        }
    }

    /// Releases a lease on the robot in the background; it is over when the robot has answered.
    fn return_lease(&self, lease: Lease, granted: LeaseGuard) {
        let (app, key) = (self.app.clone(), self.key.clone());
        let ending = app.supervisor().stop_token();
        let supervisor = app.supervisor().clone();
        supervisor.spawn_passing("release", async move {
            let _granted = granted;
            let command = ReleaseLease {
                request: Uuid::new_v4(),
                holder: lease.driver,
            };
            for _ in 0..RELEASE_TRIES {
                let answer = app.commands().send(&key, &command).await;
                if answer.is_ok() || ending.is_cancelled() {
                    return;
                }
                tokio::time::sleep(RELEASE_RETRY).await;
            }
        });
    }

    /// Stops the robot; needs no lease.
    ///
    /// # Errors
    /// As [`App::stop_robot`].
    pub async fn stop(&mut self, words: StopReason) -> Result<Stop, AppError> {
        let driver = self
            .active
            .as_ref()
            .map(|active| active.lease.driver.name.clone());
        let words = StopReason {
            by: words.by.or(driver),
            ..words
        };
        let (site, robot) = (&self.key.0, &self.key.1);
        self.app.stop_robot(site, robot, words).await
    }

    /// Returns why this session's lease is over according to the robot's states, and drops it;
    /// `None` while it is valid.
    pub fn lost_lease(&mut self) -> Option<(ReleaseCause, String)> {
        let active = self.active.as_ref()?;
        let now = self.app.clock().elapsed();
        let presence = self.app.presences().get(&self.key);
        let state = presence.state()?;
        let other_run = presence.boot().is_some_and(|(boot, _)| boot != active.boot);
        let shown = state.safety.lease.as_ref();
        let is_own = shown.is_some_and(|shown| shown.epoch == active.lease.epoch);
        if !other_run && (is_own || now.saturating_sub(active.since) < LEASE_GRACE) {
            return None;
        }
        let lost = match shown.filter(|shown| shown.epoch > active.lease.epoch || other_run) {
            Some(other) => {
                let detail = format!("`{}` has taken it", other.driver.name);
                (ReleaseCause::Taken, detail)
            }
            None if other_run => {
                let detail = "the robot's agent has restarted".to_owned();
                (ReleaseCause::Lost, detail)
            }
            None => {
                let detail = "the robot has freed it".to_owned();
                (ReleaseCause::Lost, detail)
            }
        };
        self.active = None;
        Some(lost)
    }

    /// Returns the robot's last state; `socket` is the round-trip time of the connection.
    pub fn view(&self, socket: Option<Duration>) -> DriveView {
        let now = self.app.clock().elapsed();
        let presence = self.app.presences().get(&self.key);
        let live = presence.live(now);
        let safety = live.as_ref().map(|live| live.safety.clone());
        let safety = safety.unwrap_or_default();
        let socket_ms = socket.map(|way| way.as_secs_f64() * 1e3);
        let command_age_ms = safety.drive.and_then(|drive| drive.command_age_ms);
        DriveView {
            link: presence.link(now),
            state_age_ms: live.as_ref().map(|live| live.state_age_ms),
            mode: live.as_ref().map(|live| live.mode),
            pose: live.as_ref().and_then(|live| live.pose),
            twist: live.as_ref().and_then(|live| live.twist),
            mission: live.as_ref().and_then(|live| live.mission),
            safety,
            latency_ms: command_age_ms.zip(socket_ms).map(|(age, way)| age + way),
            socket_ms,
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        self.end();
    }
}
