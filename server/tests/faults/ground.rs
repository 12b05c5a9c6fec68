//! The database that fails: a site with a robot, and the use cases on it.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use jiff::Timestamp;
use serde_json::json;
use tempfile::TempDir;
use tokio::sync::{Mutex, oneshot};
use tread_api::friction::{Information, Segment, ThetaErrors};
use tread_api::ids::{BootId, MissionId, RobotId, SiteId};
use tread_api::mission::CreateMission;
use tread_api::robot::{Capabilities, RobotModel};
use tread_api::site::Cell;
use tread_api::wire::hello::Hello;
use tread_api::wire::ingest::{Batch, Receipt, Record, RecordContent};
use tread_api::wire::{Refusal, RefusalCode};
use tread_samples::rover;
use tread_server::app::friction::{Area, CellRequest, ReadingParameters};
use tread_server::app::ingest::{Upload, Writer};
use tread_server::app::{App, AppError};
use tread_server::clock::Clock;
use tread_server::config::{FrictionConfig, StorageConfig};
use tread_server::db::{self, Db, DbError, Tx};
use uuid::Uuid;

/// Where the ground's time begins.
const BEGIN: &str = "2026-11-01T00:00:00Z";

/// The use cases of a server without a network.
pub(crate) struct Ground {
    _folder: TempDir,
    pub(crate) app: App,
    pub(crate) site: SiteId,
    pub(crate) site_pk: i64,
    pub(crate) robot: RobotId,
    pub(crate) robot_pk: i64,
    pub(crate) mission: MissionId,
    writer: Mutex<Writer>,
    acknowledged: AtomicU64,
}

pub(crate) fn now() -> Timestamp {
    BEGIN.parse().unwrap()
}

pub(crate) fn uuid(number: u64) -> Uuid {
    Uuid::from_u128(u128::from(number) + (7 << 76))
}

pub(crate) fn boot() -> BootId {
    BootId::from_uuid(uuid(1))
}

fn model() -> RobotModel {
    rover("test rover")
}

impl Ground {
    pub(crate) async fn prepare() -> Self {
        Self::prepare_with(Duration::from_secs(15)).await
    }

    /// The same, with a bound on how long a commit may take.
    pub(crate) async fn prepare_with(commit_max: Duration) -> Self {
        // Syncs cost nothing in memory; what fails is the same.
        let memory = std::path::Path::new("/dev/shm");
        let folder = tempfile::tempdir_in(memory).or_else(|_| tempfile::tempdir());
        let folder = folder.unwrap();
        let db = Db::open_with(&folder.path().join("tread.db"), commit_max)
            .await
            .unwrap();
        let clock = Clock::manual(now());
        let app = App::without_robots(
            db,
            clock,
            FrictionConfig::default(),
            StorageConfig::default(),
        );
        let site: SiteId = "yard".parse().unwrap();
        let robot: RobotId = "rover-1".parse().unwrap();
        app.ensure_site(&site).await.unwrap();
        app.hello(&site, &hello(&robot, 1)).await.unwrap();
        let mission = app.create_mission(mission(&site, &robot)).await.unwrap();
        let mut tx = app.db().read("test").await.unwrap();
        let site_pk = db::sites::find(&mut tx, &site).await.unwrap().unwrap().pk;
        let robot_pk = db::robots::pk_of(&mut tx, &site, &robot).await.unwrap();
        drop(tx);
        Self {
            _folder: folder,
            writer: Mutex::new(Writer::new(app.clone())),
            app,
            site,
            site_pk,
            robot,
            robot_pk: robot_pk.unwrap(),
            mission: mission.id,
            acknowledged: AtomicU64::new(0),
        }
    }

    /// One transaction.
    pub(crate) async fn write(
        &self,
        what: impl AsyncFnOnce(&mut Tx) -> Result<(), DbError>,
    ) -> Result<(), AppError> {
        let mut tx = self.app.db().write("test").await?;
        what(&mut tx).await?;
        Ok(tx.commit().await?)
    }

    /// Uploads measurements, as a robot does.
    pub(crate) async fn upload(&self, records: Vec<Record>) -> Result<Receipt, AppError> {
        let (answer, answered) = oneshot::channel();
        let batch = Batch {
            robot: self.robot.clone(),
            boot: boot(),
            robot_time: None,
            records,
        };
        let site = self.site.clone();
        let upload = Upload {
            site,
            batch,
            answer,
        };
        self.writer.lock().await.store(vec![upload]).await;
        match answered.await.unwrap() {
            Ok(receipt) => {
                self.acknowledged
                    .fetch_add(receipt.committed, Ordering::Relaxed);
                Ok(receipt)
            }
            // What the robot is answered when the storage fails.
            Err(Refusal {
                code: RefusalCode::Busy,
                ..
            }) => Err(AppError::Storage(DbError::Busy)),
            Err(refusal) => panic!("{refusal:?}"),
        }
    }

