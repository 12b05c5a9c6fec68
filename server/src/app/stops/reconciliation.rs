//! Compares open stops with those that robots show, in each pass of the reconciler.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use tracing::warn;
use tread_api::ids::StopId;
use tread_api::safety::StandstillState;
use tread_api::stop::Stop;
use tread_api::wire::state::RobotState;

use super::decision::{Open, ReportedStop, StopDecision, decide};
use super::{alerted, key_of};
use crate::app::allowance::Kind;
use crate::app::presence::{Presence, RobotKey};
use crate::app::{App, AppError};
use crate::db::{self, Tx};

/// Actions for all stops.
#[derive(Debug, Default)]
struct StopActions {
    again: Vec<Stop>,
    /// Those in `again` that their robots had confirmed.
    lost: Vec<Stop>,
    cleared: Vec<StopId>,
    standstill: Vec<StopId>,
    /// Robots whose own stop becomes the open one.
    adopted: Vec<RobotKey>,
    /// Robots whose alert may have to be raised or cleared.
    alerts: Vec<RobotKey>,
}

impl App {
    /// Compares open stops with those that robots show; returns the ones to be sent again.
    pub(in crate::app) async fn reconcile_stops(&self) -> Result<Vec<Stop>, AppError> {
        let StopActions {
            lost,
            cleared,
            standstill,
            adopted,
            alerts,
            again,
        } = self.check_stops().await?;
        let is_idle = lost.is_empty() && cleared.is_empty() && standstill.is_empty();
        if is_idle && adopted.is_empty() && alerts.is_empty() {
            return Ok(again);
        }
        let writing = async {
            let mut tx = self.db().write("stops").await?;
            // Read here, since the turn to write may have come late.
            let now = self.clock().now();
            for stop in &lost {
                db::stops::unconfirm(&mut tx, stop.id).await?;
            }
            for id in standstill {
                db::stops::record_standstill(&mut tx, id, now).await?;
            }
            for id in cleared {
                db::stops::clear(&mut tx, id, now).await?;
            }
            let holds_missions = !adopted.is_empty();
            for key in adopted {
                self.adopt_reported_stop(&mut tx, &key).await?;
            }
            let mut shown = Vec::new();
            for key in alerts {
                shown.extend(self.settle_alert(&mut tx, &key, true).await?);
            }
            self.commit_alerts(tx, shown).await?;
            if holds_missions {
                self.recall();
            }
            for stop in &lost {
                let robot = &stop.robot;
                warn!(robot.id = %robot, "robot `{robot}` no longer shows its stop; the stop is sent again");
                self.counters().stops_lost.one();
            }
            Ok::<(), AppError>(())
        };
        // Stops are sent again even if nothing can be stored.
        if let Err(error) = writing.await {
            self.log_failure("write down what became of stops", &error);
        }
        Ok(again)
    }

    async fn check_stops(&self) -> Result<StopActions, AppError> {
        let mut tx = self.db().read("stops").await?;
        let mut robots: BTreeMap<RobotKey, Option<Stop>> = BTreeMap::new();
        for (key, _latch) in self.presences().shown_stops() {
            robots.insert(key, None);
        }
        for stop in db::stops::in_force(&mut tx).await? {
            robots.insert(key_of(&stop), Some(self.with_confirmation(stop)));
        }
        let mut alerted = alerted(&mut tx).await?;
        let mut actions = StopActions::default();
        for (key, stop) in robots {
            let presence = self.presences().get(&key);
            let shown = match presence.state() {
                Some(state) => self.shown(&mut tx, state, &presence, stop.as_ref()).await?,
                None => None,
            };
            let is_alerted = alerted.remove(&key);
            let is_unconfirmed = |stop: &Stop| stop.confirmed_at.is_none();
            if is_alerted && !stop.as_ref().is_some_and(is_unconfirmed) {
                actions.alerts.push(key.clone());
            }
            let open = stop.as_ref().map(|stop| Open {
                id: stop.id,
                is_overdue: stop.unconfirmed,
                confirmed_at: stop.confirmed_at,
                clear_requested_at: stop.clear_requested_at,
            });
            let decision = decide(open, shown);
            let Some(stop) = stop else {
                if decision == StopDecision::Adopt && self.may_adopt(&key) {
                    actions.adopted.push(key);
                }
                continue;
            };
            let is_shown = shown.is_some_and(|shown| shown.latch == Some(stop.id));
            let standstill = presence.state().and_then(|state| state.safety.standstill);
            let is_at_standstill =
                standstill.is_some_and(|seen| seen.state == StandstillState::Standstill);
            if is_shown && is_at_standstill && stop.standstill_at.is_none() {
                actions.standstill.push(stop.id);
            }
            match decision {
                StopDecision::Send => {
                    // A robot that is on the network gets the stop, and an alert if it does not
                    // confirm.
                    if !is_alerted && !presence.is_connected(self.clock().elapsed()) {
                        actions.alerts.push(key);
                    }
                    actions.again.push(stop);
                }
                StopDecision::Resend => {
                    actions.again.push(stop.clone());
                    actions.lost.push(stop);
                }
                StopDecision::Cleared => actions.cleared.push(stop.id),
                StopDecision::Adopt if self.may_adopt(&key) => actions.adopted.push(key),
                StopDecision::Nothing | StopDecision::Adopt => {}
            }
        }
        // Robots without an open stop.
        actions.alerts.extend(alerted);
        actions
            .again
            .sort_by_key(|stop| (stop.requested_at, stop.id));
        Ok(actions)
    }

    fn may_adopt(&self, key: &RobotKey) -> bool {
        let now = self.clock().elapsed();
        self.allowances().take(key, Kind::Stop, now)
    }

    /// Returns the stop that a robot shows; `None` if that allows no conclusion.
    async fn shown(
        &self,
        tx: &mut Tx,
        state: &RobotState,
        presence: &Presence,
        open: Option<&Stop>,
    ) -> Result<Option<ReportedStop>, AppError> {
        let age = presence.state_age(self.clock().elapsed());
        let age = SignedDuration::try_from(age.unwrap_or_default());
        let age = age.unwrap_or(SignedDuration::MAX);
        let at = self.clock().now().checked_sub(age);
        let latch = state.safety.stop.as_ref().map(|latch| latch.id);
        let other = latch.filter(|&latch| open.is_none_or(|open| open.id != latch));
        let known = match other {
            Some(other) => db::stops::find(tx, other).await?,
            None => None,
        };
        // It is open, of a robot that was retired.
        let is_open = |stop: &Stop| stop.cleared_at.is_none() && stop.replaced_by.is_none();
        if known.as_ref().is_some_and(is_open) {
            return Ok(None);
        }
        Ok(Some(ReportedStop {
            latch,
            ended_at: known.and_then(|stop| stop.cleared_at),
            at: at.unwrap_or(Timestamp::MIN),
        }))
    }
}
