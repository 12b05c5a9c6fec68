//! What the server can do: use cases and their transactions. No HTTP, no SQL text.

pub mod friction;
pub mod ingest;
pub mod missions;
pub mod reconciler;
pub mod robots;
pub mod segments;
pub mod sites;
pub mod terrains;

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Notify;
use tread_api::ids::{MissionId, RobotId, SiteId, TerrainId};

use crate::clock::Clock;
use crate::config::FrictionConfig;
use crate::counters::Counters;
use crate::db::sites::SiteRow;
use crate::db::{self, Db, DbError, Tx};
use crate::fleet::presence::Presences;

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
    counters: Counters,
    presences: Presences,
    /// Wakes the reconciler: what is wanted, or what is, has changed.
    changed: Notify,
    started_at: Duration,
}

impl App {
    /// The server's use cases on this database and clock.
    pub fn new(db: Db, clock: Clock, friction: FrictionConfig) -> Self {
        let started_at = clock.elapsed();
        let inner = Inner {
            db,
            clock,
            friction,
            counters: Counters::default(),
            presences: Presences::default(),
            changed: Notify::new(),
            started_at,
        };
        Self {
            inner: Arc::new(inner),
        }
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
    pub fn presences(&self) -> &Presences {
        &self.inner.presences
    }

    /// Time since the start.
    pub fn uptime(&self) -> Duration {
        self.inner
            .clock
            .elapsed()
            .saturating_sub(self.inner.started_at)
    }

    /// Wakes the reconciler.
    pub fn wake(&self) {
        self.inner.changed.notify_one();
    }

    async fn changed(&self) {
        self.inner.changed.notified().await;
    }

    fn friction_config(&self) -> &FrictionConfig {
        &self.inner.friction
    }

    /// Whether the database answers.
    ///
    /// # Errors
    /// [`AppError::Storage`] if not.
    pub async fn ready(&self) -> Result<(), AppError> {
        let mut tx = self.db().read().await?;
        db::sites::list(&mut tx, "", 1).await?;
        Ok(())
    }
}

/// Why a use case did not do it.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// No site of that name.
    #[error("site `{0}` is not known")]
    UnknownSite(SiteId),
    /// No robot of that name in the site.
    #[error("robot `{1}` has never said hello in site `{0}`")]
    UnknownRobot(SiteId, RobotId),
    /// No terrain of that name in the site.
    #[error("terrain `{1}` is not drawn in site `{0}`")]
    UnknownTerrain(SiteId, TerrainId),
    /// No mission of that identifier.
    #[error("mission `{0}` is not known")]
    UnknownMission(MissionId),
    /// The identifier is in use.
    #[error("{what} `{id}` exists already")]
    AlreadyExists {
        /// What kind of thing.
        what: &'static str,
        /// Its identifier.
        id: String,
    },
    /// The robot cannot do what is asked.
    #[error("robot `{robot}` cannot do this: {detail}")]
    BeyondLimits {
        /// The robot.
        robot: RobotId,
        /// Which limit.
        detail: String,
    },
    /// The mission has ended and cannot be changed.
    #[error("mission `{id}` has ended: it is {state}")]
    MissionEnded {
        /// The mission.
        id: MissionId,
        /// How it ended.
        state: &'static str,
    },
    /// A bound on how many there may be is reached.
    #[error("there are already {count} {what}; that is the most")]
    TooMany {
        /// What there are too many of.
        what: &'static str,
        /// The bound.
        count: usize,
    },
    /// A field of the request says something impossible.
    #[error("{detail}")]
    Invalid {
        /// Which field.
        field: &'static str,
        /// What is wrong.
        detail: String,
    },
    /// A parameter of the query says something impossible.
    #[error("{detail}")]
    InvalidQuery {
        /// Which parameter.
        parameter: &'static str,
        /// What is wrong.
        detail: String,
    },
    /// The database failed.
    #[error("the database failed")]
    Storage(#[from] DbError),
}

impl AppError {
    /// The field or parameter that says something impossible.
    pub fn field(&self) -> Option<&'static str> {
        match self {
            Self::Invalid { field, .. } => Some(field),
            Self::InvalidQuery { parameter, .. } => Some(parameter),
            Self::UnknownSite(_)
            | Self::UnknownRobot(..)
            | Self::UnknownTerrain(..)
            | Self::UnknownMission(_)
            | Self::AlreadyExists { .. }
            | Self::BeyondLimits { .. }
            | Self::MissionEnded { .. }
            | Self::TooMany { .. }
            | Self::Storage(_) => None,
        }
    }
}

impl From<sqlx::Error> for AppError {
    fn from(error: sqlx::Error) -> Self {
        Self::Storage(error.into())
    }
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
    let length_max = tread_api::site::NAME_LENGTH_MAX;
    let trimmed = name.trim();
    if trimmed.is_empty() || trimmed.chars().count() > length_max {
        let detail = format!("a name has 1 to {length_max} characters");
        return Err(AppError::Invalid {
            field: "name",
            detail,
        });
    }
    Ok(trimmed.to_owned())
}

fn bad_cursor(cursor: &str) -> AppError {
    let cursor: String = cursor.chars().take(80).collect();
    AppError::InvalidQuery {
        parameter: "cursor",
        detail: format!("`{cursor}` is no cursor; take `next_cursor` of the page before"),
    }
}
