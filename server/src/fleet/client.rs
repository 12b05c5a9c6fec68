//! Sessions of this process at a router on this machine, and the end of sessions.

use std::net::SocketAddr;

use tracing::warn;
use tread_api::tunnel::RouterCredentials;
use zenoh::{Config, Session, Wait as _};

use super::SESSION_TIMEOUT;

/// Returns the configuration of a client of a router on this machine.
///
/// # Errors
/// Zenoh rejects a setting.
pub(super) fn client_config(
    address: SocketAddr,
    credentials: Option<&RouterCredentials>,
    timeout_ms: u128,
) -> zenoh::Result<Config> {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"tcp/{address}\"]")),
        ("connect/timeout_ms", timeout_ms.to_string()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value)?;
    }
    if let Some(credentials) = credentials {
        let text = |text: &str| serde_json::Value::from(text).to_string();
        config.insert_json5("transport/auth/usrpwd/user", &text(&credentials.user))?;
        config.insert_json5(
            "transport/auth/usrpwd/password",
            &text(&credentials.password),
        )?;
    }
    Ok(config)
}

/// Closes a session; gives up after a timeout.
pub(super) async fn close(session: Session) {
    let closing = tokio::task::spawn_blocking(move || session.close().wait());
    match tokio::time::timeout(SESSION_TIMEOUT, closing).await {
        Ok(Ok(Ok(()))) => {}
        Ok(Ok(Err(error))) => warn!("zenoh did not close cleanly: {error}"),
        Ok(Err(_panic)) => warn!("zenoh panicked while closing"),
        Err(_elapsed) => warn!("zenoh did not close in time"),
    }
}
