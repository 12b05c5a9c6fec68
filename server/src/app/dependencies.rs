//! What the use cases are created from.

use tread_telemetry::Telemetry;

use super::App;
use super::enrolment::EnrolmentService;
use super::identity::people::People;
use super::robot_link::RobotLink;
use crate::archive::SegmentArchive;
use crate::clock::Clock;
use crate::config::webhooks::WebhooksConfig;
use crate::config::{AuditConfig, FrictionConfig, MapConfig, StorageConfig};
use crate::db::Db;
use crate::friction::index::Normalisation;
use crate::supervisor::Supervisor;

/// Dependencies of use cases.
#[derive(Debug)]
pub struct Dependencies {
    /// The database.
    pub db: Db,
    /// The clock.
    pub clock: Clock,
    /// Settings of the fusion of measurements.
    pub friction: FrictionConfig,
    /// Limits beyond which the storage counts as failing.
    pub storage: StorageConfig,
    /// Declared normalisations, which join robot models.
    pub normalisations: Vec<Normalisation>,
    /// Connections to the robots.
    pub robots: RobotLink,
    /// Service by which robots join; without it any client on the network may act as a robot.
    pub enrolment: Option<EnrolmentService>,
    /// Where webhooks may go.
    pub webhooks: WebhooksConfig,
    /// Sign-in of people at an OpenID provider; without it people sign in with tokens alone.
    pub people: Option<People>,
    /// Where the audit log is written beside the database.
    pub audit: AuditConfig,
    /// Archive of raw measurements; without it old ones are only removed.
    pub archive: Option<SegmentArchive>,
    /// Memory for the map.
    pub map: MapConfig,
    /// Sender of traces of missions; its default sends none.
    pub telemetry: Telemetry,
    /// Whether it is the server that has the database.
    pub role: Role,
}

/// What a process is to its database.
#[derive(Debug, Default)]
pub enum Role {
    /// The server that has it.
    #[default]
    Active,
    /// The same, after it was a standby, whose map it takes over.
    Successor(App),
    /// A standby: another server writes the database, and this one follows it.
    Standby,
}

impl Dependencies {
    /// Returns dependencies on a database alone, with default settings and without a connection to
    /// robots.
    pub fn on_database(db: Db, clock: Clock) -> Self {
        Self {
            db,
            clock,
            friction: FrictionConfig::default(),
            storage: StorageConfig::default(),
            normalisations: Vec::new(),
            robots: RobotLink::unconnected(Supervisor::new()),
            enrolment: None,
            webhooks: WebhooksConfig::default(),
            people: None,
            audit: AuditConfig::default(),
            archive: None,
            map: MapConfig::default(),
            telemetry: Telemetry::default(),
            role: Role::Active,
        }
    }
}

impl App {
    /// Creates use cases without a connection to robots, for programs that work on the database
    /// alone.
    pub fn without_robots(
        db: Db,
        clock: Clock,
        friction: FrictionConfig,
        storage: StorageConfig,
    ) -> Self {
        Self::new(Dependencies {
            friction,
            storage,
            ..Dependencies::on_database(db, clock)
        })
    }
}
