//! Messages from robots: zenoh's callbacks put them into channels, tasks process them.

use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use tracing::{debug, info, warn};
use tread_api::keys::{self, Key};
use tread_api::wire;
use tread_api::wire::state::{FrictionReport, RobotState};
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait as _};

use super::gate::{CUT_OFF, Links};
use super::rate_limits::{Kind, Place, RateLimits, TokenVerdict};
use super::received::{
    LimitedQuery, RefusedMessage, count_refusal, explained, log_refusal, next, refuse_key,
};
use super::republish::Republisher;
use super::{requests, tokens};
use crate::app::App;
use crate::app::ingest::Upload;
use crate::app::presence::{MessageEffect, RobotKey};
use crate::counters::Counter;
use crate::supervisor::Supervisor;

/// Maximum number of waiting presence changes; all robots of a full server may connect at once.
const PRESENCE_WAITING_MAX: usize = 32_768;
/// Maximum number of waiting states and friction reports: one second of a thousand robots at 10 Hz.
const STATES_WAITING_MAX: usize = 10_000;
/// Maximum number of waiting hellos.
const HELLOS_WAITING_MAX: usize = 8_192;
/// Maximum number of states and friction reports that are processed at once.
const STATES_AT_ONCE_MAX: usize = 1_000;
/// Pause after states were processed. Those that arrive meanwhile wake no thread: with a thousand
/// robots, waking one for each would cost more than decoding it.
const STATES_PAUSE: Duration = Duration::from_millis(5);
/// Maximum size of a state or a friction report, bytes.
pub(super) const STATE_BYTES_MAX: usize = 256 * 1024;
/// Interval of checks for tokens that came too fast.
const LATE_TOKENS_EVERY: Duration = Duration::from_secs(1);
/// Maximum number of uploads that wait to be parsed.
const UPLOADS_WAITING_MAX: usize = 512;

/// Senders of the channels, for zenoh's callbacks.
#[derive(Debug, Clone)]
pub(super) struct Channels {
    app: App,
    presence: mpsc::Sender<TokenChange>,
    states: mpsc::Sender<Published>,
    hellos: mpsc::Sender<LimitedQuery>,
    uploads: mpsc::Sender<LimitedQuery>,
    limits: RateLimits,
    /// Links of the robots; `None` without a gate.
    links: Option<Links>,
}

#[derive(Debug)]
enum TokenChange {
    /// A liveliness token appeared on a router or vanished.
    Token {
        key: String,
        router: u64,
        appeared: bool,
    },
    /// A router was closed, and with it all tokens on it.
    RouterClosed(u64),
}

/// A state or a friction report.
#[derive(Debug)]
struct Published {
    kind: Kind,
    payload: Vec<u8>,
    place: Place,
    /// Time of arrival.
    at: Arrival,
}

/// Time of arrival of a message, by both clocks of the server.
#[derive(Debug, Clone, Copy)]
struct Arrival {
    monotonic: Duration,
    wall: Timestamp,
}

impl Channels {
    /// Creates the channels and starts the tasks that read them.
    pub(super) fn new(
        supervisor: &Supervisor,
        app: &App,
        uploads_out: mpsc::Sender<Upload>,
        links: Option<Links>,
        republisher: Option<Republisher>,
    ) -> Self {
        let (presence, presence_in) = mpsc::channel(PRESENCE_WAITING_MAX);
        let (states, states_in) = mpsc::channel(STATES_WAITING_MAX);
        let (hellos, hellos_in) = mpsc::channel(HELLOS_WAITING_MAX);
        let (uploads, uploads_in) = mpsc::channel(UPLOADS_WAITING_MAX);
        let queues = app.metrics().queues();
        queues.show("presence", &presence);
        queues.show("states", &states);
        queues.show("hellos", &hellos);
        queues.show("uploads", &uploads);
        queues.show("ingest", &uploads_out);
        let stop = || supervisor.stop_token();
        let limits = RateLimits::default();
        let watching = watch_presence(app.clone(), presence_in, limits.clone(), stop());
        supervisor.spawn_vital("presence", watching);
        let to = (app.clone(), republisher);
        let reading = read_states(to, states_in, limits.clone(), stop());
        supervisor.spawn_vital("states", reading);
        let replies = requests::Replies::new(app.clone(), limits.clone(), supervisor.clone());
        supervisor.spawn_vital(
            "hellos",
            requests::serve_hellos(replies.clone(), hellos_in, stop()),
        );
        let serving = requests::serve_uploads(replies, uploads_in, uploads_out, stop());
        supervisor.spawn_vital("uploads", serving);
        Self {
            app: app.clone(),
            presence,
            states,
            hellos,
            uploads,
            limits,
            links,
        }
    }
}

