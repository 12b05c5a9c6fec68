//! Fuses the measurements of several robots of one piece of ground to one estimate.
//!
//! Epoch `e` of robot `r` has the weight `w_e = 1 / (1/Λ_e + q·age_e)`, so `θ_r = Σ w_e θ_e / Λ_r`
//! with `Λ_r = Σ w_e`. Robot `r` has the weight `w_r = 1 / ((s_b·θ)² + 1/Λ_r)`, where θ is the
//! **common** estimate `Σ w_r θ_r / Σ w_r`, found by iteration; with each robot's own θ intervals
//! would be too small. The variance of θ is `1 / Σ w_r`.
//!
//! `Λ_e` is the information of independent errors. The error common to all segments of a robot, as
//! stated by the robot, replaces `s_b` if it is larger. The error common to all robots with the
//! same tyres, `t·θ`, is added to the standard deviation once and does not average out. With three
//! robots or more, no robot's bias is taken as smaller than the median of all, and `t` is the
//! median, so that no robot gains weight or widens the interval by the errors that it states.
//!
//! A peak friction coefficient is accepted if a second robot has shown as much, from one robot
//! alone up to [`MU_ALONE_MAX`]. A single robot can therefore not raise the traction limit of
//! others.
//!
//! Changes of the ground are detected for cells. The epochs are compared from the newest to the
//! oldest. An epoch that differs from the newer ones by more than [`CHANGE_DEVIATIONS`] is dropped
//! with all older ones. If the newest significant pass of an epoch contradicts the other passes of
//! that epoch, only this pass counts. A change to more slip is accepted from the first pass. A
//! change to less slip is accepted once a second pass confirms it, which must be of another robot
//! if several robots contradict it; until then the estimate is disputed.

use tread_api::friction::TYRE_DIFFERENCE_SHARE;

use super::epoch_measurement::{
    CHANGE_DEVIATIONS, EpochMeasurement, Estimate, Ground, age_s, seconds,
};
use super::joined::{EpochValue, JoinBuffers, joined};
use super::sums::Known;
use super::weights::FrictionConfig;

/// Minimum θ that the map states; a smaller estimate is raised to it (K = 10⁶).
pub const THETA_MIN: f64 = 1.0e-6;
/// Maximum standard deviation of θ; beyond it there is no estimate, since θ 10 is K 0.1, less than of any
/// ground to drive on.
pub const THETA_STD_DEV_MAX: f64 = 10.0;
/// Maximum peak friction coefficient that is accepted from one robot alone.
pub const MU_ALONE_MAX: f64 = 0.4;
/// Fused estimate of one piece of ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fused {
    /// θ, at least [`THETA_MIN`].
    pub theta: Estimate,
    /// Recent peak friction coefficient.
    pub mu_peak: Option<f64>,
    /// Ratio of effective to geometric track width.
    pub track: Option<Estimate>,
    /// Rolling resistance coefficient.
    pub rolling: Option<Estimate>,
    /// Number of all passes, including those dropped after a change and those without information.
    pub passes: u64,
    /// Number of robots that contribute to the estimate.
    pub robots: u32,
    /// End of the newest pass, microseconds since 1970.
    pub newest_at_us: i64,
    /// Whether measurements differ by more than their errors explain, or a change is unconfirmed.
    pub is_disputed: bool,
    /// Time of the last detected change of the ground, microseconds since 1970.
    pub changed_at_us: Option<i64>,
}

impl Fused {
    /// Adds uninformative passes to the count. Their information is below the resolution of the
    /// sums, 2.3·10⁻¹⁰, so they do not change the estimate.
    #[must_use]
    pub fn with_uninformative(self, uninformative_passes: u64) -> Self {
        Self {
            passes: self.passes + uninformative_passes,
            ..self
        }
    }
}

/// Fuses the measurements in `seen`, one entry for each robot and epoch; `now_us` is the time to
/// which ages refer, microseconds since 1970.
///
/// Returns `None` without measurements, or if the standard deviation exceeds [`THETA_STD_DEV_MAX`].
/// Sorts `seen`, and for a cell removes the entries from before a change.
pub fn fuse<R: Ord + Copy>(
    seen: &mut Vec<EpochMeasurement<R>>,
    ground: Ground,
    config: &FrictionConfig,
    now_us: i64,
) -> Option<Fused> {
    Fuser::default().fuse(seen, ground, config, now_us)
}

