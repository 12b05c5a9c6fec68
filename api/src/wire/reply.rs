//! Replies of a robot to commands: one type for each kind of command.
//!
//! [`Command`] binds a payload to its verb and to the type of its reply, so that only possible
//! replies are handled. On the wire an answer is `{"boot": …, "outcome": …}`; its outcome is
//! `"done"`, `{"accepted": {…}}`, `{"leased": {…}}`, `{"outcomes": {…}}` or `{"refused": {…}}`.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::ingest::MissionPhase;
use crate::ids::{BootId, MissionId, PlanHash};
use crate::keys::Verb;
use crate::mission::PlanSummary;

/// Command from the server to a robot.
pub trait Command: Serialize {
    /// Verb in the key of the command.
    const VERB: Verb;
    /// Type of the robot's reply.
    type Reply: Serialize + DeserializeOwned;
}

/// Answer of a robot to a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answer<R> {
    /// Run of the agent that answers.
    pub boot: BootId,
    /// Reply to the command.
    #[serde(rename = "outcome")]
    pub reply: R,
}

/// Reply to [`Offer`](super::command::Offer).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OfferReply {
    /// The robot has accepted the mission, now or already before.
    Accepted {
        /// Summary of the robot's plan; absent if the robot does not send one.
        plan: Option<PlanSummary>,
    },
    /// The robot refused the mission.
    Refused(CommandRefusal),
}

/// Reply to a request for the lease of teleoperation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LeaseReply {
    /// The robot granted the lease; it belongs to the run in the answer.
    Leased {
        /// Epoch of the lease.
        epoch: u64,
    },
    /// The robot refused the lease.
    Refused(CommandRefusal),
}

/// A mission that has ended on the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct EndedMission {
    /// The mission.
    pub mission: MissionId,
    /// The phase in which it ended.
    pub phase: MissionPhase,
}

/// A mission that the robot has accepted and that has not ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct AcceptedMission {
    /// The mission.
    pub mission: MissionId,
    /// Its revision.
    pub revision: u32,
    /// Hash of its plan.
    pub plan_hash: PlanHash,
}

/// What a robot remembers of missions.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissionOutcomes {
    /// Those of the missions asked for that have ended.
    pub ended: Vec<EndedMission>,
    /// The mission that it has accepted, also if it was not asked for.
    #[serde(default)]
    pub active: Option<AcceptedMission>,
    /// Newest mission that it has forgotten: of that one, and of older ones that are not in `ended`,
    /// it does not know whether they ended here. Absent while it has forgotten none.
    #[serde(default)]
    pub forgotten: Option<MissionId>,
}

/// Reply to [`Outcomes`](super::command::Outcomes).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutcomesReply {
    /// What the robot remembers.
    Outcomes(MissionOutcomes),
    /// The robot refused to say.
    Refused(CommandRefusal),
}

impl From<Result<MissionOutcomes, CommandRefusal>> for OutcomesReply {
    fn from(decided: Result<MissionOutcomes, CommandRefusal>) -> Self {
        match decided {
            Ok(outcomes) => Self::Outcomes(outcomes),
            Err(refusal) => Self::Refused(refusal),
        }
    }
}

/// Reply to every other command.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Acknowledgement {
    /// The command has taken effect, now or already before.
    Done,
    /// The robot refused the command.
    Refused(CommandRefusal),
}

/// Reason why a robot refuses a command.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandRefusal {
    /// Reason, for programs.
    pub code: CommandRefusalCode,
    /// Reason, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub detail: String,
}

/// Reason why a robot refuses a command, for programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CommandRefusalCode {
    /// Another mission is active.
    Busy,
    /// The command contradicts another one: the mission was offered with this revision and other
    /// content, a newer stop or limit is in force, or the limit is for another run of the agent.
    Conflict,
    /// The mission, the lease or the stop has already ended on the robot.
    Ended,
    /// The robot cannot drive the trajectory, or a limit is out of range.
    Impossible,
    /// The robot is not ready to drive.
    NotReady,
    /// The latest start has passed.
    TooLate,
    /// The robot does not know the mission, lease or stop that the command names.
    Unknown,
    /// Another driver has the lease; `detail` names the driver.
    Leased,
    /// A stop is in force.
    Stopped,
    /// The robot is not at rest.
    Moving,
    /// The robot has the maximum number of them already.
    TooMany,
    /// Code that this version does not know, from a newer peer.
    #[serde(other)]
    Other,
}

impl CommandRefusal {
    /// Creates a refusal with a sentence for people.
    pub fn new(code: CommandRefusalCode, detail: impl Into<String>) -> Self {
        let detail = detail.into();
        Self { code, detail }
    }

    /// Whether the same command may succeed later, when the state of the robot has changed.
    pub const fn is_transient(&self) -> bool {
        match self.code {
            CommandRefusalCode::Busy
            | CommandRefusalCode::NotReady
            | CommandRefusalCode::Leased
            | CommandRefusalCode::Stopped
            | CommandRefusalCode::Moving => true,
            CommandRefusalCode::Conflict
            | CommandRefusalCode::Ended
            | CommandRefusalCode::Impossible
            | CommandRefusalCode::TooLate
            | CommandRefusalCode::Unknown
            | CommandRefusalCode::TooMany
            | CommandRefusalCode::Other => false,
        }
    }
}

