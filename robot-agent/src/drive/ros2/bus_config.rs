//! Configuration of the zenoh session on the robot's own bus.

use std::str::FromStr as _;

use super::settings::{BusMode, BusSettings};
use crate::fleet::{LinkError, config_of};

/// Timeout of a series of attempts to connect, after which the thread checks whether it shall end,
/// milliseconds.
const CONNECT_TIMEOUT_MS: u32 = 1_000;
/// First and longest pause between attempts, milliseconds; short, to find a restarted router at
/// once.
const RETRY_MS: (u32, u32) = (50, 200);
/// Silence after which a router drops the agent's session, milliseconds.
const BUS_LEASE_MS: u32 = 3_000;

/// Creates the configuration of the session on the bus.
///
/// # Errors
/// [`LinkError::Endpoint`] for an invalid endpoint; [`LinkError`] if zenoh refuses a setting.
pub fn session_config(bus: &BusSettings) -> Result<zenoh::Config, LinkError> {
    zenoh::config::EndPoint::from_str(&bus.endpoint).map_err(|problem| LinkError::Endpoint {
        endpoint: bus.endpoint.clone(),
        problem: problem.to_string(),
    })?;
    let endpoints = serde_json::json!([bus.endpoint]).to_string();
    let none = || "[]".to_owned();
    let (mode, connect, listen) = match bus.mode {
        BusMode::Client => ("\"client\"", endpoints, none()),
        BusMode::Router => ("\"router\"", none(), endpoints),
    };
    let (first_ms, longest_ms) = RETRY_MS;
    let retry = serde_json::json!({
        "period_init_ms": first_ms,
        "period_max_ms": longest_ms,
        "period_increase_factor": 2.0,
    });
    let settings = [
        ("mode", mode.to_owned()),
        ("connect/endpoints", connect),
        ("connect/timeout_ms", CONNECT_TIMEOUT_MS.to_string()),
        ("connect/retry", retry.to_string()),
        ("listen/endpoints", listen),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("transport/link/tx/lease", BUS_LEASE_MS.to_string()),
        // A router with timestamping compares the time of every message with its clock, and logs an
        // error for each one once the machine's clock was set back. Stamps are in the messages.
        ("timestamping/enabled", "false".to_owned()),
    ];
    config_of(settings)
}

#[cfg(test)]
mod tests {
    use tread_ros2::names::Name;

    use super::*;
    use crate::drive::ros2::settings::Scheme;

    #[test]
    fn the_bus_holds_no_messages_time_against_its_own_clock() {
        for mode in [BusMode::Client, BusMode::Router] {
            let bus = BusSettings {
                scheme: Scheme::Ros2Dds,
                mode,
                endpoint: "tcp/127.0.0.1:7447".to_owned(),
                domain: 0,
                namespace: Name::namespace("/rover").unwrap(),
                node: Name::node("tread_agent").unwrap(),
            };
            let config = session_config(&bus).unwrap();
            let is_stamping = config.get_json("timestamping/enabled").unwrap();
            assert_eq!(is_stamping, "false", "{mode:?}");
        }
    }
}
