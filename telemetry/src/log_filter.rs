//! The log filter of agent and server.

/// Filter of a process for which none is given.
pub const LOG_FILTER_DEFAULT: &str = "info";

/// Levels of libraries that the given filter does not name. zenoh warns of every link that closes,
/// which our own lines report by robot.
const OF_LIBRARIES: &str = "zenoh=error,sqlx=warn";
/// Filter in place of an empty one.
const OF_EMPTY: &str = "error";

/// Returns the complete filter for the given one. Directives for zenoh in it, such as `zenoh=warn`,
/// replace ours.
pub fn log_filter(given: &str) -> String {
    let given = if given.trim().is_empty() {
        OF_EMPTY
    } else {
        given
    };
    format!("{OF_LIBRARIES},{given}")
}
