//! External limits: holds and speed limits of other programs, each with its owner and expiry. Pure.
//!
//! The newest limit of an owner applies until its expiry. An owner that the configuration requires
//! holds the robot while it has no valid limit; an expired limit of any other owner has no effect.

use serde::{Deserialize, Serialize};
use tread_api::ids::{BootId, OwnerId};
use tread_api::safety::{LIMITS_MAX, LimitStatus};
use tread_api::wire::safety::ExternalLimit;

/// Why a limit is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum LimitRefusal {
    /// It names another run of the agent.
    Foreign,
    /// Its sequence number is not above that of a limit accepted before.
    OutOfOrder,
    /// Its expiry is too far in the future.
    TooLong,
    /// Its speed is negative or not finite.
    Invalid(String),
    /// There are too many owners.
    TooMany,
}

/// Limit of one owner as the loop reads it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Entry {
    is_required: bool,
    until_us: u64,
    hold: bool,
    linear_max_m_s: Option<f64>,
}

impl Entry {
    fn holds(&self, now_us: u64) -> bool {
        if now_us < self.until_us {
            self.hold
        } else {
            self.is_required
        }
    }

    fn limit_m_s(&self, now_us: u64) -> Option<f64> {
        self.linear_max_m_s.filter(|_| now_us < self.until_us)
    }
}

/// All limits, as the loop reads them in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(from = "Vec<Entry>", into = "Vec<Entry>")]
pub(crate) struct LimitsView {
    entries: [Entry; LIMITS_MAX],
    count: usize,
}

/// Conversion for a record.
impl From<LimitsView> for Vec<Entry> {
    fn from(view: LimitsView) -> Self {
        view.present().to_vec()
    }
}

/// Conversion from a record; entries beyond [`LIMITS_MAX`] are dropped.
impl From<Vec<Entry>> for LimitsView {
    fn from(entries: Vec<Entry>) -> Self {
        let mut view = Self::default();
        for (place, entry) in view.entries.iter_mut().zip(entries) {
            *place = entry;
            view.count += 1;
        }
        view
    }
}

impl LimitsView {
    fn present(&self) -> &[Entry] {
        &self.entries[..self.count]
    }

    /// Whether any owner holds the robot at `now_us`.
    pub(crate) fn holds(&self, now_us: u64) -> bool {
        self.present().iter().any(|entry| entry.holds(now_us))
    }

    /// Returns the lowest speed limit in force, m/s.
    pub(crate) fn linear_max_m_s(&self, now_us: u64) -> Option<f64> {
        let limits = self.present().iter();
        limits
            .filter_map(|entry| entry.limit_m_s(now_us))
            .reduce(f64::min)
    }
}

#[derive(Debug, Clone)]
struct Owner {
    id: OwnerId,
    entry: Entry,
    seq: Option<u64>,
    /// Latest expiry of this owner's limits; until then a repeated or older limit must be refused.
    guarded_until_us: u64,
}

/// The owners and their limits.
#[derive(Debug, Clone)]
pub(crate) struct ExternalLimits {
    boot: BootId,
    owners: Vec<Owner>,
    refused: u64,
}

impl ExternalLimits {
    /// Creates the list with the required owners, at most [`LIMITS_MAX`]. None has sent a limit
    /// yet, so each holds the robot.
    pub(crate) fn new(boot: BootId, required: &[OwnerId]) -> Self {
        let mut owners = Vec::with_capacity(LIMITS_MAX);
        let required = required.iter().take(LIMITS_MAX).map(|id| Owner {
            id: id.clone(),
            entry: Entry {
                is_required: true,
                ..Entry::default()
            },
            seq: None,
            guarded_until_us: 0,
        });
        owners.extend(required);
        Self {
            boot,
            owners,
            refused: 0,
        }
    }

    /// Applies a limit.
    ///
    /// # Errors
    /// [`LimitRefusal`]: the limit is counted as refused and nothing changes.
    pub(crate) fn take(&mut self, limit: &ExternalLimit, now_us: u64) -> Result<(), LimitRefusal> {
        let taken = self.try_take(limit, now_us);
        if taken.is_err() {
            self.refused += 1;
        }
        taken
    }

    fn try_take(&mut self, limit: &ExternalLimit, now_us: u64) -> Result<(), LimitRefusal> {
        if limit.boot != self.boot {
            return Err(LimitRefusal::Foreign);
        }
        limit.validate().map_err(LimitRefusal::Invalid)?;
        if limit.is_too_long(now_us) {
            return Err(LimitRefusal::TooLong);
        }
        let place = self.owners.iter().position(|owner| owner.id == limit.owner);
        let place = match place {
            Some(place) => place,
            None => self.make_room(limit, now_us)?,
        };
        let owner = &mut self.owners[place];
        let is_guarded = now_us < owner.guarded_until_us;
        if is_guarded && owner.seq.is_some_and(|last| limit.seq <= last) {
            return Err(LimitRefusal::OutOfOrder);
        }
        owner.seq = Some(limit.seq);
        owner.guarded_until_us = owner.guarded_until_us.max(limit.until_us);
        owner.entry = Entry {
            is_required: owner.entry.is_required,
            until_us: limit.until_us,
            hold: limit.hold,
            linear_max_m_s: limit.linear_max_m_s,
        };
        Ok(())
    }

    fn make_room(&mut self, limit: &ExternalLimit, now_us: u64) -> Result<usize, LimitRefusal> {
        if self.owners.len() >= LIMITS_MAX {
            self.owners
                .retain(|owner| owner.entry.is_required || now_us < owner.guarded_until_us);
        }
        if self.owners.len() >= LIMITS_MAX {
            return Err(LimitRefusal::TooMany);
        }
        self.owners.push(Owner {
            id: limit.owner.clone(),
            entry: Entry::default(),
            seq: None,
            guarded_until_us: 0,
        });
        Ok(self.owners.len() - 1)
    }

