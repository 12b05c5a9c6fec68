//! Stores the received messages for a while.

use std::sync::{Mutex, PoisonError};

use tread_ros2::rmw::Attachment;

use crate::drive::ros2::refusal::Source;
use crate::drive::ros2::stamps::Arrival;
use crate::drive::ros2::topic_receiver::MessageObserver;

/// Largest number of stored messages: five topics of 200 Hz for ten seconds.
const MESSAGES_MAX: usize = 10_000;

/// A message as received.
#[derive(Debug, Clone)]
pub(super) struct Message {
    pub(super) source: Source,
    pub(super) arrival: Arrival,
    pub(super) key: String,
    pub(super) attachment: Option<Attachment>,
    pub(super) payload: Vec<u8>,
}

/// The stored messages.
#[derive(Debug, Default)]
pub(super) struct MessageBuffer(Mutex<Vec<Message>>);

impl MessageBuffer {
    fn messages(&self) -> std::sync::MutexGuard<'_, Vec<Message>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether no message is stored.
    pub(super) fn is_empty(&self) -> bool {
        self.messages().is_empty()
    }

    /// Removes all messages.
    pub(super) fn clear(&self) {
        self.messages().clear();
    }

    /// Returns all messages and removes them.
    pub(super) fn drain(&self) -> Vec<Message> {
        std::mem::take(&mut self.messages())
    }
}

impl MessageObserver for MessageBuffer {
    fn receive(
        &self,
        source: Source,
        arrival: Arrival,
        key: &str,
        attachment: Option<&[u8]>,
        payload: &[u8],
    ) {
        let mut messages = self.messages();
        if messages.len() < MESSAGES_MAX {
            messages.push(Message {
                source,
                arrival,
                key: key.to_owned(),
                attachment: attachment.and_then(Attachment::from_bytes),
                payload: payload.to_vec(),
            });
        }
    }
}
