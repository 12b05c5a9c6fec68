//! Tests of whole fleets, one process for each part; see `tread_tests` for the harness.

mod bad_input;
mod chaos;
#[cfg(test)]
mod conditions;
mod control;
#[cfg(test)]
mod drivers;
#[cfg(test)]
mod dry_runs;
#[cfg(test)]
mod earlier_state;
mod event_clients;
mod impostors;
#[cfg(test)]
mod killed_server;
mod membership;
mod messages;
mod missions;
mod outages;
#[cfg(test)]
mod pages;
#[cfg(test)]
mod releases;
#[cfg(test)]
mod restoration;
mod safety;
#[cfg(test)]
mod scenario;
#[cfg(test)]
mod state_rate;
#[cfg(test)]
mod traces;
#[cfg(test)]
mod webhooks;

use std::path::Path;

use serde_json::{Value, json};
use tread_tests::fleet::Fleet;

/// A running server, with the terrain of the simulated ground drawn.
async fn fleet() -> Fleet {
    Fleet::start_with(Path::new(env!("CARGO_BIN_EXE_node"))).await
}

/// A part of a circle that a robot at `(x_m, 0)` heading along x starts on.
fn arc(x_m: f64, turns: f64) -> Value {
    json!({"circle": {
        "center": {"x_m": x_m, "y_m": 1.5}, "radius_m": 1.5, "speed_m_s": 0.6, "turns": turns,
    }})
}

/// Straight ahead and then bends to either side, from `(x_m, 0)` heading along x: a drive that
/// tells θ from a difference of the wheels' radii, which a steady circle cannot.
fn slalom(x_m: f64, bends: u32) -> Value {
    let mut points = vec![
        json!({"x_m": x_m, "y_m": 0.0}),
        json!({"x_m": x_m + 2.0, "y_m": 0.0}),
    ];
    points.extend((1..=bends).map(|bend| {
        let side = [0.0, 0.8, 0.0, -0.8][(bend % 4) as usize];
        json!({"x_m": x_m + 2.0 + 1.5 * f64::from(bend), "y_m": side})
    }));
    json!({"waypoints": {"speed_m_s": 0.6, "points": points}})
}

/// Straight ahead and a gentle bend, from `(x_m, 0)` heading along x.
fn bend(x_m: f64) -> Value {
    json!({"waypoints": {"speed_m_s": 0.6, "points": [
        {"x_m": x_m, "y_m": 0.0}, {"x_m": x_m + 1.5, "y_m": 0.0}, {"x_m": x_m + 3.0, "y_m": 0.6},
    ]}})
}
