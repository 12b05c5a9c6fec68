//! The server's use cases and their transactions. Contains no HTTP and no SQL text.

pub mod alerts;
mod allowance;
pub mod archive;
pub mod backups;
pub mod certificate;
pub mod check;
pub mod checkpoints;
mod dependencies;
pub mod enrolment;
mod error;
pub mod events;
pub mod friction;
pub mod geofence;
pub mod identity;
pub mod ingest;
pub mod limits;
mod map;
pub mod memory;
pub mod merging;
pub mod metrics;
pub mod missions;
mod own_alert;
mod planned_path;
pub mod precondition;
pub mod presence;
mod recalls;
pub mod reconciler;
pub mod restoration;
pub mod retention;
pub mod robot_link;
pub mod robots;
pub mod segments;
pub mod shares;
pub mod sites;
mod start;
pub mod stops;
pub mod storage;
pub mod teleop;
pub mod terrains;
mod traces;
mod trajectory_value;
pub mod watched;
pub mod webhooks;
pub mod withdrawals;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::sync::{Notify, Semaphore, SemaphorePermit};
use tread_api::ids::{RobotId, SiteId};
use tread_api::rights::Scope;
use tread_telemetry::Telemetry;
use uuid::Uuid;

use self::allowance::Allowances;
use self::archive::Archive;
use self::backups::Backups;
pub use self::dependencies::{Dependencies, Role};
use self::enrolment::Membership;
pub use self::error::AppError;
use self::events::Hub;
use self::friction::{CellCounts, MapUpdates, Pictures, ReaderSlots, Timelines, Views};
use self::identity::Identity;
use self::map::Maps;
pub use self::map::{
    BlockCounts, UnwrittenCounts, blocks as map_blocks, following, writing as sums,
};
use self::missions::idempotency::InFlight;
use self::missions::immediate_offer::NewOffers;
use self::presence::Presences;
use self::restoration::Restored;
use self::retention::Removed;
use self::robot_link::{Commands, RobotLink};
use self::shares::Shares;
use self::stops::Unrecorded;
use self::storage::Storage;
use self::teleop::Holds;
use self::watched::Watched;
use self::webhooks::Webhooks;
use crate::clock::Clock;
use crate::config::FrictionConfig;
use crate::counters::Counters;
pub use crate::db::DbError;
use crate::db::sites::SiteRow;
use crate::db::{self, Db, Tx};
use crate::friction::index::Normalisation;
use crate::metrics::Metrics;
use crate::supervisor::Supervisor;

/// State shared by all use cases; clones share the same state.
#[derive(Debug, Clone)]
pub struct App {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    db: Db,
    clock: Clock,
    friction: FrictionConfig,
    counters: Arc<Counters>,
    presences: Arc<Presences>,
    robots: RobotLink,
    commands: Commands,
    /// Wakes the reconciler after a change of the desired state or of what robots report.
    changed: Notify,
    /// Wakes the feed of events.
    announced: Notify,
    hub: Hub,
    keys_in_flight: InFlight,
    new_offers: NewOffers,
    recalls: AtomicU64,
    checks: Semaphore,
    identity: Identity,
    /// Those of the standby that this process was, if it was one.
    maps: Arc<Maps>,
    membership: Membership,
    metrics: Metrics,
    /// Incremented with each change of robots' rows.
    robots_generation: AtomicU64,
    /// Identifier of this run of the server.
    run_id: Uuid,
    started_at: Duration,
    normalisations: Vec<Arc<Normalisation>>,
    reader_slots: ReaderSlots,
    cell_counts: CellCounts,
    pictures: Pictures,
    timelines: Timelines,
    views: Views,
    map_updates: MapUpdates,
    removed: Removed,
    storage: Storage,
    unrecorded: Unrecorded,
    allowances: Allowances,
    holds: Holds,
    drive_shares: Shares,
    watched: Watched,
    event_shares: Shares,
    webhooks: Webhooks,
    telemetry: Telemetry,
    backups: Backups,
    archive: Option<Archive>,
    restored: Restored,
}

