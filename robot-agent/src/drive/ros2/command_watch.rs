//! Detects other nodes that write on the command topic.
//!
//! The agent subscribes to its own command topic. Over `rmw_zenoh` each message identifies its
//! writer. Over `zenoh-bridge-ros2dds` none does: a message that the agent has not written recently
//! is another's. The bridge never returns what it wrote on DDS itself, and a foreign command that
//! equals a recent one of the agent, such as zero while the agent commands zero, is harmless.
//!
//! A base that follows two nodes tracks neither path. So while others write
//! ([`ForeignCommandWatch`]), samples of the wheels are refused and only zero is commanded.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tread_ros2::messages::MessageType;
use tread_ros2::rmw::{Attachment, GID_BYTES, check_key};

use super::refusal::Counts;
use super::settings::Scheme;

/// Number of the agent's newest commands that are recognised, more than half a second of them.
const REMEMBERED: usize = 64;

/// Number of foreign commands within [`CONTEST_SPAN`] that begins a contest; a node that ends often
/// writes one.
const CONTEST_MIN: usize = 3;
/// Time within which [`CONTEST_MIN`] foreign commands begin a contest, and after the last of which
/// it ends.
const CONTEST_SPAN: Duration = Duration::from_millis(500);

/// Detects whether another node commands the base while the agent drives it. Pure.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ForeignCommandWatch {
    last_count: u64,
    /// Times of the newest foreign commands, oldest first.
    newest: [Option<Duration>; CONTEST_MIN],
    is_contested: bool,
}

impl ForeignCommandWatch {
    /// Updates the state with the total number of foreign commands and whether the agent drives;
    /// returns whether the base is contested.
    pub(super) fn check(&mut self, now: Duration, foreign_commands: u64, drives: bool) -> bool {
        let new = foreign_commands.saturating_sub(self.last_count);
        self.last_count = foreign_commands;
        for _ in 0..new.min(CONTEST_MIN as u64) {
            self.newest.rotate_left(1);
            self.newest[CONTEST_MIN - 1] = Some(now);
        }
        let is_late =
            |at: &Option<Duration>| at.is_some_and(|at| now.saturating_sub(at) <= CONTEST_SPAN);
        // During a contest a single further command prolongs it.
        self.is_contested = if self.is_contested {
            self.newest.last().is_some_and(is_late)
        } else {
            drives && self.newest.iter().all(is_late)
        };
        self.is_contested
    }
}

/// Observer of the command topic.
#[derive(Debug)]
pub(super) struct CommandWatch {
    scheme: Scheme,
    message_type: MessageType,
    counts: Arc<Counts>,
    written: Mutex<Written>,
}

/// Identifier and recent commands of the agent itself.
#[derive(Debug)]
struct Written {
    gid: Option<[u8; GID_BYTES]>,
    recent: [u64; REMEMBERED],
    count: usize,
}

fn digest(payload: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    payload.hash(&mut hasher);
    hasher.finish()
}

impl CommandWatch {
    /// Creates a watch before the first command.
    pub(super) fn new(scheme: Scheme, message_type: MessageType, counts: Arc<Counts>) -> Self {
        Self {
            scheme,
            message_type,
            counts,
            written: Mutex::new(Written {
                gid: None,
                recent: [0; REMEMBERED],
                count: 0,
            }),
        }
    }

    fn written(&self) -> std::sync::MutexGuard<'_, Written> {
        self.written.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the identifier under which the agent writes.
    pub(super) fn write_as(&self, gid: Option<[u8; GID_BYTES]>) {
        self.written().gid = gid;
    }

    /// Records a command of the agent.
    pub(super) fn wrote(&self, payload: &[u8]) {
        let mut written = self.written();
        let place = written.count % REMEMBERED;
        written.recent[place] = digest(payload);
        written.count = written.count.wrapping_add(1);
    }

    /// Processes a message on the command topic; one that no base accepts as a command is ignored.
    pub(super) fn receive(&self, key: &str, attachment: Option<&[u8]>, payload: &[u8]) {
        let is_ours = match self.scheme {
            Scheme::RmwZenoh(generation) => {
                let attachment = attachment.and_then(Attachment::from_bytes);
                let is_command = check_key(key, &self.message_type, generation).is_ok();
                let Some(attachment) = attachment.filter(|_| is_command) else {
                    return;
                };
                self.written().gid == Some(attachment.gid)
            }
            Scheme::Ros2Dds => self.written().recent.contains(&digest(payload)),
        };
        if !is_ours {
            self.counts.count_foreign_command();
        }
    }
}

