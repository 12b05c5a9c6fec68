//! What a robot may do with which keys: one table, from which the server makes the access control
//! of its router, and tests the matrix of every key × every certificate.
//!
//! What is not in it is denied. See [`crate::keys`] for the keys themselves.

use crate::ids::{RobotId, SiteId};
use crate::keys::ROOT;

/// What a robot does with a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Act {
    /// It publishes on it.
    Publish,
    /// It hears what others publish on it.
    Listen,
    /// It answers queries on it.
    Answer,
    /// It asks the server by it.
    Ask,
    /// It shows by a liveliness token that it is there.
    Announce,
}

impl Act {
    /// Everything that a robot can do with a key.
    pub const ALL: [Self; 5] = [
        Self::Publish,
        Self::Listen,
        Self::Answer,
        Self::Ask,
        Self::Announce,
    ];
}

/// Whose key it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Owner {
    /// One robot's: nobody else of the fleet may do anything with it.
    Robot,
    /// All robots' of a site.
    Site,
}

/// A key, or several of the same kind, that robots use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct RobotKeys {
    /// What follows `tread/{site}/`; `{robot}` stands for the robot.
    pub pattern: &'static str,
    /// Whose it is.
    pub owner: Owner,
    /// The one thing that a robot does with it.
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

    /// The key expression for one robot.
    pub fn expression(&self, site: &SiteId, robot: &RobotId) -> String {
        let rest = self.pattern.replace("{robot}", robot.as_str());
        format!("{ROOT}/{site}/{rest}")
    }

    /// The key expression for all robots of all sites, as the server uses it.
    pub fn of_all(&self) -> String {
        format!("{ROOT}/*/{}", self.pattern.replace("{robot}", "*"))
    }
}

/// Everything that robots do on the network.
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
    // Only the server writes it: a robot tells what it has measured by `server/ingest` alone.
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

    /// Whether an expression, whose `*` stands for one whole chunk, has a key.
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

    /// One key of every kind that [`Key`] knows. A new kind does not compile until it is here.
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
