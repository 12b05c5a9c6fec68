//! Stops, leases, drive commands and external limits on zenoh.
//!
//! End times are on the robot's monotonic clock (`monotonic_us` of its state) and belong to one run
//! of the agent; another run refuses them. A sender estimates this clock from the state with the
//! lowest latency. The estimate lags by that latency, so that an end time may be too early, but
//! never too late.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::reply::{Acknowledgement, Command, LeaseReply};
use crate::geometry::Twist;
use crate::ids::{BootId, OwnerId, StopId};
use crate::keys::Verb;
use crate::safety::{DRIVE_AHEAD_MAX_US, Driver, LIMIT_AHEAD_MAX_US};

/// `cmd/stop`: commands zero velocity, latches the stop, and answers `done` once the latch is on
/// the disk.
///
/// It is valid in every state and needs no lease. The same stop sent twice counts once.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stop {
    /// Identifier of the stop.
    pub stop: StopId,
    /// Name of the person or program that stops the robot.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::stop::STOP_TEXT_MAX}>")]
    pub by: String,
    /// Reason, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub reason: String,
    /// Time when the stop was requested, by the sender's clock.
    pub at: Timestamp,
}

/// `cmd/clear`: clears the stop in force, if it has this identifier and the robot is at rest.
///
/// Also `done` if this stop was cleared before; refused as `conflict` if a newer stop is in force,
/// as `moving` while the robot moves. The robot does not start to move by itself afterwards.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClearStop {
    /// Stop to be cleared: the newest that the sender knows.
    pub stop: StopId,
    /// Name of the person who clears the stop.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::stop::STOP_TEXT_MAX}>")]
    pub by: String,
}

/// `cmd/lease`: acquires the lease of teleoperation, or takes it from another driver.
///
/// The `detail` of a refusal as `leased` names the driver that has the lease. A lease pauses the
/// active mission, which stays paused until it is resumed by request.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(into = "LeaseMessage")]
pub struct AcquireLease {
    /// Identifier of the request, which makes it idempotent: a repetition gets the same answer and
    /// has no effect.
    pub request: Uuid,
    /// Driver that requests the lease; a driver that has it already gets it again.
    pub holder: Driver,
    /// Whether to take the lease if another driver has it.
    pub take: bool,
}

/// `cmd/lease`: releases the lease of teleoperation. The answer is `done` also when nobody has it.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(into = "LeaseMessage")]
pub struct ReleaseLease {
    /// Identifier of the request, which makes it idempotent.
    pub request: Uuid,
    /// Driver that releases its lease.
    pub holder: Driver,
}

/// Command on `cmd/lease`, as the robot receives it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "LeaseMessage", into = "LeaseMessage")]
pub enum LeaseCommand {
    /// Request for the lease, answered by a [`LeaseReply`].
    Acquire(AcquireLease),
    /// Release of the lease, answered by an [`Acknowledgement`].
    Release(ReleaseLease),
}

/// Operation on the lease.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum LeaseAction {
    Acquire,
    Take,
    Release,
}

/// Lease command in its form on the wire.
#[derive(Serialize, Deserialize)]
struct LeaseMessage {
    request: Uuid,
    action: LeaseAction,
    holder: Driver,
}

impl From<AcquireLease> for LeaseMessage {
    fn from(command: AcquireLease) -> Self {
        Self {
            request: command.request,
            action: if command.take {
                LeaseAction::Take
            } else {
                LeaseAction::Acquire
            },
            holder: command.holder,
        }
    }
}

impl From<ReleaseLease> for LeaseMessage {
    fn from(command: ReleaseLease) -> Self {
        Self {
            request: command.request,
            action: LeaseAction::Release,
            holder: command.holder,
        }
    }
}

impl From<LeaseCommand> for LeaseMessage {
    fn from(command: LeaseCommand) -> Self {
        match command {
            LeaseCommand::Acquire(command) => command.into(),
            LeaseCommand::Release(command) => command.into(),
        }
    }
}

impl From<LeaseMessage> for LeaseCommand {
    fn from(message: LeaseMessage) -> Self {
        let LeaseMessage {
            request,
            action,
            holder,
        } = message;
        let acquire = |take, holder| {
            Self::Acquire(AcquireLease {
                request,
                holder,
                take,
            })
        };
        match action {
            LeaseAction::Acquire => acquire(false, holder),
            LeaseAction::Take => acquire(true, holder),
            LeaseAction::Release => Self::Release(ReleaseLease { request, holder }),
        }
    }
}

/// Drive command on the robot's `teleop` key: a velocity until an end time.
///
/// The robot accepts it only for the present run and lease, with a `seq` above all accepted ones,
/// and with an end in the future, at most one second ahead. Any other command is counted and
/// ignored. Once the end of the last accepted command has passed, the target velocity is zero in
/// the next tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriveCommand {
    /// Run of the agent.
    pub boot: BootId,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number of the command within the lease.
    pub seq: u64,
    /// Time of sending on the robot's monotonic clock, as the sender estimates it, microseconds.
    /// The robot computes the age of the command from it and drives slower at a high age.
    pub sent_us: u64,
    /// End of the command on the robot's monotonic clock, microseconds.
    pub until_us: u64,
    /// Commanded velocity in the robot frame.
    pub twist: Twist,
}