#[cfg(test)]
mod tests {
    use tread_ros2::messages::{Message as _, Twist};
    use tread_ros2::names::Name;
    use tread_ros2::rmw::{Generation, topic_key};

    use super::*;

    fn watch(scheme: Scheme) -> (CommandWatch, Arc<Counts>) {
        let counts = Arc::new(Counts::default());
        let watch = CommandWatch::new(scheme, Twist::TYPE, Arc::clone(&counts));
        (watch, counts)
    }

    /// Looks every 10 ms for so long; when a contest began and when it ended last.
    fn contest(
        span_ms: u64,
        foreign: impl Fn(u64) -> u64,
        drives: impl Fn(u64) -> bool,
    ) -> (Option<u64>, Option<u64>) {
        let (mut contest, mut began, mut ended, mut was) =
            (ForeignCommandWatch::default(), None, None, false);
        for now_ms in (0..span_ms).step_by(10) {
            let now = Duration::from_millis(now_ms);
            let is = contest.check(now, foreign(now_ms), drives(now_ms));
            if is && !was {
                began = began.or(Some(now_ms));
            }
            if was && !is {
                ended = Some(now_ms);
            }
            was = is;
        }
        (began, ended)
    }

    #[test]
    fn a_node_that_commands_a_driven_base_contests_it_until_half_a_second_after_its_last() {
        for period_ms in [5, 20, 100, 200] {
            // From one second to three.
            let foreign =
                |now_ms: u64| now_ms.clamp(1_000, 3_000).saturating_sub(1_000) / period_ms;
            let (began, ended) = contest(5_000, foreign, |_| true);
            let began = began.unwrap() - 1_000;
            assert!(began <= 3 * period_ms + 10, "{period_ms}: {began}");
            let ended = ended.unwrap() - 3_000;
            assert!(ended <= 510, "{period_ms}: {ended}");
        }
    }

    #[test]
    fn a_stray_command_or_one_to_a_base_at_rest_is_no_contest() {
        let stray = |now_ms: u64| 1 + now_ms / 400;
        assert_eq!(contest(5_000, stray, |_| true), (None, None));
        let steady = |now_ms: u64| now_ms / 20;
        assert_eq!(contest(5_000, steady, |_| false), (None, None));
        // Once it is contested the agent rests, and it stays contested.
        let (began, ended) = contest(5_000, steady, |now_ms| now_ms < 100);
        assert!(began.is_some() && ended.is_none());
    }

    #[test]
    fn over_rmw_zenoh_another_writer_is_known_by_its_identifier() {
        let (watch, counts) = watch(Scheme::RmwZenoh(Generation::Hashed));
        let topic = Name::topic("cmd_vel", &Name::default()).unwrap();
        let key = topic_key(0, &topic, &Twist::TYPE, Generation::Hashed);
        let from = |gid: u8| {
            let attachment = Attachment {
                sequence: 1,
                source_time_ns: 0,
                gid: [gid; GID_BYTES],
            };
            attachment.to_bytes()
        };
        watch.write_as(Some([1; GID_BYTES]));
        watch.receive(&key, Some(&from(1)), b"ours");
        watch.receive(&key, None, b"what no base takes");
        watch.receive("0/cmd_vel/another/type", Some(&from(2)), b"nor this");
        assert_eq!(counts.foreign_commands(), 0);
        watch.receive(&key, Some(&from(2)), b"ours");
        assert_eq!(counts.foreign_commands(), 1);
    }

    #[test]
    fn over_ros2dds_what_we_did_not_write_of_late_is_anothers() {
        let (watch, counts) = watch(Scheme::Ros2Dds);
        for index in 0..1_000_u32 {
            watch.wrote(&index.to_le_bytes());
            // It comes back a little later.
            watch.receive("cmd_vel", None, &index.saturating_sub(20).to_le_bytes());
        }
        assert_eq!(counts.foreign_commands(), 0);
        watch.receive("cmd_vel", None, &1_000_u32.to_le_bytes());
        watch.receive("cmd_vel", None, &100_u32.to_le_bytes());
        assert_eq!(counts.foreign_commands(), 2);
    }
}