impl Channels {
    /// Takes a place for a message on a key; `None` if the message is dropped and counted.
    fn admit(&self, key: &str, kind: Kind) -> Option<Place> {
        let now = self.app.clock().elapsed();
        let Some((site, robot)) = robot_of(key) else {
            refuse_key(&self.app, key);
            return None;
        };
        let place = self.limits.admit((site, robot), kind, now);
        if place.is_none() {
            self.app.counters().rate_limited.one();
            self.log_rate_limited(key, now);
        }
        place
    }

    fn log_rate_limited(&self, key: &str, now: Duration) {
        let Some(robot) = robot_of(key) else { return };
        if let Some(repeats) = self.limits.log_refused(&robot, now) {
            let (site, robot) = robot;
            warn!(robot.id = %robot, repeats, "robot `{robot}` of site `{site}` sends more than its share");
        }
    }

    /// Handles a liveliness token that appeared or vanished.
    fn token(&self, key: &str, router: u64, appeared: bool) {
        let Some(robot) = robot_of(key) else {
            return refuse_key(&self.app, key);
        };
        let (place, now) = ((key.to_owned(), router), self.app.clock().elapsed());
        let is_taken = if appeared {
            match self.limits.token_appeared(&robot, place, now) {
                TokenVerdict::Accepted => true,
                TokenVerdict::Refused => false,
                TokenVerdict::Excessive => {
                    self.cut_off(&robot, now);
                    false
                }
            }
        } else {
            self.limits.token_gone(&robot, &place)
        };
        if is_taken {
            let change = TokenChange::Token {
                key: key.to_owned(),
                router,
                appeared,
            };
            let dropped = &self.app.counters().presence_dropped;
            deliver(&self.presence, change, dropped);
        } else if appeared {
            self.app.counters().rate_limited.one();
            self.log_rate_limited(key, now);
        }
    }

    /// The router keeps every token, which slows it down for all robots.
    fn cut_off(&self, robot: &RobotKey, now: Duration) {
        let links = self.links.as_ref();
        if links.is_some_and(|links| links.cut_off(robot, now)) {
            let (site, robot) = robot;
            warn!(
                robot.id = %robot,
                "robot `{robot}` of site `{site}` declares liveliness tokens without end: its links are cut for {} s",
                CUT_OFF.as_secs()
            );
        }
    }

    /// Reports that a router was closed.
    pub(super) fn router_closed(&self, router: u64) {
        self.limits.router_closed(router);
        let change = TokenChange::RouterClosed(router);
        deliver(
            &self.presence,
            change,
            &self.app.counters().presence_dropped,
        );
    }
}

fn deliver<T>(channel: &mpsc::Sender<T>, message: T, dropped: &Counter) {
    // A closed channel means that the server is stopping; nothing important is lost then.
    if let Err(TrySendError::Full(_)) = channel.try_send(message) {
        dropped.one();
    }
}

