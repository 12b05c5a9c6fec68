//! Sums that receipts promise and the stored sums do not contain yet.
//!
//! ```text
//! commit of segments ─► added here and to the map ─► stored with the robot's watermark ─► removed
//! kill ─► nothing here; the segments that follow each watermark are added again
//! ```

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use foldhash::fast::RandomState;
use tread_api::site::Cell;

use crate::db::segments::Added;
use crate::db::sums::SumKey;
use crate::db::watermarks::WatermarkStep;
use crate::friction::Sums;

/// Maximum number of unwritten sums, about 300 bytes each; beyond it sums are stored before further
/// receipts.
pub(super) const UNWRITTEN_SUMS_MAX: usize = 200_000;
/// Maximum number of segments in unwritten sums, which a killed server adds again when it starts.
pub(super) const UNWRITTEN_SEGMENTS_MAX: u64 = 1_000_000;

/// The unwritten sums of all robots.
#[derive(Debug, Default)]
pub(super) struct Unwritten {
    robots: BTreeMap<i64, OfRobot>,
    /// Stored watermarks by robot.
    watermarks: HashMap<i64, i64>,
    sums: usize,
    segments: u64,
    /// Number of additions so far.
    additions: u64,
}

#[derive(Debug)]
struct OfRobot {
    sums: HashMap<SumKey, Sums, RandomState>,
    /// Keys between which all its segments in `sums` are.
    keys: Added,
    /// Number of the first addition, and its time.
    began: (u64, Duration),
}

/// How much is unwritten.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct UnwrittenCounts {
    /// Number of sums.
    pub sums: usize,
    /// Number of segments in them.
    pub segments: u64,
    /// Time of the oldest, on the server's monotonic clock.
    pub oldest_at: Option<Duration>,
}

/// Sums that are stored in one transaction: all of some robots.
#[derive(Debug, Default)]
pub(super) struct Portion {
    /// In the order of the table, so that neighbours share database pages.
    pub(super) sums: Vec<(SumKey, Sums)>,
    pub(super) steps: Vec<WatermarkStep>,
}

impl Unwritten {
    /// Creates unwritten sums that follow stored watermarks.
    pub(super) fn following(watermarks: HashMap<i64, i64>) -> Self {
        Self {
            watermarks,
            ..Self::default()
        }
    }

    /// Adds sums of segments that were committed together, with the keys of these. The keys of sums
    /// differ from the given ones in their cells.
    pub(super) fn add<'sums>(
        &mut self,
        sums: impl IntoIterator<Item = (&'sums SumKey, &'sums [(Cell, Sums)])>,
        added: Added,
        at: Duration,
    ) {
        self.additions += 1;
        for (key, cells) in sums {
            let robot = self.robots.entry(key.robot_pk).or_insert_with(|| OfRobot {
                sums: HashMap::default(),
                keys: added,
                began: (self.additions, at),
            });
            robot.keys.first = robot.keys.first.min(added.first);
            robot.keys.last = robot.keys.last.max(added.last);
            let mut key = key.clone();
            for (cell, sums) in cells {
                key.cell = *cell;
                self.segments += sums.segments;
                if let Some(present) = robot.sums.get_mut(&key) {
                    present.add(sums);
                } else {
                    robot.sums.insert(key.clone(), *sums);
                    self.sums += 1;
                }
            }
        }
    }

    /// Returns the number of additions so far.
    pub(super) fn additions(&self) -> u64 {
        self.additions
    }

    /// Returns the sums of robots that have had some since before addition `until` ended, with the
    /// steps of their watermarks: those of as many robots as have `limit` sums, and of at least one.
    pub(super) fn portion(&self, until: u64, limit: usize) -> Portion {
        let mut portion = Portion::default();
        for (&robot_pk, robot) in &self.robots {
            if robot.began.0 > until {
                continue;
            }
            if !portion.steps.is_empty() && portion.sums.len() + robot.sums.len() > limit {
                break;
            }
            portion.steps.push(WatermarkStep {
                robot_pk,
                from_pk: self.watermarks.get(&robot_pk).copied().unwrap_or_default(),
                to_pk: robot.keys.last,
            });
            let sums = robot.sums.iter();
            portion
                .sums
                .extend(sums.map(|(key, sums)| (key.clone(), *sums)));
        }
        portion
            .sums
            .sort_unstable_by_key(|(key, _)| (key.robot_pk, key.epoch_h, key.cell.iy, key.cell.ix));
        portion
    }

    /// Removes the sums of a portion, which are stored now. Nothing was added meanwhile.
    pub(super) fn written(&mut self, steps: &[WatermarkStep]) {
        for step in steps {
            self.watermarks.insert(step.robot_pk, step.to_pk);
            if let Some(robot) = self.robots.remove(&step.robot_pk) {
                self.sums -= robot.sums.len();
                self.segments -= segments_of(&robot);
            }
        }
    }

    /// Removes the sums of a robot between two hours, both included.
    pub(super) fn withdraw(&mut self, robot_pk: i64, (from_h, to_h): (i64, i64)) {
        let Some(mut robot) = self.robots.remove(&robot_pk) else {
            return;
        };
        self.sums -= robot.sums.len();
        self.segments -= segments_of(&robot);
        robot
            .sums
            .retain(|key, _| !(from_h..=to_h).contains(&key.epoch_h));
        if !robot.sums.is_empty() {
            self.sums += robot.sums.len();
            self.segments += segments_of(&robot);
            self.robots.insert(robot_pk, robot);
        }
    }

    /// Returns a key at or before that of the first segment in unwritten sums; `None` without such
    /// sums.
    pub(super) fn first_key(&self) -> Option<i64> {
        self.robots.values().map(|robot| robot.keys.first).min()
    }

    /// Returns how much is unwritten.
    pub(super) fn counts(&self) -> UnwrittenCounts {
        UnwrittenCounts {
            sums: self.sums,
            segments: self.segments,
            oldest_at: self.robots.values().map(|robot| robot.began.1).min(),
        }
    }

    /// Returns whether sums must be stored before further receipts.
    pub(super) fn is_full(&self) -> bool {
        self.sums >= UNWRITTEN_SUMS_MAX || self.segments >= UNWRITTEN_SEGMENTS_MAX
    }
}

fn segments_of(robot: &OfRobot) -> u64 {
    robot.sums.values().map(|sums| sums.segments).sum()
}

#[cfg(test)]
mod tests;
