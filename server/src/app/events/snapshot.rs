//! What a client gets first: everything as it stands now.

use std::collections::{HashSet, VecDeque};
use std::sync::Arc;

use tread_api::event::{Event, Topic};
use tread_api::ids::MissionId;
use tread_api::mission::Mission;

use super::super::{App, AppError};
use super::ROBOTS_MAX;
use super::hub::{EventFilter, Sent, unnumbered};
use crate::db;
use crate::db::missions::MissionFilter;

/// Missions in a snapshot: all that are open, and the newest.
const MISSIONS_MAX: u32 = 1_000;
/// Bytes of trajectories at which a snapshot stops naming ended missions.
const MISSIONS_BYTES_MAX: usize = 4 * 1024 * 1024;

impl App {
    pub(super) async fn snapshot(
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