/// Declares all subscriptions and queryables of the server. Blocks its thread.
pub(super) fn declare(session: &Session, channels: &Channels, router: u64) -> zenoh::Result<()> {
    let to = channels.clone();
    session
        .declare_queryable(keys::ALL_HELLOS)
        .complete(true)
        .callback(move |query| {
            if let Some(place) = to.admit(query.key_expr().as_str(), Kind::Hello) {
                let limited = LimitedQuery { query, place };
                deliver(&to.hellos, limited, &to.app.counters().hellos_dropped);
            }
        })
        .background()
        .wait()?;
    let to = channels.clone();
    session
        .declare_queryable(keys::ALL_INGEST)
        .complete(true)
        .callback(move |query| {
            if let Some(place) = to.admit(query.key_expr().as_str(), Kind::Upload) {
                let limited = LimitedQuery { query, place };
                deliver(&to.uploads, limited, &to.app.counters().ingest_dropped_busy);
            }
        })
        .background()
        .wait()?;
    for (key, kind) in [
        (keys::ALL_STATES, Kind::State),
        (keys::ALL_FRICTION, Kind::Friction),
    ] {
        let to = channels.clone();
        session
            .declare_subscriber(key)
            .callback(move |sample| {
                let key = sample.key_expr().as_str();
                let Some(place) = to.admit(key, kind) else {
                    return;
                };
                if sample.payload().len() > STATE_BYTES_MAX {
                    return to.app.counters().refused_malformed.one();
                }
                let clock = to.app.clock();
                let published = Published {
                    kind,
                    payload: sample.payload().to_bytes().into_owned(),
                    place,
                    at: Arrival {
                        monotonic: clock.elapsed(),
                        wall: clock.now(),
                    },
                };
                deliver(&to.states, published, &to.app.counters().states_dropped);
            })
            .background()
            .wait()?;
    }
    let to = channels.clone();
    session
        .liveliness()
        .declare_subscriber(keys::ALL_ALIVE)
        .history(true)
        .callback(move |sample| {
            let appeared = sample.kind() == SampleKind::Put;
            to.token(sample.key_expr().as_str(), router, appeared);
        })
        .background()
        .wait()
}

async fn watch_presence(
    app: App,
    mut changes: mpsc::Receiver<TokenChange>,
    limits: RateLimits,
    stop: CancellationToken,
) {
    let mut tokens = tokens::Tokens::default();
    let mut late = tokio::time::interval(LATE_TOKENS_EVERY);
    late.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let change = tokio::select! {
            change = next(&mut changes, &stop) => change,
            _ = late.tick() => {
                for (key, router) in limits.late_tokens(app.clock().elapsed()) {
                    appeared(&app, &mut tokens, &key, router);
                    app.wake();
                }
                continue;
            }
        };
        let Some(change) = change else { return };
        match change {
            TokenChange::Token {
                key,
                router,
                appeared: true,
            } => appeared(&app, &mut tokens, &key, router),
            TokenChange::Token { key, router, .. } => {
                if tokens.remove(&key, router) {
                    gone(&app, &key);
                }
            }
            TokenChange::RouterClosed(router) => {
                for key in tokens.router_closed(router) {
                    gone(&app, &key);
                }
            }
        }
        app.wake();
    }
}

fn appeared(app: &App, tokens: &mut tokens::Tokens, token: &str, router: u64) {
    let Some(Key::Alive(site, robot, boot)) = Key::parse(token) else {
        return refuse_key(app, token);
    };
    let key = (site, robot);
    if !app.admits(&key) || !tokens.add(token, router) {
        return;
    }
    let (site, robot) = &key;
    info!(robot.id = %robot, "robot `{robot}` of site `{site}` is on the network");
    let now = app.clock().elapsed();
    app.presences().token_appeared(key, boot, now);
}

fn gone(app: &App, token: &str) {
    if let Some(Key::Alive(site, robot, boot)) = Key::parse(token) {
        info!(robot.id = %robot, "robot `{robot}` of site `{site}` is off the network");
        let now = app.clock().elapsed();
        app.presences().token_gone(&(site, robot), boot, now);
    }
}

