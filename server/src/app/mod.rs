//! What the server can do: use cases and their transactions. No HTTP, no SQL text.

pub mod alerts;
mod allowance;
pub mod check;
pub mod checkpoints;
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
mod planned_path;
pub mod presence;
pub mod reconciler;
pub mod retention;
pub mod robot_link;
pub mod robots;
pub mod segments;
pub mod shares;
pub mod sites;
pub mod stops;
pub mod storage;
pub mod teleop;
pub mod terrains;
pub mod withdrawals;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::sync::{Notify, Semaphore, SemaphorePermit};
use tread_api::ids::{RobotId, SiteId};
use tread_api::rights::Scope;
use uuid::Uuid;

use self::allowance::Allowances;
use self::enrolment::{EnrolmentService, Membership};
pub use self::error::AppError;
use self::events::Hub;
use self::friction::{MapNews, Pictures, Views};
use self::identity::Identity;
use self::map::Maps;
use self::missions::idempotency::InFlight;
use self::presence::Presences;
use self::retention::Removed;
use self::robot_link::{Commands, RobotLink};
use self::shares::Shares;
use self::stops::Unrecorded;
use self::storage::Storage;
use self::teleop::Holds;
use crate::clock::Clock;
use crate::config::{FrictionConfig, StorageConfig};
use crate::counters::Counters;
pub use crate::db::DbError;
use crate::db::sites::SiteRow;
use crate::db::{self, Db, Tx};
use crate::friction::index::Normalisation;
use crate::metrics::Metrics;
use crate::supervisor::Supervisor;

/// Everything that use cases work on; clones are handles to the same.
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
    /// Wakes the reconciler: what is wanted, or what is, has changed.
    changed: Notify,
    /// Wakes the feed of events.
    announced: Notify,
    hub: Hub,
    keys_in_flight: InFlight,
    checks: Semaphore,
    identity: Identity,
    maps: Maps,
    membership: Membership,
    metrics: Metrics,
    /// Counts changes of what is kept of robots.
    robots_generation: AtomicU64,
    /// Tells this run of the server from any other.
    run_id: Uuid,
    started_at: Duration,
    normalisations: Vec<Arc<Normalisation>>,
    map_readers: Semaphore,
    pictures: Pictures,
    views: Views,
    news: MapNews,
    removed: Removed,
    storage: Storage,
    unrecorded: Unrecorded,
    allowances: Allowances,
    holds: Holds,
    drive_shares: Shares,
    event_shares: Shares,
}

/// What use cases work with.
#[derive(Debug)]
pub struct Dependencies {
    /// The database.
    pub db: Db,
    /// The clock.
    pub clock: Clock,
    /// How measurements are fused.
    pub friction: FrictionConfig,
    /// When the storage counts as failing.
    pub storage: StorageConfig,
    /// How robot models may be joined.
    pub normalisations: Vec<Normalisation>,
    /// How robots are reached.
    pub robots: RobotLink,
    /// By what robots join; without it whoever reaches the network may speak.
    pub enrolment: Option<EnrolmentService>,
}

impl App {
    /// The server's use cases.
    pub fn new(dependencies: Dependencies) -> Self {
        let Dependencies {
            db,
            clock,
            friction,
            storage,
            normalisations,
            robots,
            enrolment,
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
            checks: Semaphore::new(check::CHECKS_MAX),
            identity: Identity::default(),
            maps: Maps::default(),
            membership: Membership::new(enrolment),
            metrics: Metrics::default(),
            robots_generation: AtomicU64::new(1),
            run_id,
            started_at,
            normalisations: normalisations.into_iter().map(Arc::new).collect(),
            map_readers: Semaphore::new(friction::MAP_READERS_MAX),
            pictures: Pictures::default(),
            views: Views::default(),
            news: MapNews::default(),
            removed: Removed::default(),
            storage: Storage::new(storage),
            unrecorded: Unrecorded::default(),
            allowances: Allowances::default(),
            holds: Holds::default(),
            drive_shares: Shares::new(teleop::SHARES),
            event_shares: Shares::new(events::SHARES),
        };
        Self {
            inner: Arc::new(inner),
        }
    }

    /// Use cases that reach no robot, for programs that work on the database alone.
    pub fn without_robots(
        db: Db,
        clock: Clock,
        friction: FrictionConfig,
        storage: StorageConfig,
    ) -> Self {
        Self::new(Dependencies {
            db,
            clock,
            friction,
            storage,
            normalisations: Vec::new(),
            robots: RobotLink::unconnected(Supervisor::new()),
            enrolment: None,
        })
    }

