//! Key expressions on zenoh, all below `tread/{site}/`.
//!
//! | key | kind | from → to |
//! |---|---|---|
//! | `robots/{robot}/alive/{boot}` | liveliness token | robot → all |
//! | `robots/{robot}/state` | published | robot → all |
//! | `robots/{robot}/friction` | published | robot → all |
//! | `robots/{robot}/cmd/{verb}` | query | server → robot |
//! | `robots/{robot}/teleop` | published | server → robot |
//! | `robots/{robot}/limit/{owner}` | published | any program → robot |
//! | `server/pulse` | published | server → all robots |
//! | `server/map` | published | server → all robots and programs |
//! | `server/hello/{robot}` | query | robot → server |
//! | `server/ingest/{robot}` | query | robot → server |

use crate::ids::{BootId, OwnerId, RobotId, SiteId};

/// First chunk of every key.
pub const ROOT: &str = "tread";

/// Verb of a command to a robot, the last chunk of its key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Verb {
    /// Offers a mission.
    Offer,
    /// Cancels a mission.
    Cancel,
    /// Pauses a mission.
    Pause,
    /// Resumes a paused mission.
    Resume,
    /// Replaces the definition of the site.
    Site,
    /// Stops the robot and latches the stop.
    Stop,
    /// Clears a stop.
    Clear,
    /// Acquires, takes or releases the lease of teleoperation.
    Lease,
    /// Holds or slows the robot by an external limit.
    Limit,
    /// Requests states at a higher rate for a limited time.
    StateRate,
    /// Asks how missions ended.
    Outcomes,
}

impl Verb {
    /// Every verb.
    pub const ALL: [Self; 11] = [
        Self::Offer,
        Self::Cancel,
        Self::Pause,
        Self::Resume,
        Self::Site,
        Self::Stop,
        Self::Clear,
        Self::Lease,
        Self::Limit,
        Self::StateRate,
        Self::Outcomes,
    ];

    /// Returns the verb as a chunk of a key.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Offer => "offer",
            Self::Cancel => "cancel",
            Self::Pause => "pause",
            Self::Resume => "resume",
            Self::Site => "site",
            Self::Stop => "stop",
            Self::Clear => "clear",
            Self::Lease => "lease",
            Self::Limit => "limit",
            Self::StateRate => "state_rate",
            Self::Outcomes => "outcomes",
        }
    }

    /// Returns the verb with this name; `None` if there is none.
    pub fn from_chunk(chunk: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|verb| verb.as_str() == chunk)
    }
}

fn robot_key(site: &SiteId, robot: &RobotId, rest: &str) -> String {
    format!("{ROOT}/{site}/robots/{robot}/{rest}")
}

/// Returns the key of the liveliness token of one run of an agent.
pub fn alive(site: &SiteId, robot: &RobotId, boot: BootId) -> String {
    robot_key(site, robot, &format!("alive/{boot}"))
}

/// Returns the key on which a robot publishes its state.
pub fn state(site: &SiteId, robot: &RobotId) -> String {
    robot_key(site, robot, "state")
}

/// Returns the key on which a robot publishes its two friction estimates.
pub fn friction(site: &SiteId, robot: &RobotId) -> String {
    robot_key(site, robot, "friction")
}

/// Returns the key on which a robot answers commands of one verb.
pub fn command(site: &SiteId, robot: &RobotId, verb: Verb) -> String {
    robot_key(site, robot, &format!("cmd/{}", verb.as_str()))
}

/// Parameter of a command's selector that names the run of the agent to which the command is
/// addressed. Other runs do not answer; without the parameter every run does.
pub const RUN: &str = "boot";

/// Returns the selector of a command to one run of the agent.
pub fn to_run(command: &str, boot: BootId) -> String {
    format!("{command}?{RUN}={boot}")
}

/// Returns the key expression of all commands to one robot.
pub fn commands(site: &SiteId, robot: &RobotId) -> String {
    robot_key(site, robot, "cmd/*")
}

/// Returns the key on which drive commands to a robot are published.
pub fn teleop(site: &SiteId, robot: &RobotId) -> String {
    robot_key(site, robot, "teleop")
}

/// Returns the key on which one owner publishes its limits of a robot.
pub fn limit(site: &SiteId, robot: &RobotId, owner: &OwnerId) -> String {
    robot_key(site, robot, &format!("limit/{owner}"))
}

/// Returns the key expression of the limits of a robot by all owners.
pub fn limits(site: &SiteId, robot: &RobotId) -> String {
    robot_key(site, robot, "limit/*")
}

/// Returns the key on which the server publishes its pulse.
pub fn pulse(site: &SiteId) -> String {
    format!("{ROOT}/{site}/server/pulse")
}

/// Returns the key on which the server publishes changes of the friction map.
pub fn map(site: &SiteId) -> String {
    format!("{ROOT}/{site}/server/map")
}

