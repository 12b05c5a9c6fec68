//! Configuration of the robot's zenoh session: a client that reconnects without end, with short
//! queues below zenoh.

use std::net::SocketAddr;
use std::str::FromStr;
use std::time::Duration;

use tread_api::ids::BootId;
use tread_api::wire::{BATCH_BYTES, SESSION_LEASE_MS};

use super::{LinkError, zenoh_failed};

/// First pause before a lost connection is retried, milliseconds.
const RETRY_FIRST_MS: u32 = 100;
/// Longest pause between attempts, milliseconds.
const RETRY_MAX_MS: u32 = 300;
/// Timeout of one attempt to connect, milliseconds. The kernel repeats its first packet every
/// second, so a restored network is found within that; this value lies between two repetitions. It
/// also bounds all round trips of TCP, TLS and zenoh on a link of high delay.
const OPEN_TIMEOUT_MS: u32 = 2_500;
/// Timeout of a series of attempts before zenoh is opened again, milliseconds.
const CONNECT_TIMEOUT_MS: u32 = 5_000;
/// Send buffer of the kernel, bytes.
const SEND_BUFFER_BYTES: u32 = 32_768;
/// Kernel send buffer towards the tunnel, bytes; the tunnel has another one.
const TUNNEL_SEND_BUFFER_BYTES: u32 = 4 * 1024;

/// Longest time to find out whether something listens.
const LISTENING_MAX: Duration = Duration::from_secs(1);

/// Longest pause before the first attempt to connect.
const START_JITTER_MAX: Duration = Duration::from_millis(300);

/// Returns the pause before the first attempt to connect, from 0 to `START_JITTER_MAX`, derived
/// from the random boot identifier.
pub fn start_jitter(boot: BootId) -> Duration {
    let share = f64::from(boot.as_uuid().as_fields().0) / f64::from(u32::MAX);
    START_JITTER_MAX.mul_f64(share)
}

/// Returns the endpoint with a small kernel send buffer, unless it names one: priorities act only
/// above that buffer, so on a slow link a large one delays urgent messages behind bulk data.
fn with_small_buffer(server: &str) -> String {
    if !server.starts_with("tcp/") || server.contains("so_sndbuf") {
        return server.to_owned();
    }
    let joint = if server.contains('#') { ';' } else { '#' };
    format!("{server}{joint}so_sndbuf={SEND_BUFFER_BYTES}")
}

/// Credentials of a session at the router.
#[derive(Clone)]
pub(super) struct SessionUser {
    /// zenoh id of the session, in hexadecimal.
    pub(super) session_id: String,
    /// The user name.
    pub(super) user: String,
    /// The password.
    pub(super) password: String,
}

impl std::fmt::Debug for SessionUser {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("SessionUser")
            .field("user", &self.user)
            .finish_non_exhaustive()
    }
}

/// Creates the configuration of a session through a tunnel.
///
/// # Errors
/// [`LinkError`] if zenoh refuses a setting.
pub(super) fn tunnel_config(
    local: SocketAddr,
    user: &SessionUser,
) -> Result<zenoh::Config, LinkError> {
    let endpoint = format!("tcp/{local}#so_sndbuf={TUNNEL_SEND_BUFFER_BYTES}");
    let mut config = session_config(&endpoint)?;
    let text = |text: &str| serde_json::Value::from(text).to_string();
    for (key, value) in [
        ("id", text(&user.session_id)),
        ("transport/auth/usrpwd/user", text(&user.user)),
        ("transport/auth/usrpwd/password", text(&user.password)),
    ] {
        config
            .insert_json5(key, &value)
            .map_err(zenoh_failed("take its credentials"))?;
    }
    Ok(config)
}

