//! Random interleavings of everything that can happen to missions, against a simple reference.
//!
//! Real use cases, real reconciler, a real database (SQLite, or PostgreSQL, see [`engine`]); the network and the robots are simulated in this
//! process, and so is the time. Messages are lost, delayed, doubled and reordered; robots, server
//! and links go down at any moment. After every step the history that the server wrote is checked
//! against the reference; at the end of a run the network heals, and every mission must end, with
//! both sides of one mind. People stop robots, clear their stops and teleoperate meanwhile; what
//! was held for that must not be resumed before somebody says so.

mod dice;
#[path = "../engine/mod.rs"]
mod engine;
mod network;
#[cfg(test)]
pub(crate) mod overtaking;
mod reference;
mod robot;
mod safety;
mod samples;

use std::collections::HashSet;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::oneshot;
use tread_api::ids::{MissionId, SiteId};
use tread_api::mission::{
    Cause, CreateMission, LinkPolicy, MissionState, ReplaceMission, StartPolicy,
};
use tread_api::robot::Capabilities;
use tread_api::wire::hello::Hello;
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::state::RobotState;
use tread_server::app::ingest::{Upload, Writer};
use tread_server::app::reconciler::Reconciler;
use tread_server::app::robot_link::RobotLink;
use tread_server::app::{App, AppError, Dependencies};
use tread_server::clock::Clock;
use tread_server::db::{Db, Location};
use tread_server::supervisor::Supervisor;

use self::dice::Dice;
use self::network::{LATE_MAX, Late, Shared, World, with};
use self::reference::Reference;
use self::robot::Robot;
use self::samples::{circle, model};

/// Robots of one run.
const ROBOTS: usize = 3;
/// Missions of one run that requests may name.
const NAMED_MAX: usize = 40;
/// Steps within which everything must have ended after the network has healed.
const HEAL_STEPS: usize = 600;

/// One run.
struct Storm {
    world: Shared,
    clock: Clock,
    database: Location,
    app: App,
    writer: Writer,
    reconciler: Reconciler,
    supervisor: Supervisor,
    reference: Reference,
    site: SiteId,
    boots: u64,
}

async fn app_on(database: &Location, clock: &Clock, site: &SiteId, robots: RobotLink) -> App {
    let app = App::new(Dependencies {
        robots,
        ..Dependencies::on_database(
            Db::open(database).await.expect("the database opens"),
            clock.clone(),
        )
    });
    app.ensure_site(site).await.expect("the site is made");
    app
}

/// Runs one storm of so many steps.
///
/// # Errors
/// What the server did wrong, with the seed.
pub(crate) async fn run(seed: u64, steps: usize) -> Result<usize, String> {
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let file = || Location::from(folder.path().join("storm.db"));
    let database = engine::address_for(folder.path()).map_or_else(file, Location::Postgres);
    let mut storm = Storm::start(seed, database).await;
    let weathered = storm.weather(steps).await;
    storm
        .supervisor
        .stop()
        .await
        .map_err(|error| error.to_string())?;
    storm.app.db().close().await;
    weathered.map_err(|what| format!("seed {seed}: {what}"))
}

impl Storm {
    async fn start(seed: u64, database: Location) -> Self {
        let site: SiteId = "yard".parse().expect("it is an identifier");
        let clock = Clock::manual("2026-11-01T00:00:00Z".parse().expect("it is a time"));
        let robots = (0..ROBOTS).map(|index| {
            let id = format!("rover-{index}").parse().expect("an identifier");
            Robot::new(id, index as u64)
        });
        let world: Shared = Arc::new(Mutex::new(World {
            robots: robots.collect(),
            late: Vec::new(),
            dice: Dice::of(seed),
            calm: false,
            held: HashSet::new(),
            wrong: None,
        }));
        let supervisor = Supervisor::new();
        let robots = safety::robot_link(&world, &supervisor);
        let app = app_on(&database, &clock, &site, robots).await;
        let mut storm = Self {
            reconciler: Reconciler::new(app.clone()),
            writer: Writer::new(app.clone()),
            world,
            clock,
            database,
            app,
            supervisor,
            reference: Reference::default(),
            site,
            boots: ROBOTS as u64,
        };
        for index in 0..ROBOTS {
            storm.greet(index).await;
        }
        storm
    }

