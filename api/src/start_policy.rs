//! Effect of a new mission on the other missions of its robot.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Effect of a new mission on the other missions of its robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StartPolicy {
    /// The new mission waits in the queue.
    #[default]
    Append,
    /// The other missions are cancelled, the active and the queued ones.
    Replace,
    /// The new mission is refused if the robot has another mission that has not ended.
    Refuse,
}
