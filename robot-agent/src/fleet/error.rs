//! Why the link could not be made, and why a question went without an answer.

use tread_api::wire::{self, Refusal, RefusalCode, WireError};

/// Why the link could not be made.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// An endpoint is none.
    #[error("`{endpoint}` is no zenoh endpoint: {problem}")]
    Endpoint {
        /// What was given.
        endpoint: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The robot's certificate, its key or the fleet's authority cannot be used.
    #[error("the robot's certificate cannot be used; join the fleet again")]
    Certificate(#[source] rustls::Error),
    /// The machine gives no port on the loopback.
    #[error("the tunnel's local port cannot be opened")]
    LocalPort(#[source] std::io::Error),
    /// zenoh refused.
    #[error("zenoh could not {action}: {problem}")]
    Zenoh {
        /// What was tried.
        action: &'static str,
        /// What zenoh said.
        problem: String,
    },
}

pub(crate) fn zenoh_failed(action: &'static str) -> impl FnOnce(zenoh::Error) -> LinkError {
    move |problem| LinkError::Zenoh {
        action,
        problem: problem.to_string(),
    }
}

/// Why a question to the server went without an answer.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// Nobody answered: the server is not there, or too slow.
    #[error("the server did not answer")]
    NoAnswer,
    /// The server refused the whole message.
    #[error("the server refused: {0:?}")]
    Refused(Refusal),
    /// The answer cannot be read.
    #[error("the server's answer cannot be read")]
    Unreadable(#[source] WireError),
    /// The question cannot be written.
    #[error("the message cannot be written as JSON")]
    Unwritable(#[source] serde_json::Error),
    /// zenoh refused.
    #[error(transparent)]
    Link(#[from] LinkError),
}

impl AskError {
    /// Reads the payload of an error reply.
    pub(super) fn of_reply(payload: &[u8]) -> Self {
        match wire::decode::<Refusal>(payload) {
            Ok(refusal) => Self::Refused(refusal),
            Err(other @ WireError::Version(_)) => Self::Unreadable(other),
            // zenoh itself reports a timeout as an error reply of its own.
            Err(WireError::TooLarge(_) | WireError::Malformed(_)) => Self::NoAnswer,
        }
    }
}

/// Whether sending the same again to the same server may help.
pub fn may_pass_later(error: &AskError) -> bool {
    match error {
        AskError::Refused(refusal) => refusal.code != RefusalCode::Malformed,
        AskError::NoAnswer
        | AskError::Unreadable(_)
        | AskError::Unwritable(_)
        | AskError::Link(_) => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_refusal_of_an_older_server_names_both_versions() {
        let reply = br#"{"v":1,"body":{"code":"version","detail":"major version 2 is not known"}}"#;
        let AskError::Unreadable(cause) = AskError::of_reply(reply) else {
            panic!("it was read");
        };
        assert_eq!(
            cause.to_string(),
            "the other side speaks major version 1 and this side 2: update the older one"
        );
        assert!(matches!(AskError::of_reply(b"Timeout"), AskError::NoAnswer));
    }
}
