//! Errors of requests to the server, each with an exit code and a hint.

use reqwest::StatusCode;
use tread_api::problem::{ProblemBody, ProblemType};

use crate::exit::Exit;

/// Error of a request to the server.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ClientError {
    /// The address of the server is invalid.
    #[error("`{address}` is not the address of a server: use one like http://127.0.0.1:8420")]
    Address { address: String },
    /// The token would be sent unencrypted over the network.
    #[error(
        "a token is not sent to {address} without TLS: use https, or an address of this machine"
    )]
    ClearText { address: String },
    /// The certificate file to trust is unreadable or invalid.
    #[error("cannot trust the certificate in `{file}`")]
    Authority {
        file: String,
        #[source]
        cause: std::io::Error,
    },
    /// TLS cannot be set up.
    #[error("TLS cannot be set up")]
    Tls(#[source] rustls::Error),
    /// The server's certificate is not accepted.
    #[error("the certificate of {address} is not accepted: {}", failure_reason(.cause))]
    Untrusted {
        address: String,
        cause: rustls::Error,
    },
    /// The connection failed.
    #[error("no server answers at {address}")]
    Unreachable {
        address: String,
        #[source]
        cause: reqwest::Error,
    },
    /// The server did not answer in time.
    #[error("{address} did not answer in time")]
    Silent {
        address: String,
        #[source]
        cause: reqwest::Error,
    },
    /// The server refused the request.
    #[error("{}", refusal(.problem))]
    Refused { problem: Box<ProblemBody> },
    /// No mission has an identifier that begins or ends like this.
    #[error(
        "no mission of site `{site}` has an identifier that begins or ends with `{part}`, of the \
         newest {read}"
    )]
    NoSuchMission {
        part: String,
        site: String,
        read: usize,
    },
    /// No webhook has this name or identifier.
    #[error("there is no webhook `{name}`")]
    NoSuchWebhook { name: String },
    /// Several missions have an identifier that begins or ends like this.
    #[error("`{part}` stands for {} missions:{}", .candidates.len(), listed(.candidates))]
    AmbiguousMission {
        part: String,
        candidates: Vec<String>,
    },
    /// The peer does not open a WebSocket.
    #[error(
        "the server at {address} does not open a WebSocket for driving: check proxies on the way"
    )]
    NoWebSocket { address: String },
    /// The answer does not have the form of this API.
    #[error("{address} is no Tread server of this version ({status})")]
    NotUnderstood {
        address: String,
        status: StatusCode,
        #[source]
        cause: serde_json::Error,
    },
}

/// Returns why a certificate is not accepted, for people.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "the library's own words serve for all other causes"
)]
fn failure_reason(cause: &rustls::Error) -> String {
    use rustls::CertificateError as Cause;
    match cause {
        rustls::Error::InvalidCertificate(Cause::Expired | Cause::ExpiredContext { .. }) => {
            "it has expired, or the clock of this machine is wrong".to_owned()
        }
        rustls::Error::InvalidCertificate(
            Cause::NotValidYet | Cause::NotValidYetContext { .. },
        ) => "it is not valid yet: the clock of this machine or of the server is wrong".to_owned(),
        rustls::Error::InvalidCertificate(
            Cause::NotValidForName | Cause::NotValidForNameContext { .. },
        ) => "it is for another name".to_owned(),
        rustls::Error::InvalidCertificate(Cause::UnknownIssuer) => {
            "its authority is not trusted here".to_owned()
        }
        other => other.to_string(),
    }
}

/// Returns what to do about a certificate that is not accepted.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "one hint serves for all other causes"
)]
fn trust_step(cause: &rustls::Error) -> &'static str {
    use rustls::CertificateError as Cause;
    match cause {
        rustls::Error::InvalidCertificate(
            Cause::Expired
            | Cause::ExpiredContext { .. }
            | Cause::NotValidYet
            | Cause::NotValidYetContext { .. },
        ) => "compare the clocks, and run `tread-server doctor` on the server",
        rustls::Error::InvalidCertificate(
            Cause::NotValidForName | Cause::NotValidForNameContext { .. },
        ) => {
            "use a name of the certificate in --server, or add this one to the server's certificate"
        }
        _ => {
            "give the authority's certificate with --ca, or its fingerprint with --ca-fingerprint: \
             `tread-server init` and `tread-server doctor` print it"
        }
    }
}