    /// Counts a limit that does not parse or is too large.
    pub(crate) fn count_malformed(&mut self) {
        self.refused += 1;
    }

    /// Returns the number of refused limits.
    pub(crate) fn refused(&self) -> u64 {
        self.refused
    }

    /// Returns the limits as the loop reads them.
    pub(crate) fn view(&self) -> LimitsView {
        let mut view = LimitsView {
            count: self.owners.len(),
            ..LimitsView::default()
        };
        for (entry, owner) in view.entries.iter_mut().zip(&self.owners) {
            *entry = owner.entry;
        }
        view
    }

    /// Returns the limits in force and the required owners, for the robot's state message.
    pub(crate) fn status(&self, now_us: u64) -> Vec<LimitStatus> {
        let of_note = self
            .owners
            .iter()
            .filter(|owner| owner.entry.is_required || now_us < owner.entry.until_us);
        of_note
            .map(|owner| LimitStatus {
                owner: owner.id.clone(),
                required: owner.entry.is_required,
                hold: owner.entry.holds(now_us),
                linear_max_m_s: owner.entry.limit_m_s(now_us),
                ends_in_ms: owner
                    .entry
                    .until_us
                    .checked_sub(now_us)
                    .filter(|left_us| *left_us > 0)
                    .map(|left_us| left_us / 1_000),
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use uuid::Uuid;

    use super::*;

    fn boot() -> BootId {
        BootId::from_uuid(Uuid::from_u128(5))
    }

    fn limit(owner: &str, seq: u64, until_us: u64, hold: bool) -> ExternalLimit {
        ExternalLimit {
            owner: owner.parse().unwrap(),
            boot: boot(),
            until_us,
            seq,
            hold,
            linear_max_m_s: Some(0.3),
        }
    }

    #[test]
    fn a_required_owner_holds_by_its_silence_and_any_other_only_while_it_lasts() {
        let mut limits = ExternalLimits::new(boot(), &["lidar".parse().unwrap()]);
        assert!(limits.view().holds(0), "not heard yet");
        limits.take(&limit("lidar", 1, 1_000, false), 10).unwrap();
        assert!(!limits.view().holds(999));
        assert_eq!(limits.view().linear_max_m_s(999), Some(0.3));
        assert!(limits.view().holds(1_000), "silent again");
        assert_eq!(limits.view().linear_max_m_s(1_000), None);
        limits
            .take(&limit("lidar", 2, 9_000, false), 1_000)
            .unwrap();
        limits.take(&limit("boss", 1, 3_000, true), 1_000).unwrap();
        assert!(limits.view().holds(2_999));
        assert!(!limits.view().holds(3_000));
        limits.take(&limit("lidar", 3, 0, false), 3_000).unwrap();
        assert!(limits.view().holds(3_000), "ended by its owner is silence");
    }

    #[test]
    fn too_many_owners_foreign_and_endless_limits_are_refused() {
        let mut limits = ExternalLimits::new(boot(), &["lidar".parse().unwrap()]);
        for number in 1..LIMITS_MAX {
            let owner = format!("h{number}");
            limits.take(&limit(&owner, 1, 1_000, true), 0).unwrap();
        }
        let one_more = limit("one-more", 1, 2_000, true);
        assert_eq!(limits.take(&one_more, 0), Err(LimitRefusal::TooMany));
        assert_eq!(
            limits.take(&one_more, 1_000),
            Ok(()),
            "ended ones make room"
        );
        let mut foreign = one_more.clone();
        foreign.boot = BootId::from_uuid(Uuid::from_u128(6));
        assert_eq!(limits.take(&foreign, 0), Err(LimitRefusal::Foreign));
        let endless = limit("one-more", 9, u64::MAX, true);
        assert_eq!(limits.take(&endless, 0), Err(LimitRefusal::TooLong));
        for bad in [f64::NAN, -1.0, f64::INFINITY] {
            let mut limit = limit("one-more", 10, 3_000, true);
            limit.linear_max_m_s = Some(bad);
            let refused = limits.take(&limit, 0);
            assert!(matches!(refused, Err(LimitRefusal::Invalid(_))), "{bad}");
        }
        assert_eq!(limits.refused(), 6);
    }

    proptest! {
        #[test]
        fn whatever_the_order_of_arrival_the_newest_that_is_in_time_counts(
            sent in prop::collection::vec((0..5_000_u64, any::<bool>()), 1..12),
            order in any::<prop::sample::Index>(),
            doubles in 0..4_usize,
        ) {
            // All arrive at once, in any rotation, some twice: the highest number wins.
            let mut arrivals: Vec<ExternalLimit> = sent
                .iter()
                .zip(1_u64..)
                .map(|(&(until_us, hold), seq)| limit("h", seq, 10_000 + until_us, hold))
                .collect();
            let newest = arrivals.last().cloned().unwrap();
            let turn = order.index(arrivals.len());
            arrivals.rotate_left(turn);
            let again: Vec<_> = arrivals.iter().take(doubles).cloned().collect();
            arrivals.extend(again);
            let mut limits = ExternalLimits::new(boot(), &[]);
            for arrival in &arrivals {
                let _ = limits.take(arrival, 0);
            }
            let view = limits.view();
            prop_assert_eq!(view.holds(newest.until_us - 1), newest.hold);
            prop_assert!(!view.holds(newest.until_us));
        }
    }
}
