//! The feed of events: publishes changes in one order to all subscribed clients.
//!
//! One task reads the transitions of missions from the database, in order, and changes of robots
//! from memory; alerts are published where they are written. Each event is encoded as JSON once and
//! goes to all clients through bounded buffers. A client whose buffer is full is dropped: it gets
//! the buffered events and an `end`; if it does not read those either, its connection is closed.
//! The newest events are kept, so that a client that reconnects soon misses nothing.

mod feed;
mod hub;
mod sent;
mod snapshot;

use std::collections::{HashSet, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tread_api::event::{Event, StreamEnd, Topic};
use tread_api::ids::RobotId;

pub use self::feed::{FEED_PERIOD, run};
use self::hub::Client;
pub use self::hub::{CLIENT_BUFFER, CLIENT_BYTES_MAX, Hub, KEPT_BYTES_MAX, KEPT_EVENTS_MAX};
pub use self::sent::{EventFilter, Sent};
use self::sent::{Position, unnumbered};
use self::snapshot::Reading;
pub use self::snapshot::SNAPSHOT_BYTES_MAX;
use super::enrolment::FLEET_ROBOTS_MAX;
use super::identity::Credential;
use super::shares::{Bounds, Place};
use super::{App, AppError};
use crate::db;
use crate::db::robots::RobotRow;

/// Maximum number of clients at once.
pub const CLIENTS_MAX: usize = 1_500;
/// Maximum number of clients of one token, with its sessions.
pub const CLIENTS_PER_IDENTITY_MAX: usize = 1_100;
/// Number of clients reserved for operators and admins.
const CLIENTS_AT_WORK: usize = 200;
/// Limits on clients: in all, of viewers, and of each token or person.
pub(super) const SHARES: Bounds = Bounds {
    all: CLIENTS_MAX,
    viewers: CLIENTS_MAX - CLIENTS_AT_WORK,
    each: CLIENTS_PER_IDENTITY_MAX,
};
/// Maximum number of transitions of missions that are sent to a client that comes from another run of the server.
const STEPS_MISSED_MAX: u32 = 500;
/// Maximum number of raised alerts in a snapshot.
const ALERTS_MAX: u32 = 10_000;

/// The receiving end of a client's buffer; dropping it ends the subscription.
#[derive(Debug)]
pub struct Subscription {
    app: App,
    id: u64,
    events: mpsc::Receiver<Arc<Sent>>,
    waiting: Arc<AtomicUsize>,
    /// Transitions of missions to send before the snapshot, that the client has not read elsewhere.
    steps: VecDeque<Arc<Sent>>,
    /// Snapshot to send first; `None` if the events kept are enough.
    snapshot: Option<Reading>,
    /// Events that the client missed, or that were published since the snapshot.
    first: VecDeque<Arc<Sent>>,
    has_begun: Arc<AtomicBool>,
    covered: u64,
    ended: bool,
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.app.hub().lock().remove(self.id);
    }
}

impl Subscription {
    /// Returns the next event; `None` after the end.
    pub async fn next(&mut self) -> Option<Arc<Sent>> {
        if let Some(step) = self.steps.pop_front() {
            return Some(step);
        }
        if let Some(event) = self.snapshot.as_mut().and_then(Reading::next) {
            return Some(event);
        }
        // Released as soon as it is read: the memory of all snapshots is bounded.
        self.snapshot = None;
        self.has_begun.store(true, Ordering::Relaxed);
        if let Some(first) = self.first.pop_front() {
            return Some(first);
        }
        if self.ended {
            return None;
        }
        loop {
            let event = self.events.recv().await;
            if let Some(event) = &event {
                self.waiting.fetch_sub(event.text.len(), Ordering::Relaxed);
            }
            match event {
                // The snapshot includes this event already.
                Some(event) if event.seq <= self.covered => {}
                Some(event) => return Some(event),
                None => {
                    self.ended = true;
                    let why = if self.app.hub().is_closed() {
                        StreamEnd::Stopping
                    } else {
                        StreamEnd::TooSlow
                    };
                    return Some(Arc::new(unnumbered(&Event::End(why), None, None)));
                }
            }
        }
    }
}

impl App {
    /// Takes a place for one more event stream of this credential.
    ///
    /// # Errors
    /// [`AppError::TooMany`]: all [`CLIENTS_MAX`] are taken, or those for viewers, or the
    /// [`CLIENTS_PER_IDENTITY_MAX`] of this token.
    pub fn event_place(&self, of: &Credential) -> Result<Place, AppError> {
        self.inner.event_shares.take(of, "event clients")
    }

