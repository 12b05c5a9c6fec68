//! Snapshots: the present state of everything, sent to a client first.
//!
//! Clients often connect together, after a restart or an outage, so they share a snapshot built
//! within the last [`SHARED_FOR`]; later events come from those that are kept. A snapshot stays in
//! memory while a client reads it: the bytes of all snapshots are bounded, and each must be read in
//! time.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Weak};
use std::time::Duration;

use tread_api::event::{Event, Topic};
use tread_api::ids::{MissionId, SiteId};
use tread_api::mission::Mission;
use tread_api::rights;
use tread_api::robot::Alert;

use super::super::{App, AppError};
use super::ALERTS_MAX;
use super::sent::{EventFilter, Position, Sent, unnumbered};
use crate::app::enrolment::FLEET_ROBOTS_MAX;
use crate::app::presence::RobotKey;
use crate::db;
use crate::db::alerts::AlertFilter;
use crate::db::missions::MissionFilter;

/// Maximum age of a snapshot that is shared with another client.
const SHARED_FOR: Duration = Duration::from_millis(100);
/// Maximum number of bytes of snapshots being read; beyond it no further one is built.
pub const SNAPSHOT_BYTES_MAX: usize = 128 * 1024 * 1024;
/// Maximum time in which a client must read its snapshot.
pub(super) const SNAPSHOT_READ_MAX: Duration = Duration::from_mins(1);
/// Missions in a snapshot: all that are open, and the newest.
const MISSIONS_MAX: u32 = 1_000;
/// Bytes of trajectories beyond which a snapshot leaves out ended missions.
const MISSIONS_BYTES_MAX: usize = 4 * 1024 * 1024;

/// Present state at one event, for all clients of the same topics, site and scope.
#[derive(Debug)]
pub(super) struct Snapshot {
    /// The newest event that is included.
    covered: Position,
    events: Vec<Arc<Sent>>,
    bytes: usize,
}

/// A client's reading position in a snapshot.
#[derive(Debug)]
pub(super) struct Reading {
    snapshot: Arc<Snapshot>,
    filter: EventFilter,
    next: usize,
}

impl Reading {
    /// Returns the newest event that the snapshot includes.
    pub(super) fn covered(&self) -> Position {
        self.snapshot.covered
    }

    /// Returns the next event that passes the client's filter; `None` after the last.
    pub(super) fn next(&mut self) -> Option<Arc<Sent>> {
        let rest = self.snapshot.events.get(self.next..)?;
        let wanted = |event: &Arc<Sent>| self.filter.matches(event.topic, event.about.as_ref());
        let skipped = rest.iter().position(wanted)?;
        self.next += skipped + 1;
        rest.get(skipped).cloned()
    }
}

/// Filter for which a snapshot was built.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Scope {
    topics: HashSet<Topic>,
    site: Option<SiteId>,
    within: rights::Scope,
}

/// A snapshot that clients may be reading.
#[derive(Debug)]
struct Built {
    scope: Scope,
    at: Duration,
    /// Value of the hub's counter of first clients. If it differs, there was a time without clients,
    /// in which no events were published.
    gathering: u64,
    snapshot: Weak<Snapshot>,
}

/// Snapshots being read, oldest first; locked while one is built.
#[derive(Debug, Default)]
pub(super) struct Snapshots(tokio::sync::Mutex<Vec<Built>>);

impl App {
    /// Returns a snapshot for a client that is already subscribed, and the events since.
    pub(super) async fn snapshot_for(
        &self,
        filter: &EventFilter,
    ) -> Result<(Reading, VecDeque<Arc<Sent>>), AppError> {
        let scope = Scope {
            topics: filter.topics.clone(),
            site: filter.site.clone(),
            within: filter.within.clone(),
        };
        let mut all = self.hub().snapshots.0.lock().await;
        all.retain(|built| built.snapshot.strong_count() > 0);
        let alive = all.iter().filter_map(|built| built.snapshot.upgrade());
        let is_full = alive.map(|snapshot| snapshot.bytes).sum::<usize>() >= SNAPSHOT_BYTES_MAX;
        let (now, gathering) = (self.clock().elapsed(), self.hub().gathering());
        // If the memory for a further snapshot is missing, an older one and the kept events are
        // used.
        let usable = all.iter().rev().filter(|built| {
            let young = now.saturating_sub(built.at) <= SHARED_FOR;
            built.scope == scope && built.gathering == gathering && (young || is_full)
        });
        let mut shared = usable.filter_map(|built| built.snapshot.upgrade());
        let found = shared.find_map(|snapshot| {
            let since = self.hub().since(snapshot.covered.seq, filter)?;
            Some((snapshot, since))
        });
        let (snapshot, since) = match found {
            Some(found) => found,
            None if is_full => {
                return Err(AppError::TooMany {
                    what: "bytes of snapshots that event clients read",
                    count: SNAPSHOT_BYTES_MAX,
                });
            }
            None => {
                let snapshot = Arc::new(self.build_snapshot(&scope).await?);
                all.push(Built {
                    scope,
                    at: now,
                    gathering,
                    snapshot: Arc::downgrade(&snapshot),
                });
                // Events that are no longer kept are in the client's own buffer.
                let since = self.hub().since(snapshot.covered.seq, filter);
                (snapshot, since.unwrap_or_default())
            }
        };
        let reading = Reading {
            snapshot,
            filter: filter.clone(),
            next: 0,
        };
        Ok((reading, since))
    }

