//! What a played robot answers, as its mood is.

use std::sync::Mutex;

use tread_api::ids::BootId;
use tread_api::keys::{Key, Verb};
use tread_api::robot::{MissionProgress, RobotMode};
use tread_api::safety::{Lease, StopLatch};
use tread_api::wire;
use tread_api::wire::command::{Answer, Cancel, OfferRefusal, Outcome};
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::safety::{ClearStop, LeaseAction, LeaseCommand, Stop};
use tread_api::wire::state::RobotState;
use zenoh::Wait as _;

use super::{Heard, Mood};

pub(super) fn answer(
    query: &zenoh::query::Query,
    boot: BootId,
    heard: &Mutex<Heard>,
    state: &Mutex<RobotState>,
) {
    let Some(Key::Command(_, _, verb)) = Key::parse(query.key_expr().as_str()) else {
        return;
    };
    let payload = query.payload().unwrap().to_bytes();
    let mut heard = heard.lock().unwrap();
    let outcome = match verb {
        Verb::Offer => {
            heard.offers.push(wire::decode(&payload).unwrap());
            match heard.mood {
                Mood::Silent => return,
                Mood::Refusing(code) => Outcome::Refused {
                    code,
                    detail: "as told".to_owned(),
                },
                Mood::Willing | Mood::Braking => {
                    let offer = heard.offers.last().unwrap();
                    let mut state = state.lock().unwrap();
                    state.mode = RobotMode::Tracking;
                    state.mission = Some(MissionProgress {
                        id: offer.mission,
                        revision: offer.revision,
                        plan_hash: offer.plan_hash,
                        driven_m: 0.0,
                        length_m: 18.85,
                        cross_track_m: 0.0,
                        paused: false,
                        paused_by: None,
                    });
                    Outcome::Accepted { plan: None }
                }
            }
        }
        Verb::Cancel => {
            let cancel: Cancel = wire::decode(&payload).unwrap();
            let mut state = state.lock().unwrap();
            if state.mission.is_some_and(|held| held.id == cancel.mission) {
                state.mode = RobotMode::Idle;
                state.mission = None;
            }
            heard.cancels.push(cancel);
            Outcome::Done
        }
        Verb::Pause | Verb::Resume => {
            let mut state = state.lock().unwrap();
            heard.holds.push(verb);
            match heard.mood {
                Mood::Silent => return,
                Mood::Willing | Mood::Refusing(_) | Mood::Braking => {}
            }
            if heard.mood != Mood::Braking
                && let Some(mission) = &mut state.mission
            {
                mission.paused = verb == Verb::Pause;
            }
            Outcome::Done
        }
        Verb::Site => {
            let definition: SiteDefinition = wire::decode(&payload).unwrap();
            let mut state = state.lock().unwrap();
            state.terrain_revision = Some(definition.terrain_revision);
            state.safety.fence_revision = Some(definition.geofence.revision);
            heard.sites.push(definition);
            Outcome::Done
        }
        Verb::Stop | Verb::Clear | Verb::Lease | Verb::Limit => {
            let mut state = state.lock().unwrap();
            match in_safety(verb, &payload, &mut heard, &mut state) {
                Some(outcome) => outcome,
                None => return,
            }
        }
    };
    let payload = wire::encode(&Answer { boot, outcome }).unwrap();
    query
        .reply(query.key_expr().clone(), payload)
        .wait()
        .unwrap();
}

/// What it answers to all that may only slow it down; `None` is silence.
fn in_safety(
    verb: Verb,
    payload: &[u8],
    heard: &mut Heard,
    state: &mut RobotState,
) -> Option<Outcome> {
    Some(match verb {
        Verb::Stop => {
            if heard.deaf_to_stops {
                return None;
            }
            let stop: Stop = wire::decode(payload).unwrap();
            if heard.stops_are_over {
                heard.stops.push(stop);
                return Some(Outcome::Refused {
                    code: OfferRefusal::Ended,
                    detail: "this stop was in force, and was cleared".to_owned(),
                });
            }
            state.mode = RobotMode::Stopped;
            if let Some(mission) = &mut state.mission {
                mission.paused = true;
            }
            state.safety.stop = Some(StopLatch {
                id: stop.stop,
                by: stop.by.clone(),
                reason: stop.reason.clone(),
                since: stop.at,
            });
            heard.stops.push(stop);
            Outcome::Done
        }
        Verb::Clear => {
            let clear: ClearStop = wire::decode(payload).unwrap();
            let newest = state.safety.stop.as_ref().map(|latch| latch.id);
            if newest.is_some_and(|newest| newest != clear.stop) {
                Outcome::Refused {
                    code: OfferRefusal::Conflict,
                    detail: "a newer stop is in force".to_owned(),
                }
            } else {
                state.safety.stop = None;
                state.mode = RobotMode::Idle;
                heard.clears.push(clear);
                Outcome::Done
            }
        }
        Verb::Lease => {
            let lease: LeaseCommand = wire::decode(payload).unwrap();
            let other = state.safety.lease.clone();
            let other = other.filter(|other| other.driver.client != lease.holder.client);
            heard.leases.push(lease.clone());
            match (lease.action, other) {
                (LeaseAction::Acquire, Some(other)) => Outcome::Refused {
                    code: OfferRefusal::Leased,
                    detail: format!("`{}` drives it", other.driver.name),
                },
                (LeaseAction::Acquire | LeaseAction::Take, _) => {
                    heard.epoch += 1;
                    let epoch = heard.epoch;
                    let driver = lease.holder;
                    state.safety.lease = Some(Lease { epoch, driver });
                    Outcome::Leased { epoch }
                }
                (LeaseAction::Release, other) => {
                    state.safety.lease = other;
                    Outcome::Done
                }
            }
        }
        Verb::Limit => {
            heard.limits.push(wire::decode(payload).unwrap());
            Outcome::Done
        }
        Verb::Offer | Verb::Cancel | Verb::Pause | Verb::Resume | Verb::Site => return None,
    })
}
