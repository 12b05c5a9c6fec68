//! zenoh payloads: versioned JSON, readable by any zenoh client, or CBOR of the same types where both
//! sides know it ([`encoding`]).
//!
//! Every payload is `{"v": 2, "body": {…}}`. `v` is the major version; a payload of another major
//! version is refused. Unknown fields are ignored, so that a newer peer may add fields.

pub mod command;
pub mod encoding;
pub mod hello;
pub mod ingest;
pub mod reply;
pub mod safety;
pub mod state;
pub mod trace;

use self::encoding::{CodecError, Encoding};
use self::trace::TraceParent;
use serde::de::{DeserializeOwned, IgnoredAny};
use serde::{Deserialize, Serialize};

/// Major version of all payloads.
pub const VERSION: u32 = 2;
/// Maximum size of a payload that is read, bytes; sufficient for a path with the maximum number of
/// waypoints.
pub const PAYLOAD_BYTES_MAX: usize = 16 * 1024 * 1024;
/// Lease of the zenoh session between robot and server, milliseconds: after this silence either side takes the
/// other for gone. TCP repeats what was lost after ever longer pauses; a new connection is there sooner.
pub const SESSION_LEASE_MS: u32 = 3_000;
/// Largest batch that zenoh hands to the kernel at once, bytes. Priorities act only above it.
pub const BATCH_BYTES: u16 = 8 * 1024;

/// Reason why a payload is refused.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// The payload is larger than [`PAYLOAD_BYTES_MAX`]; contains its size, bytes.
    #[error("a payload of {0} bytes is over the limit of {PAYLOAD_BYTES_MAX}")]
    TooLarge(usize),
    /// The payload is of another major version.
    #[error(
        "the other side speaks major version {0} and this side {VERSION}: update the older one"
    )]
    Version(u32),
    /// The payload does not parse.
    #[error("the payload does not parse")]
    Malformed(#[source] CodecError),
}

#[derive(Serialize)]
struct Outgoing<'body, T> {
    v: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    traceparent: Option<TraceParent>,
    body: &'body T,
}

#[derive(Deserialize)]
struct Incoming<T> {
    v: u32,
    body: T,
}

/// Of a payload, only its version.
#[derive(Deserialize)]
struct Versioned {
    v: u32,
}

/// Encodes a payload.
///
/// # Errors
/// The value cannot be represented in JSON, such as a map whose keys are not strings. A non-finite
/// number is not an error: it becomes `null`, which the reader refuses.
pub fn encode<T: Serialize>(body: &T) -> Result<Vec<u8>, serde_json::Error> {
    encode_traced(body, None)
}

/// Encodes a payload in an encoding that the reader knows.
///
/// # Errors
/// As [`encode`].
pub fn encode_as<T: Serialize>(encoding: Encoding, body: &T) -> Result<Vec<u8>, CodecError> {
    encoding.write(&Outgoing {
        v: VERSION,
        traceparent: None,
        body,
    })
}

/// Encodes a payload with a trace context beside its body, which older peers ignore.
///
/// # Errors
/// As [`encode`].
pub fn encode_traced<T: Serialize>(
    body: &T,
    traceparent: Option<TraceParent>,
) -> Result<Vec<u8>, serde_json::Error> {
    serde_json::to_vec(&Outgoing {
        v: VERSION,
        traceparent,
        body,
    })
}

/// Returns the trace context of a payload; `None` if it has none, or one that cannot be read. The
/// payload itself is refused by [`decode`] if it is not valid.
pub fn traceparent(payload: &[u8]) -> Option<TraceParent> {
    #[derive(Deserialize)]
    struct Traced {
        traceparent: TraceParent,
    }
    if payload.len() > PAYLOAD_BYTES_MAX {
        return None;
    }
    let traced: Traced = serde_json::from_slice(payload).ok()?;
    Some(traced.traceparent)
}

/// Decodes a JSON payload.
///
/// # Errors
/// [`WireError`] if it is too large, of another major version, or does not parse as `T`.
pub fn decode<T: DeserializeOwned>(payload: &[u8]) -> Result<T, WireError> {
    decode_as(Encoding::Json, payload)
}

/// Checks the version of a JSON payload, whose body may be anything.
///
/// # Errors
/// [`WireError`] if it is too large, of another major version, or no envelope.
pub fn check_version(payload: &[u8]) -> Result<(), WireError> {
    decode::<IgnoredAny>(payload).map(|_body| ())
}

