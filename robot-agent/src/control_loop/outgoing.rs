//! Sends the loop's events without blocking, and keeps mission events for which there is no room.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError};

use super::channels::{LoopEvent, Shared};

/// Capacity for mission events that wait for room in the channel; one mission makes a few. Events
/// beyond it are dropped.
const UNSENT_MAX: usize = 32;

/// The loop's end of the event channel.
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

    /// Sends the waiting events; returns false if some still wait.
    pub(super) fn flush(&mut self) -> bool {
        while let Some(event) = self.unsent.pop_front() {
            if let Err(TrySendError::Full(event)) = self.events.try_send(event) {
                self.unsent.push_front(event);
                return false;
            }
        }
        true
    }

    /// Sends an event. If the channel is full, a segment is dropped and counted, any other event
    /// waits.
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