    /// Subscribes a client. It first gets the events since `last`, or a snapshot if these are not
    /// available.
    ///
    /// `cut` is cancelled if the client is dropped and does not read the event that tells it so.
    ///
    /// # Errors
    /// [`AppError::TooMany`] beyond [`CLIENTS_MAX`] clients, or the database failed.
    pub async fn subscribe(
        &self,
        filter: EventFilter,
        last: Option<&str>,
        cut: CancellationToken,
    ) -> Result<Subscription, AppError> {
        let (buffer, events) = mpsc::channel(CLIENT_BUFFER);
        let waiting = Arc::new(AtomicUsize::new(0));
        let has_begun = Arc::new(AtomicBool::new(false));
        let client = Client {
            filter: filter.clone(),
            buffer,
            waiting: Arc::clone(&waiting),
            cut,
            since: self.clock().elapsed(),
            has_begun: Arc::clone(&has_begun),
        };
        let (id, covered) = {
            let mut state = self.hub().lock();
            if state.clients.len() >= CLIENTS_MAX || state.next_client == u64::MAX {
                return Err(AppError::TooMany {
                    what: "event clients",
                    count: CLIENTS_MAX,
                });
            }
            let id = state.next_client;
            state.next_client += 1;
            state.clients.insert(id, client);
            (id, state.seq)
        };
        let mut subscription = Subscription {
            app: self.clone(),
            id,
            events,
            waiting,
            steps: VecDeque::new(),
            snapshot: None,
            first: VecDeque::new(),
            has_begun,
            covered,
            ended: false,
        };
        let missed = last.and_then(|last| self.hub().missed(last, &filter));
        subscription.first = if let Some(missed) = missed {
            missed
        } else {
            let (snapshot, since) = self.snapshot_for(&filter).await?;
            let covered = snapshot.covered();
            if let Some(last) = last {
                let missed = self.steps_missed(last, covered.step, &filter).await?;
                subscription.steps = missed;
            }
            // The buffer may hold events that the snapshot includes already.
            subscription.covered = covered.seq;
            subscription.snapshot = Some(snapshot);
            since
        };
        // Events published since the subscription are also in the buffer.
        let newest = subscription.first.back().map_or(0, |event| event.seq);
        subscription.covered = subscription.covered.max(newest);
        Ok(subscription)
    }

    /// Begins the order of events: all transitions of missions so far are in every snapshot.
    ///
    /// # Errors
    /// The database failed.
    pub async fn begin_events(&self) -> Result<(), AppError> {
        let mut tx = self.db().read("events").await?;
        self.hub()
            .begin_after(db::history::newest_step(&mut tx).await?);
        Ok(())
    }

    /// Returns the transitions of missions that a client has not read from another run of the server or
    /// another server of the same database, up to one that a snapshot includes; only the newest
    /// [`STEPS_MISSED_MAX`] of the whole fleet are looked at.
    async fn steps_missed(
        &self,
        last: &str,
        until: i64,
        filter: &EventFilter,
    ) -> Result<VecDeque<Arc<Sent>>, AppError> {
        let read = self.hub().read_elsewhere(last);
        let Some((run, at)) = read.filter(|_| filter.includes_topic(Topic::Missions)) else {
            return Ok(VecDeque::new());
        };
        let after = at.step.max(until - i64::from(STEPS_MISSED_MAX));
        let mut tx = self.db().read("events").await?;
        let steps = db::history::steps_after(&mut tx, after, STEPS_MISSED_MAX).await?;
        let missed = steps.into_iter().filter(|(pk, _)| *pk <= until);
        let missed = missed.map(|(step, content)| {
            let about = Some((content.site.clone(), Some(content.robot.clone())));
            let event = Event::Step(Box::new(content));
            Sent {
                // A client that leaves in between goes on after the last that it has read.
                id: Some(hub::id_of(run, Position { step, ..at })),
                ..unnumbered(&event, Some(Topic::Missions), about)
            }
        });
        let matches = |step: &Sent| filter.matches(step.topic, step.about.as_ref());
        Ok(missed.filter(matches).map(Arc::new).collect())
    }

    /// Returns the first name in a filter that is not known, with its query parameter.
    pub async fn unknown_in(
        &self,
        filter: &EventFilter,
    ) -> Result<Option<(&'static str, String)>, AppError> {
        let mut tx = self.db().read("events").await?;
        if let Some(site) = &filter.site
            && db::sites::find(&mut tx, site).await?.is_none()
        {
            return Ok(Some(("site", site.to_string())));
        }
        if filter.robots.is_empty() {
            return Ok(None);
        }
        let rows = db::robots::all(&mut tx, FLEET_ROBOTS_MAX).await?;
        let of_site = |row: &&RobotRow| {
            let is_site = filter.site.as_ref().is_none_or(|site| *site == row.site);
            is_site && filter.within.includes_robot(&row.site, &row.id)
        };
        let known: HashSet<&RobotId> = rows.iter().filter(of_site).map(|row| &row.id).collect();
        let mut names: Vec<&RobotId> = filter.robots.iter().collect();
        names.sort();
        let unknown = names.into_iter().find(|robot| !known.contains(robot));
        Ok(unknown.map(|robot| ("robots", robot.to_string())))
    }
}
