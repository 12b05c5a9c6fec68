//! All metrics of the server in the OpenMetrics format: those recorded continuously
//! ([`crate::metrics`]), and those read at the time of the request.

mod map;

use std::collections::BTreeMap;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};
use tread_api::link::LinkQuality;
use tread_api::mission::{Mission, MissionState};

use super::friction::KnownGround;
use super::{App, AppError};
use crate::build;
use crate::db;
use crate::db::failure::{self, StorageFailure};
use crate::metrics::Refusal;

/// Media type of the OpenMetrics text format.
pub const MEDIA_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Maximum number of pairs of terrain and robot model with their own time series.
pub const TERRAIN_SERIES_MAX: usize = 500;

/// Maximum number of robots whose links have time series of their own.
pub const ROBOT_SERIES_MAX: usize = 500;

/// Reasons for which HTTP requests are refused before a handler runs.
const OF_CLIENTS: [&str; 11] = [
    "host",
    "locked",
    "no_token",
    "origin",
    "role",
    "scope",
    "token_expired",
    "token_malformed",
    "token_revoked",
    "token_unknown",
    "too_long",
];

/// Gauges with one label, filled at the time of the request.
type Gauges<V = &'static str> = Family<[(&'static str, V); 1], Gauge<u64, AtomicU64>>;
/// Counters with one label, filled at the time of the request.
type Counts = Family<[(&'static str, &'static str); 1], Counter>;

/// Labels of a terrain and a robot model.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct TerrainLabels {
    site: String,
    terrain: String,
    configuration: String,
}

/// Labels of a robot.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RobotLabels {
    site: String,
    robot: String,
}

/// Selects one value of a link's quality.
type LinkValue = fn(&LinkQuality) -> Option<f64>;
/// Selects one value of a terrain's friction.
type TerrainValue = fn(&KnownGround) -> f64;

#[expect(clippy::cast_precision_loss, reason = "counts of an hour")]
fn as_f64(count: u64) -> f64 {
    count as f64
}

fn count(of: usize) -> u64 {
    u64::try_from(of).unwrap_or(u64::MAX)
}

impl App {
    /// Returns all metrics as text; without those from the database while it cannot be read.
    pub async fn metrics_text(&self) -> String {
        let mut registry = Registry::default();
        self.register_storage(&mut registry);
        self.register_sums(&mut registry);
        self.register_map_blocks(&mut registry);
        // Metrics from memory are shown also while the database cannot be read.
        for registered in [
            self.register_standbys(&mut registry).await,
            self.register_fleet(&mut registry).await,
            self.register_terrains(&mut registry).await,
        ] {
            if let Err(error) = registered {
                self.log_failure("read metrics", &error);
            }
        }
        self.register_clients(&mut registry);
        self.register_links(&mut registry);
        self.register_clock(&mut registry);
        self.register_build(&mut registry);
        self.register_backups(&mut registry);
        self.register_archive(&mut registry);
        let uptime = ConstGauge::new(self.uptime().as_secs_f64());
        let help = "Time since the start";
        registry.register_with_unit("tread_uptime", help, Unit::Seconds, uptime);
        let refusals = self.register_counters(&mut registry);
        self.metrics().register(&mut registry, refusals);
        self.db().metrics().register(&mut registry);
        let mut text = String::new();
        if let Err(error) = encode(&mut text, &registry) {
            self.log_failure("write metrics", &error);
        }
        text
    }

    /// Records the duration of a mission that has ended, none if it never began, and sends its trace.
    pub(super) fn record_duration(&self, mission: &Mission) {
        self.trace_mission(mission);
        if let (Some(began), Some(ended)) = (mission.started_at, mission.ended_at) {
            let took = Duration::try_from(ended.duration_since(began)).unwrap_or_default();
            self.metrics().mission(mission.state, took);
        }
    }

