//! Whether somebody else writes on the command topic.
//!
//! The agent hears its own command topic. Over `rmw_zenoh` each message names its writer. Over
//! `zenoh-bridge-ros2dds` none does: what the agent did not write itself of late is another's. The
//! bridge never hands back what it wrote on DDS itself, and commands that equal one of ours of
//! late, such as rest while we command rest, do no harm.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::{Arc, Mutex, PoisonError};

use tread_ros2::messages::MessageType;
use tread_ros2::rmw::{Attachment, GID_BYTES, check_key};

use super::refusal::Counts;
use super::settings::Scheme;

/// Newest commands of our own that are known again, more than half a second of them.
const REMEMBERED: usize = 64;

/// Hears the command topic.
#[derive(Debug)]
pub(super) struct CommandWatch {
    scheme: Scheme,
    message_type: MessageType,
    counts: Arc<Counts>,
    written: Mutex<Written>,
}

/// What the agent wrote itself.
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
    /// A watch of a topic on which nothing was written yet.
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

    /// From now on the agent writes under this identifier.
    pub(super) fn write_as(&self, gid: Option<[u8; GID_BYTES]>) {
        self.written().gid = gid;
    }

    /// The agent writes this.
    pub(super) fn wrote(&self, payload: &[u8]) {
        let mut written = self.written();
        let place = written.count % REMEMBERED;
        written.recent[place] = digest(payload);
        written.count = written.count.wrapping_add(1);
    }

    /// A message came on the command topic. What no base would take for a command is passed over.
    pub(super) fn hear(&self, key: &str, attachment: Option<&[u8]>, payload: &[u8]) {
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
            self.counts.note_foreign_command();
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
        watch.hear(&key, Some(&from(1)), b"ours");
        watch.hear(&key, None, b"what no base takes");
        watch.hear("0/cmd_vel/another/type", Some(&from(2)), b"nor this");
        assert_eq!(counts.foreign_commands(), 0);
        watch.hear(&key, Some(&from(2)), b"ours");
        assert_eq!(counts.foreign_commands(), 1);
    }

    #[test]
    fn over_ros2dds_what_we_did_not_write_of_late_is_anothers() {
        let (watch, counts) = watch(Scheme::Ros2Dds);
        for index in 0..1_000_u32 {
            watch.wrote(&index.to_le_bytes());
            // It comes back a little later.
            watch.hear("cmd_vel", None, &index.saturating_sub(20).to_le_bytes());
        }
        assert_eq!(counts.foreign_commands(), 0);
        watch.hear("cmd_vel", None, &1_000_u32.to_le_bytes());
        watch.hear("cmd_vel", None, &100_u32.to_le_bytes());
        assert_eq!(counts.foreign_commands(), 2);
    }
}
