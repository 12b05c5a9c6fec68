//! Event counters of the server, reported by `GET /v1/server`.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

macro_rules! counters {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// Event counters since the start of the process.
        #[derive(Debug, Default)]
        pub struct Counters {
            $($(#[$doc])* pub $name: Counter,)*
        }

        /// Values of the event counters since the start of the server process.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
        pub struct CounterValues {
            $($(#[$doc])* pub $name: u64,)*
        }

        impl Counters {
            /// Returns the present values of all counters.
            pub fn values(&self) -> CounterValues {
                CounterValues { $($name: self.$name.get(),)* }
            }
        }
    };
}

counters! {
    /// Segments stored.
    segments_committed,
    /// Segments and mission reports received again after they were stored.
    records_duplicate,
    /// Records refused for good: values out of range, or a mission of another robot.
    records_refused,
    /// Segments with times in the future, deferred until the clock offset of their boot is known.
    segments_deferred,
    /// Raw segments deleted by the retention; their statistics stay on the map.
    segments_removed,
    /// Raw segments written to the archive.
    segments_archived,
    /// Failures of the archive of raw segments, to write or to read.
    archive_failures,
    /// Mission reports stored.
    mission_reports_committed,
    /// Uploaded batches that were answered with a receipt.
    batches_answered,
    /// Database transactions of the ingest of uploads.
    ingest_transactions,
    /// Uploads dropped because the queue was full; robots send them again.
    ingest_dropped_busy,
    /// States and friction reports processed.
    states_received,
    /// States and friction reports dropped because the queue was full.
    states_dropped,
    /// Hello messages of robots answered.
    hellos_answered,
    /// Hello messages dropped because the queue was full; robots send them again.
    hellos_dropped,
    /// Messages refused because they cannot be parsed or are too large.
    refused_malformed,
    /// Messages refused because of another payload version.
    refused_version,
    /// Messages refused because they name another robot than their key.
    refused_impersonation,
    /// States and friction reports refused because their robot has not sent a hello message.
    refused_unknown_robot,
    /// States and friction reports refused because they are of another boot than the last hello
    /// message: late messages, or a second agent with the robot's name.
    refused_other_run,
    /// Messages refused because the robot's enrolment was revoked.
    refused_revoked_robot,
    /// Messages refused because the robot is not enrolled, where enrolment is required.
    refused_unenrolled_robot,
    /// Enrolments of robots, with repeated ones.
    robots_enrolled,
    /// Certificates of robots renewed.
    certificates_renewed,
    /// Attempts to join with a malformed join token.
    join_token_malformed,
    /// Attempts to join with an unknown join token.
    join_token_unknown,
    /// Attempts to join with an expired join token.
    join_token_expired,
    /// Attempts to join with a join token that was already used.
    join_token_used,
    /// Attempts to join with a revoked join token.
    join_token_revoked,
    /// Attempts to join as a robot that the join token does not allow.
    join_token_other_robot,
    /// Renewals refused: the certificate is not of this fleet or expired too long ago, or the robot
    /// did not prove that it has the key.
    renewals_refused,
    /// Renewals refused because the enrolment was revoked or superseded by a newer one.
    renewals_revoked,
    /// Renewals refused because this server did not issue the certificate, or the robot has used a
    /// newer one since.
    renewals_not_issued,
    /// Renewals refused because the certificate is of a retired authority.
    renewals_retired,
    /// Connections accepted on the robots' port.
    gate_connections,
    /// Connections to the robots' port closed because they did not begin with a TLS handshake.
    gate_not_tls,
    /// Connections to the robots' port closed because no data arrived in time.
    gate_silent,
    /// Connections to the robots' port whose TLS handshake failed, for example without a
    /// certificate of the fleet.
    gate_tls_failed,
    /// Connections to the robots' port refused because too many of their address failed before.
    gate_rate_limited,
    /// Connections to the robots' port refused because too many were open.
    gate_full,
    /// Connections to the robots' port closed before their handshake to make room for new ones.
    gate_displaced,
    /// Connections of robots closed or refused because the robot declared too many liveliness
    /// tokens.
    gate_cut_off,
    /// Pauses in reading from robots that exceeded their byte rate.
    gate_throttled,
    /// Connections of robots closed because the enrolment was revoked or superseded by a newer one.
    gate_revoked,
    /// Connections of robots closed because their certificate expired.
    gate_expired,
    /// Connections of robots closed because the authority of their certificate was retired.
    gate_retired,
    /// Connections to the robots' port closed by the robot because it does not trust the port's
    /// authority: a robot of another fleet, or one that missed a change of the authority.
    gate_untrusted,
    /// Connections of robots that could not be forwarded to a router.
    gate_router_failed,
    /// Sessions of robots that did not open: the link closed, a timeout expired, the session was
    /// not of a zenoh client, or it was not of the robot that the certificate names.
    gate_session_failed,
    /// Routers opened in addition to the present ones, for robots that joined.
    routers_opened,
    /// Messages refused because of an unknown site.
    refused_unknown_site,
    /// Messages and liveliness tokens of robots refused by a rate limit.
    rate_limited,
    /// Messages refused because their key is not part of the protocol.
    refused_key,
    /// Changes of presence dropped because the queue was full; the robot's presence is wrong until
    /// its next change.
    presence_dropped,
    /// Replies dropped because too many were waiting to be sent.
    replies_dropped,
    /// Mission reports ignored because the mission is of another robot or has other content.
    reports_foreign,
    /// Commands to end a mission that a robot reported and the server does not have as open.
    missions_unknown,
    /// Routers reopened because they no longer answered.
    router_reopened,
    /// Health checks of a router that it did not answer.
    router_probes_failed,
    /// Offers of missions sent to robots, with repetitions.
    offers_sent,
    /// Commands that their robot did not answer in time.
    commands_unanswered,
    /// Requests for states at a higher rate sent to watched robots, with repetitions.
    state_rates_requested,
    /// Stop commands sent to robots, with repetitions.
    stops_sent,
    /// Stop commands not confirmed by their robot within 300 ms.
    stops_unconfirmed,
    /// Stops sent again because a robot no longer reported them although they were not cleared.
    stops_lost,
    /// Drive commands sent to robots.
    drive_commands_sent,
    /// Drive commands replaced by a newer one of the same socket before they were sent.
    drive_commands_replaced,
    /// Drive sockets closed because a frame was malformed, too large or not allowed.
    drive_frames_refused,
    /// Drive sockets lost while their driver held the lease; the robots were commanded to stop.
    drivers_lost,
    /// HTTP connections refused because too many were open.
    http_connections_refused,
    /// HTTP connections closed to make room for new ones: idle, or without a complete request.
    http_connections_displaced,
    /// HTTP requests refused because the limit of busy connections was reached, for their token,
    /// for their address or for the server.
    http_requests_without_room,
    /// HTTP connections closed because no request arrived in time, or because TLS was expected.
    http_connections_silent,
    /// TLS handshakes of HTTP clients that failed.
    http_tls_failed,
    /// Requests refused because they had no token.
    refused_no_token,
    /// Requests refused because the token was malformed.
    refused_token_malformed,
    /// Requests refused because the token was unknown.
    refused_token_unknown,
    /// Requests refused because the token had expired.
    refused_token_expired,
    /// Requests refused because the token was revoked.
    refused_token_revoked,
    /// Requests with an invalid token refused because their address or token prefix was locked
    /// after too many failures.
    refused_locked,
    /// Requests refused because the caller lacks the right.
    refused_role,
    /// Requests refused because the site or robot is outside the caller's scope, or because they
    /// would grant more than the caller has.
    refused_scope,
    /// Requests refused because a page of another origin sent them.
    refused_origin,
    /// Requests refused because their `Host` is not a name of this server.
    refused_host,
    /// Requests refused because their path or query is too long.
    refused_too_long,
    /// Requests that the audit log contains only as a count of repeats.
    audit_repeats,
    /// Requests missing in the audit log because too many different repeats were counted, or
    /// because the database failed until the stop of the server.
    audit_dropped,
    /// Deliveries that the receiver of a webhook took.
    webhook_delivered,
    /// Attempts to send a delivery to a webhook that failed.
    webhook_attempts_failed,
    /// Deliveries to webhooks given up after the last attempt, or because they waited too long.
    webhook_given_up,
    /// Deliveries to webhooks dropped because too many others were waiting.
    webhook_dropped,
    /// HTTP requests whose handler panicked.
    http_panics,
}

/// A counter that only increases.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// Adds one.
    pub fn one(&self) {
        self.add(1);
    }

    /// Adds `count`.
    pub fn add(&self, count: u64) {
        self.0.fetch_add(count, Ordering::Relaxed);
    }

    /// Returns the present value.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}
