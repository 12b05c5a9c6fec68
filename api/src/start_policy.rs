//! What becomes of a robot's other missions when one is asked for.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What becomes of a robot's other missions when a new one is requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StartPolicy {
    /// The new one waits for its turn.
    #[default]
    Append,
    /// The others are cancelled: the active one, and all that wait.
    Replace,
    /// The new one is refused if the robot has any other that has not ended.
    Refuse,
}
