//! Checks that the messages of a topic are of one writer and in order.
//!
//! A writer that restarts numbers its messages from the beginning. Under another identifier it
//! replaces the former writer once that has been silent for [`SILENT_AFTER`]. Under the same
//! identifier its low numbers look like repeated messages; it is accepted as restarted in two
//! cases:
//!
//! * its source times are newer than all before, in [`AGREE_MIN`] consecutive messages;
//! * its clock restarted too, the writer had been silent for [`SILENT_AFTER`], and
//!   [`AGREE_WITHOUT_CLOCK_MIN`] consecutive messages are none of the last [`REMEMBERED`].
//!
//! The caller checks a message by [`WriterWatch::check`], and calls [`WriterWatch::follow`] only if
//! its content is valid, so that repeated old data never count as a restarted writer.

use std::time::Duration;

use tread_ros2::rmw::{Attachment, GID_BYTES};

use super::refusal::Refusal;

/// Silence of a writer after which another one may replace it, such as a restarted node.
const SILENT_AFTER: Duration = Duration::from_millis(200);
/// Number of consecutive messages that show a restart by their source times.
pub const AGREE_MIN: u32 = 3;
/// Number of consecutive messages that show a restart where the source times do not.
pub const AGREE_WITHOUT_CLOCK_MIN: u32 = 10;
/// Number of newest messages that are recognised when repeated.
const REMEMBERED: usize = 64;

/// Relation of a message to those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MessageOrder {
    /// The first message, or a later one of the same writer.
    Continues,
    /// The writer restarted, or another one replaced a silent one.
    Restarted,
    /// The writer may have restarted; more messages are needed.
    MayHaveRestarted,
}

/// The writer of one topic.
#[derive(Debug, Clone, Copy, Default)]
pub struct WriterWatch {
    writer: Option<WriterState>,
    restart: Option<Restart>,
}

#[derive(Debug, Clone, Copy)]
struct WriterState {
    gid: [u8; GID_BYTES],
    sequence: i64,
    /// Newest source time of all its messages, nanoseconds.
    source_time_ns: i64,
    at: Duration,
    /// Sequence numbers and source times of the newest messages, in a ring buffer.
    recent: [(i64, i64); REMEMBERED],
    /// Number of messages so far.
    count: usize,
}

/// Newest message and number of messages that look like those of a restarted writer.
#[derive(Debug, Clone, Copy)]
struct Restart {
    sequence: i64,
    source_time_ns: i64,
    count: u32,
}

impl WriterState {
    fn knows(&self, message: &Attachment) -> bool {
        let known = &self.recent[..self.count.min(REMEMBERED)];
        known.contains(&(message.sequence, message.source_time_ns))
    }
}

impl WriterWatch {
    /// Checks whether a message follows those before it; changes nothing.
    ///
    /// # Errors
    /// [`Refusal::OutOfOrder`] for a repeated or older message, [`Refusal::SecondWriter`] for one
    /// of another writer while the topic's writer is active.
    pub fn check(&self, message: &Attachment, now: Duration) -> Result<MessageOrder, Refusal> {
        let Some(state) = &self.writer else {
            return Ok(MessageOrder::Continues);
        };
        let is_silent = now.saturating_sub(state.at) >= SILENT_AFTER;
        if state.gid != message.gid {
            return if is_silent {
                Ok(MessageOrder::Restarted)
            } else {
                Err(Refusal::SecondWriter)
            };
        }
        if message.sequence > state.sequence {
            return Ok(MessageOrder::Continues);
        }
        let went_on = message.source_time_ns > state.source_time_ns;
        if state.knows(message) || !(went_on || is_silent) {
            return Err(Refusal::OutOfOrder);
        }
        let before = match &self.restart {
            Some(restart) if is_after(message, restart) => restart.count,
            Some(restart) if message.sequence == restart.sequence => {
                return Err(Refusal::OutOfOrder);
            }
            Some(_) | None => 0,
        };
        let enough = if went_on {
            AGREE_MIN
        } else {
            AGREE_WITHOUT_CLOCK_MIN
        };
        Ok(if before + 1 >= enough {
            MessageOrder::Restarted
        } else {
            MessageOrder::MayHaveRestarted
        })
    }

    /// Records a message that was checked and has valid content.
    pub fn follow(&mut self, message: &Attachment, order: MessageOrder, now: Duration) {
        if order == MessageOrder::MayHaveRestarted {
            let before = self.restart.filter(|restart| is_after(message, restart));
            self.restart = Some(Restart {
                sequence: message.sequence,
                source_time_ns: message.source_time_ns,
                count: before.map_or(0, |restart| restart.count) + 1,
            });
            return;
        }
        self.restart = None;
        let Attachment {
            sequence,
            source_time_ns,
            gid,
        } = *message;
        let former = self.writer.filter(|_| order == MessageOrder::Continues);
        let mut state = former.unwrap_or(WriterState {
            gid,
            sequence,
            source_time_ns,
            at: now,
            recent: [(0, 0); REMEMBERED],
            count: 0,
        });
        state.recent[state.count % REMEMBERED] = (sequence, source_time_ns);
        self.writer = Some(WriterState {
            sequence,
            source_time_ns: state.source_time_ns.max(source_time_ns),
            at: now,
            count: state.count + 1,
            ..state
        });
    }
}

