//! Stops, leases, drive commands and external limits on zenoh.
//!
//! End times are on the robot's own monotonic clock (`monotonic_us` of its state), with the run of
//! the agent that they belong to: another run refuses them. Whoever writes one estimates that
//! clock from the state that had the shortest way. The estimate lags by that way, so an end comes
//! too early, never too late.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::reply::{Acknowledgement, Command, LeaseReply};
use crate::geometry::Twist;
use crate::ids::{BootId, OwnerId, StopId};
use crate::keys::Verb;
use crate::safety::{DRIVE_AHEAD_MAX_US, Driver, LIMIT_AHEAD_MAX_US};

/// `cmd/stop`: command zero, latch, and answer `done` once the latch is on the disk.
///
/// Works in every state and needs no lease. The same twice is one stop.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stop {
    /// The stop.
    pub stop: StopId,
    /// Who stops, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::stop::STOP_TEXT_MAX}>")]
    pub by: String,
    /// Why, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub reason: String,
    /// When it was asked for, by the sender's clock.
    pub at: Timestamp,
}

/// `cmd/clear`: end the stop that is in force, if it is this one and the robot stands.
///
/// `done` also when this stop was cleared before; refused as `conflict` when a newer stop is in
/// force, as `moving` while the robot moves. Nothing starts by itself afterwards.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClearStop {
    /// The newest stop that its sender knows of.
    pub stop: StopId,
    /// Who clears, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::stop::STOP_TEXT_MAX}>")]
    pub by: String,
}

/// `cmd/lease`: acquire the lease of teleoperation, or take it from whoever has it.
///
/// A refusal as `leased` has a detail that names who has it. A lease holds the active mission: it
/// stays paused until it is resumed by request.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(into = "LeaseMessage")]
pub struct AcquireLease {
    /// Makes the command idempotent: the same request again gets the same answer and changes
    /// nothing.
    pub request: Uuid,
    /// Who wants it; whoever has it gets it again.
    pub holder: Driver,
    /// Whether to have it also if somebody else does now.
    pub take: bool,
}

/// `cmd/lease`: give the lease of teleoperation back. It is `done` also when nobody has it.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(into = "LeaseMessage")]
pub struct ReleaseLease {
    /// Makes the command idempotent.
    pub request: Uuid,
    /// Whose lease it is.
    pub holder: Driver,
}

/// What comes on `cmd/lease`, for whoever answers it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "LeaseMessage", into = "LeaseMessage")]
pub enum LeaseCommand {
    /// Answered by a [`LeaseReply`].
    Acquire(AcquireLease),
    /// Answered by an [`Acknowledgement`].
    Release(ReleaseLease),
}

/// What is wanted with a lease.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum LeaseAction {
    Acquire,
    Take,
    Release,
}

/// A lease command as it is on the wire.
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

/// On the robot's `teleop` key: drive like this until then.
///
/// Taken only with the present run and lease, a number above all before, and an end in the future
/// that is no more than a second away. Anything else changes nothing and is counted. Once the last
/// end has passed, the target is zero in the next tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriveCommand {
    /// The run of the agent.
    pub boot: BootId,
    /// The lease.
    pub epoch: u64,
    /// Counts the commands of this lease.
    pub seq: u64,
    /// The robot's clock when it was sent, as the sender estimates it, microseconds. The robot
    /// measures its age by it and slows down when that is high.
    pub sent_us: u64,
    /// The robot's clock at which it ends, microseconds.
    pub until_us: u64,
    /// What is wanted.
    pub twist: Twist,
}

/// On the robot's `limit/{owner}` key, or by `cmd/limit`: hold or slow down until then.
///
/// The highest `seq` of an owner counts while it lasts (microseconds of any clock that never falls
/// do well). `until_us` in the past, such as 0, ends the owner's limit at once. An owner that
/// the robot's configuration calls required holds the robot by its silence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExternalLimit {
    /// Who limits; the same as in the key.
    pub owner: OwnerId,
    /// The run of the agent.
    pub boot: BootId,
    /// The robot's clock at which it ends, microseconds, at most an hour ahead.
    pub until_us: u64,
    /// Orders the limits of this owner.
    pub seq: u64,
    /// Whether the robot is to stand.
    #[serde(default)]
    pub hold: bool,
    /// Fastest speed, m/s; as before when absent.
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
    /// Whether its end lies ahead and not too far, at the robot's clock `now_us`.
    pub const fn is_in_time(&self, now_us: u64) -> bool {
        now_us < self.until_us && self.until_us - now_us <= DRIVE_AHEAD_MAX_US
    }
}

impl ExternalLimit {
    /// Checks what does not depend on time.
    ///
    /// # Errors
    /// A sentence, if the speed is negative or no number.
    pub fn validate(&self) -> Result<(), String> {
        match self.linear_max_m_s {
            Some(most_m_s) if !(most_m_s.is_finite() && most_m_s >= 0.0) => Err(format!(
                "linear_max_m_s must be finite and not negative, not {most_m_s}"
            )),
            Some(_) | None => Ok(()),
        }
    }

    /// Whether its end is too far ahead, at the robot's clock `now_us`.
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