/// Creates the configuration of an unencrypted session.
///
/// # Errors
/// [`LinkError`] for an invalid endpoint, or if zenoh refuses a setting.
pub fn session_config(server: &str) -> Result<zenoh::Config, LinkError> {
    let endpoint_failed = |problem: String| LinkError::Endpoint {
        endpoint: server.to_owned(),
        problem,
    };
    zenoh::config::EndPoint::from_str(server)
        .map_err(|problem| endpoint_failed(problem.to_string()))?;
    let endpoints = serde_json::json!([with_small_buffer(server)]).to_string();
    let retry = serde_json::json!({
        "period_init_ms": RETRY_FIRST_MS,
        "period_max_ms": RETRY_MAX_MS,
        "period_increase_factor": 2.0,
    });
    let settings = [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", endpoints),
        ("connect/timeout_ms", CONNECT_TIMEOUT_MS.to_string()),
        ("connect/retry", retry.to_string()),
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("transport/link/tx/lease", SESSION_LEASE_MS.to_string()),
        ("transport/link/tx/batch_size", BATCH_BYTES.to_string()),
        (
            "transport/unicast/open_timeout",
            OPEN_TIMEOUT_MS.to_string(),
        ),
    ];
    config_of(settings)
}

/// Creates a configuration of zenoh from settings, each a key and its value as JSON.
///
/// # Errors
/// [`LinkError`] if zenoh refuses a setting.
pub(crate) fn config_of(
    settings: impl IntoIterator<Item = (&'static str, String)>,
) -> Result<zenoh::Config, LinkError> {
    let mut config = zenoh::Config::default();
    for (key, value) in settings {
        config
            .insert_json5(key, &value)
            .map_err(zenoh_failed("take its configuration"))?;
    }
    Ok(config)
}

/// Returns whether something accepts connections at an endpoint; true for one that is not of TCP.
pub(super) async fn is_listening(endpoint: &str) -> bool {
    let Some(rest) = endpoint.strip_prefix("tcp/") else {
        return true;
    };
    let address = rest.split(['?', '#']).next().unwrap_or(rest);
    let connecting = tokio::net::TcpStream::connect(address);
    let connected = tokio::time::timeout(LISTENING_MAX, connecting).await;
    connected.is_ok_and(|connected| connected.is_ok())
}

/// Has a session opened by one attempt alone, without repetitions.
///
/// # Errors
/// [`LinkError`] if zenoh refuses the setting.
pub(super) fn try_once(config: &mut zenoh::Config) -> Result<(), LinkError> {
    config
        .insert_json5("connect/timeout_ms", "0")
        .map_err(zenoh_failed("take its configuration"))
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn agents_that_start_together_come_one_after_the_other() {
        let boot = || BootId::from_uuid(Uuid::new_v4());
        let mut pauses: Vec<Duration> = (0..1_000).map(|_| start_jitter(boot())).collect();
        pauses.sort();
        assert!(pauses[999] <= START_JITTER_MAX);
        // Spread over the whole of it: a tenth of the time sees about a tenth of the agents.
        for tenth in 0..10 {
            let within = START_JITTER_MAX / 10 * tenth..START_JITTER_MAX / 10 * (tenth + 1);
            let count = pauses
                .iter()
                .filter(|pause| within.contains(*pause))
                .count();
            assert!((40..200).contains(&count), "{count} within {within:?}");
        }
    }

    #[test]
    fn a_stream_gets_a_small_send_buffer_unless_it_names_one() {
        for (given, used) in [
            ("tcp/h:7447", "tcp/h:7447#so_sndbuf=32768"),
            ("tcp/h:7447#a=b", "tcp/h:7447#a=b;so_sndbuf=32768"),
            ("tcp/h:7447#so_sndbuf=9000", "tcp/h:7447#so_sndbuf=9000"),
            ("quic/h:7447", "quic/h:7447"),
        ] {
            assert_eq!(with_small_buffer(given), used);
        }
        assert!(session_config("tcp/127.0.0.1:7447").is_ok());
        assert!(session_config("nonsense").is_err());
    }
}
