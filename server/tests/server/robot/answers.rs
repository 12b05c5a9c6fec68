//! What a played robot answers, as its mood is.

use std::sync::Mutex;

use tokio::time::Instant;
use tread_api::ids::BootId;
use tread_api::keys::{Key, Verb};
use tread_api::robot::{MissionProgress, RobotMode};
use tread_api::safety::{Lease, StopLatch};
use tread_api::wire;
use tread_api::wire::command::{Cancel, Offer, Outcomes, Pause};
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::reply::{
    AcceptedMission, Acknowledgement, Answer, Command, CommandRefusal, CommandRefusalCode,
    LeaseReply, OfferReply, OutcomesReply,
};
use tread_api::wire::safety::{
    AcquireLease, ClearStop, ExternalLimit, LeaseCommand, ReleaseLease, Stop,
};
use tread_api::wire::state::{RobotState, StateRate};
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
    let mut state = state.lock().unwrap();
    let reply = match verb {
        Verb::Offer => {
            heard.offers.push(wire::decode(&payload).unwrap());
            offered(&heard, &mut state).map(|reply| says::<Offer>(boot, reply))
        }
        Verb::Cancel => {
            let cancel: Cancel = wire::decode(&payload).unwrap();
            if state.mission.is_some_and(|held| held.id == cancel.mission) {
                state.mode = RobotMode::Idle;
                state.mission = None;
            }
            heard.cancels.push(cancel);
            Some(says::<Cancel>(boot, Acknowledgement::Done))
        }
        Verb::Pause | Verb::Resume => {
            heard.holds.push(verb);
            if heard.mood != Mood::Braking
                && heard.mood != Mood::Silent
                && let Some(mission) = &mut state.mission
            {
                mission.paused = verb == Verb::Pause;
            }
            let is_silent = heard.mood == Mood::Silent;
            (!is_silent).then(|| says::<Pause>(boot, Acknowledgement::Done))
        }
        Verb::Site => {
            let definition: SiteDefinition = wire::decode(&payload).unwrap();
            state.terrain_revision = Some(definition.terrain_revision);
            state.safety.fence_revision = Some(definition.geofence.revision);
            heard.sites.push(definition);
            Some(says::<SiteDefinition>(boot, Acknowledgement::Done))
        }
        Verb::Stop => {
            let stop: Stop = wire::decode(&payload).unwrap();
            let is_deaf = heard.deaf_to_stops;
            (!is_deaf).then(|| says::<Stop>(boot, stopped(stop, &mut heard, &mut state)))
        }
        Verb::Clear => {
            let clear: ClearStop = wire::decode(&payload).unwrap();
            let reply = cleared(clear, &mut heard, &mut state);
            Some(says::<ClearStop>(boot, reply))
        }
        Verb::Lease => Some(match wire::decode(&payload).unwrap() {
            LeaseCommand::Acquire(acquire) => {
                let reply = leased(acquire, &mut heard, &mut state);
                says::<AcquireLease>(boot, reply)
            }
            LeaseCommand::Release(release) => {
                let client = release.holder.client;
                let other = state.safety.lease.take();
                state.safety.lease = other.filter(|other| other.driver.client != client);
                heard.leases.push(LeaseCommand::Release(release));
                says::<ReleaseLease>(boot, Acknowledgement::Done)
            }
        }),
        Verb::Limit => {
            heard.limits.push(wire::decode(&payload).unwrap());
            Some(says::<ExternalLimit>(boot, Acknowledgement::Done))
        }
        Verb::StateRate => {
            let asked: StateRate = wire::decode(&payload).unwrap();
            heard.state_rates.push((Instant::now(), asked));
            let is_deaf = heard.deaf_to_state_rates;
            (!is_deaf).then(|| says::<StateRate>(boot, Acknowledgement::Done))
        }
        Verb::Outcomes => {
            let asked: Outcomes = wire::decode(&payload).unwrap();
            heard.outcomes_asked.push(asked);
            let accepted = state.mission.map(|held| AcceptedMission {
                mission: held.id,
                revision: held.revision,
                plan_hash: held.plan_hash,
            });
            heard.remembered.clone().map(|mut outcomes| {
                outcomes.active = accepted;
                says::<Outcomes>(boot, OutcomesReply::Outcomes(outcomes))
            })
        }
    };
    let Some(payload) = reply else {
        return;
    };
    query
        .reply(query.key_expr().clone(), payload)
        .wait()
        .unwrap();
}

fn says<C: Command>(boot: BootId, reply: C::Reply) -> Vec<u8> {
    wire::encode(&Answer { boot, reply }).unwrap()
}

/// What it answers to the newest offer; `None` is silence.
fn offered(heard: &Heard, state: &mut RobotState) -> Option<OfferReply> {
    Some(match heard.mood {
        Mood::Silent => return None,
        Mood::Refusing(code) => OfferReply::Refused(CommandRefusal::new(code, "as the test asked")),
        Mood::Willing | Mood::Braking => {
            let offer = heard.offers.last().unwrap();
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
            OfferReply::Accepted { plan: None }
        }
    })
}

fn stopped(stop: Stop, heard: &mut Heard, state: &mut RobotState) -> Acknowledgement {
    if heard.stops_are_over {
        heard.stops.push(stop);
        let detail = "this stop was in force, and was cleared";
        let refusal = CommandRefusal::new(CommandRefusalCode::Ended, detail);
        return Acknowledgement::Refused(refusal);
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
    Acknowledgement::Done
}

fn cleared(clear: ClearStop, heard: &mut Heard, state: &mut RobotState) -> Acknowledgement {
    let newest = state.safety.stop.as_ref().map(|latch| latch.id);
    if newest.is_some_and(|newest| newest != clear.stop) {
        let detail = "a newer stop is in force";
        let refusal = CommandRefusal::new(CommandRefusalCode::Conflict, detail);
        return Acknowledgement::Refused(refusal);
    }
    state.safety.stop = None;
    state.mode = RobotMode::Idle;
    heard.clears.push(clear);
    Acknowledgement::Done
}

fn leased(acquire: AcquireLease, heard: &mut Heard, state: &mut RobotState) -> LeaseReply {
    heard.leases.push(LeaseCommand::Acquire(acquire.clone()));
    let other = state.safety.lease.as_ref();
    let other = other.filter(|other| other.driver.client != acquire.holder.client);
    if let Some(other) = other.filter(|_| !acquire.take) {
        let detail = format!("`{}` drives it", other.driver.name);
        let refusal = CommandRefusal::new(CommandRefusalCode::Leased, detail);
        return LeaseReply::Refused(refusal);
    }
    heard.epoch += 1;
    let epoch = heard.epoch;
    let driver = acquire.holder;
    state.safety.lease = Some(Lease { epoch, driver });
    LeaseReply::Leased { epoch }
}
