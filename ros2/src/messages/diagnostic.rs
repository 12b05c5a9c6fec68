//! `diagnostic_msgs`.

use super::common::Header;
use super::{message, record};
use crate::cdr::Sequence;

/// How bad something is; the constants of `DiagnosticStatus`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Level {
    /// It works.
    Ok = 0,
    /// It works, and somebody should look.
    Warn = 1,
    /// It does not work.
    Error = 2,
    /// Nothing was heard of it for too long.
    Stale = 3,
}

record! {
    /// A figure of a part, in words.
    KeyValue<'a> {
        /// What.
        key: &'a str,
        /// How much.
        value: &'a str,
    }
}

record! {
    /// How a part is.
    DiagnosticStatus<'a> {
        /// See [`Level`].
        level: u8,
        /// The part.
        name: &'a str,
        /// In words.
        message: &'a str,
        /// On which machine.
        hardware_id: &'a str,
        /// In figures.
        values: Sequence<'a, KeyValue<'a>>,
    }
}

record! {
    /// How parts are.
    DiagnosticArray<'a> {
        /// When.
        header: Header<'a>,
        /// Each.
        status: Sequence<'a, DiagnosticStatus<'a>>,
    }
}
message!(
    DiagnosticArray<'a>,
    "diagnostic_msgs",
    "DiagnosticArray",
    "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
);
