//! The part on theta.

use crate::report::{Options, Section};

/// Runs the part.
pub(crate) fn run(_options: &Options) -> Section {
    Section {
        text: String::new(),
        figures: serde_json::Value::Null,
        checks: Vec::new(),
    }
}