/// Decodes a payload in one pass.
///
/// # Errors
/// As [`decode`].
pub fn decode_as<T: DeserializeOwned>(encoding: Encoding, payload: &[u8]) -> Result<T, WireError> {
    if payload.len() > PAYLOAD_BYTES_MAX {
        return Err(WireError::TooLarge(payload.len()));
    }
    match encoding.read::<Incoming<T>>(payload) {
        Ok(incoming) if incoming.v == VERSION => Ok(incoming.body),
        Ok(incoming) => Err(WireError::Version(incoming.v)),
        // A body of another version need not parse.
        Err(cause) => match encoding.read::<Versioned>(payload) {
            Ok(Versioned { v }) if v != VERSION => Err(WireError::Version(v)),
            _ => Err(WireError::Malformed(cause)),
        },
    }
}

/// Reason why a peer refused a query; the body of every error reply.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// Reason, for programs.
    pub code: RefusalCode,
    /// Reason, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub detail: String,
}

/// Reason why a query was refused, for programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RefusalCode {
    /// The payload does not parse or is too large.
    Malformed,
    /// The payload is of another major version.
    Version,
    /// The payload names a robot other than the key.
    Impersonation,
    /// The site does not exist.
    UnknownSite,
    /// The server is busy; try again later.
    Busy,
    /// Code that this version does not know, from a newer peer.
    #[serde(other)]
    Other,
}

impl From<&WireError> for Refusal {
    fn from(error: &WireError) -> Self {
        let code = match error {
            WireError::TooLarge(_) | WireError::Malformed(_) => RefusalCode::Malformed,
            WireError::Version(_) => RefusalCode::Version,
        };
        // The position of the parse error helps the developer of the peer.
        let cause = std::error::Error::source(error).map(|cause| format!(": {cause}"));
        Self {
            code,
            detail: format!("{error}{}", cause.unwrap_or_default()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Body {
        x: f64,
    }

    #[test]
    fn a_payload_comes_back_as_it_was_written() {
        let payload = encode(&Body { x: 0.1 }).unwrap();
        assert_eq!(payload, br#"{"v":2,"body":{"x":0.1}}"#);
        assert_eq!(decode::<Body>(&payload).unwrap(), Body { x: 0.1 });
    }

    #[test]
    fn a_trace_context_stands_beside_the_body_and_a_wrong_one_counts_as_none() {
        let mission = "0192f0c1-2b3c-7d4e-8f50-617283940a1b".parse().unwrap();
        let parent = TraceParent::of_mission(mission);
        let payload = encode_traced(&Body { x: 0.1 }, Some(parent)).unwrap();
        assert_eq!(traceparent(&payload), Some(parent));
        assert_eq!(decode::<Body>(&payload).unwrap(), Body { x: 0.1 });
        for text in [
            r#"{"v":2,"body":{"x":0.1}}"#,
            r#"{"v":2,"traceparent":"nonsense","body":{"x":0.1}}"#,
            r#"{"v":2,"traceparent":7,"body":{"x":0.1}}"#,
        ] {
            assert_eq!(traceparent(text.as_bytes()), None, "{text}");
            assert!(decode::<Body>(text.as_bytes()).is_ok(), "{text}");
        }
    }

    #[test]
    fn fields_of_a_newer_minor_version_are_ignored() {
        let payload = br#"{"v":2,"trace":"t","body":{"x":0.5,"y":[1,{}]}}"#;
        assert_eq!(decode::<Body>(payload).unwrap(), Body { x: 0.5 });
    }

    #[test]
    fn another_major_version_is_refused_by_its_number() {
        let refused = decode::<Body>(br#"{"v":1,"body":{"z":1}}"#).unwrap_err();
        assert!(matches!(refused, WireError::Version(1)));
        assert!(check_version(br#"{"v":2,"body":[]}"#).is_ok());
        let other = check_version(br#"{"v":3,"content":1}"#);
        assert!(matches!(other, Err(WireError::Version(3))));
        assert!(matches!(check_version(b""), Err(WireError::Malformed(_))));
        assert_eq!(Refusal::from(&refused).code, RefusalCode::Version);
    }

    #[test]
    fn numbers_that_are_not_finite_do_not_pass() {
        let payload = encode(&Body { x: f64::NAN }).unwrap();
        assert!(matches!(
            decode::<Body>(&payload),
            Err(WireError::Malformed(_))
        ));
        for text in ["NaN", "1e999", "-Infinity"] {
            let payload = format!(r#"{{"v":2,"body":{{"x":{text}}}}}"#);
            assert!(decode::<Body>(payload.as_bytes()).is_err(), "{text}");
        }
    }

    #[test]
    fn garbage_is_refused() {
        for payload in [
            &b""[..],
            b"\xff\xfe",
            b"[]",
            b"{\"v\":1}",
            b"{\"v\":-1,\"body\":{}}",
        ] {
            assert!(decode::<Body>(payload).is_err());
        }
    }
}
