//! The feed of events: what changes, in one order, to every client that asked for it.
//!
//! One task reads the steps of missions from the database, in their order, and what is new of
//! robots from memory; alerts come from where they are written. Each event is written as JSON once
//! and goes to all clients through bounded buffers. A client whose buffer is full is dropped: it
//! gets what it has, an `end`, and if it does not even read that, its connection is cut. The
//! newest events are kept, so that a client that comes back soon misses nothing.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{error, info};
use tread_api::event::{Event, StreamEnd, Topic};
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::Mission;
use tread_api::robot::{Alert, Robot};

use super::{App, AppError};
use crate::db;
use crate::db::missions::MissionFilter;
use crate::db::robots::RobotRow;
use crate::fleet::presence::RobotKey;

/// Most clients at once.
pub const CLIENTS_MAX: usize = 1_500;
/// Events that wait for one client.
pub const CLIENT_BUFFER: usize = 4_096;
/// Bytes of events that wait for one client; a single event may be larger.
pub const CLIENT_BYTES_MAX: usize = 4 * 1024 * 1024;
/// Newest events that are kept for clients that come back.
pub const KEPT_EVENTS_MAX: usize = 8_192;
/// Bytes of them.
pub const KEPT_BYTES_MAX: usize = 32 * 1024 * 1024;
/// How often robots are looked at.
pub const FEED_PERIOD: Duration = Duration::from_millis(100);
/// Steps of missions in one look.
const STEPS_MAX: u32 = 500;
/// Robots whose rows are read afresh at most this often.
const ROWS_PERIOD: Duration = Duration::from_secs(1);
/// Robots of one server in a snapshot.
const ROBOTS_MAX: u32 = 10_000;
/// Missions in a snapshot: all that are open, and the newest.
const MISSIONS_MAX: u32 = 1_000;
/// Bytes of trajectories at which a snapshot stops naming ended missions.
const MISSIONS_BYTES_MAX: usize = 4 * 1024 * 1024;
/// How long a client that was dropped may take to read its end.
const LINGER: Duration = Duration::from_secs(5);

/// One event, ready to be sent.
#[derive(Debug)]
pub struct Sent {
    /// What a client gives back as `Last-Event-ID`; `None` within a snapshot.
    pub id: Option<String>,
    /// Its name.
    pub name: &'static str,
    /// Its body, JSON on one line.
    pub text: String,
    seq: u64,
    topic: Option<Topic>,
    robot: Option<RobotKey>,
}

/// What a client wants to hear of; what is empty lets everything through.
#[derive(Debug, Clone, Default)]
pub struct EventFilter {
    /// Only these topics.
    pub topics: HashSet<Topic>,
    /// Only this site.
    pub site: Option<SiteId>,
    /// Only these robots.
    pub robots: HashSet<RobotId>,
}

impl EventFilter {
    fn lets_through(&self, topic: Option<Topic>, robot: Option<&RobotKey>) -> bool {
        let of_topic = topic.is_none_or(|topic| self.wants(topic));
        of_topic && robot.is_none_or(|(site, robot)| self.wants_robot(site, robot))
    }

    fn wants(&self, topic: Topic) -> bool {
        self.topics.is_empty() || self.topics.contains(&topic)
    }

    fn wants_robot(&self, site: &SiteId, robot: &RobotId) -> bool {
        self.site.as_ref().is_none_or(|wanted| wanted == site)
            && (self.robots.is_empty() || self.robots.contains(robot))
    }
}

/// Why a client was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Full;

/// The clients, and the newest events.
#[derive(Debug)]
pub struct Hub {
    /// Tells the events of one run of the server from those of another.
    run: String,
    state: Mutex<HubState>,
}

#[derive(Debug, Default)]
struct HubState {
    seq: u64,
    kept: VecDeque<Arc<Sent>>,
    kept_bytes: usize,
    clients: HashMap<u64, Client>,
    dropped: Vec<(Option<Duration>, CancellationToken)>,
    next_client: u64,
    dropped_count: u64,
}

#[derive(Debug)]
struct Client {
    filter: EventFilter,
    buffer: mpsc::Sender<Arc<Sent>>,
    /// Bytes that wait in the buffer.
    waiting: Arc<AtomicUsize>,
    cut: CancellationToken,
}