/// Reusable buffers to fuse many pieces of ground without allocation.
#[derive(Debug)]
pub struct Fuser<R> {
    before: Vec<EpochMeasurement<R>>,
    room: JoinBuffers,
}

impl<R> Default for Fuser<R> {
    fn default() -> Self {
        Self {
            before: Vec::new(),
            room: JoinBuffers::default(),
        }
    }
}

impl<R: Ord + Copy> Fuser<R> {
    /// Fuses measurements as [`fuse()`] does.
    pub fn fuse(
        &mut self,
        seen: &mut Vec<EpochMeasurement<R>>,
        ground: Ground,
        config: &FrictionConfig,
        now_us: i64,
    ) -> Option<Fused> {
        fuse_in(self, seen, ground, config, now_us)
    }
}

fn fuse_in<R: Ord + Copy>(
    room: &mut Fuser<R>,
    seen: &mut Vec<EpochMeasurement<R>>,
    ground: Ground,
    config: &FrictionConfig,
    now_us: i64,
) -> Option<Fused> {
    seen.sort_unstable_by(|left, right| {
        right
            .newest_at_us
            .cmp(&left.newest_at_us)
            .then_with(|| left.robot.cmp(&right.robot))
            .then_with(|| right.epoch_h.cmp(&left.epoch_h))
            .then_with(|| left.cmp_theta(right))
    });
    let passes = seen.iter().map(|one| one.passes).sum();
    let newest_at_us = seen.first()?.newest_at_us;
    let present = match ground {
        Ground::Cell => Present::of(seen, room, config),
        Ground::Area => Present::default(),
    };
    seen.sort_unstable_by(|left, right| {
        let by_robot = left.robot.cmp(&right.robot);
        by_robot
            .then_with(|| left.epoch_h.cmp(&right.epoch_h))
            .then_with(|| left.cmp_theta(right))
    });
    let drift = config.drift_variance_per_s;
    let words = &mut room.room;
    let value = |one: &EpochMeasurement<R>| {
        Some(EpochValue {
            known: one.theta,
            bias_ratio: one.bias_ratio(config),
            tyre_ratio: one.tyre_ratio,
        })
    };
    let (theta, heterogeneity) = joined(seen, words, value, (now_us, drift))?;
    let std_dev = theta.std_dev * heterogeneity.widening();
    if std_dev > THETA_STD_DEV_MAX {
        return None;
    }
    let mut layer = |value_of: fn(&EpochMeasurement<R>) -> Option<Known>| {
        let is_known = seen.iter().any(|one| value_of(one).is_some());
        let value = |one: &EpochMeasurement<R>| {
            value_of(one).map(|known| EpochValue {
                known,
                bias_ratio: config.robot_bias_ratio,
                tyre_ratio: 0.0,
            })
        };
        let joined = is_known.then(|| joined(seen, words, value, (now_us, 0.0)));
        joined.flatten().map(|joined| joined.0)
    };
    let (track, rolling) = (layer(|one| one.track), layer(|one| one.rolling));
    let recent = |one: &&EpochMeasurement<R>| age_s(one, now_us) <= config.mu_peak_age_max_s;
    Some(Fused {
        theta: Estimate {
            value: theta.value.max(THETA_MIN),
            std_dev,
        },
        mu_peak: mu_shown(seen.iter().filter(recent)),
        track,
        rolling,
        passes,
        robots: heterogeneity.robots,
        newest_at_us,
        is_disputed: present.is_unconfirmed || heterogeneity.is_dispute(ground),
        changed_at_us: present.changed_at_us,
    })
}