/// Returns the TLS error behind a transport error; `None` if there is none.
pub(crate) fn tls_error(cause: &reqwest::Error) -> Option<rustls::Error> {
    let mut next: Option<&(dyn std::error::Error + 'static)> = Some(cause);
    while let Some(error) = next {
        // The source of an input error is that of what it holds, not what it holds.
        let within = error
            .downcast_ref::<std::io::Error>()
            .and_then(std::io::Error::get_ref);
        let found = within
            .and_then(|within| within.downcast_ref::<rustls::Error>())
            .or_else(|| error.downcast_ref::<rustls::Error>());
        if let Some(found) = found {
            return Some(found.clone());
        }
        next = match within {
            Some(within) => Some(within),
            None => error.source(),
        };
    }
    None
}

/// Maximum number of missions that an error lists.
const CANDIDATES_SHOWN: usize = 10;

fn listed(candidates: &[String]) -> String {
    let mut text = String::new();
    for candidate in candidates.iter().take(CANDIDATES_SHOWN) {
        text.push_str("\n  ");
        text.push_str(candidate);
    }
    match candidates.len().checked_sub(CANDIDATES_SHOWN) {
        None | Some(0) => text,
        Some(more) => format!("{text}\n  and {more} more"),
    }
}

fn refusal(problem: &ProblemBody) -> String {
    // What the server says of it is for programs that send HTTP headers.
    if problem.kind == ProblemType::Unauthenticated {
        return "the server knows no valid token of you: it is missing, mistyped, expired or revoked"
            .to_owned();
    }
    let mut text = problem.title.clone();
    if let Some(field) = &problem.field {
        text = format!("{text}, at `{field}`");
    }
    match &problem.detail {
        Some(detail) => format!("{text}: {detail}"),
        None => text,
    }
}

/// Hint for each problem type; types whose `detail` contains the hint are absent.
const NEXT_STEPS: &[(ProblemType, &str)] = &[
    (
        ProblemType::InvalidBody,
        "see the same command with --help for its arguments",
    ),
    (
        ProblemType::InvalidQuery,
        "see the same command with --help for its arguments",
    ),
    (
        ProblemType::Unauthenticated,
        "sign in with `tread login`, or give a token with --token-file or TREAD_TOKEN",
    ),
    (
        ProblemType::Forbidden,
        "`tread whoami` shows your rights; an admin makes tokens with `tread tokens create`",
    ),
    (
        ProblemType::TooManyAttempts,
        "wait for the stated time, then sign in again with `tread login`",
    ),
    (
        ProblemType::UnknownHost,
        "use a configured host name of the server, or add this one to `web.hosts` in its configuration",
    ),
    (
        ProblemType::UnknownSite,
        "`tread sites` lists the sites; name one with --site or TREAD_SITE",
    ),
    (
        ProblemType::UnknownRobot,
        "`tread robots` lists the robots of the site; name another site with --site",
    ),
    (
        ProblemType::UnknownTerrain,
        "`tread terrains` lists the terrains of the site",
    ),
    (
        ProblemType::UnknownMission,
        "`tread missions` lists the newest missions of the site",
    ),
    (
        ProblemType::UnknownAlert,
        "`tread alerts --all` lists alerts, cleared ones too",
    ),
    (ProblemType::UnknownStop, "`tread stops` lists the stops"),
    (
        ProblemType::UnknownToken,
        "`tread tokens` and `tread robots join-token list` list tokens",
    ),
    (
        ProblemType::UnknownSession,
        "`tread sessions` lists the sessions of people",
    ),
    (
        ProblemType::UnknownWebhook,
        "`tread webhooks` lists the webhooks",
    ),
    (
        ProblemType::StopNotCleared,
        "wait until the robot is at rest, and give its newest stop: `tread clear ROBOT` shows it",
    ),
    (
        ProblemType::RobotUnreachable,
        "`tread robots ROBOT` shows the time of its last message",
    ),
    (
        ProblemType::RobotBusy,
        "`tread missions --robot ROBOT` lists its missions; cancel the active one, or use --start append",
    ),
    (
        ProblemType::RobotRetired,
        "`tread robots restore ROBOT` restores it",
    ),
    (
        ProblemType::RobotCannot,
        "`tread robots ROBOT --json` shows its capabilities",
    ),
    (
        ProblemType::BeyondLimits,
        "reduce the speed or enlarge the radius; `tread robots ROBOT --json` shows the limits",
    ),
    (
        ProblemType::TurnTooSharp,
        "move the points apart, or enlarge the radius",
    ),
    (
        ProblemType::CrossesGeofence,
        "`tread geofence` shows the areas that robots may use",
    ),
    (
        ProblemType::RobotOutsideGeofence,
        "move the robot first, or include its position in the geofence",
    ),
    (
        ProblemType::MissionEnded,
        "`tread missions show MISSION` shows its end; send another with `tread send`",
    ),
    (
        ProblemType::MissionState,
        "`tread missions show MISSION` shows its state",
    ),
    (
        ProblemType::AlreadyExists,
        "choose another identifier, or change the existing object",
    ),
    (
        ProblemType::PreconditionFailed,
        "read the object again, and give its new revision with --revision",
    ),
    (
        ProblemType::EnrolmentDisabled,
        "add `[robots]` to the server's configuration, run `tread-server init` with it, and restart the server",
    ),
    (
        ProblemType::RobotsLeft,
        "`tread authority` lists them; connect them to the network, or add --force",
    ),
    (
        ProblemType::Internal,
        "the server's log has the cause; `tread status` shows whether the server works",
    ),
];

impl ClientError {
    /// Returns the exit code for the error.
    pub(crate) fn exit(&self) -> Exit {
        match self {
            Self::Address { .. } | Self::AmbiguousMission { .. } => Exit::Usage,
            Self::NoSuchMission { .. } | Self::NoSuchWebhook { .. } => Exit::NotFound,
            Self::Unreachable { .. } | Self::Untrusted { .. } | Self::NoWebSocket { .. } => {
                Exit::Unreachable
            }
            Self::Silent { .. } => Exit::TimedOut,
            Self::Refused { problem } => exit_of(problem),
            Self::ClearText { .. } => Exit::Refused,
            Self::Authority { .. } | Self::Tls(_) | Self::NotUnderstood { .. } => Exit::BadResult,
        }
    }

    /// Returns a hint what to do next; `None` if the message itself contains it.
    pub(crate) fn next_step(&self) -> Option<&'static str> {
        match self {
            Self::Unreachable { .. } => Some(
                "start one with `tread demo` or `tread-server`, or name another with --server or \
                 TREAD_SERVER",
            ),
            Self::Untrusted { cause, .. } => Some(trust_step(cause)),
            Self::Silent { .. } => {
                Some("the request may have been carried out: check before you repeat it")
            }
            Self::NoSuchMission { .. } => {
                Some("`tread missions` lists the newest missions of the site")
            }
            Self::NoSuchWebhook { .. } => Some("`tread webhooks` lists them"),
            Self::AmbiguousMission { .. } => {
                Some("give more of the identifier; its end is what differs")
            }
            Self::NotUnderstood { .. } => Some("compare `tread --version` with `tread status`"),
            Self::Refused { problem } => NEXT_STEPS
                .iter()
                .find(|(kind, _)| *kind == problem.kind)
                .map(|(_, step)| *step),
            Self::Address { .. }
            | Self::ClearText { .. }
            | Self::Authority { .. }
            | Self::Tls(_)
            | Self::NoWebSocket { .. } => None,
        }
    }

    /// Returns whether the same request may succeed later: the server was not reached, or was too busy
    /// to answer, itself or behind a proxy.
    pub(crate) fn is_temporary(&self) -> bool {
        match self {
            Self::Unreachable { .. } | Self::Silent { .. } => true,
            Self::Refused { problem } => matches!(
                problem.kind,
                ProblemType::Unavailable | ProblemType::Timeout | ProblemType::TooManyRequests
            ),
            Self::NotUnderstood { status, .. } => matches!(status.as_u16(), 429 | 502..=504),
            Self::Address { .. }
            | Self::ClearText { .. }
            | Self::Authority { .. }
            | Self::Tls(_)
            | Self::Untrusted { .. }
            | Self::NoSuchMission { .. }
            | Self::NoSuchWebhook { .. }
            | Self::AmbiguousMission { .. }
            | Self::NoWebSocket { .. } => false,
        }
    }

    /// Returns the problem that the server answered; `None` for any other error.
    pub(crate) fn problem(&self) -> Option<&ProblemBody> {
        match self {
            Self::Refused { problem } => Some(problem),
            Self::Address { .. }
            | Self::ClearText { .. }
            | Self::Authority { .. }
            | Self::Tls(_)
            | Self::Untrusted { .. }
            | Self::Unreachable { .. }
            | Self::Silent { .. }
            | Self::NoSuchMission { .. }
            | Self::NoSuchWebhook { .. }
            | Self::AmbiguousMission { .. }
            | Self::NoWebSocket { .. }
            | Self::NotUnderstood { .. } => None,
        }
    }
}

