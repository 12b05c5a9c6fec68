//! The offer of a mission in the transaction that inserts it.
//!
//! The reconciler would set the mission to `offered` in a transaction of its own, with a write to the
//! disk that the robot waits for. It still sends the offer.

use tread_api::mission::Actor;
use tread_api::robot::LinkState;

use super::transitions::Change;
use super::{Step, take_step};
use crate::app::{App, AppError};
use crate::db::missions::{Facts, MissionRow};
use crate::db::{self, Tx};

impl App {
    /// Sets a new mission to `offered` if the reconciler would do so at once: its robot is heard, has no
    /// other open mission, is not stopped or teleoperated, and not restrained since a restoration.
    pub(super) async fn offer_immediately(
        &self,
        tx: &mut Tx,
        row: &MissionRow,
    ) -> Result<(), AppError> {
        let mission = &row.mission;
        let key = (mission.site.clone(), mission.robot.clone());
        let link = self.presences().get(&key).link(self.clock().elapsed());
        if mission.pause_wanted || link == LinkState::Offline {
            return Ok(());
        }
        let open = db::missions::open_of_robot(tx, row.robot_pk).await?;
        if open.iter().any(|other| other.id != mission.id) {
            return Ok(());
        }
        let restrained = db::restorations::restrained(tx).await?;
        if restrained.iter().any(|robot| robot.pk == row.robot_pk) {
            return Ok(());
        }
        let step = Step {
            change: Change::Offer,
            actor: Actor::Server,
            reason: None,
            at: self.clock().now(),
            facts: Facts::default(),
        };
        take_step(tx, &mission.into(), step).await?;
        Ok(())
    }
}