/// Returns the peak friction coefficient that two robots have shown, or one alone up to
/// [`MU_ALONE_MAX`]. `seen` must be sorted by robot.
fn mu_shown<'seen, R: Ord + Copy + 'seen>(
    seen: impl Iterator<Item = &'seen EpochMeasurement<R>>,
) -> Option<f64> {
    let (mut largest, mut second): (Option<f64>, Option<f64>) = (None, None);
    let mut of_robot: Option<(R, f64)> = None;
    let mut note = |shown: Option<(R, f64)>| {
        let Some((_, mu)) = shown else { return };
        if largest.is_none_or(|largest| mu > largest) {
            second = largest.replace(mu);
        } else if second.is_none_or(|second| mu > second) {
            second = Some(mu);
        }
    };
    for one in seen {
        let Some(mu) = one.mu_peak else { continue };
        of_robot = match of_robot {
            Some((robot, shown)) if robot == one.robot => Some((robot, shown.max(mu))),
            before => {
                note(before);
                Some((one.robot, mu))
            }
        };
    }
    note(of_robot);
    let alone = largest.map(|largest| largest.min(MU_ALONE_MAX));
    alone.map(|alone| second.map_or(alone, |second| second.max(alone)))
}

/// Result of detecting a change of the ground in a cell.
#[derive(Debug, Clone, Copy, Default)]
struct Present {
    is_unconfirmed: bool,
    changed_at_us: Option<i64>,
}

impl Present {
    /// Removes from `seen`, which is sorted newest first, the entries from before the last change
    /// of the ground.
    fn of<R: Ord + Copy>(
        seen: &mut Vec<EpochMeasurement<R>>,
        room: &mut Fuser<R>,
        config: &FrictionConfig,
    ) -> Self {
        let older = &mut room.before;
        older.clear();
        older.extend_from_slice(seen);
        let (kept, changed_at_us) = keep_present(seen, config);
        seen.truncate(kept);
        let Some(changed_at_us) = changed_at_us else {
            return Self::default();
        };
        let witnesses: u64 = seen.iter().map(|one| one.passes).sum();
        let divided = SplitEntries {
            kept: seen,
            contradicted: &older[kept..],
        };
        let lone = single_robot(divided, config);
        if witnesses > 1 && lone.is_none() {
            return Self {
                is_unconfirmed: false,
                changed_at_us: Some(changed_at_us),
            };
        }
        // One pass or one robot contradicts all earlier ones: find the estimate without it.
        let now = seen.first().map(|one| one.theta.value);
        let mut index = 0;
        older.retain_mut(|one| {
            index += 1;
            if lone == Some(one.robot) {
                return false;
            }
            if index > kept || lone.is_some() {
                return true;
            }
            let rest = one.contradicted();
            if let Some((_newest, rest)) = rest {
                *one = one.without_newest(rest);
            }
            rest.is_some()
        });
        let (kept, earlier_us) = keep_present(older, config);
        older.truncate(kept);
        let earlier = older.first().map(|one| one.theta.value);
        let is_slipperier = earlier.zip(now).is_none_or(|(earlier, now)| now > earlier);
        if is_slipperier {
            return Self {
                is_unconfirmed: true,
                changed_at_us: Some(changed_at_us),
            };
        }
        seen.clear();
        seen.extend_from_slice(older);
        Self {
            is_unconfirmed: true,
            changed_at_us: earlier_us,
        }
    }
}

/// Entries on both sides of a change of the ground.
#[derive(Clone, Copy)]
struct SplitEntries<'seen, R> {
    kept: &'seen [EpochMeasurement<R>],
    contradicted: &'seen [EpochMeasurement<R>],
}

/// Returns the only robot that measured less slip while several others measured more; `None` if
/// there is no such robot. Repeated measurements of it do not confirm the change, so all of its
/// entries are ignored.
fn single_robot<R: Ord + Copy>(
    SplitEntries { kept, contradicted }: SplitEntries<'_, R>,
    config: &FrictionConfig,
) -> Option<R> {
    let mut now = WeightedTheta::default();
    for one in kept {
        now.add(WeightedTheta::of(one, one.theta, config));
    }
    let mut worse = contradicted
        .iter()
        .filter(|one| now.is_better(&WeightedTheta::of(one, one.theta, config)));
    let first = worse.next()?;
    let against = WeightedTheta::of(first, first.theta, config);
    // The contradicted entries have to be of at least two robots.
    let second = worse.find(|one| one.robot != first.robot)?;
    let mut witnesses = kept
        .iter()
        .filter(|one| WeightedTheta::of(one, one.theta, config).is_better(&against))
        .map(|one| one.robot);
    let lone = witnesses.next()?;
    let is_alone = witnesses.all(|robot| robot == lone);
    let others = [first.robot, second.robot];
    let is_of_others = others.contains(&lone)
        && !worse.any(|one| one.robot != lone && !others.contains(&one.robot));
    (is_alone && !is_of_others).then_some(lone)
}

