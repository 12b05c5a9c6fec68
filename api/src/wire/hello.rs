//! Hello query of a robot when it connects, and the server's answer with the definition of the
//! site.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::encoding::Encoding;
use super::reply::{Acknowledgement, Command};
use crate::ids::{BootId, RobotId};
use crate::keys::Verb;
use crate::robot::{Capabilities, RobotModel};
use crate::safety::Geofence;
use crate::site::Grid;
use crate::terrain::TerrainShape;

/// Query that a robot sends on every new connection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// Identifier of the robot; must equal the one in the key.
    pub robot: RobotId,
    /// Present run of the agent.
    pub boot: BootId,
    /// Version of the agent.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::robot::VERSION_TEXT_MAX}>")]
    pub agent_version: String,
    /// Model and tyres.
    pub model: RobotModel,
    /// Wall clock of the robot.
    pub robot_time: Timestamp,
    /// Capabilities of the base and its agent; when absent, the robot only drives missions.
    #[serde(default)]
    pub capabilities: Capabilities,
}

/// Answer of the server to [`Hello`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Welcome {
    /// Definition of the robot's site.
    pub site: SiteDefinition,
    /// Wall clock of the server.
    pub server_time: Timestamp,
    /// Encodings of uploads that the server reads besides JSON; an older server names none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub upload_encodings: Vec<Encoding>,
}

impl Welcome {
    /// Returns the encoding in which a robot uploads to this server.
    pub fn upload_encoding(&self) -> Encoding {
        if self.upload_encodings.contains(&Encoding::Cbor) {
            Encoding::Cbor
        } else {
            Encoding::Json
        }
    }
}

/// Data of a site that a robot needs to assign measurements to cells and terrains, and to respect
/// the geofence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SiteDefinition {
    /// Grid of cells.
    pub grid: Grid,
    /// Number of changes of the terrains; a robot reports the one that it has.
    pub terrain_revision: u64,
    /// All terrains of the site.
    pub terrains: Vec<TerrainShape>,
    /// Geofence of the site. An older server sends none, an older robot ignores it.
    #[serde(default)]
    pub geofence: Geofence,
}

/// `cmd/site`: replaces the robot's definition of its site.
impl Command for SiteDefinition {
    const VERB: Verb = Verb::Site;
    type Reply = Acknowledgement;
}
