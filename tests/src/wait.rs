//! Waiting for a state, with a bound.

use std::fmt::Debug;
use std::future::Future;
use std::time::Duration;

use tokio::time::Instant;

/// Time between two looks.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Longest wait for anything that takes no driving.
pub const SHORT: Duration = Duration::from_secs(15);
/// Longest wait for a robot to drive a short mission.
pub const DRIVE: Duration = Duration::from_mins(1);

/// Waits until `look` gives a value that `holds`, and returns it.
///
/// # Panics
/// After `bound`, with what was seen last.
pub async fn eventually<T, F>(
    what: &str,
    bound: Duration,
    mut look: impl FnMut() -> F,
    holds: impl Fn(&T) -> bool,
) -> T
where
    T: Debug,
    F: Future<Output = T>,
{
    let deadline = Instant::now() + bound;
    loop {
        let seen = look().await;
        if holds(&seen) {
            return seen;
        }
        assert!(
            Instant::now() < deadline,
            "not within {bound:?}: {what}; seen last: {seen:#?}"
        );
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}
