//! What the loop reports: handed on without waiting, kept for later where there is no room.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError};

use super::channels::{LoopEvent, Shared};

/// Mission events that may wait for room in the channel; one mission at a time makes a few.
const UNSENT_MAX: usize = 32;

/// The loop's end of the events.
#[derive(Debug)]
pub(super) struct Outgoing {
    events: SyncSender<LoopEvent>,
    unsent: VecDeque<LoopEvent>,
    shared: Arc<Shared>,
}

impl Outgoing {
    pub(super) fn new(events: SyncSender<LoopEvent>, shared: Arc<Shared>) -> Self {
        Self {
            events,
            unsent: VecDeque::with_capacity(UNSENT_MAX),
            shared,
        }
    }

    /// Hands on what still waits; false if there was no room for all of it.
    pub(super) fn flush(&mut self) -> bool {
        while let Some(event) = self.unsent.pop_front() {
            if let Err(TrySendError::Full(event)) = self.events.try_send(event) {
                self.unsent.push_front(event);
                return false;
            }
        }
        true
    }

    /// Hands an event on. What matters waits for room; a segment is lost and counted instead.
    pub(super) fn send(&mut self, event: LoopEvent) {
        let refused = if self.unsent.is_empty() {
            match self.events.try_send(event) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => return,
                Err(TrySendError::Full(event)) => event,
            }
        } else {
            event
        };
        if matches!(refused, LoopEvent::Segment(_)) {
            Shared::count(&self.shared.lost_segments);
        } else if self.unsent.len() < UNSENT_MAX {
            self.unsent.push_back(refused);
        }
    }
}
