//! The offer of a mission in the transaction that inserts it.
//!
//! The reconciler would set the mission to `offered` in a transaction of its own, with a write to the
//! disk that the robot waits for. It still sends the offer: at once, from [`NewOffers`], or as of every
//! mission that it reads as offered.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tread_api::robot::LinkState;
use tread_api::trajectory::Trajectory;
use tread_api::wire::command::PathPrior;

use crate::app::presence::RobotKey;
use crate::app::{App, AppError};
use crate::db::missions::MissionRow;
use crate::db::{self, Tx};

/// Maximum time for reading the map beside the commit of a mission: blocks that are not in memory may
/// take longer, and then the reconciler reads them.
const EARLY_PRIOR_MAX: Duration = Duration::from_millis(500);
/// Maximum number of missions in [`NewOffers`]; the reconciler reads the others from the database.
const JUST_OFFERED_MAX: usize = 64;

/// A mission that is to be offered now.
#[derive(Debug)]
pub(in crate::app) struct OfferedNow {
    pub(in crate::app) row: MissionRow,
    /// What the map says along its trajectory.
    pub(in crate::app) prior: Option<PathPrior>,
    /// [`App::recalls`] before the mission was stored or read.
    pub(in crate::app) recalls: u64,
}

/// Missions whose creation and offer are committed, for the reconciler.
#[derive(Debug, Default)]
pub(in crate::app) struct NewOffers {
    missions: Mutex<VecDeque<OfferedNow>>,
}

impl NewOffers {
    fn lock(&self) -> MutexGuard<'_, VecDeque<OfferedNow>> {
        self.missions.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a mission; does nothing if there are too many.
    pub(super) fn add(&self, mission: OfferedNow) {
        let mut missions = self.lock();
        if missions.len() < JUST_OFFERED_MAX {
            missions.push_back(mission);
        }
    }

    /// Takes all of them, in the order of their commits.
    pub(in crate::app) fn take(&self) -> VecDeque<OfferedNow> {
        std::mem::take(&mut *self.lock())
    }
}

/// What the map says along the trajectory of a mission that is being stored.
#[derive(Debug)]
pub(super) struct EarlyPrior(pub(super) Option<PathPrior>);

impl App {
    /// Reads the map along a new mission, while the mission is stored; `None` if its robot is not
    /// heard, so that it is not offered now, or if the map could not be read.
    pub(super) async fn early_prior(
        &self,
        key: &RobotKey,
        trajectory: &Trajectory,
    ) -> Option<EarlyPrior> {
        let link = self.presences().get(key).link(self.clock().elapsed());
        if link == LinkState::Offline {
            return None;
        }
        let reading = self.prior_along((&key.0, &key.1), trajectory);
        let prior = tokio::time::timeout(EARLY_PRIOR_MAX, reading).await;
        prior.ok()?.ok().map(EarlyPrior)
    }

    /// Returns whether the reconciler would offer a new mission at once, as the only open one of its
    /// robot: the robot is heard, is not stopped or teleoperated, and not restricted since a
    /// restoration.
    pub(super) async fn may_offer_immediately(
        &self,
        tx: &mut Tx,
        row: &MissionRow,
    ) -> Result<bool, AppError> {
        let mission = &row.mission;
        let key = (mission.site.clone(), mission.robot.clone());
        let link = self.presences().get(&key).link(self.clock().elapsed());
        if mission.pause_requested || link == LinkState::Offline {
            return Ok(false);
        }
        // Robots of a database that was never restored are not restricted.
        if self.restoration().is_none() {
            return Ok(true);
        }
        let restricted = db::restorations::restricted(tx).await?;
        Ok(restricted.iter().all(|robot| robot.pk != row.robot_pk))
    }
}