    /// Registers the state of the storage.
    fn register_storage(&self, registry: &mut Registry) {
        let condition = self.storage_condition();
        let gauges = [
            (
                "tread_storage_writable",
                Some(u64::from(condition.unwritable.is_none())),
                "Whether the database takes writes",
            ),
            (
                "tread_storage_damaged",
                Some(u64::from(condition.damaged.is_some())),
                "Whether the database is known to be damaged",
            ),
            (
                "tread_storage_disk_low",
                Some(u64::from(condition.is_disk_low)),
                "Whether less is free on the disk of the database than configured",
            ),
            (
                "tread_storage_disk_free_bytes",
                condition.disk_free_bytes,
                "Free bytes on the disk of the database",
            ),
            (
                "tread_db_size_bytes",
                condition.database_bytes,
                "Size of the database file",
            ),
            (
                "tread_db_log_bytes",
                condition.log_bytes,
                "Size of the write-ahead log of the database",
            ),
        ];
        for (name, value, help) in gauges {
            if let Some(value) = value {
                registry.register(name, help, ConstGauge::new(value));
            }
        }
        if let Some(ends) = self.storage().certificate_ends() {
            let left = ends.duration_since(self.clock().machine_time());
            let help = "Time until the certificate of the REST API expires";
            let left = ConstGauge::new(left.as_secs_f64());
            registry.register("tread_certificate_left_seconds", help, left);
        }
        let failures = Counts::default();
        for failure in StorageFailure::ALL {
            let counter = failures.get_or_create(&[("kind", failure.as_str())]);
            counter.inc_by(failure::count(failure));
        }
        let help = "Failures of the storage, by kind";
        registry.register("tread_storage_failures", help, failures);
    }

    /// Registers version, commit and schema.
    fn register_build(&self, registry: &mut Registry) {
        let info = Info::new([
            ("version", build::VERSION.to_owned()),
            ("commit", build::commit().unwrap_or("unknown").to_owned()),
            ("schema", self.db().schema().to_string()),
        ]);
        registry.register("tread_build", "Version, commit and schema", info);
        let awaiting = self.restoration().map_or(0, |(_, awaiting)| awaiting);
        let help = "Robots that await their release after a restoration from a backup";
        registry.register(
            "tread_robots_awaiting_release",
            help,
            ConstGauge::new(awaiting),
        );
    }

    /// Registers the state of scheduled backups; nothing without them.
    fn register_backups(&self, registry: &mut Registry) {
        let Some(state) = self.backup_state() else {
            return;
        };
        if let Some((at, bytes)) = state.last {
            let age = self.clock().now().duration_since(at);
            let age = ConstGauge::new(age.as_secs_f64());
            let help = "Age of the last complete backup";
            registry.register_with_unit("tread_backup_age", help, Unit::Seconds, age);
            let help = "Size of the last complete backup";
            let bytes = ConstGauge::new(bytes);
            registry.register_with_unit("tread_backup_size", help, Unit::Bytes, bytes);
        }
        if let Some(took) = state.took {
            let help = "Duration of the last backup of this process";
            let took = ConstGauge::new(took.as_secs_f64());
            registry.register_with_unit("tread_backup_duration", help, Unit::Seconds, took);
        }
        let failed = ConstGauge::new(u64::from(state.failure.is_some()));
        let help = "Whether the last attempt to make a backup failed";
        registry.register("tread_backup_failed", help, failed);
    }

    /// Registers the state of the archive; nothing without one.
    fn register_archive(&self, registry: &mut Registry) {
        if let Some(is_failed) = self.is_archive_failed() {
            let failed = ConstGauge::new(u64::from(is_failed));
            let help = "Whether the last attempt to archive old measurements failed";
            registry.register("tread_archive_failed", help, failed);
        }
    }

    /// Registers the steps of the machine's clock.
    fn register_clock(&self, registry: &mut Registry) {
        // Read here, so that a step shows even if nothing else reads the clock.
        self.clock().now();
        let steps = self.clock().steps();
        let counts = Counts::default();
        for (direction, count) in [("back", steps.back), ("forward", steps.forward)] {
            counts
                .get_or_create(&[("direction", direction)])
                .inc_by(count);
        }
        let help = "Steps of the machine's clock";
        registry.register("tread_clock_steps", help, counts);
        let ahead = ConstGauge::new(steps.ahead.as_secs_f64());
        let help = "How far the server's time is ahead of the machine's clock, which was set back";
        registry.register_with_unit("tread_clock_ahead", help, Unit::Seconds, ahead);
    }