/// Whether a message follows the newest one of a writer that may have restarted.
fn is_after(message: &Attachment, restart: &Restart) -> bool {
    message.sequence > restart.sequence && message.source_time_ns >= restart.source_time_ns
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_MS: i64 = 10;

    fn message(writer: u8, sequence: i64, source_ms: i64) -> Attachment {
        Attachment {
            sequence,
            source_time_ns: source_ms * 1_000_000,
            gid: [writer; GID_BYTES],
        }
    }

    /// Whether a message is taken; one that may be of a writer that started again is not.
    fn take(
        watch: &mut WriterWatch,
        message: &Attachment,
        now_ms: i64,
    ) -> Result<MessageOrder, Refusal> {
        let now = Duration::from_millis(now_ms.unsigned_abs());
        let order = watch.check(message, now)?;
        watch.follow(message, order, now);
        Ok(order)
    }

    /// A writer that has written a number of messages, the last at that time in milliseconds.
    fn written(count: i64) -> (WriterWatch, i64) {
        let mut watch = WriterWatch::default();
        for index in 1..=count {
            let now_ms = index * PERIOD_MS;
            let taken = take(&mut watch, &message(1, index, now_ms), now_ms);
            assert_eq!(taken, Ok(MessageOrder::Continues));
        }
        (watch, count * PERIOD_MS)
    }

    #[test]
    fn one_writer_is_heard_in_order_and_another_when_it_is_silent() {
        let mut watch = WriterWatch::default();
        let mut check = |writer: u8, sequence: i64, now_ms: i64| {
            take(&mut watch, &message(writer, sequence, now_ms), now_ms)
        };
        assert_eq!(check(1, 7, 0), Ok(MessageOrder::Continues));
        assert_eq!(check(1, 9, 10), Ok(MessageOrder::Continues));
        assert_eq!(check(1, 9, 10), Err(Refusal::OutOfOrder));
        assert_eq!(check(2, 1, 20), Err(Refusal::SecondWriter));
        assert_eq!(check(2, 2, 210), Ok(MessageOrder::Restarted));
        assert_eq!(check(2, 3, 213), Ok(MessageOrder::Continues));
        assert_eq!(check(1, 10, 215), Err(Refusal::SecondWriter));
    }

    #[test]
    fn a_writer_that_starts_again_under_its_identifier_is_heard_after_three_messages() {
        // Whether it is away for long or not at all.
        for pause_ms in [0, 50, 1_000] {
            let (mut watch, last_ms) = written(500);
            let mut orders = Vec::new();
            for index in 1..=5 {
                let now_ms = last_ms + pause_ms + index * PERIOD_MS;
                orders.push(take(&mut watch, &message(1, index, now_ms), now_ms).unwrap());
            }
            let [first, second, third, rest @ ..] = orders.as_slice() else {
                panic!("{orders:?}");
            };
            assert_eq!(
                [*first, *second, *third],
                [
                    MessageOrder::MayHaveRestarted,
                    MessageOrder::MayHaveRestarted,
                    MessageOrder::Restarted
                ]
            );
            assert!(rest.iter().all(|order| *order == MessageOrder::Continues));
        }
    }

    #[test]
    fn a_writer_whose_clock_begins_again_is_heard_after_a_silence_and_ten_messages() {
        let (mut watch, last_ms) = written(500);
        let mut restarted = None;
        for index in 1..=60 {
            let now_ms = last_ms + index * PERIOD_MS;
            // Half a millisecond off the first life's times, within which it lies.
            let mut again = message(1, index, index * PERIOD_MS);
            again.source_time_ns += 500_000;
            match take(&mut watch, &again, now_ms) {
                Ok(MessageOrder::Restarted) => {
                    restarted = Some(now_ms - last_ms);
                    break;
                }
                Ok(order) => assert_eq!(order, MessageOrder::MayHaveRestarted),
                Err(refusal) => assert_eq!(refusal, Refusal::OutOfOrder),
            }
        }
        let bound_ms = 200 + 10 * PERIOD_MS;
        assert!(
            restarted.is_some_and(|after_ms| after_ms <= bound_ms),
            "{restarted:?}"
        );
    }

    #[test]
    fn messages_that_are_repeated_are_never_those_of_a_writer_that_started_again() {
        let (mut watch, last_ms) = written(500);
        // The newest again and again, while the writer speaks and after it fell silent.
        for repeat in 0..50 {
            for back in 0..40 {
                let index = 500 - 39 + back;
                let now_ms = last_ms + 400 * repeat + back * PERIOD_MS;
                let refused = take(&mut watch, &message(1, index, index * PERIOD_MS), now_ms);
                assert_eq!(refused, Err(Refusal::OutOfOrder));
            }
        }
        // The writer goes on, and each of its messages comes twice, and an old one with it.
        for index in 501..700 {
            let now_ms = last_ms + 20_000 + index * PERIOD_MS;
            let next = message(1, index, index * PERIOD_MS);
            assert_eq!(take(&mut watch, &next, now_ms), Ok(MessageOrder::Continues));
            let old = message(1, index - 300, (index - 300) * PERIOD_MS);
            for again in [next, old] {
                assert_eq!(
                    take(&mut watch, &again, now_ms + 1),
                    Err(Refusal::OutOfOrder)
                );
            }
        }
    }

    #[test]
    fn two_writers_of_one_identifier_do_not_take_turns() {
        let (mut watch, last_ms) = written(500);
        for index in 1..200 {
            let now_ms = last_ms + index * PERIOD_MS;
            let live = message(1, 500 + index, now_ms);
            assert_eq!(take(&mut watch, &live, now_ms), Ok(MessageOrder::Continues));
            let other = take(&mut watch, &message(1, index, now_ms + 1), now_ms + 1);
            assert_eq!(other, Ok(MessageOrder::MayHaveRestarted));
        }
    }
}