impl OfferReply {
    /// Returns the plan; `None` if the robot did not send one.
    ///
    /// # Errors
    /// The refusal of the robot.
    pub fn into_result(self) -> Result<Option<PlanSummary>, CommandRefusal> {
        match self {
            Self::Accepted { plan } => Ok(plan),
            Self::Refused(refusal) => Err(refusal),
        }
    }
}

impl From<Result<PlanSummary, CommandRefusal>> for OfferReply {
    fn from(decided: Result<PlanSummary, CommandRefusal>) -> Self {
        match decided {
            Ok(plan) => Self::Accepted { plan: Some(plan) },
            Err(refusal) => Self::Refused(refusal),
        }
    }
}

impl LeaseReply {
    /// Returns the epoch of the lease.
    ///
    /// # Errors
    /// The refusal of the robot.
    pub fn into_result(self) -> Result<u64, CommandRefusal> {
        match self {
            Self::Leased { epoch } => Ok(epoch),
            Self::Refused(refusal) => Err(refusal),
        }
    }
}

impl From<Result<u64, CommandRefusal>> for LeaseReply {
    fn from(decided: Result<u64, CommandRefusal>) -> Self {
        match decided {
            Ok(epoch) => Self::Leased { epoch },
            Err(refusal) => Self::Refused(refusal),
        }
    }
}

impl Acknowledgement {
    /// Converts the acknowledgement to a result.
    ///
    /// # Errors
    /// The refusal of the robot.
    pub fn into_result(self) -> Result<(), CommandRefusal> {
        match self {
            Self::Done => Ok(()),
            Self::Refused(refusal) => Err(refusal),
        }
    }
}

impl From<Result<(), CommandRefusal>> for Acknowledgement {
    fn from(decided: Result<(), CommandRefusal>) -> Self {
        match decided {
            Ok(()) => Self::Done,
            Err(refusal) => Self::Refused(refusal),
        }
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::wire;

    const BOOT: &str = "00000000-0000-0000-0000-000000000001";

    fn says<R>(reply: R, outcome: &str)
    where
        R: Serialize + DeserializeOwned + PartialEq + std::fmt::Debug,
    {
        let boot = BootId::from_uuid(Uuid::from_u128(1));
        let answer = Answer { boot, reply };
        let text = format!(r#"{{"v":2,"body":{{"boot":"{BOOT}","outcome":{outcome}}}}}"#);
        let payload = wire::encode(&answer).unwrap();
        assert_eq!(String::from_utf8(payload).unwrap(), text);
        assert_eq!(wire::decode::<Answer<R>>(text.as_bytes()).unwrap(), answer);
    }

    #[test]
    fn replies_are_written_as_agents_of_all_releases_write_them() {
        let refusal = CommandRefusal::new(CommandRefusalCode::NotReady, "not yet");
        let refused = r#"{"refused":{"code":"not_ready","detail":"not yet"}}"#;
        let plan = PlanSummary {
            length_m: 3.0,
            duration_s: 4.5,
            speed_peak_m_s: 0.75,
            begin: None,
        };
        says(
            OfferReply::from(Ok(plan)),
            r#"{"accepted":{"plan":{"length_m":3.0,"duration_s":4.5,"speed_peak_m_s":0.75}}}"#,
        );
        says(
            OfferReply::Accepted { plan: None },
            r#"{"accepted":{"plan":null}}"#,
        );
        says(OfferReply::from(Err(refusal.clone())), refused);
        says(LeaseReply::from(Ok(7)), r#"{"leased":{"epoch":7}}"#);
        says(LeaseReply::from(Err(refusal.clone())), refused);
        says(
            OutcomesReply::from(Ok(MissionOutcomes {
                ended: vec![EndedMission {
                    mission: MissionId::from_uuid(Uuid::from_u128(1)),
                    phase: MissionPhase::Succeeded,
                }],
                active: None,
                forgotten: None,
            })),
            &format!(
                r#"{{"outcomes":{{"ended":[{{"mission":"{BOOT}","phase":"succeeded"}}],"active":null,"forgotten":null}}}}"#
            ),
        );
        says(OutcomesReply::from(Err(refusal.clone())), refused);
        says(Acknowledgement::from(Ok(())), r#""done""#);
        says(Acknowledgement::from(Err(refusal)), refused);
    }

    #[test]
    fn a_reply_to_another_verb_does_not_read() {
        let done = format!(r#"{{"v":2,"body":{{"boot":"{BOOT}","outcome":"done"}}}}"#);
        assert!(wire::decode::<Answer<OfferReply>>(done.as_bytes()).is_err());
        assert!(wire::decode::<Answer<LeaseReply>>(done.as_bytes()).is_err());
        assert!(wire::decode::<Answer<Acknowledgement>>(done.as_bytes()).is_ok());
    }

    #[test]
    fn a_code_of_a_newer_peer_is_read_and_is_not_transient() {
        let text = r#"{"refused":{"code":"on_strike","detail":"no"}}"#;
        let reply: Acknowledgement = serde_json::from_str(text).unwrap();
        let refusal = reply.into_result().unwrap_err();
        assert_eq!(refusal.code, CommandRefusalCode::Other);
        assert!(!refusal.is_transient());
    }
}