    /// Registers missions, robots and stops.
    async fn register_fleet(&self, registry: &mut Registry) -> Result<(), AppError> {
        let now = self.clock().elapsed();
        let robots = Gauges::default();
        for (link, number) in self.presences().link_counts(now) {
            let gauge = robots.get_or_create(&[("link", link.as_str())]);
            gauge.set(count(number));
        }
        registry.register("tread_robots", "Robots by link state", robots);
        let reduced = Gauges::<String>::default();
        for (cause, number) in self.presences().gate_causes(now) {
            reduced
                .get_or_create(&[("cause", cause)])
                .set(count(number));
        }
        let help = "Robots that are heard and slowed down, by the strictest cause";
        registry.register("tread_robots_reduced", help, reduced);
        let mut tx = self.db().read("metrics").await?;
        let counts = db::missions::counts(&mut tx).await?;
        let pending = db::webhooks::pending_count(&mut tx).await?;
        drop(tx);
        self.register_queues(registry, pending);
        let missions = Gauges::default();
        for state in MissionState::ALL {
            let found = counts.iter().find(|(of, _)| *of == state);
            let number = found.map_or(0, |(_, number)| *number);
            missions
                .get_or_create(&[("state", state.as_str())])
                .set(number);
        }
        registry.register("tread_missions", "Missions by state", missions);
        let help = "Deliveries that wait to be sent to webhooks";
        registry.register("tread_webhook_pending", help, ConstGauge::new(pending));
        let stops = self.stops_in_force().await?;
        let open = stops.iter().filter(|stop| stop.unconfirmed).count();
        let in_force = ConstGauge::new(count(stops.len()));
        registry.register(
            "tread_stops_in_force",
            "Stops that are not cleared",
            in_force,
        );
        let help = "Stops that their robots have not confirmed within 300 ms";
        registry.register(
            "tread_stops_unconfirmed",
            help,
            ConstGauge::new(count(open)),
        );
        Ok(())
    }

    /// Registers the depths of queues.
    fn register_queues(&self, registry: &mut Registry, webhooks: u64) {
        let family = Gauges::default();
        for (queue, depth) in self.depths(webhooks) {
            family.get_or_create(&[("queue", queue)]).set(depth);
        }
        let help = "What waits in each queue";
        registry.register("tread_queue_depth", help, family);
    }

