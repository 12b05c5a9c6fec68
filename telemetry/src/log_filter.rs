//! The log filter of agent and server.

/// Filter of a process for which none is given.
pub const LOG_FILTER_DEFAULT: &str = "info";

/// Levels of libraries that the given filter does not name. zenoh warns of every link that closes,
/// which our own lines report by robot.
const LIBRARY_DIRECTIVES: &str = "zenoh=error,sqlx=warn";
/// Filter in place of an empty one.
const EMPTY_FILTER: &str = "error";

/// Returns the complete filter for the given one. Directives for zenoh in it, such as `zenoh=warn`,
/// replace ours.
pub fn log_filter(given: &str) -> String {
    let given = if given.trim().is_empty() {
        EMPTY_FILTER
    } else {
        given
    };
    format!("{LIBRARY_DIRECTIVES},{given}")
}