/// Returns the key on which a robot queries the server when it connects, with its model and state.
pub fn hello(site: &SiteId, robot: &RobotId) -> String {
    format!("{ROOT}/{site}/server/hello/{robot}")
}

/// Returns the key on which a robot uploads records that must not be lost.
pub fn ingest(site: &SiteId, robot: &RobotId) -> String {
    format!("{ROOT}/{site}/server/ingest/{robot}")
}

/// Key expression of the liveliness tokens of all robots of all sites.
pub const ALL_ALIVE: &str = "tread/*/robots/*/alive/*";
/// Key expression of the states of all robots of all sites.
pub const ALL_STATES: &str = "tread/*/robots/*/state";
/// Key expression of the friction estimates of all robots of all sites.
pub const ALL_FRICTION: &str = "tread/*/robots/*/friction";
/// Key expression of the hello queries of all robots of all sites.
pub const ALL_HELLOS: &str = "tread/*/server/hello/*";
/// Key expression of the uploads of all robots of all sites.
pub const ALL_INGEST: &str = "tread/*/server/ingest/*";

/// Parsed key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Key {
    /// Liveliness token of one run of an agent.
    Alive(SiteId, RobotId, BootId),
    /// State of a robot.
    State(SiteId, RobotId),
    /// Friction estimates of a robot.
    Friction(SiteId, RobotId),
    /// Command to a robot.
    Command(SiteId, RobotId, Verb),
    /// Drive commands to a robot.
    Teleop(SiteId, RobotId),
    /// Limits of a robot by one owner.
    Limit(SiteId, RobotId, OwnerId),
    /// Pulse of the server.
    Pulse(SiteId),
    /// Changes of the friction map.
    Map(SiteId),
    /// Hello query of a robot.
    Hello(SiteId, RobotId),
    /// Upload of a robot.
    Ingest(SiteId, RobotId),
}

impl Key {
    /// Parses a key; `None` if it is not a key of this protocol.
    pub fn parse(key: &str) -> Option<Self> {
        let mut chunks = key.split('/');
        if chunks.next()? != ROOT {
            return None;
        }
        let site: SiteId = chunks.next()?.parse().ok()?;
        let rest: Vec<&str> = chunks.collect();
        Some(match rest.as_slice() {
            ["robots", robot, "alive", boot] => {
                Self::Alive(site, robot.parse().ok()?, boot.parse().ok()?)
            }
            ["robots", robot, "state"] => Self::State(site, robot.parse().ok()?),
            ["robots", robot, "friction"] => Self::Friction(site, robot.parse().ok()?),
            ["robots", robot, "cmd", verb] => {
                Self::Command(site, robot.parse().ok()?, Verb::from_chunk(verb)?)
            }
            ["robots", robot, "teleop"] => Self::Teleop(site, robot.parse().ok()?),
            ["robots", robot, "limit", owner] => {
                Self::Limit(site, robot.parse().ok()?, owner.parse().ok()?)
            }
            ["server", "pulse"] => Self::Pulse(site),
            ["server", "map"] => Self::Map(site),
            ["server", "hello", robot] => Self::Hello(site, robot.parse().ok()?),
            ["server", "ingest", robot] => Self::Ingest(site, robot.parse().ok()?),
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn every_key_reads_back_as_what_it_was_made_from() {
        let site: SiteId = "yard".parse().unwrap();
        let robot: RobotId = "rover-1".parse().unwrap();
        let boot = BootId::from_uuid(Uuid::from_u128(7));
        let owner: OwnerId = "lidar".parse().unwrap();
        let pair = || (site.clone(), robot.clone());
        let cases = [
            (
                alive(&site, &robot, boot),
                Key::Alive(pair().0, pair().1, boot),
            ),
            (state(&site, &robot), Key::State(pair().0, pair().1)),
            (friction(&site, &robot), Key::Friction(pair().0, pair().1)),
            (
                command(&site, &robot, Verb::Offer),
                Key::Command(pair().0, pair().1, Verb::Offer),
            ),
            (teleop(&site, &robot), Key::Teleop(pair().0, pair().1)),
            (
                limit(&site, &robot, &owner),
                Key::Limit(pair().0, pair().1, owner.clone()),
            ),
            (pulse(&site), Key::Pulse(site.clone())),
            (map(&site), Key::Map(site.clone())),
            (hello(&site, &robot), Key::Hello(pair().0, pair().1)),
            (ingest(&site, &robot), Key::Ingest(pair().0, pair().1)),
        ];
        for (text, key) in cases {
            assert_eq!(Key::parse(&text), Some(key), "{text}");
        }
        for other in [
            "",
            "tread",
            "tread/yard/robots/r",
            "other/yard/robots/r/state",
        ] {
            assert_eq!(Key::parse(other), None, "{other}");
        }
    }
}