impl Client {
    /// Puts an event into the buffer; false if it is full.
    fn take(&self, event: &Arc<Sent>) -> bool {
        let bytes = event.text.len();
        let before = self.waiting.fetch_add(bytes, Ordering::Relaxed);
        (before == 0 || before + bytes <= CLIENT_BYTES_MAX)
            && self.buffer.try_send(Arc::clone(event)).is_ok()
    }
}

/// A client's end of its buffer; dropping it ends the subscription.
#[derive(Debug)]
pub struct Subscription {
    app: App,
    id: u64,
    events: mpsc::Receiver<Arc<Sent>>,
    waiting: Arc<AtomicUsize>,
    /// What comes first: a snapshot, or what was missed.
    first: VecDeque<Arc<Sent>>,
    covered: u64,
    ended: bool,
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.app.hub().lock().clients.remove(&self.id);
    }
}

impl Subscription {
    /// The next event; `None` after the end.
    pub async fn next(&mut self) -> Option<Arc<Sent>> {
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
                // The snapshot holds it already.
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

fn unnumbered(event: &Event, topic: Option<Topic>, robot: Option<RobotKey>) -> Sent {
    Sent {
        id: None,
        name: event.name(),
        text: serde_json::to_string(event).unwrap_or_default(),
        seq: 0,
        topic,
        robot,
    }
}

impl Hub {
    /// No clients and no events yet.
    pub(super) fn new(started_at: Timestamp) -> Self {
        Self {
            run: format!("{:x}", started_at.as_microsecond()),
            state: Mutex::default(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, HubState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How many clients there are.
    pub fn client_count(&self) -> usize {
        self.lock().clients.len()
    }

    /// How many clients were dropped because they read too slowly.
    pub fn dropped_count(&self) -> u64 {
        self.lock().dropped_count
    }

    /// The most events that wait for any client.
    pub fn longest_buffer(&self) -> usize {
        let state = self.lock();
        let waiting = |client: &Client| CLIENT_BUFFER - client.buffer.capacity();
        state.clients.values().map(waiting).max().unwrap_or(0)
    }

    fn is_closed(&self) -> bool {
        self.lock().next_client == u64::MAX
    }

    /// Ends all streams; no further client is taken.
    fn close(&self) {
        let mut state = self.lock();
        state.next_client = u64::MAX;
        state.clients.clear();
    }

    fn publish(&self, event: &Event, topic: Topic, robot: RobotKey) {
        let mut state = self.lock();
        state.seq += 1;
        let seq = state.seq;
        let sent = Arc::new(Sent {
            id: Some(format!("{}-{seq}", self.run)),
            seq,
            ..unnumbered(event, Some(topic), Some(robot))
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
            let wanted = client.filter.lets_through(sent.topic, sent.robot.as_ref());
            if wanted && !client.take(&sent) {
                slow.push(id);
            }
        }
        for id in slow {
            if let Some(client) = state.clients.remove(&id) {
                info!("an event client reads too slowly and is dropped");
                state.dropped.push((None, client.cut));
                state.dropped_count += 1;
            }
        }
    }

    /// Publishes an alert as it is now.
    pub(super) fn alert(&self, alert: &Alert) {
        let robot = (alert.site.clone(), alert.robot.clone());
        let event = Event::Alert(Box::new(alert.clone()));
        self.publish(&event, Topic::Alerts, robot);
    }

    /// Cuts the connections of clients that did not even read their end.
    fn sweep(&self, now: Duration) {
        self.lock().dropped.retain_mut(|(since, cut)| {
            let since = *since.get_or_insert(now);
            let over = now.saturating_sub(since) > LINGER;
            if over {
                cut.cancel();
            }
            !over
        });
    }

    /// What a client missed since an event; `None` if that is out of reach.
    fn missed(&self, last: &str, filter: &EventFilter) -> Option<VecDeque<Arc<Sent>>> {
        let (run, seq) = last.rsplit_once('-')?;
        let seq: u64 = seq.parse().ok()?;
        let state = self.lock();
        let oldest = state.kept.front().map_or(state.seq + 1, |event| event.seq);
        if run != self.run || seq + 1 < oldest || seq > state.seq {
            return None;
        }
        let missed = state.kept.iter().filter(|event| event.seq > seq);
        let wanted = missed.filter(|event| filter.lets_through(event.topic, event.robot.as_ref()));
        Some(wanted.cloned().collect())
    }
}

impl App {
    /// Subscribes a client: what it missed since its last event, or a snapshot, comes first.
    ///
    /// `cut` is cancelled when the client is dropped and does not read its end.
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
        let client = Client {
            filter: filter.clone(),
            buffer,
            waiting: Arc::clone(&waiting),
            cut,
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
            first: VecDeque::new(),
            covered,
            ended: false,
        };
        let missed = last.and_then(|last| self.hub().missed(last, &filter));
        if let Some(missed) = missed {
            // Published between the subscription and now: in the buffer too.
            let newest = missed.back().map_or(0, |event| event.seq);
            subscription.covered = covered.max(newest);
            subscription.first = missed;
        } else {
            subscription.covered = self.hub().lock().seq;
            subscription.first = self.snapshot(&filter, subscription.covered).await?;
        }
        Ok(subscription)
    }

    /// The first name of a filter that nothing has, with the parameter that it stands in.
    pub async fn unknown_in(
        &self,
        filter: &EventFilter,
    ) -> Result<Option<(&'static str, String)>, AppError> {
        let mut tx = self.db().read().await?;
        if let Some(site) = &filter.site
            && db::sites::find(&mut tx, site).await?.is_none()
        {
            return Ok(Some(("site", site.to_string())));
        }
        if filter.robots.is_empty() {
            return Ok(None);
        }
        let rows = db::robots::all(&mut tx, ROBOTS_MAX).await?;
        let of_site = |row: &&RobotRow| filter.site.as_ref().is_none_or(|site| *site == row.site);
        let known: HashSet<&RobotId> = rows.iter().filter(of_site).map(|row| &row.id).collect();
        let mut names: Vec<&RobotId> = filter.robots.iter().collect();
        names.sort();
        let unknown = names.into_iter().find(|robot| !known.contains(robot));
        Ok(unknown.map(|robot| ("robots", robot.to_string())))
    }

    async fn snapshot(
        &self,
        filter: &EventFilter,
        covered: u64,
    ) -> Result<VecDeque<Arc<Sent>>, AppError> {
        let mut events = VecDeque::new();
        let mut add = |event: &Event| events.push_back(Arc::new(unnumbered(event, None, None)));
        add(&Event::SnapshotBegin);
        let mut tx = self.db().read().await?;
        if filter.wants(Topic::Robots) {
            for row in db::robots::all(&mut tx, ROBOTS_MAX).await? {
                if row.retired_at.is_none() && filter.wants_robot(&row.site, &row.id) {
                    let alerts = db::alerts::raised_of(&mut tx, row.pk).await?;
                    add(&Event::Robot(Box::new(self.with_live(row, alerts))));
                }
            }
        }
        if filter.wants(Topic::Missions) {
            for mission in self.missions_to_show(&mut tx, filter).await? {
                add(&Event::Mission(Box::new(mission)));
            }
        }
        if filter.wants(Topic::Alerts) {
            for alert in db::alerts::raised(&mut tx, ROBOTS_MAX).await? {
                if filter.wants_robot(&alert.site, &alert.robot) {
                    add(&Event::Alert(Box::new(alert)));
                }
            }
        }
        drop(tx);
        let end = Sent {
            id: Some(format!("{}-{covered}", self.hub().run)),
            ..unnumbered(&Event::SnapshotEnd, None, None)
        };
        events.push_back(Arc::new(end));
        Ok(events)
    }

    /// The newest missions, and older ones that have not ended; oldest first.
    async fn missions_to_show(
        &self,
        tx: &mut db::Tx,
        filter: &EventFilter,
    ) -> Result<Vec<Mission>, AppError> {
        let of_site = MissionFilter {
            site: filter.site.clone(),
            ..MissionFilter::default()
        };
        let (mut rows, _more) =
            db::missions::list(tx, &of_site, MISSIONS_MAX, MISSIONS_BYTES_MAX).await?;
        let known: HashSet<MissionId> = rows.iter().map(|row| row.mission.id).collect();
        for standing in db::missions::in_hand(tx).await? {
            if !known.contains(&standing.id) {
                rows.extend(db::missions::find(tx, standing.id).await?);
            }
        }
        let missions = rows.into_iter().map(|row| self.with_progress(row.mission));
        let wanted = missions.filter(|mission| filter.wants_robot(&mission.site, &mission.robot));
        let mut missions: Vec<Mission> = wanted.collect();
        missions.sort_by_key(|mission| mission.id);
        Ok(missions)
    }
}

/// Publishes until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let mut feed = Feed {
        app: app.clone(),
        last_step: None,
        rows: HashMap::new(),
        rows_of: (0, None),
    };
    loop {
        if let Err(error) = feed.look().await {
            error!("cannot read what is new: {error:?}");
        }
        tokio::select! {
            biased;
            () = stop.cancelled() => break,
            () = app.announced() => {}
            () = tokio::time::sleep(FEED_PERIOD) => {}
        }
    }
    app.hub().close();
}

struct Feed {
    app: App,
    last_step: Option<i64>,
    rows: HashMap<RobotKey, (RobotRow, Vec<Alert>)>,
    /// The generation of the rows, and when they were read.
    rows_of: (u64, Option<Duration>),
}

impl Feed {
    async fn look(&mut self) -> Result<(), AppError> {
        let now = self.app.clock().elapsed();
        self.steps().await?;
        self.robots(now).await?;
        self.app.hub().sweep(now);
        Ok(())
    }

    async fn steps(&mut self) -> Result<(), AppError> {
        let mut tx = self.app.db().read().await?;
        let Some(mut last) = self.last_step else {
            // What was before the start is in every snapshot.
            self.last_step = Some(db::history::newest_step(&mut tx).await?);
            return Ok(());
        };
        let steps = db::history::steps_after(&mut tx, last, STEPS_MAX).await?;
        if u32::try_from(steps.len()).is_ok_and(|count| count == STEPS_MAX) {
            self.app.announce();
        }
        let mut moved = HashSet::new();
        let mut ended = HashSet::new();
        for (pk, step) in steps {
            last = pk;
            moved.insert(step.mission);
            if step.step.to.is_terminal() && step.step.from != Some(step.step.to) {
                ended.insert(step.mission);
            }
            let robot = (step.site.clone(), step.robot.clone());
            let event = Event::Step(Box::new(step));
            self.app.hub().publish(&event, Topic::Missions, robot);
        }
        for id in moved {
            if let Some(row) = db::missions::find(&mut tx, id).await? {
                if ended.contains(&id) {
                    self.app.mission_durations().note(&row.mission);
                }
                let mission = self.app.with_progress(row.mission);
                let robot = (mission.site.clone(), mission.robot.clone());
                let event = Event::Mission(Box::new(mission));
                self.app.hub().publish(&event, Topic::Missions, robot);
            }
        }
        self.last_step = Some(last);
        Ok(())
    }

    async fn robots(&mut self, now: Duration) -> Result<(), AppError> {
        let generation = self.app.robots_generation();
        let due = self
            .rows_of
            .1
            .is_none_or(|read_at| now.saturating_sub(read_at) >= ROWS_PERIOD);
        let mut news: HashSet<RobotKey> = HashSet::new();
        if due && self.rows_of.0 != generation {
            let mut tx = self.app.db().read().await?;
            let mut rows = HashMap::new();
            for row in db::robots::all(&mut tx, ROBOTS_MAX).await? {
                let key = (row.site.clone(), row.id.clone());
                rows.insert(key, (row, Vec::new()));
            }
            for alert in db::alerts::raised(&mut tx, ROBOTS_MAX).await? {
                let key = (alert.site.clone(), alert.robot.clone());
                if let Some((_row, alerts)) = rows.get_mut(&key) {
                    alerts.push(alert);
                }
            }
            for (key, (row, alerts)) in &rows {
                let is_same = |(before, raised): &(RobotRow, Vec<Alert>)| {
                    (&before.name, before.retired_at, raised) == (&row.name, row.retired_at, alerts)
                };
                if !self.rows.get(key).is_some_and(is_same) {
                    news.insert(key.clone());
                }
            }
            self.rows = rows;
            self.rows_of = (generation, Some(now));
        }
        news.extend(self.app.presences().take_news(now));
        if self.app.hub().client_count() == 0 {
            return Ok(());
        }
        for key in news {
            if let Some((row, alerts)) = self.rows.get(&key) {
                let robot: Robot = self.app.with_live(row.clone(), alerts.clone());
                let event = Event::Robot(Box::new(robot));
                self.app.hub().publish(&event, Topic::Robots, key);
            }
        }
        Ok(())
    }
}