    fn normalisations(&self) -> &[Arc<Normalisation>] {
        &self.inner.normalisations
    }

    /// Sends commands to robots.
    fn commands(&self) -> &Commands {
        &self.inner.commands
    }

    /// How robots are reached.
    fn robot_link(&self) -> &RobotLink {
        &self.inner.robots
    }

    /// Starts something that ends by itself, beside a request.
    pub fn pass_by(&self, name: &'static str, task: impl Future<Output = ()> + Send + 'static) {
        self.supervisor().spawn_passing(name, task);
    }

    /// Runs what goes on after a request was answered.
    fn supervisor(&self) -> &Supervisor {
        &self.inner.robots.supervisor
    }

    /// The database.
    pub fn db(&self) -> &Db {
        &self.inner.db
    }

    /// The clock.
    pub fn clock(&self) -> &Clock {
        &self.inner.clock
    }

    /// What the server counts about itself.
    pub fn counters(&self) -> &Counters {
        &self.inner.counters
    }

    /// Who is on the network now.
    pub fn presences(&self) -> &Arc<Presences> {
        &self.inner.presences
    }

    /// Time since the start.
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

    /// Wakes the feed of events alone.
    fn announce(&self) {
        self.inner.announced.notify_one();
    }

    async fn announced(&self) {
        self.inner.announced.notified().await;
    }

    /// Where event clients subscribe.
    pub fn hub(&self) -> &Hub {
        &self.inner.hub
    }

    /// Where durations, refusals and queues are recorded.
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

    /// Waits for a turn to plan; `None` never comes, since nobody closes the semaphore.
    async fn check_turn(&self) -> Option<SemaphorePermit<'_>> {
        self.inner.checks.acquire().await.ok()
    }

    /// Waits for a turn to read the map; `None` never comes, since nobody closes the semaphore.
    async fn map_turn(&self) -> Option<SemaphorePermit<'_>> {
        self.inner.map_readers.acquire().await.ok()
    }

    fn pictures(&self) -> &Pictures {
        &self.inner.pictures
    }

    fn views(&self) -> &Views {
        &self.inner.views
    }

    fn news(&self) -> &MapNews {
        &self.inner.news
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

    fn holds(&self) -> &Holds {
        &self.inner.holds
    }

    fn allowances(&self) -> &Allowances {
        &self.inner.allowances
    }

    /// A name of this run of the server: counts in memory begin anew with each.
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

    /// Has the clock take up where the database left off, so that time does not go back over a
    /// restart either.
    ///
    /// # Errors
    /// The database failed.
    pub async fn continue_time(&self) -> Result<(), AppError> {
        let mut tx = self.db().read("mod").await?;
        let newest = db::times::newest(&mut tx).await?;
        let newest_id = db::times::newest_id(&mut tx).await?;
        self.clock().continue_after(newest, newest_id);
        Ok(())
    }
}

/// Refuses a filter that names what is not known here.
async fn check_named(
    tx: &mut Tx,
    site: Option<&SiteId>,
    robot: Option<&RobotId>,
    within: &Scope,
) -> Result<(), AppError> {
    let unknown = |parameter, name: &str| {
        let detail = format!("`{name}` names nothing that is known here");
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

/// Whether a robot of a name is known in a site, or without one in a site of a scope.
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

/// Cuts a list that was read one entry too long, and says where the next page begins.
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

/// A name for people: what was given, without blanks around it, or the identifier.
fn name_or(name: Option<String>, id: &str) -> Result<String, AppError> {
    let Some(name) = name else {
        return Ok(id.to_owned());
    };
    people_line("name", &name, tread_api::site::NAME_LENGTH_MAX)
}

/// A line that people gave for people, without blanks around it.
fn people_line(field: &'static str, given: &str, length_max: usize) -> Result<String, AppError> {
    let line = tread_api::text::line(given, length_max);
    line.map(str::to_owned).map_err(|wrong| AppError::Invalid {
        field,
        detail: format!("the {field} cannot be taken: {wrong}"),
    })
}

fn bad_cursor(cursor: &str) -> AppError {
    let cursor: String = cursor.chars().take(80).collect();
    AppError::InvalidQuery {
        parameter: "cursor",
        detail: format!("`{cursor}` is no cursor; take `next_cursor` of the page before"),
    }
}