/// Weighted mean of θ of several measurements, with their errors: sums of the information Λ, and of
/// Λ times θ, times the robots' bias and times the tyres' error, the latter two relative to θ.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct WeightedTheta {
    information: f64,
    weighted: f64,
    bias: f64,
    tyre: f64,
}

impl WeightedTheta {
    fn of<R>(one: &EpochMeasurement<R>, theta: Known, config: &FrictionConfig) -> Self {
        Self {
            information: theta.information,
            weighted: theta.information * theta.value,
            bias: theta.information * one.bias_ratio(config),
            tyre: theta.information * one.tyre_ratio,
        }
    }

    fn add(&mut self, other: Self) {
        self.information += other.information;
        self.weighted += other.weighted;
        self.bias += other.bias;
        self.tyre += other.tyre;
    }

    fn value(&self) -> f64 {
        self.weighted / self.information
    }

    /// Returns the variance of the difference of two means on unchanged ground. Biases of robots do
    /// not contribute if both are of one robot.
    fn difference_variance(&self, other: &Self, is_one_robot: bool) -> f64 {
        // On unchanged ground biases are relative to the common θ, which the weighted mean of both
        // estimates best.
        let common = (self.weighted + other.weighted) / (self.information + other.information);
        let (mine, its) = (self.information, other.information);
        let bias = if is_one_robot {
            0.0
        } else {
            (self.bias / mine).powi(2) + (other.bias / its).powi(2)
        };
        let tyre = TYRE_DIFFERENCE_SHARE * (self.tyre / mine).max(other.tyre / its);
        mine.recip() + its.recip() + (bias + tyre * tyre) * common * common
    }

    /// Returns whether this θ is significantly below the other one, with biases taken into account.
    fn is_better(&self, other: &Self) -> bool {
        let variance = self.difference_variance(other, false);
        other.value() - self.value() > CHANGE_DEVIATIONS * variance.sqrt()
    }
}

/// Returns the number of leading entries of `seen` (newest first) that agree, and the time of the
/// change if there is one, microseconds since 1970. Entries with a change within their epoch are
/// reduced to their newest pass.
fn keep_present<R: Ord + Copy>(
    seen: &mut [EpochMeasurement<R>],
    config: &FrictionConfig,
) -> (usize, Option<i64>) {
    let mut changed_at_us = None;
    let mut oldest_kept_us = None;
    // Mean of the entries kept so far, and their robot while it is only one.
    let mut kept = WeightedTheta::default();
    let mut only: Option<R> = None;
    let mut newest_kept_us = 0;
    for (index, one) in seen.iter_mut().enumerate() {
        let mixed = one.contradicted();
        let theta = mixed.map_or(one.theta, |(newest, _before)| newest);
        let weighted = WeightedTheta::of(one, theta, config);
        if kept.information > 0.0 {
            let apart_s = seconds(newest_kept_us - one.newest_at_us);
            let variance = kept.difference_variance(&weighted, only == Some(one.robot))
                + config.drift_variance_per_s * apart_s;
            if (weighted.value() - kept.value()).abs() > CHANGE_DEVIATIONS * variance.sqrt() {
                return (index, oldest_kept_us.or(changed_at_us));
            }
            if only != Some(one.robot) {
                only = None;
            }
        } else {
            only = Some(one.robot);
            newest_kept_us = one.newest_at_us;
        }
        oldest_kept_us = Some(one.newest_at_us);
        if let Some((newest, _before)) = mixed {
            *one = one.with_newest_alone(newest);
            changed_at_us = Some(one.newest_at_us);
        }
        kept.add(weighted);
    }
    (seen.len(), changed_at_us)
}
