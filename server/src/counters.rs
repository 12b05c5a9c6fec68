//! What the server counts about itself, shown at `GET /v1/server`.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

macro_rules! counters {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// Counters since the start of the process; each only grows.
        #[derive(Debug, Default)]
        pub struct Counters {
            $($(#[$doc])* pub $name: Counter,)*
        }

        /// The counters at one moment.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
        pub struct CounterValues {
            $($(#[$doc])* pub $name: u64,)*
        }

        impl Counters {
            /// Reads all counters.
            pub fn values(&self) -> CounterValues {
                CounterValues { $($name: self.$name.get(),)* }
            }
        }
    };
}

counters! {
    /// Segments stored.
    segments_committed,
    /// Segments and mission reports that were stored before and came again.
    records_duplicate,
    /// Records that can never be taken: impossible numbers, or not this robot's mission.
    records_refused,
    /// Segments with times in the future, deferred until their run's clock is known.
    segments_deferred,
    /// Raw segments removed after their time; their statistics stay on the map.
    segments_removed,
    /// Mission reports taken.
    mission_reports_committed,
    /// Batches answered.
    batches_answered,
    /// Transactions of the ingest writer.
    ingest_transactions,
    /// Uploads that found the queue full; the robot sends them again.
    ingest_dropped_busy,
    /// States and friction reports taken.
    states_received,
    /// States and friction reports that found the queue full.
    states_dropped,
    /// Introductions answered.
    hellos_answered,
    /// Introductions that found the queue full; the robot sends them again.
    hellos_dropped,
    /// Messages that do not parse, or are too large.
    refused_malformed,
    /// Messages of another major version.
    refused_version,
    /// Messages that name another robot than their key.
    refused_impersonation,
    /// States and friction reports of robots that have not said hello.
    refused_unknown_robot,
    /// States and friction reports of another run of the agent than the one that said hello last:
    /// stragglers, or a second agent under the robot's name.
    refused_other_run,
    /// Messages of robots whose enrolment was revoked.
    refused_revoked_robot,
    /// Messages of robots that have not joined, where only those that have are accepted.
    refused_unenrolled_robot,
    /// Robots that joined, with those that joined again.
    robots_enrolled,
    /// Certificates renewed.
    certificates_renewed,
    /// Attempts to join with what cannot be a join token.
    join_token_malformed,
    /// Attempts to join with a join token that is not kept here.
    join_token_unknown,
    /// Attempts to join with a join token whose time is over.
    join_token_expired,
    /// Attempts to join with a join token that was used before.
    join_token_used,
    /// Attempts to join with a join token that was revoked.
    join_token_revoked,
    /// Attempts to join as a robot that the join token does not allow.
    join_token_other_robot,
    /// Renewals refused: no certificate of this fleet, over for too long, or without its key.
    renewals_refused,
    /// Renewals refused because the robot's enrolment was revoked, or it joined again.
    renewals_revoked,
    /// Renewals refused because this server did not give the certificate, or gave it long ago.
    renewals_not_issued,
    /// Renewals refused because the certificate was of an authority that was retired.
    renewals_retired,
    /// Connections to the robots' port.
    gate_connections,
    /// Connections to the robots' port that began with something else than TLS.
    gate_garbage,
    /// Connections to the robots' port on which nothing came in time.
    gate_silent,
    /// Connections to the robots' port whose TLS handshake failed, for want of a certificate of
    /// the fleet's or otherwise.
    gate_tls_failed,
    /// Connections to the robots' port refused because too many of their address had failed.
    gate_rate_limited,
    /// Connections to the robots' port refused because too many were open.
    gate_full,
    /// Connections to the robots' port ended to make room for new ones before their handshake.
    gate_displaced,
    /// Connections of robots that declared liveliness tokens without end, cut or refused for a while.
    gate_cut_off,
    /// Pauses in the reading of robots that send more bytes a second than they may.
    gate_throttled,
    /// Connections of robots whose enrolment was revoked, or that have joined again since.
    gate_revoked,
    /// Connections of robots ended because their certificate was over.
    gate_expired,
    /// Connections of robots ended because the authority of their certificate was retired.
    gate_retired,
    /// Connections to the robots' port that the robot ended because it does not trust the port's
    /// authority: one of another fleet, or from before the authority was changed.
    gate_distrusted,
    /// Connections of robots that the router did not take.
    gate_router_failed,
    /// Sessions of robots that did not open: the link ended, it took too long, or the session was
    /// not one of a client, or not that of the robot whose certificate it showed.
    gate_session_failed,
    /// Times that another router was opened beside the present ones, for robots that joined.
    routers_opened,
    /// Messages to a site that is not known.
    refused_unknown_site,
    /// Messages and liveliness tokens of robots beyond their rate limits.
    rate_limited,
    /// Messages on a key that is none of ours.
    refused_key,
    /// Changes of presence that found the queue full; the robot shows wrongly until its next one.
    presence_dropped,
    /// Replies that could not be sent because too many were waiting.
    replies_dropped,
    /// Reports on missions that are none of their robot's, or of other content; without effect.
    reports_foreign,
    /// Robots that were commanded to end a mission which the server does not have as open.
    missions_disowned,
    /// Times that the router was opened again because it no longer answered.
    router_reopened,
    /// Looks at the router that it did not answer.
    router_probes_failed,
    /// Missions offered to robots, with repetitions.
    offers_sent,
    /// Commands that no robot answered.
    commands_unanswered,
    /// Stops sent to robots, with repetitions.
    stops_sent,
    /// Stops that their robots had not confirmed within 300 ms.
    stops_unconfirmed,
    /// Stops that robots no longer reported although they had not been cleared; sent again.
    stops_lost,
    /// Drive commands sent to robots.
    drive_commands_sent,
    /// Drive commands that a newer one of the same socket replaced before they were sent.
    drive_commands_replaced,
    /// Drive sockets closed because a frame was malformed, too large or not allowed.
    drive_frames_refused,
    /// Drivers whose socket was lost while they had the lease; their robots were commanded to
    /// stand.
    drivers_lost,
    /// HTTP connections refused because too many were open.
    http_connections_refused,
    /// HTTP connections ended to make room for new ones: idle, or without a whole request.
    http_connections_displaced,
    /// HTTP requests refused because their token, or all others together, had as many connections at
    /// work as they may.
    http_requests_without_room,
    /// HTTP connections on which nothing came in time, or no TLS.
    http_connections_silent,
    /// TLS handshakes that failed.
    http_tls_failed,
    /// Requests without a token where one is needed.
    refused_no_token,
    /// Requests with a token that cannot be one.
    refused_token_malformed,
    /// Requests with a token that is not kept here.
    refused_token_unknown,
    /// Requests with a token whose time is over.
    refused_token_expired,
    /// Requests with a token that was revoked.
    refused_token_revoked,
    /// Requests with a token that opens nothing, from where there were too many before.
    refused_locked,
    /// Requests that the token's rights do not allow.
    refused_role,
    /// Requests about a site or robot that the token is not for, or to give more than it has.
    refused_scope,
    /// Requests of another site's page.
    refused_origin,
    /// Requests to a name that is not this server's.
    refused_host,
    /// Requests whose path or query is too long.
    refused_too_long,
    /// Requests that the audit log has as a count in one entry for all repeats.
    audit_repeats,
    /// Requests that the audit log lost: too many different ones were counted, or the database failed
    /// until the stop.
    audit_dropped,
    /// Requests whose handler panicked.
    http_panics,
}

/// One counter.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// Counts one.
    pub fn one(&self) {
        self.add(1);
    }

    /// Counts several.
    pub fn add(&self, count: u64) {
        self.0.fetch_add(count, Ordering::Relaxed);
    }

    /// The count so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}
