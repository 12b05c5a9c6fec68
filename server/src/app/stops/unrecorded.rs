//! Stops that were sent and are not stored yet: usually for milliseconds, and as long as the
//! storage fails.
//!
//! They are listed like stored ones. There is at most one per robot: a newer one replaces it, as it
//! does on the robot.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use jiff::Timestamp;
use tread_api::ids::StopId;
use tread_api::stop::Stop;

use super::key_of;
use crate::app::presence::RobotKey;
use crate::db::stops::StopFilter;

/// The newest unstored stop of each robot.
#[derive(Debug, Default)]
pub(in crate::app) struct Unrecorded {
    stops: Mutex<HashMap<RobotKey, Stop>>,
}

impl Unrecorded {
    fn lock(&self) -> MutexGuard<'_, HashMap<RobotKey, Stop>> {
        self.stops.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn extend(&self, stops: &[Stop]) {
        let new = stops.iter().map(|stop| (key_of(stop), stop.clone()));
        self.lock().extend(new);
    }

    /// Returns those of `stops` that are the newest of their robot, in their present state.
    pub(super) fn newest_of(&self, stops: &[Stop]) -> Vec<Stop> {
        let kept = self.lock();
        let newest = stops.iter().filter_map(|stop| {
            let kept = kept.get(&key_of(stop))?;
            (kept.id == stop.id).then(|| kept.clone())
        });
        newest.collect()
    }

    /// Returns whether a stop of a robot is not stored yet.
    pub(super) fn has_of(&self, key: &RobotKey) -> bool {
        self.lock().contains_key(key)
    }

    /// Returns the stop that will replace this one once it is stored.
    pub(super) fn successor_of(&self, stop: &Stop) -> Option<StopId> {
        let kept = self.lock();
        let newest = kept.get(&key_of(stop))?;
        let is_newer = (newest.requested_at, newest.id) > (stop.requested_at, stop.id);
        is_newer.then_some(newest.id)
    }

    /// Records confirmations of robots.
    pub(super) fn confirm(&self, confirmed: &[(StopId, Timestamp)]) {
        let mut kept = self.lock();
        for stop in kept.values_mut() {
            if let Some((_, at)) = confirmed.iter().find(|(id, _)| *id == stop.id) {
                stop.confirmed_at.get_or_insert(*at);
            }
        }
    }

    /// Removes stops that were stored.
    pub(super) fn remove(&self, stops: &[Stop]) {
        let mut kept = self.lock();
        for stop in stops {
            let key = key_of(stop);
            if kept.get(&key).is_some_and(|kept| kept.id == stop.id) {
                kept.remove(&key);
            }
        }
    }

    /// Returns the stops that a filter lets through. All are newer than a stop that is recorded.
    pub(super) fn list(&self, filter: &StopFilter) -> Vec<Stop> {
        let kept = self.lock();
        let order_of = |stop: &Stop| (stop.requested_at, stop.id);
        let named = |id: StopId| kept.values().find(|stop| stop.id == id);
        let is_before = |stop: &Stop, id: StopId| {
            named(id).is_some_and(|named| order_of(stop) < order_of(named))
        };
        let wanted = kept.values().filter(|stop| {
            filter.site.as_ref().is_none_or(|site| *site == stop.site)
                && filter
                    .robot
                    .as_ref()
                    .is_none_or(|robot| *robot == stop.robot)
                && filter.before.is_none_or(|before| is_before(stop, before))
                && filter.within.includes_robot(&stop.site, &stop.robot)
        });
        wanted.cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    fn stop(id: u128, robot: &str) -> Stop {
        Stop {
            id: StopId::from_uuid(Uuid::from_u128(id)),
            site: "yard".parse().unwrap(),
            robot: robot.parse().unwrap(),
            by: "test".to_owned(),
            reason: "test".to_owned(),
            requested_at: Timestamp::UNIX_EPOCH,
            confirmed_at: None,
            standstill_at: None,
            unconfirmed: false,
            clear_requested_by: None,
            clear_requested_at: None,
            cleared_at: None,
            replaced_by: None,
        }
    }

    #[test]
    fn a_newer_stop_of_a_robot_replaces_the_one_that_waits() {
        let unrecorded = Unrecorded::default();
        let (first, second, other) = (stop(1, "rover-1"), stop(2, "rover-1"), stop(3, "rover-2"));
        unrecorded.extend(&[first.clone(), other.clone()]);
        unrecorded.extend(std::slice::from_ref(&second));
        assert!(
            unrecorded
                .newest_of(std::slice::from_ref(&first))
                .is_empty()
        );
        // Storing the older one must not remove the newer one.
        unrecorded.remove(&[first]);
        unrecorded.confirm(&[(second.id, Timestamp::UNIX_EPOCH)]);
        let of_robot = StopFilter {
            robot: Some(second.robot.clone()),
            ..StopFilter::default()
        };
        let listed = unrecorded.list(&of_robot);
        assert_eq!((listed.len(), listed[0].id), (1, second.id));
        assert!(listed[0].confirmed_at.is_some());
        unrecorded.remove(&[second, other]);
        assert!(unrecorded.list(&StopFilter::default()).is_empty());
    }
}
