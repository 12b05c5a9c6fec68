//! What the link listens to: commands, the server's pulse, drive commands and limits.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::ids::SiteId;
use tread_api::keys::{self, Key, Verb};
use tread_api::safety::SMALL_PAYLOAD_MAX;
use tread_api::wire::state::ServerPulse;
use tread_api::wire::{self, PAYLOAD_BYTES_MAX, WireError};
use zenoh::Wait;
use zenoh::query::Query;

use super::{
    HandleUrgent, Identity, IncomingCommand, LinkError, LinkEvent, LinkEventHandler, Listeners,
    Urgent, zenoh_failed,
};

/// Declares the queryable of the server's commands, which puts them into the queue of
/// [`Listeners::commands`].
pub(super) fn listen_to_commands(
    session: &zenoh::Session,
    identity: &Identity,
    listeners: &Listeners,
    left: &CancellationToken,
) -> Result<(), LinkError> {
    let (site, robot) = (&identity.site, &identity.robot);
    let command_sender = listeners.commands.clone();
    let on_event = Arc::clone(&listeners.on_event);
    let urgent = Arc::clone(&listeners.urgent);
    let is_left = left.clone();
    let own_run = identity.boot.to_string();
    let take_query = move |query: Query| {
        // Addressed to another run of the agent: no reply.
        let run = query.parameters().get(keys::RUN);
        if run.is_some_and(|run| run != own_run) {
            return;
        }
        let Some(Key::Command(_, _, verb)) = Key::parse(query.key_expr().as_str()) else {
            // A wildcard or an unknown verb: no reply, which means not delivered.
            return;
        };
        let payload = query.payload().map_or(0, zenoh::bytes::ZBytes::len);
        if payload > PAYLOAD_BYTES_MAX {
            debug!(payload, "a command is larger than any can be");
            return;
        }
        let payload = query.payload().map(|bytes| bytes.to_bytes().into_owned());
        // A server whose commands cannot be read must not keep the link alive. A large command is not
        // parsed here, because this callback must be quick; pulses keep the link alive meanwhile.
        let is_small_and_readable = |payload: &Vec<u8>| {
            payload.len() <= SMALL_PAYLOAD_MAX && wire::check_version(payload).is_ok()
        };
        if payload.as_ref().is_some_and(is_small_and_readable) {
            on_event(LinkEvent::ServerMessage);
        }
        // A stop counts whoever sends it.
        if let (Verb::Stop, Some(payload)) = (verb, &payload) {
            urgent(Urgent::Stop(payload));
        } else if is_left.is_cancelled() {
            return;
        }
        let command = IncomingCommand {
            verb,
            payload: payload.unwrap_or_default(),
            query,
        };
        // Queue full: the query is dropped, the server gets no reply and repeats it.
        if command_sender.try_send(command).is_err() {
            on_event(LinkEvent::CommandLost);
        }
    };
    session
        .declare_queryable(keys::commands(site, robot))
        .complete(true)
        .callback(take_query)
        .background()
        .wait()
        .map_err(zenoh_failed("declare the commands"))
}

/// Subscribes to the server's pulse, which also states which authorities robots shall trust.
///
/// A pulse that cannot be read does not count as a message of the server: this robot could not read
/// a Stop of that server either.
pub(super) fn listen_to_pulse(
    session: &zenoh::Session,
    site: &SiteId,
    on_event: &LinkEventHandler,
) -> Result<(), LinkError> {
    let on_event = Arc::clone(on_event);
    let log = VersionLog::new("pulse of the server");
    session
        .declare_subscriber(keys::pulse(site))
        .callback(move |sample| {
            let pulse = wire::decode::<ServerPulse>(&small(sample.payload()));
            match pulse {
                Ok(pulse) => {
                    on_event(LinkEvent::ServerMessage);
                    if let Some(trust) = pulse.trust {
                        on_event(LinkEvent::Trust(trust));
                    }
                }
                Err(refusal) => log.record(&refusal),
            }
        })
        .background()
        .wait()
        .map_err(zenoh_failed("listen for the server's pulse"))
}

/// Subscribes to drive commands and limits. Only the latest counts, so each is processed in its
/// callback.
pub(super) fn listen_urgently(
    session: &zenoh::Session,
    identity: &Identity,
    urgent: &HandleUrgent,
) -> Result<(), LinkError> {
    let (site, robot) = (&identity.site, &identity.robot);
    let take = Arc::clone(urgent);
    let log = VersionLog::new("drive command");
    session
        .declare_subscriber(keys::teleop(site, robot))
        .callback(move |sample| {
            let payload = small(sample.payload());
            log.check(&payload);
            take(Urgent::Drive(&payload));
        })
        .background()
        .wait()
        .map_err(zenoh_failed("listen for drive commands"))?;
    let take = Arc::clone(urgent);
    let log = VersionLog::new("limit");
    session
        .declare_subscriber(keys::limits(site, robot))
        .callback(move |sample| {
            if let Some(Key::Limit(_, _, owner)) = Key::parse(sample.key_expr().as_str()) {
                let payload = small(sample.payload());
                log.check(&payload);
                take(Urgent::Limit(&owner, &payload));
            }
        })
        .background()
        .wait()
        .map_err(zenoh_failed("listen for limits"))
}

/// Log of published messages of another wire version: one warning for messages of the same version
/// in a row.
struct VersionLog {
    kind: &'static str,
    /// The other version of the last warning; 0 before the first one.
    logged: AtomicU32,
}

impl VersionLog {
    fn new(kind: &'static str) -> Self {
        Self {
            kind,
            logged: AtomicU32::new(0),
        }
    }

    /// Logs a payload of another version. The recipient of the payload refuses and counts it.
    fn check(&self, payload: &[u8]) {
        if let Err(refusal) = wire::check_version(payload) {
            self.record(&refusal);
        }
    }

    fn record(&self, refusal: &WireError) {
        if let WireError::Version(version) = *refusal
            && self.logged.swap(version, Ordering::Relaxed) != version
        {
            warn!("a {} is ignored: {refusal}", self.kind);
        }
    }
}

/// Returns the bytes of a small payload; those of a larger one are empty, which does not parse.
fn small(payload: &zenoh::bytes::ZBytes) -> Vec<u8> {
    if payload.len() > SMALL_PAYLOAD_MAX {
        return Vec::new();
    }
    payload.to_bytes().into_owned()
}
