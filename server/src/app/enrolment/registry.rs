//! In-memory registry of the robots that have joined, checked for every message and connection.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{PoisonError, RwLock};

use tokio::sync::watch;
use tread_api::enrolment::Enrolment;

use crate::app::presence::RobotKey;

/// State of a robot's newest enrolment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EnrolmentStatus {
    /// In force, with the enrolment's number.
    Enrolled(u32),
    /// Revoked, with the number of the enrolment that ended.
    Revoked(u32),
}

impl EnrolmentStatus {
    fn number(self) -> u32 {
        match self {
            Self::Enrolled(number) | Self::Revoked(number) => number,
        }
    }
}

/// All robots that have ever joined.
#[derive(Debug)]
pub struct EnrolmentRegistry {
    robots: RwLock<HashMap<RobotKey, EnrolmentStatus>>,
    /// Whether messages of robots that have not joined are refused.
    is_closed: AtomicBool,
    changes: watch::Sender<u64>,
}

impl Default for EnrolmentRegistry {
    fn default() -> Self {
        Self {
            robots: RwLock::default(),
            is_closed: AtomicBool::new(false),
            changes: watch::Sender::new(0),
        }
    }
}

impl EnrolmentRegistry {
    /// From now on refuses messages of robots that have not joined.
    pub(super) fn close(&self) {
        self.is_closed.store(true, Ordering::Relaxed);
    }

    /// Records an enrolment read from the database; ignored if a newer one, or its end, is recorded
    /// already.
    pub(crate) fn record(&self, enrolment: &Enrolment) {
        let status = match enrolment.revoked_at {
            None => EnrolmentStatus::Enrolled(enrolment.number),
            Some(_) => EnrolmentStatus::Revoked(enrolment.number),
        };
        let key = (enrolment.site.clone(), enrolment.robot.clone());
        let mut robots = self.robots.write().unwrap_or_else(PoisonError::into_inner);
        let present = robots.get(&key).copied();
        let is_late = present.is_some_and(|present| {
            let ended = present == EnrolmentStatus::Revoked(enrolment.number);
            present.number() > enrolment.number || ended
        });
        if !is_late {
            robots.insert(key, status);
            drop(robots);
            self.changes.send_modify(|count| *count += 1);
        }
    }

    /// Returns the state of a robot's enrolment; `None` if it has never joined.
    pub fn status(&self, key: &RobotKey) -> Option<EnrolmentStatus> {
        let robots = self.robots.read().unwrap_or_else(PoisonError::into_inner);
        robots.get(key).copied()
    }

    /// Returns whether messages of a robot are accepted, over any link.
    pub fn may_send(&self, key: &RobotKey) -> bool {
        match self.status(key) {
            Some(EnrolmentStatus::Enrolled(_)) => true,
            Some(EnrolmentStatus::Revoked(_)) => false,
            None => !self.is_closed.load(Ordering::Relaxed),
        }
    }

    /// Returns whether the robot's newest enrolment has this number and is not revoked.
    pub fn is_in_force(&self, key: &RobotKey, enrolment: u32) -> bool {
        self.status(key) == Some(EnrolmentStatus::Enrolled(enrolment))
    }

    /// Returns every robot that has ever joined.
    pub fn robots(&self) -> Vec<RobotKey> {
        let robots = self.robots.read().unwrap_or_else(PoisonError::into_inner);
        robots.keys().cloned().collect()
    }

    /// Returns a receiver of a counter that increases whenever a robot joins or is revoked.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use tread_api::ids::JoinTokenId;

    use super::*;

    fn enrolment(number: u32, is_revoked: bool) -> Enrolment {
        Enrolment {
            site: "yard".parse().unwrap(),
            robot: "rover-1".parse().unwrap(),
            number,
            enrolled_at: Timestamp::UNIX_EPOCH,
            join_token: JoinTokenId::from_uuid(uuid::Uuid::nil()),
            renewed_at: Timestamp::UNIX_EPOCH,
            expires_at: Timestamp::MAX,
            revoked_at: is_revoked.then_some(Timestamp::UNIX_EPOCH),
            revoked_by: is_revoked.then(|| "test".to_owned()),
            authority: None,
        }
    }

    #[test]
    fn whatever_the_order_of_the_news_the_newest_enrolment_counts_and_an_end_is_final() {
        let key: RobotKey = ("yard".parse().unwrap(), "rover-1".parse().unwrap());
        let news = [(1, false), (1, true), (2, false), (2, true)];
        for first in 0..news.len() {
            for turn in 0..news.len() {
                let registry = EnrolmentRegistry::default();
                let mut order = news.to_vec();
                order.rotate_left(turn);
                order.swap(0, first);
                for (number, is_revoked) in order {
                    registry.record(&enrolment(number, is_revoked));
                }
                assert_eq!(registry.status(&key), Some(EnrolmentStatus::Revoked(2)));
                assert!(!registry.may_send(&key));
            }
        }
    }

    #[test]
    fn a_stranger_may_speak_until_the_registry_is_closed() {
        let registry = EnrolmentRegistry::default();
        let key: RobotKey = ("yard".parse().unwrap(), "rover-1".parse().unwrap());
        assert!(registry.may_send(&key) && !registry.is_in_force(&key, 1));
        registry.close();
        assert!(!registry.may_send(&key));
        let changes = registry.changes();
        registry.record(&enrolment(1, false));
        assert!(changes.has_changed().unwrap());
        assert!(
            registry.may_send(&key)
                && registry.is_in_force(&key, 1)
                && !registry.is_in_force(&key, 2)
        );
    }
}
