//! Clients of the feed with their bounded buffers, and the newest events.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::info;
use tread_api::event::{Event, Topic};
use tread_api::friction::MapChange;
use tread_api::robot::Alert;

use super::sent::{EventFilter, EventSubject, Position, Sent, unnumbered};
use super::snapshot::{SNAPSHOT_READ_MAX, Snapshots};
use crate::app::presence::RobotKey;

/// Maximum number of events buffered for one client.
pub const CLIENT_BUFFER: usize = 4_096;
/// Maximum number of bytes buffered for one client; a single event may be larger.
pub const CLIENT_BYTES_MAX: usize = 4 * 1024 * 1024;
/// Maximum number of recent events kept for clients that reconnect.
pub const KEPT_EVENTS_MAX: usize = 8_192;
/// Maximum number of bytes of those recent events.
pub const KEPT_BYTES_MAX: usize = 16 * 1024 * 1024;
/// Maximum length of the name of a run.
const RUN_LENGTH_MAX: usize = 16;
/// How long a client that was dropped may take to read its end.
const CLOSE_WAIT_MAX: Duration = Duration::from_secs(5);

/// Returns the identifier of an event of a run.
pub(super) fn id_of(run: &str, Position { seq, step }: Position) -> String {
    format!("{run}-{seq}-{step}")
}

/// Parses the identifier of an event: the run of the server, and its place there. `None` for what no server
/// has given.
fn read_id(id: &str) -> Option<(&str, Position)> {
    let (rest, step) = id.rsplit_once('-')?;
    let (run, seq) = rest.rsplit_once('-')?;
    let is_run =
        |run: &str| run.len() <= RUN_LENGTH_MAX && run.bytes().all(|byte| byte.is_ascii_hexdigit());
    if !is_run(run) {
        return None;
    }
    let at = Position {
        seq: seq.parse().ok()?,
        step: step.parse().ok()?,
    };
    Some((run, at))
}

/// The clients, and the newest events.
#[derive(Debug)]
pub struct Hub {
    /// Identifier of this run of the server, part of event identifiers.
    pub(super) run: String,
    pub(super) state: Mutex<HubState>,
    pub(super) snapshots: Snapshots,
}

#[derive(Debug, Default)]
pub(super) struct HubState {
    pub(super) seq: u64,
    /// Key of the newest transition of a mission that was published, or was there before.
    step: i64,
    pub(super) kept: VecDeque<Arc<Sent>>,
    pub(super) kept_bytes: usize,
    pub(super) clients: HashMap<u64, Client>,
    pub(super) dropped: Vec<(Option<Duration>, CancellationToken)>,
    pub(super) next_client: u64,
    pub(super) dropped_count: u64,
    /// Incremented whenever the last client leaves.
    gathering: u64,
}

impl HubState {
    pub(super) fn remove(&mut self, id: u64) -> Option<Client> {
        let client = self.clients.remove(&id)?;
        self.gathering += u64::from(self.clients.is_empty());
        Some(client)
    }

    /// Drops clients that read too slowly: they get the buffered events and an end.
    fn drop_slow(&mut self, slow: Vec<u64>) {
        for id in slow {
            if let Some(client) = self.remove(id) {
                info!("an event client reads too slowly and is dropped");
                self.dropped.push((None, client.cut));
                self.dropped_count += 1;
            }
        }
    }
}

#[derive(Debug)]
pub(super) struct Client {
    pub(super) filter: EventFilter,
    pub(super) buffer: mpsc::Sender<Arc<Sent>>,
    /// Bytes in the buffer.
    pub(super) waiting: Arc<AtomicUsize>,
    pub(super) cut: CancellationToken,
    /// Time of subscription, since the start of the server.
    pub(super) since: Duration,
    /// Whether it has read its snapshot.
    pub(super) has_begun: Arc<AtomicBool>,
}

impl Client {
    /// Puts an event into the buffer; returns false if the buffer is full.
    fn take(&self, event: &Arc<Sent>) -> bool {
        let bytes = event.text.len();
        let before = self.waiting.fetch_add(bytes, Ordering::Relaxed);
        (before == 0 || before + bytes <= CLIENT_BYTES_MAX)
            && self.buffer.try_send(Arc::clone(event)).is_ok()
    }
}

impl Hub {
    /// Creates a hub without clients or events.
    pub(in crate::app) fn new(started_at: Timestamp) -> Self {
        Self {
            run: format!("{:x}", started_at.as_microsecond()),
            state: Mutex::default(),
            snapshots: Snapshots::default(),
        }
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, HubState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the number of clients.
    pub fn client_count(&self) -> usize {
        self.lock().clients.len()
    }

    /// Returns the number of clients that were dropped because they read too slowly.
    pub fn dropped_count(&self) -> u64 {
        self.lock().dropped_count
    }

    /// Returns the largest number of events buffered for any client.
    pub fn longest_buffer(&self) -> usize {
        let state = self.lock();
        let waiting = |client: &Client| CLIENT_BUFFER - client.buffer.capacity();
        state.clients.values().map(waiting).max().unwrap_or(0)
    }

    /// Returns the newest event.
    pub(super) fn newest(&self) -> Position {
        let state = self.lock();
        Position {
            seq: state.seq,
            step: state.step,
        }
    }

    /// Says that all transitions up to one are in every snapshot and are not published.
    pub(super) fn begin_after(&self, step: i64) {
        self.lock().step = step;
    }

    /// Returns the identifier of an event.
    pub(super) fn id_of(&self, at: Position) -> String {
        id_of(&self.run, at)
    }

    /// Returns a number that changes whenever the last client has left.
    pub(super) fn gathering(&self) -> u64 {
        self.lock().gathering
    }

    pub(super) fn is_closed(&self) -> bool {
        self.lock().next_client == u64::MAX
    }

    /// Ends all streams and accepts no further client.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        state.next_client = u64::MAX;
        state.clients.clear();
    }

