//! Common parts of receiving robots' messages: queries with their place, the next message of a
//! channel, and logging of refusals.

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::wire::{self, WireError};
use zenoh::query::Query;

use super::rate_limits::{Place, RateLimits};
use crate::app::App;
use crate::app::presence::RobotKey;

/// A query with its place in the robot's limits, held until it is answered.
#[derive(Debug)]
pub(super) struct LimitedQuery {
    pub(super) query: Query,
    pub(super) place: Place,
}

/// Returns the next message; `None` at the stop.
pub(super) async fn next<T>(
    channel: &mut mpsc::Receiver<T>,
    stop: &CancellationToken,
) -> Option<T> {
    tokio::select! {
        biased;
        () = stop.cancelled() => None,
        message = channel.recv() => message,
    }
}

/// A refused message: its key, and the reason.
#[derive(Debug, Clone, Copy)]
pub(super) struct RefusedMessage<'text> {
    pub(super) key: &'text str,
    pub(super) why: &'text str,
}

/// Logs a refused message, at a limited rate per robot, with the number of those not logged.
pub(super) fn log_refusal(
    app: &App,
    limits: &RateLimits,
    robot: &RobotKey,
    refused: RefusedMessage<'_>,
) {
    let RefusedMessage { key, why } = refused;
    if let Some(repeats) = limits.log_refused(robot, app.clock().elapsed()) {
        warn!(repeats, "a message on `{key}` was refused: {why}");
    }
}

/// Counts a message that cannot be parsed.
pub(super) fn count_refusal(app: &App, error: &WireError) {
    match error {
        WireError::TooLarge(_) | WireError::Malformed(_) => app.counters().refused_malformed.one(),
        WireError::Version(_) => app.counters().refused_version.one(),
    }
}

/// Formats an error with its cause on one line.
pub(super) fn explained(error: &WireError) -> String {
    wire::Refusal::from(error).detail
}

/// Counts and logs an invalid key.
pub(super) fn refuse_key(app: &App, key: &str) {
    app.counters().refused_key.one();
    let key: String = key.chars().take(200).collect();
    debug!("a message on `{key}` was refused: the key is none of Tread's");
}
