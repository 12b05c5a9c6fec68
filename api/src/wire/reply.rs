//! A robot's replies to commands: one type for each kind of command.
//!
//! [`Command`] binds a payload to its verb and to the reply that the verb gets, so that nobody
//! handles a reply that cannot come. On the wire an answer is `{"boot": …, "outcome": …}`, with
//! `"done"`, `{"accepted": {…}}`, `{"leased": {…}}` or `{"refused": {…}}` as its outcome.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::ids::BootId;
use crate::keys::Verb;
use crate::mission::PlanSummary;

/// What the server asks of a robot.
pub trait Command: Serialize {
    /// The verb in its key.
    const VERB: Verb;
    /// What the robot replies.
    type Reply: Serialize + DeserializeOwned;
}

/// A robot's answer to a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answer<R> {
    /// The run of the agent that answers.
    pub boot: BootId,
    /// What it replies.
    #[serde(rename = "outcome")]
    pub reply: R,
}

/// The reply to an offer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OfferReply {
    /// The mission is taken, now or already before.
    Accepted {
        /// What the robot planned; absent when it does not say.
        plan: Option<PlanSummary>,
    },
    /// The robot will not.
    Refused(CommandRefusal),
}

/// The reply to a request for the lease of teleoperation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LeaseReply {
    /// The lease is given; the run that gave it is that of the answer.
    Leased {
        /// The lease.
        epoch: u64,
    },
    /// The robot will not.
    Refused(CommandRefusal),
}

/// The reply to every other command.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Acknowledgement {
    /// The command has taken effect, now or already before.
    Done,
    /// The robot will not.
    Refused(CommandRefusal),
}

/// Why a robot does not do what a command asks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandRefusal {
    /// For programs.
    pub code: CommandRefusalCode,
    /// For people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub detail: String,
}

/// Why a robot refuses a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CommandRefusalCode {
    /// Another mission is being driven.
    Busy,
    /// The same mission and revision were offered with other content.
    Conflict,
    /// The mission, the lease or the stop has ended here before.
    Ended,
    /// The trajectory cannot be driven by this robot.
    Impossible,
    /// The robot is in no state to drive.
    NotReady,
    /// The latest start has passed.
    TooLate,
    /// The mission, or whatever the command names, is not known here.
    Unknown,
    /// Somebody else teleoperates the robot; the detail names who.
    Leased,
    /// A stop is in force.
    Stopped,
    /// The robot does not stand.
    Moving,
    /// There are too many of these.
    TooMany,
    /// Any code of a newer peer.
    #[serde(other)]
    Other,
}

impl CommandRefusal {
    /// A refusal with a sentence for people.
    pub fn new(code: CommandRefusalCode, detail: impl Into<String>) -> Self {
        let detail = detail.into();
        Self { code, detail }
    }

    /// Whether the same command may succeed later, when the robot is in another state.
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
    /// The plan, if the robot says one.
    ///
    /// # Errors
    /// The refusal.
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
    /// The epoch of the lease.
    ///
    /// # Errors
    /// The refusal.
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
    /// Nothing to say but that it is done.
    ///
    /// # Errors
    /// The refusal.
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