    pub(super) fn publish(&self, event: &Event, topic: Topic, (site, robot): RobotKey) {
        self.publish_about(event, (topic, None), Some((site, Some(robot))));
    }

    /// Publishes a transition of a mission, which has this key.
    pub(super) fn publish_step(&self, event: &Event, step: i64, (site, robot): RobotKey) {
        let about = Some((site, Some(robot)));
        self.publish_about(event, (Topic::Missions, Some(step)), about);
    }

    /// Publishes an event about a robot, a site, or, with neither, the server.
    fn publish_about(
        &self,
        event: &Event,
        (topic, step): (Topic, Option<i64>),
        about: Option<EventSubject>,
    ) {
        let mut state = self.lock();
        state.seq += 1;
        state.step = step.unwrap_or(state.step);
        let (seq, step) = (state.seq, state.step);
        let sent = Arc::new(Sent {
            id: Some(self.id_of(Position { seq, step })),
            seq,
            ..unnumbered(event, Some(topic), about)
        });
        state.kept_bytes += sent.text.len();
        state.kept.push_back(Arc::clone(&sent));
        while state.kept.len() > KEPT_EVENTS_MAX || state.kept_bytes > KEPT_BYTES_MAX {
            let Some(oldest) = state.kept.pop_front() else {
                break;
            };
            state.kept_bytes -= oldest.text.len();
        }
        let mut slow = Vec::new();
        for (&id, client) in &state.clients {
            let is_wanted = client.filter.matches(sent.topic, sent.about.as_ref());
            if is_wanted && !client.take(&sent) {
                slow.push(id);
            }
        }
        state.drop_slow(slow);
    }

    /// Publishes the areas of a site in which the map has changed.
    pub(in crate::app) fn map(&self, change: &MapChange) {
        let about = (change.site.clone(), None);
        let event = Event::Map(Box::new(change.clone()));
        self.publish_about(&event, (Topic::Map, None), Some(about));
    }

    /// Publishes the present state of an alert.
    pub(in crate::app) fn alert(&self, alert: &Alert) {
        let about = alert.robot_key().map(|(site, robot)| (site, Some(robot)));
        let event = Event::Alert(Box::new(alert.clone()));
        self.publish_about(&event, (Topic::Alerts, None), about);
    }

    /// Drops clients that do not read their snapshot in time, and closes the connections of those
    /// that did not read their end either.
    pub(super) fn sweep(&self, now: Duration) {
        let mut state = self.lock();
        let late = state.clients.iter().filter(|(_, client)| {
            let has_begun = client.has_begun.load(Ordering::Relaxed);
            !has_begun && now.saturating_sub(client.since) > SNAPSHOT_READ_MAX
        });
        let late = late.map(|(&id, _)| id).collect();
        state.drop_slow(late);
        state.dropped.retain_mut(|(since, cut)| {
            let since = *since.get_or_insert(now);
            let over = now.saturating_sub(since) > CLOSE_WAIT_MAX;
            if over {
                cut.cancel();
            }
            !over
        });
    }

    /// Returns the events that a client missed since `last`; `None` if they are no longer kept.
    pub(super) fn missed(&self, last: &str, filter: &EventFilter) -> Option<VecDeque<Arc<Sent>>> {
        let (run, at) = read_id(last)?;
        if run != self.run {
            return None;
        }
        self.since(at.seq, filter)
    }

    /// Returns the run and the place of an event that a client has read from another run of the server, or
    /// from another server of the same database; `None` for an event of this run.
    pub(super) fn read_elsewhere<'id>(&self, last: &'id str) -> Option<(&'id str, Position)> {
        read_id(last).filter(|(run, _)| *run != self.run)
    }

    /// Returns the events since `seq` that pass a filter; `None` if they are no longer kept.
    pub(super) fn since(&self, seq: u64, filter: &EventFilter) -> Option<VecDeque<Arc<Sent>>> {
        let state = self.lock();
        let oldest = state.kept.front().map_or(state.seq + 1, |event| event.seq);
        if seq > state.seq || seq + 1 < oldest {
            return None;
        }
        let missed = state.kept.iter().filter(|event| event.seq > seq);
        let wanted = missed.filter(|event| filter.matches(event.topic, event.about.as_ref()));
        Some(wanted.cloned().collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identifier_is_read_as_a_server_has_given_it_and_no_other_text_is() {
        let hub = Hub::new(Timestamp::UNIX_EPOCH);
        let at = Position { seq: 7, step: 41 };
        let own = hub.id_of(at);
        assert_eq!(read_id(&own), Some(("0", at)));
        assert_eq!(hub.read_elsewhere(&own), None);
        assert_eq!(hub.read_elsewhere("65f2-7-41"), Some(("65f2", at)));
        let long = format!("{}-7-41", "a".repeat(RUN_LENGTH_MAX + 1));
        for wrong in [
            "", "-", "7-41", "x-7-41", "65f2-7", "65f2--7", "65f2-7-", &long,
        ] {
            assert_eq!(hub.read_elsewhere(wrong), None, "{wrong}");
        }
    }
}