    fn dice<T>(&self, roll: impl FnOnce(&mut Dice) -> T) -> T {
        with(&self.world, |world| roll(&mut world.dice))
    }

    /// A robot is on the network and says hello.
    async fn greet(&mut self, index: usize) {
        let (robot, boot) = with(&self.world, |world| {
            let robot = &world.robots[index];
            (robot.id.clone(), robot.boot)
        });
        let now = self.clock.elapsed();
        let key = (self.site.clone(), robot.clone());
        self.app.presences().token_appeared(key, boot, now);
        let hello = Hello {
            robot,
            boot,
            agent_version: "0".to_owned(),
            model: model(),
            robot_time: self.clock.now(),
            capabilities: Capabilities {
                pause: true,
                replace: true,
                ..Capabilities::default()
            },
        };
        let welcomed = self.app.hello(&self.site, &hello).await;
        assert!(welcomed.is_ok(), "{welcomed:?}");
    }

    async fn weather(&mut self, steps: usize) -> Result<usize, String> {
        for _ in 0..steps {
            self.step().await?;
            self.reference.follow(self.app.db()).await?;
            if let Some(wrong) = with(&self.world, |world| world.wrong.take()) {
                return Err(wrong);
            }
        }
        self.heal().await?;
        let count = self.reference.missions.len();
        self.agree()?;
        Ok(count)
    }

    async fn step(&mut self) -> Result<(), String> {
        let (what, index) = self.dice(|dice| (dice.below(100), dice.below(ROBOTS)));
        match what {
            0..8 => self.create(index).await?,
            8..18 => self.want().await?,
            18 => self.stop(index).await?,
            19 => self.clear_or_release(index).await?,
            20 => self.lease(index),
            21..38 => {
                let unlucky = self.dice(|dice| dice.percent(2));
                with(&self.world, |world| world.robots[index].drive(2.5, unlucky));
            }
            38..55 => self.heartbeat(index),
            55..67 => self.upload(index).await,
            67..75 => self.deliver_late(),
            75..77 => self.restart_robot(index).await,
            77..79 => self.toggle(index).await,
            79 => self.restart_server().await,
            80..88 => {
                let span_ms = self.dice(|dice| dice.below(3_000)) as u64;
                self.clock.advance(Duration::from_millis(span_ms));
            }
            _ => self.reconcile().await?,
        }
        Ok(())
    }

    async fn reconcile(&mut self) -> Result<(), String> {
        let passed = self.reconciler.pass().await;
        self.reconciler.rest().await;
        passed.map_err(|error| format!("{error:?}"))
    }

    async fn create(&mut self, index: usize) -> Result<(), String> {
        let robot = with(&self.world, |world| world.robots[index].id.clone());
        let (policy, priority, bound, late) = self.dice(|dice| {
            (
                dice.below(12),
                dice.below(3),
                dice.below(3),
                dice.percent(10),
            )
        });
        let soon = self.clock.now() + jiff::SignedDuration::from_secs(4);
        let request = CreateMission {
            site: self.site.clone(),
            robot,
            trajectory: circle(3.0),
            latest_start: late.then_some(soon),
            priority: i32::try_from(priority).unwrap_or(0),
            start_policy: match policy {
                0 => StartPolicy::Replace,
                1 => StartPolicy::Refuse,
                _ => StartPolicy::Append,
            },
            link_policy: LinkPolicy::Continue,
            lost_after_s: (bound == 0).then_some(5.0),
        };
        let made = self.app.create_mission(request).await;
        if let Ok(mission) = &made
            && mission.pause_requested
        {
            with(&self.world, |world| world.held.insert(mission.id));
        }
        allowed(made)
    }

