//! Access table: which operation a robot may perform on which zenoh keys. The server derives the
//! access control list of its router from [`ROBOT_KEYS`]; tests check every key against every
//! certificate.
//!
//! Everything that is not in the table is denied. See [`crate::keys`] for the keys themselves.

use crate::ids::{RobotId, SiteId};
use crate::keys::ROOT;

/// Operation that a robot performs on a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Act {
    /// Publishes on the key.
    Publish,
    /// Subscribes to what others publish on the key.
    Listen,
    /// Answers queries on the key.
    Answer,
    /// Sends queries on the key, which the server answers.
    Ask,
    /// Declares a liveliness token on the key.
    Announce,
}

impl Act {
    /// Every operation that a robot can perform on a key.
    pub const ALL: [Self; 5] = [
        Self::Publish,
        Self::Listen,
        Self::Answer,
        Self::Ask,
        Self::Announce,
    ];
}

/// Robots that share a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Owner {
    /// One robot: every other robot of the fleet is denied access.
    Robot,
    /// All robots of a site.
    Site,
}

/// Key, or group of keys of one kind, that robots use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct RobotKeys {
    /// Key expression relative to `tread/{site}/`; `{robot}` is a placeholder for the robot's
    /// identifier.
    pub pattern: &'static str,
    /// Robots that may use the key.
    pub owner: Owner,
    /// The only operation that a robot may perform on the key.
    pub act: Act,
}

impl RobotKeys {
    const fn of_robot(pattern: &'static str, act: Act) -> Self {
        Self {
            pattern,
            owner: Owner::Robot,
            act,
        }
    }

    /// Returns the key expression for one robot.
    pub fn expression(&self, site: &SiteId, robot: &RobotId) -> String {
        let rest = self.pattern.replace("{robot}", robot.as_str());
        format!("{ROOT}/{site}/{rest}")
    }

    /// Returns the key expression that matches all robots of all sites, as the server uses it.
    pub fn of_all(&self) -> String {
        format!("{ROOT}/*/{}", self.pattern.replace("{robot}", "*"))
    }
}

/// Every operation on every key that robots are allowed; all others are denied.
pub const ROBOT_KEYS: [RobotKeys; 10] = [
    RobotKeys::of_robot("robots/{robot}/alive/*", Act::Announce),
    RobotKeys::of_robot("robots/{robot}/state", Act::Publish),
    RobotKeys::of_robot("robots/{robot}/friction", Act::Publish),
    RobotKeys::of_robot("robots/{robot}/cmd/*", Act::Answer),
    RobotKeys::of_robot("robots/{robot}/teleop", Act::Listen),
    RobotKeys::of_robot("robots/{robot}/limit/*", Act::Listen),
    RobotKeys::of_robot("server/hello/{robot}", Act::Ask),
    RobotKeys::of_robot("server/ingest/{robot}", Act::Ask),
    RobotKeys {
        pattern: "server/pulse",
        owner: Owner::Site,
        act: Act::Listen,
    },
    // Only the server publishes on it: robots upload their measurements on `server/ingest` alone.
    RobotKeys {
        pattern: "server/map",
        owner: Owner::Site,
        act: Act::Listen,
    },
];

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::ids::BootId;
    use crate::keys::{self, Key, Verb};

    /// Whether an expression matches a key; each `*` in it matches exactly one chunk.
    fn has(expression: &str, key: &str) -> bool {
        let (mut wanted, mut given) = (expression.split('/'), key.split('/'));
        loop {
            match (wanted.next(), given.next()) {
                (None, None) => return true,
                (Some(wanted), Some(given)) if wanted == "*" || wanted == given => {}
                _ => return false,
            }
        }
    }

    /// One example key of each variant of [`Key`]. A new variant does not compile until it is
    /// added.
    fn one_of_each(site: &SiteId, robot: &RobotId) -> Vec<String> {
        let boot = BootId::from_uuid(Uuid::from_u128(7));
        let owner = "lidar".parse().unwrap();
        let all = [
            keys::alive(site, robot, boot),
            keys::state(site, robot),
            keys::friction(site, robot),
            keys::command(site, robot, Verb::Stop),
            keys::teleop(site, robot),
            keys::limit(site, robot, &owner),
            keys::pulse(site),
            keys::map(site),
            keys::hello(site, robot),
            keys::ingest(site, robot),
        ];
        for key in &all {
            match Key::parse(key).unwrap() {
                Key::Alive(..)
                | Key::State(..)
                | Key::Friction(..)
                | Key::Command(..)
                | Key::Teleop(..)
                | Key::Limit(..)
                | Key::Pulse(..)
                | Key::Map(..)
                | Key::Hello(..)
                | Key::Ingest(..) => {}
            }
        }
        all.to_vec()
    }

    #[test]
    fn each_key_is_in_the_table_once_and_only_for_its_robot() {
        let site: SiteId = "yard".parse().unwrap();
        let [robot, other]: [RobotId; 2] = ["rover-1", "rover-2"].map(|id| id.parse().unwrap());
        for key in one_of_each(&site, &robot) {
            let rows = ROBOT_KEYS.iter();
            let rows: Vec<_> = rows
                .filter(|row| has(&row.expression(&site, &robot), &key))
                .collect();
            let [row] = rows.as_slice() else {
                panic!("{key} is in {} rows", rows.len());
            };
            assert!(has(&row.of_all(), &key), "{key}");
            let is_foreign = has(&row.expression(&site, &other), &key);
            assert_eq!(is_foreign, row.owner == Owner::Site, "{key}");
        }
    }
}