fn exit_of(problem: &ProblemBody) -> Exit {
    match problem.status {
        404 => Exit::NotFound,
        409 | 412 => Exit::Conflict,
        408 | 504 => Exit::TimedOut,
        _ if problem.kind == ProblemType::Timeout => Exit::TimedOut,
        502 | 503 => Exit::Unreachable,
        _ => Exit::Refused,
    }
}

#[cfg(test)]
impl ClientError {
    /// Creates the refusal of a server with this problem.
    pub(super) fn refused(kind: ProblemType, status: u16) -> Self {
        Self::Refused {
            problem: Box::new(ProblemBody {
                kind,
                title: kind.title().to_owned(),
                status,
                detail: None,
                field: None,
                state: None,
                place: None,
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refused_token_is_said_without_a_word_of_http() {
        let mut error = ClientError::refused(ProblemType::Unauthenticated, 401);
        if let ClientError::Refused { problem } = &mut error {
            problem.detail = Some("send `authorization: Bearer …`".to_owned());
        }
        let said = error.to_string();
        assert!(said.contains("token"), "{said}");
        for word in ["authorization", "Bearer", "header", "/v1"] {
            assert!(!said.contains(word), "{said}");
        }
    }

    #[test]
    fn missions_that_a_part_stands_for_are_listed_up_to_a_bound() {
        let candidates: Vec<String> = (0..12).map(|at| format!("mission {at}")).collect();
        let part = "0a1b".to_owned();
        let said = ClientError::AmbiguousMission { part, candidates }.to_string();
        assert!(
            said.starts_with("`0a1b` stands for 12 missions:\n  mission 0\n"),
            "{said}"
        );
        assert!(said.ends_with("\n  mission 9\n  and 2 more"), "{said}");
    }

    #[test]
    fn each_kind_of_refusal_has_its_exit_code_and_its_next_step() {
        for (kind, status, exit) in [
            (ProblemType::Unauthenticated, 401, Exit::Refused),
            (ProblemType::Forbidden, 403, Exit::Refused),
            (ProblemType::UnknownRobot, 404, Exit::NotFound),
            (ProblemType::UnknownToken, 404, Exit::NotFound),
            (ProblemType::UnknownSession, 404, Exit::NotFound),
            (ProblemType::UnknownWebhook, 404, Exit::NotFound),
            (ProblemType::RobotBusy, 409, Exit::Conflict),
            (ProblemType::PreconditionFailed, 412, Exit::Conflict),
            (ProblemType::EnrolmentDisabled, 409, Exit::Conflict),
            (ProblemType::BeyondLimits, 422, Exit::Refused),
            (ProblemType::TurnTooSharp, 422, Exit::Refused),
            (ProblemType::RobotUnreachable, 503, Exit::Unreachable),
        ] {
            let error = ClientError::refused(kind, status);
            assert_eq!(error.exit(), exit, "{kind:?}");
            assert!(error.next_step().is_some(), "{kind:?}");
        }
    }
}
