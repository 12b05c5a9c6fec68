//! Values as they are stored: times as integers, and lists as JSON text.

use std::collections::BTreeSet;
use std::fmt::Display;
use std::str::FromStr;

use jiff::Timestamp;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tread_api::ids::RobotId;
use tread_api::rights::Scope;

use super::EngineError;

/// Converts a time to microseconds since 1970, as stored.
pub(super) fn to_us(time: Timestamp) -> i64 {
    time.as_microsecond()
}

pub(super) fn from_us(time_us: i64) -> Result<Timestamp, EngineError> {
    Timestamp::from_microsecond(time_us).map_err(|_range| corrupt("time", time_us))
}

pub(super) fn corrupt(what: &'static str, value: impl Display) -> EngineError {
    EngineError::Corrupt {
        what,
        value: value.to_string(),
    }
}

pub(super) fn parse<T: FromStr>(what: &'static str, text: &str) -> Result<T, EngineError> {
    text.parse().map_err(|_error| corrupt(what, text))
}

pub(super) fn to_json<T: Serialize>(what: &'static str, value: &T) -> Result<String, EngineError> {
    serde_json::to_string(value).map_err(|_error| EngineError::DoesNotFit(what))
}

pub(super) fn from_json<T: DeserializeOwned>(
    what: &'static str,
    text: &str,
) -> Result<T, EngineError> {
    serde_json::from_str(text).map_err(|_error| corrupt(what, text))
}

/// Converts a scope to the parameter of statements: `NULL` for everywhere.
pub(super) fn scope_text(scope: &Scope) -> Result<Option<String>, EngineError> {
    let names = scope.names();
    names.map(|names| to_json("scope", &names)).transpose()
}

/// Converts a list of robots to the parameter of statements: `NULL` for all.
pub(super) fn robots_text(
    robots: Option<&BTreeSet<RobotId>>,
) -> Result<Option<String>, EngineError> {
    robots.map(|robots| to_json("robots", robots)).transpose()
}

pub(super) fn unsigned<T: TryFrom<i64>>(what: &'static str, value: i64) -> Result<T, EngineError> {
    T::try_from(value).map_err(|_range| corrupt(what, value))
}
