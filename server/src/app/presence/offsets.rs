//! Offset of a robot's clock from the server's, estimated from its last states.
//!
//! The offset of one state is too small by the delay of the state, so the largest of several is the
//! best estimate. All states of the last [`OFFSETS_SPAN`] are used; if these are fewer than
//! [`OFFSETS_MIN`], the last [`OFFSETS_MIN`] states are used.

use std::collections::VecDeque;
use std::time::Duration;

/// Time for which an offset counts.
const OFFSETS_SPAN: Duration = Duration::from_millis(3_200);
/// Minimum number of offsets that count, and number from which their largest counts as right: those
/// of the span at 5 Hz.
pub(super) const OFFSETS_MIN: usize = 16;
/// Maximum number of offsets kept: those of the span at the highest rate that is requested.
const OFFSETS_MAX: usize = 64;

/// Offsets of the last states, robot minus server, in one unit.
#[derive(Debug, Clone, Default)]
pub(super) struct Offsets {
    /// Time of arrival, and offset.
    last: VecDeque<(Duration, i64)>,
}

impl Offsets {
    /// Adds the offset of a state that arrived at `now`.
    pub(super) fn push(&mut self, now: Duration, offset: i64) {
        let is_old = |&(at, _): &(Duration, i64)| now.saturating_sub(at) > OFFSETS_SPAN;
        while self.last.len() >= OFFSETS_MAX
            || (self.last.len() >= OFFSETS_MIN && self.last.front().is_some_and(is_old))
        {
            self.last.pop_front();
        }
        self.last.push_back((now, offset));
    }

    /// Returns the largest offset; `None` without a state.
    pub(super) fn largest(&self) -> Option<i64> {
        self.last.iter().map(|&(_, offset)| offset).max()
    }

    /// Returns the offset of the last state; `None` without a state.
    pub(super) fn newest(&self) -> Option<i64> {
        self.last.back().map(|&(_, offset)| offset)
    }

    /// Returns whether there are enough of them for the largest to count as right.
    pub(super) fn has_enough(&self) -> bool {
        self.last.len() >= OFFSETS_MIN
    }

    /// Forgets all.
    pub(super) fn clear(&mut self) {
        self.last.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shortest_delay_of_the_last_seconds_counts_at_every_rate() {
        for period_ms in [50, 100, 200, 1_000] {
            let mut offsets = Offsets::default();
            let at = |number: u64| Duration::from_millis(number * period_ms);
            offsets.push(at(0), 0);
            // All that follow were under way for longer.
            let mut number = 1;
            while offsets.largest() == Some(0) {
                offsets.push(at(number), -40);
                number += 1;
                assert!(offsets.last.len() <= OFFSETS_MAX);
            }
            let counted = at(number - 1);
            assert!(counted >= OFFSETS_SPAN, "{period_ms} ms: {counted:?}");
            assert!(number > 16, "{period_ms} ms: {number}");
            assert!(
                counted <= OFFSETS_SPAN.max(at(16)) + at(1),
                "{period_ms} ms"
            );
        }
    }
}
