//! Errors of the link and of queries to the server.

use tread_api::wire::encoding::CodecError;
use tread_api::wire::{self, Refusal, RefusalCode, WireError};

/// Why the link could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The endpoint is invalid.
    #[error("`{endpoint}` is no zenoh endpoint: {problem}")]
    Endpoint {
        /// The text given as the endpoint.
        endpoint: String,
        /// The problem with it.
        problem: String,
    },
    /// The robot's certificate, its key or the fleet's authority cannot be used.
    #[error("the robot's certificate cannot be used; join the fleet again")]
    Certificate(#[source] rustls::Error),
    /// No port on the loopback interface can be opened.
    #[error("the tunnel's local port cannot be opened")]
    LocalPort(#[source] std::io::Error),
    /// A call of zenoh failed.
    #[error("zenoh could not {action}: {problem}")]
    Zenoh {
        /// The action that failed.
        action: &'static str,
        /// The error message of zenoh.
        problem: String,
    },
}

pub(crate) fn zenoh_failed(action: &'static str) -> impl FnOnce(zenoh::Error) -> LinkError {
    move |problem| LinkError::Zenoh {
        action,
        problem: problem.to_string(),
    }
}

/// Why a query to the server has no usable answer.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// No answer in time: the server is unreachable or too slow.
    #[error("the server did not answer")]
    NoAnswer,
    /// The server refused the whole message.
    #[error("the server refused: {0:?}")]
    Refused(Refusal),
    /// The answer cannot be read.
    #[error("the server's answer cannot be read")]
    Unreadable(#[source] WireError),
    /// The query cannot be encoded.
    #[error("the message cannot be encoded")]
    Unwritable(#[source] CodecError),
    /// A call of zenoh failed.
    #[error(transparent)]
    Link(#[from] LinkError),
}

impl AskError {
    /// Reads the payload of an error reply.
    pub(super) fn of_reply(payload: &[u8]) -> Self {
        match wire::decode::<Refusal>(payload) {
            Ok(refusal) => Self::Refused(refusal),
            Err(other @ WireError::Version(_)) => Self::Unreadable(other),
            // zenoh itself reports a timeout as an error reply.
            Err(WireError::TooLarge(_) | WireError::Malformed(_)) => Self::NoAnswer,
        }
    }
}

/// Whether repeating the same query may succeed.
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
