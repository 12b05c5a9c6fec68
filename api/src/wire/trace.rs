//! Trace context of a message: `traceparent` of the W3C recommendation Trace Context, level 1.
//!
//! The trace of a mission has the mission's identifier as its own, and the identifier of the root
//! span follows from it. So server and agents, after any restart, add to the same trace without
//! keeping anything.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use uuid::Uuid;

use crate::ids::{DERIVED_NAMESPACE, MissionId};

/// Trace and parent span of what follows a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct TraceParent {
    /// Identifier of the trace, not 0.
    pub trace_id: u128,
    /// Identifier of the parent span, not 0.
    pub span_id: u64,
}

/// The text is not a `traceparent`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "a traceparent is `00-`, 32 hex digits, `-`, 16 hex digits and `-01`, none of them all zero"
)]
pub struct InvalidTraceParent;

impl TraceParent {
    /// Returns the trace of a mission, with its root span.
    pub fn of_mission(mission: MissionId) -> Self {
        let id = mission.as_uuid();
        let derived = Uuid::new_v5(&DERIVED_NAMESPACE, id.as_bytes());
        Self {
            trace_id: id.as_u128(),
            // An identifier of version 5 is never zero.
            span_id: derived.as_u64_pair().0,
        }
    }

    /// Returns the same trace with another span.
    #[must_use]
    pub fn with_span(self, span_id: u64) -> Self {
        Self { span_id, ..self }
    }
}

impl fmt::Display for TraceParent {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            formatter,
            "00-{:032x}-{:016x}-01",
            self.trace_id, self.span_id
        )
    }
}

impl FromStr for TraceParent {
    type Err = InvalidTraceParent;

    fn from_str(text: &str) -> Result<Self, InvalidTraceParent> {
        let parts: Vec<&str> = text.split('-').collect();
        let [version, trace, span, _flags, ..] = parts[..] else {
            return Err(InvalidTraceParent);
        };
        let is_hex = |part: &str, length: usize| {
            part.len() == length
                && part
                    .bytes()
                    .all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
        };
        // Later versions begin in the same way; `ff` is none.
        let is_known =
            is_hex(version, 2) && version != "ff" && (version != "00" || parts.len() == 4);
        if !is_known || !is_hex(trace, 32) || !is_hex(span, 16) {
            return Err(InvalidTraceParent);
        }
        let trace_id = u128::from_str_radix(trace, 16).map_err(|_| InvalidTraceParent)?;
        let span_id = u64::from_str_radix(span, 16).map_err(|_| InvalidTraceParent)?;
        if trace_id == 0 || span_id == 0 {
            return Err(InvalidTraceParent);
        }
        Ok(Self { trace_id, span_id })
    }
}

impl TryFrom<String> for TraceParent {
    type Error = InvalidTraceParent;

    fn try_from(text: String) -> Result<Self, InvalidTraceParent> {
        text.parse()
    }
}

impl From<TraceParent> for String {
    fn from(parent: TraceParent) -> Self {
        parent.to_string()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_trace_context_comes_back_from_its_text(trace_id in 1..u128::MAX, span_id in 1..u64::MAX) {
            let parent = TraceParent { trace_id, span_id };
            prop_assert_eq!(parent.to_string().parse(), Ok(parent));
        }

        #[test]
        fn any_text_is_read_or_refused(text in "[0-9a-f-]{0,60}") {
            if let Ok(read) = text.parse::<TraceParent>() {
                prop_assert!(read.trace_id != 0 && read.span_id != 0);
            }
        }
    }

    #[test]
    fn the_examples_of_the_recommendation_are_read_and_what_it_forbids_is_not() {
        let known = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
        let read: TraceParent = known.parse().unwrap();
        assert_eq!(read.to_string(), known);
        assert!(known.replace("-01", "-00").parse::<TraceParent>().is_ok());
        assert!(known.replacen("00", "01", 1).parse::<TraceParent>().is_ok());
        for wrong in [
            "",
            "00",
            "ff-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
            "00-00000000000000000000000000000000-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-0000000000000000-01",
            "00-4BF92F3577B34DA6A3CE929D0E0E4736-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e473-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01-more",
        ] {
            assert_eq!(
                wrong.parse::<TraceParent>(),
                Err(InvalidTraceParent),
                "{wrong}"
            );
        }
    }

    #[test]
    fn the_trace_of_a_mission_is_the_same_each_time() {
        let mission: MissionId = "0192f0c1-2b3c-7d4e-8f50-617283940a1b".parse().unwrap();
        let parent = TraceParent::of_mission(mission);
        assert_eq!(parent, TraceParent::of_mission(mission));
        assert!(
            parent
                .to_string()
                .starts_with("00-0192f0c12b3c7d4e8f50617283940a1b-")
        );
    }
}