/// External limit on the robot's `limit/{owner}` key, or by `cmd/limit`: holds or slows the robot
/// until an end time.
///
/// Of one owner, the limit with the highest `seq` applies until its end; microseconds of any clock
/// that never runs back are suitable for `seq`. An `until_us` in the past, such as 0, ends the
/// owner's limit at once. The robot is also on hold while an owner is silent that its configuration
/// lists as required.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExternalLimit {
    /// Owner of the limit; must equal the one in the key.
    pub owner: OwnerId,
    /// Run of the agent.
    pub boot: BootId,
    /// End of the limit on the robot's monotonic clock, microseconds, at most one hour ahead.
    pub until_us: u64,
    /// Sequence number of the limit; strictly increasing for each owner.
    pub seq: u64,
    /// Whether to hold the robot at rest.
    #[serde(default)]
    pub hold: bool,
    /// Maximum speed, m/s; unchanged when absent.
    #[serde(default)]
    pub linear_max_m_s: Option<f64>,
}

impl Command for Stop {
    const VERB: Verb = Verb::Stop;
    type Reply = Acknowledgement;
}

impl Command for ClearStop {
    const VERB: Verb = Verb::Clear;
    type Reply = Acknowledgement;
}

impl Command for AcquireLease {
    const VERB: Verb = Verb::Lease;
    type Reply = LeaseReply;
}

impl Command for ReleaseLease {
    const VERB: Verb = Verb::Lease;
    type Reply = Acknowledgement;
}

impl Command for ExternalLimit {
    const VERB: Verb = Verb::Limit;
    type Reply = Acknowledgement;
}

impl DriveCommand {
    /// Whether the end is in the future and at most [`DRIVE_AHEAD_MAX_US`] ahead of the robot's
    /// clock `now_us`.
    pub const fn is_in_time(&self, now_us: u64) -> bool {
        now_us < self.until_us && self.until_us - now_us <= DRIVE_AHEAD_MAX_US
    }
}

impl ExternalLimit {
    /// Checks the fields that do not depend on time.
    ///
    /// # Errors
    /// A message for people, if the speed is negative or not finite.
    pub fn validate(&self) -> Result<(), String> {
        match self.linear_max_m_s {
            Some(most_m_s) if !(most_m_s.is_finite() && most_m_s >= 0.0) => Err(format!(
                "linear_max_m_s must be finite and not negative, not {most_m_s}"
            )),
            Some(_) | None => Ok(()),
        }
    }

    /// Whether the end is more than [`LIMIT_AHEAD_MAX_US`] ahead of the robot's clock `now_us`.
    pub const fn is_too_long(&self, now_us: u64) -> bool {
        self.until_us.saturating_sub(now_us) > LIMIT_AHEAD_MAX_US
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire;

    #[test]
    fn a_drive_command_is_in_time_between_now_and_a_second() {
        let command = |until_us| DriveCommand {
            boot: BootId::from_uuid(Uuid::from_u128(1)),
            epoch: 1,
            seq: 1,
            sent_us: 0,
            until_us,
            twist: Twist::default(),
        };
        for (until_us, is_in_time) in [
            (0, false),
            (1_000, false),
            (1_001, true),
            (1_001_000, true),
            (1_001_001, false),
            (u64::MAX, false),
        ] {
            assert_eq!(
                command(until_us).is_in_time(1_000),
                is_in_time,
                "{until_us}"
            );
        }
    }

    #[test]
    fn a_drive_command_that_is_no_number_does_not_parse() {
        let good = r#"{"v":2,"body":{"boot":"00000000-0000-0000-0000-000000000001","epoch":2,
            "seq":3,"sent_us":4,"until_us":5,"twist":{"linear_m_s":0.5,"angular_rad_s":-0.1}}}"#;
        let command: DriveCommand = wire::decode(good.as_bytes()).unwrap();
        assert_eq!((command.epoch, command.seq), (2, 3));
        for bad in ["NaN", "1e999", "null", "\"0.5\"", "-Infinity"] {
            let text = good.replace("0.5", bad);
            assert!(
                wire::decode::<DriveCommand>(text.as_bytes()).is_err(),
                "{bad}"
            );
        }
    }
    #[test]
    fn a_lease_command_is_one_message_with_its_action() {
        let holder = Driver {
            client: Uuid::from_u128(2),
            name: "a driver".to_owned(),
        };
        let request = Uuid::from_u128(1);
        let acquire = |take| AcquireLease {
            request,
            holder: holder.clone(),
            take,
        };
        let release = ReleaseLease {
            request,
            holder: holder.clone(),
        };
        let text = |action: &str| {
            format!(
                r#"{{"v":2,"body":{{"request":"{request}","action":"{action}","holder":{{"client":"{}","name":"a driver"}}}}}}"#,
                holder.client
            )
        };
        for (written, read, action) in [
            (
                wire::encode(&acquire(false)),
                LeaseCommand::Acquire(acquire(false)),
                "acquire",
            ),
            (
                wire::encode(&acquire(true)),
                LeaseCommand::Acquire(acquire(true)),
                "take",
            ),
            (
                wire::encode(&release),
                LeaseCommand::Release(release.clone()),
                "release",
            ),
        ] {
            let written = written.unwrap();
            assert_eq!(String::from_utf8_lossy(&written), text(action));
            assert_eq!(wire::decode::<LeaseCommand>(&written).unwrap(), read);
        }
    }
}
