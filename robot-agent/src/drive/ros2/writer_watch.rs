//! Who writes on a topic: one writer, its messages in order.

use std::time::Duration;

use tread_ros2::rmw::{Attachment, GID_BYTES};

use super::refusal::Refusal;

/// Silence after which another writer may take the topic over: a node that was started again.
const SILENT_AFTER: Duration = Duration::from_millis(200);

/// The writer of one topic.
#[derive(Debug, Clone, Copy, Default)]
pub struct WriterWatch {
    writer: Option<Heard>,
}

#[derive(Debug, Clone, Copy)]
struct Heard {
    gid: [u8; GID_BYTES],
    sequence: i64,
    at: Duration,
}

impl WriterWatch {
    /// Looks whether a message is the next one of the topic's writer.
    ///
    /// # Errors
    /// [`Refusal::OutOfOrder`] for one that came already, [`Refusal::SecondWriter`] for another's.
    pub fn check(&mut self, attachment: &Attachment, now: Duration) -> Result<(), Refusal> {
        if let Some(heard) = self.writer {
            let is_same = heard.gid == attachment.gid;
            if is_same && attachment.sequence <= heard.sequence {
                return Err(Refusal::OutOfOrder);
            }
            if !is_same && now.saturating_sub(heard.at) < SILENT_AFTER {
                return Err(Refusal::SecondWriter);
            }
        }
        self.writer = Some(Heard {
            gid: attachment.gid,
            sequence: attachment.sequence,
            at: now,
        });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_writer_is_heard_in_order_and_another_when_it_is_silent() {
        let mut watch = WriterWatch::default();
        let mut check = |writer: u8, sequence: i64, now_ms: u64| {
            let attachment = Attachment {
                sequence,
                source_time_ns: 0,
                gid: [writer; GID_BYTES],
            };
            watch.check(&attachment, Duration::from_millis(now_ms))
        };
        assert_eq!(check(1, 7, 0), Ok(()));
        assert_eq!(check(1, 9, 10), Ok(()));
        assert_eq!(check(1, 9, 11), Err(Refusal::OutOfOrder));
        assert_eq!(check(2, 1, 20), Err(Refusal::SecondWriter));
        assert_eq!(check(2, 2, 210), Ok(()));
        assert_eq!(check(1, 10, 215), Err(Refusal::SecondWriter));
    }
}