    async fn want(&mut self) -> Result<(), String> {
        let newest: Vec<MissionId> = self.reference.missions.keys().rev().copied().collect();
        let (verb, place, radius) =
            self.dice(|dice| (dice.below(5), dice.below(NAMED_MAX), dice.below(5)));
        let Some(&id) = newest.get(place % newest.len().max(1)) else {
            return Ok(());
        };
        match verb {
            0 => {
                let cancelled = self.app.cancel_mission(id).await;
                self.hold_if(id, cancelled)
            }
            1 => {
                let paused = self.app.pause_mission(id).await;
                self.hold_if(id, paused)
            }
            2 | 3 => self.resume(id).await,
            _ => {
                #[expect(clippy::cast_precision_loss, reason = "below 5")]
                let trajectory = circle(2.0 + radius as f64);
                let request = ReplaceMission { trajectory };
                allowed(self.app.replace_mission(id, request).await)
            }
        }
    }

    /// From now on the mission may not be driven by a command of the server, if that was granted.
    fn hold_if<T>(&self, id: MissionId, granted: Result<T, AppError>) -> Result<(), String> {
        if granted.is_ok() {
            with(&self.world, |world| world.held.insert(id));
        }
        allowed(granted)
    }

    fn heartbeat(&mut self, index: usize) {
        let heard = with(&self.world, |world| {
            let robot = &mut world.robots[index];
            let reachable = robot.on && robot.linked;
            let state = robot.state();
            let fate = if world.calm {
                99
            } else {
                world.dice.below(100)
            };
            if fate < 25 && world.late.len() < LATE_MAX {
                world.late.push(Late::State(Box::new(state.clone())));
            }
            (reachable && fate >= 15).then_some(state)
        });
        if let Some(state) = heard {
            self.receive(state);
        }
    }

    fn receive(&self, state: RobotState) {
        let key = (self.site.clone(), state.robot.clone());
        let (now, wall) = (self.clock.elapsed(), self.clock.now());
        self.app.presences().state(&key, state, now, wall);
    }

    fn deliver_late(&mut self) {
        let state = with(&self.world, |world| {
            if world.late.is_empty() {
                return None;
            }
            let place = world.dice.below(world.late.len());
            match world.late.swap_remove(place) {
                Late::State(state) => Some(*state),
                Late::Command(index, run, verb, payload) => {
                    if world.robots[index].on && world.robots[index].is_run(run) {
                        world.robots[index].answer(verb, &payload, false);
                    }
                    None
                }
            }
        });
        if let Some(state) = state {
            self.receive(state);
        }
    }

    async fn upload(&mut self, index: usize) {
        let (batch, doubled, lost) = with(&self.world, |world| {
            let robot = &world.robots[index];
            let up = robot.on && robot.linked;
            let batch = robot.batch(1 + world.dice.below(3)).filter(|_| up);
            let calm = world.calm;
            let (doubled, lost) = (world.dice.percent(15), world.dice.percent(20));
            (batch, doubled && !calm, lost && !calm)
        });
        let Some(batch) = batch else { return };
        for _ in 0..=usize::from(doubled) {
            let (answer, answered) = oneshot::channel();
            let upload = Upload {
                site: self.site.clone(),
                batch: batch.clone(),
                answer,
            };
            self.writer.store(vec![upload]).await;
            let taken = matches!(answered.await, Ok(Ok(_)));
            // The commit is done, and the robot hears of it or not.
            if taken && !lost {
                with(&self.world, |world| world.robots[index].answered(&batch));
            }
        }
    }

    async fn restart_robot(&mut self, index: usize) {
        self.boots += 1;
        let boot = self.boots;
        let before = with(&self.world, |world| {
            let tells = world.dice.percent(50);
            let robot = &mut world.robots[index];
            let before = (robot.id.clone(), robot.boot);
            robot.restart(boot, tells);
            robot.on = true;
            before
        });
        let now = self.clock.elapsed();
        let key = (self.site.clone(), before.0);
        self.app.presences().token_gone(&key, before.1, now);
        if with(&self.world, |world| world.robots[index].linked) {
            self.greet(index).await;
        }
    }

