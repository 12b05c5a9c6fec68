//! The network between robots and server: it loses, delays, doubles and reorders.

use std::collections::HashSet;
use std::sync::{Arc, Mutex, PoisonError};

use tread_api::ids::{BootId, MissionId};
use tread_api::keys::Verb;
use tread_api::wire;
use tread_api::wire::command::{Offer, Pause};
use tread_api::wire::state::RobotState;
use tread_server::app::presence::RobotKey;
use tread_server::app::robot_link::{Answering, CommandTransport, Undelivered};

use super::dice::Dice;
use super::robot::Robot;

/// A message that is still on its way.
#[derive(Debug)]
pub(super) enum Late {
    Command(usize, Option<BootId>, Verb, Vec<u8>),
    State(Box<RobotState>),
}

/// The robots and the network between them and the server.
#[derive(Debug)]
pub(super) struct World {
    pub(super) robots: Vec<Robot>,
    pub(super) late: Vec<Late>,
    pub(super) dice: Dice,
    pub(super) calm: bool,
    /// Missions that a person has held or ended, and that nobody has let go on since.
    pub(super) held: HashSet<MissionId>,
    /// What the server set in motion by itself, if it ever does.
    pub(super) wrong: Option<String>,
}

impl World {
    /// No command may resume what was held.
    fn check_sent(&mut self, verb: Verb, payload: &[u8]) {
        let mission = match verb {
            Verb::Offer => match wire::decode::<Offer>(payload) {
                // It is to be taken and not to be driven.
                Ok(offer) if offer.on_hold => return,
                offer => offer.map(|offer| offer.mission),
            },
            Verb::Resume => wire::decode::<Pause>(payload).map(|pause| pause.mission),
            Verb::Cancel
            | Verb::Pause
            | Verb::Site
            | Verb::Stop
            | Verb::Clear
            | Verb::Lease
            | Verb::Limit
            | Verb::StateRate
            | Verb::Outcomes => return,
        };
        let mission = mission.expect("the server writes what can be read");
        if self.held.contains(&mission) {
            self.wrong = Some(format!("{verb:?} of {mission}, which is held"));
        }
    }
}

pub(super) type Shared = Arc<Mutex<World>>;

pub(super) fn with<T>(world: &Shared, act: impl FnOnce(&mut World) -> T) -> T {
    act(&mut world.lock().unwrap_or_else(PoisonError::into_inner))
}

#[derive(Debug)]
pub(super) struct Network(pub(super) Shared);

impl CommandTransport for Network {
    fn send(
        &self,
        (_, robot): &RobotKey,
        run: Option<BootId>,
        verb: Verb,
        payload: Vec<u8>,
    ) -> Answering {
        let answer = with(&self.0, |world| {
            world.check_sent(verb, &payload);
            let index = world.robots.iter().position(|here| here.id == *robot)?;
            let there = &world.robots[index];
            let reachable = there.on && there.linked && there.is_run(run);
            let calm = world.calm;
            let fate = if calm { 99 } else { world.dice.below(100) };
            // Lost on the way, or late: the server hears nothing.
            if !reachable || fate < 15 {
                return None;
            }
            if fate < 25 && world.late.len() < LATE_MAX {
                world.late.push(Late::Command(index, run, verb, payload));
                return None;
            }
            if fate < 35 && world.late.len() < LATE_MAX {
                world
                    .late
                    .push(Late::Command(index, run, verb, payload.clone()));
            }
            let impossible = !calm && world.dice.percent(3);
            let answer = world.robots[index].answer(verb, &payload, impossible);
            // Done, and the answer is lost.
            (fate >= 45).then_some(answer)
        });
        Box::pin(std::future::ready(answer.ok_or(Undelivered::NoAnswer)))
    }
}

/// Messages that are late at once.
pub(super) const LATE_MAX: usize = 30;