    async fn build_snapshot(&self, scope: &Scope) -> Result<Snapshot, AppError> {
        let filter = EventFilter {
            topics: scope.topics.clone(),
            site: scope.site.clone(),
            robots: HashSet::new(),
            within: scope.within.clone(),
        };
        let covered = self.hub().newest();
        let mut events = vec![unnumbered(&Event::SnapshotBegin, None, None)];
        let mut add = |event: &Event, topic, robot: Option<RobotKey>| {
            let about = robot.map(|(site, robot)| (site, Some(robot)));
            events.push(unnumbered(event, Some(topic), about));
        };
        let mut tx = self.db().read("events").await?;
        let alerts = db::alerts::raised(&mut tx, ALERTS_MAX).await?;
        if filter.includes_topic(Topic::Robots) {
            let mut of_robots: HashMap<RobotKey, Vec<Alert>> = HashMap::new();
            for alert in &alerts {
                if let Some(key) = alert.robot_key() {
                    of_robots.entry(key).or_default().push(alert.clone());
                }
            }
            for row in db::robots::all(&mut tx, FLEET_ROBOTS_MAX).await? {
                if row.retired_at.is_none() && filter.includes_robot(&row.site, &row.id) {
                    let key = (row.site.clone(), row.id.clone());
                    let alerts = of_robots.remove(&key).unwrap_or_default();
                    let robot = Event::Robot(Box::new(self.with_live(row, alerts)));
                    add(&robot, Topic::Robots, Some(key));
                }
            }
        }
        if filter.includes_topic(Topic::Missions) {
            for mission in self.missions_to_show(&mut tx, &filter).await? {
                let key = (mission.site.clone(), mission.robot.clone());
                add(
                    &Event::Mission(Box::new(mission)),
                    Topic::Missions,
                    Some(key),
                );
            }
        }
        if filter.includes_topic(Topic::Alerts) {
            let of_server = self.storage().alerts(&AlertFilter {
                raised: true,
                ..AlertFilter::default()
            });
            for alert in alerts.into_iter().chain(of_server) {
                let key = alert.robot_key();
                let is_wanted = |(site, robot): &RobotKey| filter.includes_robot(site, robot);
                if key.as_ref().is_none_or(is_wanted) {
                    add(&Event::Alert(Box::new(alert)), Topic::Alerts, key);
                }
            }
        }
        drop(tx);
        events.push(Sent {
            id: Some(self.hub().id_of(covered)),
            ..unnumbered(&Event::SnapshotEnd, None, None)
        });
        let bytes = events.iter().map(|event| event.text.len()).sum();
        let events = events.into_iter().map(Arc::new).collect();
        Ok(Snapshot {
            covered,
            events,
            bytes,
        })
    }

    /// Returns the newest missions and older open ones, oldest first.
    async fn missions_to_show(
        &self,
        tx: &mut db::Tx,
        filter: &EventFilter,
    ) -> Result<Vec<Mission>, AppError> {
        let of_site = MissionFilter {
            site: filter.site.clone(),
            within: filter.within.clone(),
            ..MissionFilter::default()
        };
        let (mut rows, _more) =
            db::missions::list(tx, &of_site, MISSIONS_MAX, MISSIONS_BYTES_MAX).await?;
        let known: HashSet<MissionId> = rows.iter().map(|row| row.mission.id).collect();
        for open in db::missions::in_progress(tx).await? {
            if !known.contains(&open.id) {
                rows.extend(db::missions::find(tx, open.id).await?);
            }
        }
        let missions = rows.into_iter().map(|row| self.with_progress(row.mission));
        let wanted =
            missions.filter(|mission| filter.includes_robot(&mission.site, &mission.robot));
        let mut missions: Vec<Mission> = wanted.collect();
        missions.sort_by_key(|mission| mission.id);
        Ok(missions)
    }
}
