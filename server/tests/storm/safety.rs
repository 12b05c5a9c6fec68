//! People who stop robots, clear their stops, and teleoperate them in the middle of it all.

use std::sync::Arc;
use std::time::Duration;

use tread_api::ids::MissionId;
use tread_api::keys::Verb;
use tread_api::safety::Driver;
use tread_api::stop::Stop;
use tread_api::wire;
use tread_api::wire::safety::AcquireLease;
use tread_server::app::robot_link::{CommandTransport as _, RobotLink};
use tread_server::app::stops::StopReason;
use tread_server::db;
use tread_server::db::stops::StopFilter;
use tread_server::supervisor::Supervisor;
use uuid::Uuid;

use super::network::{Network, Shared, with};
use super::{Storm, allowed};

/// Stops that are looked at; a storm has fewer robots.
const STOPS_MAX: u32 = 100;
/// Looks, a millisecond apart, within which a stop must be in the database.
const SETTLING_LOOKS_MAX: usize = 10_000;
/// An answer is there at once or never.
const CONFIRM_MAX: Duration = Duration::from_millis(1);

/// How the use cases reach the simulated robots.
pub(super) fn robot_link(world: &Shared, supervisor: &Supervisor) -> RobotLink {
    RobotLink {
        commands: Arc::new(Network(Arc::clone(world))),
        stop_confirm_max: CONFIRM_MAX,
        ..RobotLink::unconnected(supervisor.clone())
    }
}

fn text(error: impl std::fmt::Debug) -> String {
    format!("{error:?}")
}

impl Storm {
    /// Somebody stops a robot: from now on nothing that it has may go on by itself.
    pub(super) async fn stop(&mut self, index: usize) -> Result<(), String> {
        let robot = with(&self.world, |world| world.robots[index].id.clone());
        let stopped = self
            .app
            .stop_robot(&self.site, &robot, StopReason::default());
        let stopped = stopped.await;
        if let Ok(stop) = &stopped {
            self.is_settled(stop).await?;
        }
        allowed(stopped)?;
        self.reference.follow(self.app.db()).await?;
        let open = self.reference.open_of(&robot);
        with(&self.world, |world| world.held.extend(open));
        Ok(())
    }

    /// Waits until a stop is written down with what became of it: that is done beside the answer.
    async fn is_settled(&self, stop: &Stop) -> Result<(), String> {
        for _ in 0..SETTLING_LOOKS_MAX {
            let mut tx = self.app.db().read("test").await.map_err(text)?;
            let found = db::stops::find(&mut tx, stop.id).await.map_err(text)?;
            let alerts = db::alerts::raised(&mut tx, STOPS_MAX).await.map_err(text)?;
            drop(tx);
            let is_confirmed = found
                .as_ref()
                .is_some_and(|found| found.confirmed_at.is_some());
            let is_notified = alerts
                .iter()
                .any(|alert| alert.robot.as_ref() == Some(&stop.robot));
            if is_confirmed || (found.is_some() && is_notified) {
                return Ok(());
            }
            tokio::time::sleep(CONFIRM_MAX).await;
        }
        Err(format!("{stop:?} was not written down"))
    }

    pub(super) async fn stops_in_force(&self) -> Result<Vec<Stop>, String> {
        let filter = StopFilter {
            in_force: true,
            ..StopFilter::default()
        };
        let page = self.app.stops(&filter, STOPS_MAX).await;
        Ok(page.map_err(text)?.items)
    }

    pub(super) async fn is_any_stopped(&self) -> Result<bool, String> {
        Ok(!self.stops_in_force().await?.is_empty())
    }

    /// Somebody clears a robot's newest stop, or whoever teleoperates it lets go.
    pub(super) async fn clear_or_release(&mut self, index: usize) -> Result<(), String> {
        let robot = with(&self.world, |world| {
            world.robots[index].end_lease();
            world.robots[index].id.clone()
        });
        let stops = self.stops_in_force().await?;
        let Some(newest) = stops.iter().find(|stop| stop.robot == robot) else {
            return Ok(());
        };
        let cleared = self.app.clear_stop(&self.site, &robot, newest.id, None);
        allowed(cleared.await)
    }

    /// Somebody takes a robot's lease, over the same network as everything else.
    pub(super) fn lease(&self, index: usize) {
        let robot = with(&self.world, |world| world.robots[index].id.clone());
        let (client, take) = self.dice(|dice| (dice.below(3) as u128, dice.percent(30)));
        let command = AcquireLease {
            request: Uuid::from_u128(client),
            holder: Driver {
                client: Uuid::from_u128(client),
                name: "a driver".to_owned(),
            },
            take,
        };
        let payload = wire::encode(&command).expect("it can be written");
        let network = Network(std::sync::Arc::clone(&self.world));
        // It is carried when it is called; nobody waits for the answer.
        drop(network.send(&(self.site.clone(), robot), None, Verb::Lease, payload));
    }

    /// Somebody lets a mission go on.
    pub(super) async fn resume(&mut self, id: MissionId) -> Result<(), String> {
        let resumed = self.app.resume_mission(id).await;
        if resumed.is_ok() {
            with(&self.world, |world| world.held.remove(&id));
        }
        allowed(resumed)
    }

    /// Everybody lets go of every robot.
    pub(super) async fn let_go(&mut self) -> Result<(), String> {
        let stopped = with(&self.world, |world| {
            for robot in &mut world.robots {
                robot.end_lease();
            }
            let stopped = world.robots.iter();
            let stopped = stopped.filter_map(|robot| Some((robot.id.clone(), robot.stopped_by()?)));
            stopped.collect::<Vec<_>>()
        });
        for (robot, stop) in stopped {
            allowed(self.app.clear_stop(&self.site, &robot, stop, None).await)?;
        }
        Ok(())
    }
}