impl App {
    /// Creates the server's use cases.
    pub fn new(dependencies: Dependencies) -> Self {
        let Dependencies {
            db,
            clock,
            friction,
            storage,
            normalisations,
            robots,
            enrolment,
            webhooks,
            people,
            audit,
            archive,
            map,
            telemetry,
            role,
        } = dependencies;
        let started_at = clock.elapsed();
        let presences = Arc::default();
        let counters = Arc::<Counters>::default();
        let commands = Commands::new(
            Arc::clone(&robots.commands),
            Arc::clone(&presences),
            Arc::clone(&counters),
        );
        let hub = Hub::new(clock.now());
        let archive = archive.map(Archive::new);
        let run_id = clock.new_id::<Uuid>();
        let inner = Inner {
            db,
            clock,
            friction,
            counters,
            presences,
            robots,
            commands,
            changed: Notify::new(),
            announced: Notify::new(),
            hub,
            keys_in_flight: InFlight::default(),
            new_offers: NewOffers::default(),
            recalls: AtomicU64::new(0),
            checks: Semaphore::new(check::CHECKS_MAX),
            identity: Identity::new(people, audit),
            maps: match role {
                Role::Active => Arc::new(Maps::new(map.memory_max_mib, false)),
                Role::Standby => Arc::new(Maps::new(map.memory_max_mib, true)),
                Role::Successor(standby) => Arc::clone(&standby.inner.maps),
            },
            membership: Membership::new(enrolment),
            metrics: Metrics::default(),
            robots_generation: AtomicU64::new(1),
            run_id,
            started_at,
            normalisations: normalisations.into_iter().map(Arc::new).collect(),
            reader_slots: ReaderSlots::default(),
            cell_counts: CellCounts::default(),
            pictures: Pictures::default(),
            timelines: Timelines::default(),
            views: Views::default(),
            map_updates: MapUpdates::default(),
            removed: Removed::default(),
            storage: Storage::new(storage),
            unrecorded: Unrecorded::default(),
            allowances: Allowances::default(),
            holds: Holds::default(),
            drive_shares: Shares::new(teleop::SHARES),
            watched: Watched::default(),
            event_shares: Shares::new(events::SHARES),
            webhooks: Webhooks::new(webhooks),
            telemetry,
            backups: Backups::default(),
            archive,
            restored: Restored::default(),
        };
        Self {
            inner: Arc::new(inner),
        }
    }

    fn normalisations(&self) -> &[Arc<Normalisation>] {
        &self.inner.normalisations
    }

    /// Returns the sender of commands to robots.
    fn commands(&self) -> &Commands {
        &self.inner.commands
    }

    /// Returns the connections to the robots.
    fn robot_link(&self) -> &RobotLink {
        &self.inner.robots
    }

    /// Starts a background task that the request does not wait for. The task must be finite.
    pub fn spawn_background(
        &self,
        name: &'static str,
        task: impl Future<Output = ()> + Send + 'static,
    ) {
        self.supervisor().spawn_passing(name, task);
    }

    /// Returns the supervisor of tasks that outlive their request.
    pub fn supervisor(&self) -> &Supervisor {
        &self.inner.robots.supervisor
    }

    /// Returns the database.
    pub fn db(&self) -> &Db {
        &self.inner.db
    }

    /// Returns the clock.
    pub fn clock(&self) -> &Clock {
        &self.inner.clock
    }

    /// Returns the server's counters.
    pub fn counters(&self) -> &Counters {
        &self.inner.counters
    }

    /// Returns the presence of all robots.
    pub fn presences(&self) -> &Arc<Presences> {
        &self.inner.presences
    }

    /// Returns the time since the start of the server.
    pub fn uptime(&self) -> Duration {
        self.inner
            .clock
            .elapsed()
            .saturating_sub(self.inner.started_at)
    }

    /// Wakes the reconciler and the feed of events.
    pub fn wake(&self) {
        self.inner.changed.notify_one();
        self.announce();
    }

    /// Wakes only the feed of events.
    fn announce(&self) {
        self.inner.announced.notify_one();
    }

    async fn announced(&self) {
        self.inner.announced.notified().await;
    }

    /// Returns the hub to which event clients subscribe.
    pub fn hub(&self) -> &Hub {
        &self.inner.hub
    }

    /// Returns the metrics of durations, refusals and queues.
    pub fn metrics(&self) -> &Metrics {
        &self.inner.metrics
    }

    fn maps(&self) -> &Maps {
        &self.inner.maps
    }

    fn identity(&self) -> &Identity {
        &self.inner.identity
    }

    fn membership(&self) -> &Membership {
        &self.inner.membership
    }

    fn keys_in_flight(&self) -> &InFlight {
        &self.inner.keys_in_flight
    }

    fn new_offers(&self) -> &NewOffers {
        &self.inner.new_offers
    }

