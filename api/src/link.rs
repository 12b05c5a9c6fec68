//! Quality of a robot's link to the server.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Quality of a robot's link as the server has measured it in the last hour, since its start at the
/// longest.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LinkQuality {
    /// Time from the last command to the robot's answer, milliseconds; `null` if the robot has
    /// answered none. Offers do not count, since a robot plans before it answers.
    pub round_trip_ms: Option<f64>,
    /// Time since that answer, milliseconds; `null` if the robot has answered none.
    pub round_trip_age_ms: Option<u64>,
    /// Time by which the last state was under way for longer than the fastest of the last seconds,
    /// milliseconds; `null` if the robot has sent no state.
    pub delay_variation_ms: Option<u64>,
    /// Number of states that arrived in the last hour.
    pub states_received: u64,
    /// Number of states of the last hour that did not arrive, by their sequence numbers.
    pub states_missed: u64,
    /// Number of times in the last hour that the robot connected again.
    pub reconnects: u64,
}