    async fn toggle(&mut self, index: usize) {
        let now_up = with(&self.world, |world| {
            let linked = &mut world.robots[index].linked;
            *linked = !*linked;
            *linked
        });
        if now_up {
            self.greet(index).await;
        }
    }

    async fn restart_server(&mut self) {
        self.app.db().close().await;
        let robots = safety::robot_link(&self.world, &self.supervisor);
        self.app = app_on(&self.database, &self.clock, &self.site, robots).await;
        self.writer = Writer::new(self.app.clone());
        self.reconciler = Reconciler::new(self.app.clone());
        for index in 0..ROBOTS {
            if with(&self.world, |world| world.robots[index].linked) {
                self.greet(index).await;
            }
        }
    }

    /// The network heals, people let everything go on, and time passes.
    async fn heal(&mut self) -> Result<(), String> {
        with(&self.world, |world| {
            world.calm = true;
            for robot in &mut world.robots {
                (robot.on, robot.linked) = (true, true);
            }
        });
        for index in 0..ROBOTS {
            self.greet(index).await;
        }
        for _ in 0..HEAL_STEPS {
            while with(&self.world, |world| !world.late.is_empty()) {
                self.deliver_late();
            }
            self.let_go().await?;
            for (id, _) in self.reference.open() {
                self.resume(id).await?;
            }
            for index in 0..ROBOTS {
                with(&self.world, |world| world.robots[index].drive(2.5, false));
                self.heartbeat(index);
                self.upload(index).await;
            }
            self.reconcile().await?;
            self.clock.advance(Duration::from_millis(500));
            self.reference.follow(self.app.db()).await?;
            let idle = with(&self.world, |world| {
                let done = |robot: &Robot| robot.holds().is_none() && robot.batch(1).is_none();
                world.robots.iter().all(done)
            });
            let free = with(&self.world, |world| {
                !world.robots.iter().any(Robot::is_operator_controlled)
            });
            if idle && free && self.reference.open().is_empty() && !self.is_any_stopped().await? {
                return Ok(());
            }
        }
        let hands = with(&self.world, |world| {
            let hand = |robot: &Robot| {
                let stopped_by = robot.stopped_by();
                (
                    robot.id.clone(),
                    robot.holds(),
                    stopped_by,
                    robot.is_operator_controlled(),
                )
            };
            world.robots.iter().map(hand).collect::<Vec<_>>()
        });
        let (open, stops) = (self.reference.open(), self.stops_in_force().await?);
        Err(format!(
            "stuck: open at the server {open:?}, stops in force {stops:?}, robots with mission, stop and whether they \
             are in somebody's hands {hands:?}"
        ))
    }

    /// Both sides say the same of every mission, or policy said that the server decides.
    fn agree(&self) -> Result<(), String> {
        with(&self.world, |world| {
            for (id, (robot, state, cause)) in &self.reference.missions {
                let of = world.robots.iter().find(|here| here.id == *robot);
                let Some(phase) = of.and_then(|here| here.ended.get(id)) else {
                    continue;
                };
                let same = matches!(
                    (phase, state),
                    (MissionPhase::Succeeded, MissionState::Succeeded)
                        | (MissionPhase::Failed, MissionState::Failed)
                        | (MissionPhase::Cancelled, MissionState::Cancelled)
                );
                let decided_here = matches!(
                    cause,
                    Cause::RobotLost
                        | Cause::AgentRestarted
                        | Cause::RobotLostMission
                        | Cause::Rejected
                        | Cause::Expired
                ) || self.reference.cancelled_in_queue.contains(id);
                if !same && !decided_here {
                    return Err(format!(
                        "mission {id}: the robot says {phase:?}, the server {state:?} by {cause:?}"
                    ));
                }
            }
            Ok(())
        })
    }
}

/// What may be asked may also be refused; only the database must not fail.
fn allowed<T>(answer: Result<T, AppError>) -> Result<(), String> {
    match answer {
        Err(error @ AppError::Storage(_)) => Err(format!("{error:?}")),
        Ok(_) | Err(_) => Ok(()),
    }
}