async fn read_states(
    (app, republisher): (App, Option<Republisher>),
    mut published: mpsc::Receiver<Published>,
    limits: RateLimits,
    stop: CancellationToken,
) {
    let mut messages = Vec::with_capacity(STATES_AT_ONCE_MAX);
    loop {
        let received = tokio::select! {
            biased;
            () = stop.cancelled() => return,
            received = published.recv_many(&mut messages, STATES_AT_ONCE_MAX) => received,
        };
        if received == 0 {
            return;
        }
        for message in messages.drain(..) {
            let is_taken = process(&app, &limits, &message);
            if let Some(republisher) = republisher.as_ref().filter(|_| is_taken) {
                let (site, robot) = message.place.robot();
                let key = if message.kind == Kind::Friction {
                    keys::friction(site, robot)
                } else {
                    keys::state(site, robot)
                };
                republisher.publish(key, message.payload);
            }
        }
        if received < STATES_AT_ONCE_MAX {
            tokio::time::sleep(STATES_PAUSE).await;
        } else {
            // More are probably waiting.
            tokio::task::yield_now().await;
        }
    }
}

/// Records a state or a friction report of a robot; returns whether it was taken.
fn process(app: &App, limits: &RateLimits, message: &Published) -> bool {
    let key = message.place.robot();
    if !app.admits(key) {
        return false;
    }
    let (_, robot) = key;
    let heard = if message.kind == Kind::Friction {
        let named = |report: &FrictionReport| report.robot == *robot;
        let Some(report) = read(app, limits, message, named) else {
            return false;
        };
        let presences = app.presences();
        presences.friction(key, &report, message.at.monotonic)
    } else {
        let named = |state: &RobotState| state.robot == *robot;
        let Some(mut state) = read(app, limits, message, named) else {
            return false;
        };
        state.remove_impossible_values();
        let (presences, at) = (app.presences(), message.at);
        presences.state(key, state, at.monotonic, at.wall)
    };
    match heard {
        MessageEffect::Changed => app.wake(),
        MessageEffect::Unchanged => {}
        MessageEffect::NotWelcomed => {
            refuse_stranger(app, key);
            return false;
        }
        MessageEffect::OtherRun => {
            app.counters().refused_other_run.one();
            return false;
        }
    }
    true
}

fn read<T: serde::de::DeserializeOwned>(
    app: &App,
    limits: &RateLimits,
    message: &Published,
    is_named: impl Fn(&T) -> bool,
) -> Option<T> {
    let counters = app.counters();
    let why = match wire::decode::<T>(&message.payload) {
        Ok(body) if is_named(&body) => {
            counters.states_received.one();
            return Some(body);
        }
        Ok(_other_robot) => {
            counters.refused_impersonation.one();
            "it names another robot".to_owned()
        }
        Err(error) => {
            count_refusal(app, &error);
            explained(&error)
        }
    };
    let (site, robot) = message.place.robot();
    let key = if message.kind == Kind::Friction {
        keys::friction(site, robot)
    } else {
        keys::state(site, robot)
    };
    let refused = RefusedMessage {
        key: &key,
        why: &why,
    };
    log_refusal(app, limits, message.place.robot(), refused);
    None
}

/// Returns the robot to which a key belongs.
fn robot_of(key: &str) -> Option<RobotKey> {
    match Key::parse(key)? {
        Key::State(site, robot)
        | Key::Friction(site, robot)
        | Key::Hello(site, robot)
        | Key::Ingest(site, robot)
        | Key::Alive(site, robot, _) => Some((site, robot)),
        Key::Command(..) | Key::Teleop(..) | Key::Limit(..) | Key::Pulse(..) | Key::Map(..) => None,
    }
}

/// Counts and logs a message of an unknown robot.
fn refuse_stranger(app: &App, (site, robot): &RobotKey) {
    app.counters().refused_unknown_robot.one();
    debug!("a message of robot `{robot}` of site `{site}` was refused: it has not said hello");
}