    /// Waits for a turn to plan. `None` cannot occur, since the semaphore is never closed.
    async fn check_turn(&self) -> Option<SemaphorePermit<'_>> {
        self.inner.checks.acquire().await.ok()
    }

    fn pictures(&self) -> &Pictures {
        &self.inner.pictures
    }

    fn timelines(&self) -> &Timelines {
        &self.inner.timelines
    }

    fn views(&self) -> &Views {
        &self.inner.views
    }

    fn map_updates(&self) -> &MapUpdates {
        &self.inner.map_updates
    }

    fn removed(&self) -> &Removed {
        &self.inner.removed
    }

    fn storage(&self) -> &Storage {
        &self.inner.storage
    }

    fn unrecorded(&self) -> &Unrecorded {
        &self.inner.unrecorded
    }

    fn webhooks(&self) -> &Webhooks {
        &self.inner.webhooks
    }

    fn holds(&self) -> &Holds {
        &self.inner.holds
    }

    fn watched(&self) -> &Watched {
        &self.inner.watched
    }

    fn allowances(&self) -> &Allowances {
        &self.inner.allowances
    }

    /// Returns an identifier of this run of the server: counts in memory restart with each run.
    fn run_id(&self) -> String {
        self.inner.run_id.to_string()
    }

    fn robots_changed(&self) {
        self.inner.robots_generation.fetch_add(1, Ordering::Relaxed);
    }

    fn robots_generation(&self) -> u64 {
        self.inner.robots_generation.load(Ordering::Relaxed)
    }

    async fn changed(&self) {
        self.inner.changed.notified().await;
    }

    fn friction_config(&self) -> &FrictionConfig {
        &self.inner.friction
    }
}

/// Refuses a filter that names an unknown site or robot.
async fn check_named(
    tx: &mut Tx,
    site: Option<&SiteId>,
    robot: Option<&RobotId>,
    within: &Scope,
) -> Result<(), AppError> {
    let unknown = |parameter, name: &str| {
        let detail = format!("`{name}` is unknown, or outside the scope of the token");
        Err(AppError::InvalidQuery { parameter, detail })
    };
    if let Some(site) = site
        && db::sites::find(tx, site).await?.is_none()
    {
        return unknown("site", site.as_str());
    }
    match robot {
        Some(robot) if !is_known(tx, site, robot, within).await? => {
            unknown("robot", robot.as_str())
        }
        Some(_) | None => Ok(()),
    }
}

/// Returns whether a robot of this name is known in a site, or, without one, in any site of a
/// scope.
async fn is_known(
    tx: &mut Tx,
    site: Option<&SiteId>,
    robot: &RobotId,
    within: &Scope,
) -> Result<bool, AppError> {
    let (Some(sites), None) = (within.sites(), site) else {
        return Ok(db::robots::is_known(tx, site, robot).await?);
    };
    for site in sites {
        let is_in = within.includes_robot(site, robot);
        if is_in && db::robots::is_known(tx, Some(site), robot).await? {
            return Ok(true);
        }
    }
    Ok(false)
}

async fn site_row(tx: &mut Tx, site: &SiteId) -> Result<SiteRow, AppError> {
    db::sites::find(tx, site)
        .await?
        .ok_or_else(|| AppError::UnknownSite(site.clone()))
}

/// Truncates a list that was read one entry too long, and sets the cursor of the next page.
fn page<T>(
    mut items: Vec<T>,
    limit: u32,
    cursor_of: impl Fn(&T) -> String,
) -> tread_api::page::Page<T> {
    let limit = usize::try_from(limit).unwrap_or(usize::MAX);
    let more = items.len() > limit;
    items.truncate(limit);
    let next_cursor = items.last().filter(|_| more).map(cursor_of);
    tread_api::page::Page { items, next_cursor }
}

/// Returns a display name: the given one, trimmed, or else the identifier.
fn name_or(name: Option<String>, id: &str) -> Result<String, AppError> {
    let Some(name) = name else {
        return Ok(id.to_owned());
    };
    people_line(PeopleField::Name, &name, tread_api::site::NAME_LENGTH_MAX)
}

/// Field of a request that is a line of text for people.
#[derive(Debug, Clone, Copy)]
enum PeopleField {
    Name,
    Reason,
}

/// Checks and trims a line of text for people.
fn people_line(field: PeopleField, given: &str, length_max: usize) -> Result<String, AppError> {
    let field = match field {
        PeopleField::Name => "name",
        PeopleField::Reason => "reason",
    };
    let line = tread_api::text::line(given, length_max);
    line.map(str::to_owned).map_err(|wrong| AppError::Invalid {
        field,
        detail: format!("the {field} is invalid: {wrong}"),
    })
}

fn bad_cursor(cursor: &str) -> AppError {
    let cursor: String = cursor.chars().take(80).collect();
    AppError::InvalidQuery {
        parameter: "cursor",
        detail: format!("`{cursor}` is not a cursor; use `next_cursor` of the previous page"),
    }
}