    fn depths(&self, webhooks: u64) -> BTreeMap<&'static str, u64> {
        let queues = self.metrics().queues().depths();
        let mut depths: BTreeMap<&'static str, u64> = queues
            .into_iter()
            .map(|(name, depth)| (name, count(depth)))
            .collect();
        depths.insert("webhooks", webhooks);
        depths.insert("events", count(self.hub().longest_buffer()));
        depths
    }

    /// Returns what waits in each queue: messages of robots, uploads to be stored, commands of the
    /// reconciler, deliveries to webhooks, and events for the slowest client. Without the deliveries
    /// while the database cannot be read.
    pub async fn queue_depths(&self) -> BTreeMap<&'static str, u64> {
        let pending = async {
            let mut tx = self.db().read("metrics").await?;
            Ok::<_, AppError>(db::webhooks::pending_count(&mut tx).await?)
        };
        match pending.await {
            Ok(pending) => self.depths(pending),
            Err(error) => {
                self.log_failure("count the deliveries to webhooks", &error);
                let mut depths = self.depths(0);
                depths.remove("webhooks");
                depths
            }
        }
    }

    /// Registers the quality of robots' links.
    fn register_links(&self, registry: &mut Registry) {
        let now = self.clock().elapsed();
        let (links, left_out) = self.presences().link_qualities(now, ROBOT_SERIES_MAX);
        let gauges: [(&str, LinkValue, &str); 4] = [
            (
                "tread_robot_round_trip_seconds",
                |link| link.round_trip_ms.map(|round_trip_ms| round_trip_ms / 1e3),
                "Time from the last command to the robot's answer",
            ),
            (
                "tread_robot_states_received_hour",
                |link| Some(as_f64(link.states_received)),
                "States of the robot that arrived in the last hour",
            ),
            (
                "tread_robot_states_missed_hour",
                |link| Some(as_f64(link.states_missed)),
                "States of the robot that did not arrive in the last hour",
            ),
            (
                "tread_robot_reconnects_hour",
                |link| Some(as_f64(link.reconnects)),
                "Times that the robot connected again in the last hour",
            ),
        ];
        for (name, value_of, help) in gauges {
            let family = Family::<RobotLabels, Gauge<f64, AtomicU64>>::default();
            for ((site, robot), link) in &links {
                if let Some(value) = value_of(link) {
                    let of = RobotLabels {
                        site: site.to_string(),
                        robot: robot.to_string(),
                    };
                    family.get_or_create(&of).set(value);
                }
            }
            registry.register(name, help, family);
        }
        let help = "Robots beyond those whose links have series of their own";
        let left_out = ConstGauge::new(count(left_out));
        registry.register("tread_robot_series_left_out", help, left_out);
    }

    /// Registers the friction of terrains.
    async fn register_terrains(&self, registry: &mut Registry) -> Result<(), AppError> {
        let (known, left_out) = self.known_of_terrains(TERRAIN_SERIES_MAX).await?;
        let gauges: [(&str, TerrainValue, &str); 3] = [
            (
                "tread_terrain_theta",
                |known| known.theta,
                "Slip per friction coefficient of each terrain that was measured, by robot model",
            ),
            (
                "tread_terrain_theta_std_dev",
                |known| known.std_dev,
                "Standard deviation of tread_terrain_theta",
            ),
            (
                "tread_terrain_age_seconds",
                |known| known.age_s,
                "Age of the newest measurement of each terrain",
            ),
        ];
        for (name, value_of, help) in gauges {
            let family = Family::<TerrainLabels, Gauge<f64, AtomicU64>>::default();
            for known in &known {
                let of = TerrainLabels {
                    site: known.site.to_string(),
                    terrain: known.terrain.to_string(),
                    configuration: known.configuration.to_string(),
                };
                family.get_or_create(&of).set(value_of(known));
            }
            registry.register(name, help, family);
        }
        let help = "Terrains and robot models beyond those that have series of their own";
        let left_out = ConstGauge::new(count(left_out));
        registry.register("tread_terrain_series_left_out", help, left_out);
        Ok(())
    }

    /// Registers the numbers of teleoperation and event clients.
    fn register_clients(&self, registry: &mut Registry) {
        let gauges = [
            (
                "tread_drive_clients",
                self.drive_clients(),
                "Drive sockets that are open",
            ),
            (
                "tread_robots_watched",
                self.watched_robots(),
                "Robots that somebody watches or drives by a drive socket",
            ),
            (
                "tread_event_clients",
                self.hub().client_count(),
                "Event clients",
            ),
            (
                "tread_event_buffer_longest",
                self.hub().longest_buffer(),
                "Most events that wait for one client",
            ),
        ];
        for (name, value, help) in gauges {
            registry.register(name, help, ConstGauge::new(count(value)));
        }
        let dropped = ConstCounter::new(self.hub().dropped_count());
        let help = "Event clients that read too slowly";
        registry.register("tread_event_clients_dropped", help, dropped);
    }

    /// Registers the counters of `GET /v1/server`; returns those of refusals.
    fn register_counters(&self, registry: &mut Registry) -> Vec<(Refusal, u64)> {
        let counters = serde_json::to_value(self.counters().values()).unwrap_or_default();
        let mut refusals = Vec::new();
        for (counter, value) in counters.as_object().into_iter().flatten() {
            let value = value.as_u64().unwrap_or_default();
            let name = format!("tread_{counter}");
            registry.register(name, "See GET /v1/server", ConstCounter::new(value));
            let of_message = counter.strip_prefix("refused_");
            let of_record = ["records_refused", "reports_foreign", "missions_unknown"];
            let listed = of_record
                .contains(&counter.as_str())
                .then_some(counter.as_str());
            if let Some(reason) = of_message.or(listed) {
                let is_client = OF_CLIENTS.contains(&reason);
                let of = Refusal {
                    of: if is_client { "client" } else { "robot" },
                    reason: reason.to_owned(),
                };
                refusals.push((of, value));
            }
        }
        refusals
    }
}