    /// The database is whole, holds what was acknowledged, and the map in memory is what it says.
    pub(crate) async fn check(&self) {
        assert_eq!(self.app.db().quick_check().await.unwrap(), None);
        let mut tx = self.app.db().read("test").await.unwrap();
        let broken = sqlx::query("PRAGMA foreign_key_check")
            .fetch_all(&mut **tx.as_sqlite().unwrap())
            .await
            .unwrap();
        assert!(
            broken.is_empty(),
            "{} foreign keys lead nowhere",
            broken.len()
        );
        drop(tx);
        // Before the last sums are stored, and after.
        self.check_map().await;
        let counted = self.segments_counted().await;
        assert_eq!(counted, self.acknowledged.load(Ordering::Relaxed));
        self.check_map().await;
    }

    /// Segments in the sums of the database, after all were stored.
    pub(crate) async fn segments_counted(&self) -> u64 {
        self.app.write_sums().await.unwrap();
        let mut tx = self.app.db().read("test").await.unwrap();
        let mut counted = 0;
        db::sums::each(&mut tx, |row| counted += row.sums.segments)
            .await
            .unwrap();
        counted
    }

    /// The map in memory is what the database says.
    pub(crate) async fn check_map(&self) {
        assert_eq!(
            self.said(&self.app).await,
            self.said_after_a_restart().await
        );
    }

    /// Whether the map in memory is what the database says.
    pub(crate) async fn is_map_right(&self) -> bool {
        self.said(&self.app).await == self.said_after_a_restart().await
    }

    async fn said_after_a_restart(&self) -> String {
        let restarted = App::without_robots(
            self.app.db().clone(),
            self.app.clock().clone(),
            FrictionConfig::default(),
            StorageConfig::default(),
        );
        restarted.load_map().await.unwrap();
        self.said(&restarted).await
    }

    /// The map now, and as it was in the middle of a day: that shows what is read as days.
    async fn said(&self, app: &App) -> String {
        let mut said = Vec::new();
        for as_of in [None, Some(now() - Duration::from_hours(39))] {
            let cells = CellRequest {
                area: Area::WHOLE,
                resolution_m: None,
                cursor: None,
                limit: 1_000,
            };
            let parameters = ReadingParameters {
                as_of,
                ..ReadingParameters::default()
            };
            let page = app.friction_of_cells(&self.site, &parameters, cells).await;
            said.push(page.unwrap().items);
        }
        format!("{said:?}")
    }
}

pub(crate) fn hello(robot: &RobotId, number: u64) -> Hello {
    Hello {
        robot: robot.clone(),
        boot: boot(),
        agent_version: format!("0.0.{number}"),
        model: model(),
        robot_time: now(),
        capabilities: Capabilities {
            pause: true,
            replace: true,
            stop: true,
            ..Capabilities::default()
        },
    }
}

pub(crate) fn mission(site: &SiteId, robot: &RobotId) -> CreateMission {
    let circle = json!({"circle": {"center": {"x_m": 1.0, "y_m": 2.0}, "radius_m": 3.0,
                                   "speed_m_s": 0.6}});
    let mission = json!({"site": site, "robot": robot, "trajectory": circle});
    serde_json::from_value(mission).unwrap()
}

/// A measurement in one of some cells, in one of some hours.
pub(crate) fn segment(number: u64) -> Record {
    let small = i32::try_from(number % 5).unwrap();
    let hour = Duration::from_hours(number % 3);
    let at = now() - Duration::from_hours(40) + hour;
    Record {
        seq: number,
        content: RecordContent::Segment(Segment {
            configuration: model().configuration(),
            mission: None,
            started_at: at,
            ended_at: at,
            grid_revision: 1,
            cell: Cell {
                ix: small,
                iy: -small,
            },
            terrain: None,
            theta: Information {
                information: 1e4,
                weighted: 2e3 + f64::from(small),
            },
            theta_errors: (number % 2 == 1).then_some(ThetaErrors {
                independent_information: 1e4,
                robot_ratio: 0.12,
                tyre_ratio: 0.1,
            }),
            effective_track_ratio: None,
            rolling_resistance: None,
            mu_peak_lower_bound: Some(0.4),
            samples: 100,
            distance_m: 0.9,
            saturation_ratio: 0.0,
        }),
    }
}
