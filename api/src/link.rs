//! Quality of a robot's link to the server.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Quality of a robot's link, measured by the server over the last hour, or since its start if that
/// is shorter ago.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LinkQuality {
    /// Time from the last command to the robot's answer, milliseconds; `null` if the robot has
    /// answered none. Offers do not count, since a robot plans before it answers.
    pub round_trip_ms: Option<f64>,
    /// Time since that answer, milliseconds; `null` if the robot has answered none.
    pub round_trip_age_ms: Option<u64>,
    /// Network delay of the last state in excess of the least delay of the last seconds,
    /// milliseconds; `null` if the robot has sent no state.
    pub delay_variation_ms: Option<u64>,
    /// Number of states that arrived in the last hour.
    pub states_received: u64,
    /// Number of states of the last hour that did not arrive, by their sequence numbers.
    pub states_missed: u64,
    /// Number of reconnections of the robot in the last hour.
    pub reconnects: u64,
}
