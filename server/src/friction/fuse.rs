//! Many robots' measurements of one piece of ground as one estimate.
//!
//! Epoch `e` of robot `r` weighs `w_e = 1 / (1/Λ_e + q·age_e)`, so `θ_r = Σ w_e θ_e / Λ_r` with
//! `Λ_r = Σ w_e`. Robot `r` weighs `w_r = 1 / ((s_b·θ)² + 1/Λ_r)`, with θ the **common** estimate
//! `Σ w_r θ_r / Σ w_r`, found by iterating: each robot's own θ there would make intervals too
//! small. The variance of θ is `1 / Σ w_r`.
//!
//! The ground changes. For a cell, the epochs are gone through from the newest back, and where one
//! contradicts what is newer by more than [`CHANGE_DEVIATIONS`], it and all older ones are left
//! out. An epoch whose newest telling pass contradicts its other ones counts with that pass alone. Bad news
//! (more slip) is believed from the first pass, good news when a second one confirms it; until
//! then the estimate is disputed.

use tread_api::friction::{Information, NORMAL_95};

use super::sums::{Known, Sums};
use crate::config::FrictionConfig;

/// Smallest θ that the map states: stiffer than K = 10⁶ is not told apart.
pub const THETA_MIN: f64 = 1.0e-6;
/// Largest standard deviation of θ that tells something: the whole range of θ, to K 0.1.
pub const THETA_STD_DEV_MAX: f64 = 10.0;
/// Standard deviations from which measurements contradict each other. With as many comparisons as
/// a cell ever sees, one in ten thousand of them cuts off what was true.
pub const CHANGE_DEVIATIONS: f64 = 4.5;
/// Most rounds of the iteration for the common θ; it settles within about ten.
const ROUNDS_MAX: u32 = 100;
/// Relative change at which the common θ counts as settled.
const SETTLED_RATIO: f64 = 1.0e-12;
/// Normal quantile from which differences are called a dispute: one in a thousand by chance.
const DISPUTE_QUANTILE: f64 = 3.090_232_306_167_813;
/// Microseconds of a second.
const SECOND_US: f64 = 1.0e6;

/// What one robot measured in one epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen<R> {
    /// The robot; its order is the order of adding, so it must not depend on arrival.
    pub robot: R,
    /// First hour of the epoch.
    pub epoch_h: i64,
    /// θ.
    pub theta: Known,
    /// Σ Λ·(θ − mean)² of the passes, which is χ² with one degree less than passes.
    pub scatter: f64,
    /// How many passes.
    pub passes: u64,
    /// End of the newest pass, microseconds since 1970.
    pub newest_at_us: i64,
    /// θ of the newest pass that tells something, if it is known by itself.
    pub newest: Option<Known>,
    /// Friction seen by that pass.
    pub newest_mu: Option<f64>,
    /// Largest friction coefficient seen.
    pub mu_peak: Option<f64>,
    /// Ratio of effective to geometric track.
    pub track: Option<Known>,
    /// Rolling resistance coefficient.
    pub rolling: Option<Known>,
}

impl<R> Seen<R> {
    /// Of sums; `None` when they know no θ.
    pub fn of(robot: R, epoch_h: i64, sums: &Sums) -> Option<Self> {
        let theta = sums.theta.known()?;
        let scatter = sums.theta_square.to_f64() - theta.information * theta.value * theta.value;
        Some(Self {
            robot,
            epoch_h,
            theta,
            scatter: scatter.max(0.0),
            passes: sums.segments,
            newest_at_us: sums.newest_at_us,
            newest: sums.newest.theta.as_ref().and_then(known),
            newest_mu: sums.newest.mu_peak,
            mu_peak: sums.mu_peak,
            track: sums.track.known(),
            rolling: sums.rolling.known(),
        })
    }

    /// The same in the θ of another model, of which this model's is a multiple.
    #[must_use]
    pub fn scaled(mut self, ratio: f64) -> Self {
        let scale = |known: Known| Known {
            information: known.information * ratio * ratio,
            value: known.value / ratio,
        };
        (self.theta, self.newest) = (scale(self.theta), self.newest.map(&scale));
        self
    }

    /// The passes before the newest one, if the newest contradicts them.
    fn contradicted(&self) -> Option<(Known, Known)> {
        let newest = self.newest.filter(|_| self.passes > 1)?;
        let information = self.theta.information - newest.information;
        if information <= 1.0e-9 * self.theta.information {
            return None;
        }
        let weighted =
            self.theta.information * self.theta.value - newest.information * newest.value;
        let before = Known {
            information,
            value: weighted / information,
        };
        let variance = newest.information.recip() + information.recip();
        ((newest.value - before.value).abs() > CHANGE_DEVIATIONS * variance.sqrt())
            .then_some((newest, before))
    }

    fn with_newest_alone(mut self, newest: Known) -> Self {
        self.theta = newest;
        self.scatter = 0.0;
        self.passes = 1;
        self.mu_peak = self.newest_mu;
        // Which of the passes showed these is not kept.
        (self.track, self.rolling) = (None, None);
        self
    }

    fn without_newest(mut self, before: Known) -> Self {
        self.theta = before;
        self.passes -= 1;
        self.newest = None;
        self.mu_peak = None;
        self
    }
}

fn known(information: &Information) -> Option<Known> {
    (information.information > 0.0).then(|| Known {
        information: information.information,
        value: information.weighted / information.information,
    })
}

/// A value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The value.
    pub value: f64,
    /// Its standard deviation.
    pub std_dev: f64,
}

/// What is known of one piece of ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fused {
    /// θ, at least [`THETA_MIN`].
    pub theta: Estimate,
    /// Largest friction coefficient seen of late.
    pub mu_peak: Option<f64>,
    /// Ratio of effective to geometric track.
    pub track: Option<Estimate>,
    /// Rolling resistance coefficient.
    pub rolling: Option<Estimate>,
    /// Passes that ever came, also those that a change has made void and those that told nothing.
    pub passes: u64,
    /// Robots behind the estimate.
    pub robots: u32,
    /// End of the newest pass, microseconds since 1970.
    pub newest_at_us: i64,
    /// Whether measurements differ by more than they should.
    pub is_disputed: bool,
    /// Since when the ground is as it is, if it was otherwise; microseconds since 1970.
    pub changed_at_us: Option<i64>,
}

impl Fused {
    /// The same with passes that told nothing counted too: their information is below what the sums
    /// resolve, 2.3·10⁻¹⁰, so that they change no estimate.
    #[must_use]
    pub fn with_uninformative(self, uninformative_passes: u64) -> Self {
        Self {
            passes: self.passes + uninformative_passes,
            ..self
        }
    }
}

/// What a piece of ground is, which says how a difference between measurements is understood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ground {
    /// One place: a difference in time is a change.
    Cell,
    /// Many places: a difference is one of place as well.
    Area,
}

/// One estimate of what was seen; `None` when nothing was, or nothing that tells one ground from
/// another ([`THETA_STD_DEV_MAX`]).
///
/// `seen` has one entry for each robot and epoch; it comes back sorted.
pub fn fuse<R: Ord + Copy>(
    seen: &mut Vec<Seen<R>>,
    ground: Ground,
    config: &FrictionConfig,
    now_us: i64,
) -> Option<Fused> {
    Fuser::default().fuse(seen, ground, config, now_us)
}

/// Fuses one piece of ground after another in the same room.
#[derive(Debug)]
pub struct Fuser<R> {
    before: Vec<Seen<R>>,
    robots: Vec<Word>,
}

impl<R> Default for Fuser<R> {
    fn default() -> Self {
        Self {
            before: Vec::new(),
            robots: Vec::new(),
        }
    }
}

impl<R: Ord + Copy> Fuser<R> {
    /// The same as [`fuse()`].
    pub fn fuse(
        &mut self,
        seen: &mut Vec<Seen<R>>,
        ground: Ground,
        config: &FrictionConfig,
        now_us: i64,
    ) -> Option<Fused> {
        fuse_in(self, seen, ground, config, now_us)
    }
}

/// What one robot says, with the variance that its own measurements leave.
#[derive(Debug, Clone, Copy)]
struct Word {
    variance: f64,
    value: f64,
}

/// Two revisions of a terrain that are one ground may both have a sum of one robot and epoch.
fn by_content<R>(left: &Seen<R>, right: &Seen<R>) -> std::cmp::Ordering {
    let information = left.theta.information.total_cmp(&right.theta.information);
    information.then_with(|| left.theta.value.total_cmp(&right.theta.value))
}

fn fuse_in<R: Ord + Copy>(
    room: &mut Fuser<R>,
    seen: &mut Vec<Seen<R>>,
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
            .then_with(|| by_content(left, right))
    });
    let passes = seen.iter().map(|one| one.passes).sum();
    let newest_at_us = seen.first()?.newest_at_us;
    let present = match ground {
        Ground::Cell => Present::of(seen, &mut room.before, config),
        Ground::Area => Present::default(),
    };
    seen.sort_unstable_by(|left, right| {
        let by_robot = left.robot.cmp(&right.robot);
        by_robot
            .then_with(|| left.epoch_h.cmp(&right.epoch_h))
            .then_with(|| by_content(left, right))
    });
    let drift = config.drift_variance_per_s;
    let words = &mut room.robots;
    let (theta, spread) = joined(seen, words, |one| Some(one.theta), config, (now_us, drift))?;
    let std_dev = theta.std_dev * spread.widening();
    if std_dev > THETA_STD_DEV_MAX {
        return None;
    }
    let mut layer = |value_of: fn(&Seen<R>) -> Option<Known>| {
        let is_known = seen.iter().any(|one| value_of(one).is_some());
        let joined = is_known.then(|| joined(seen, words, value_of, config, (now_us, 0.0)));
        joined.flatten().map(|joined| joined.0)
    };
    let (track, rolling) = (layer(|one| one.track), layer(|one| one.rolling));
    let recent = |one: &&Seen<R>| age_s(one, now_us) <= config.mu_peak_age_max_s;
    Some(Fused {
        theta: Estimate {
            value: theta.value.max(THETA_MIN),
            std_dev,
        },
        mu_peak: seen
            .iter()
            .filter(recent)
            .filter_map(|one| one.mu_peak)
            .reduce(f64::max),
        track,
        rolling,
        passes,
        robots: spread.robots,
        newest_at_us,
        is_disputed: present.is_unconfirmed || spread.is_dispute(ground),
        changed_at_us: present.changed_at_us,
    })
}

/// Which of what was seen of a cell is of the ground as it is.
#[derive(Debug, Clone, Copy, Default)]
struct Present {
    is_unconfirmed: bool,
    changed_at_us: Option<i64>,
}

impl Present {
    /// Keeps, of what is sorted from the newest back, what is of the ground as it is.
    fn of<R: Ord + Copy>(
        seen: &mut Vec<Seen<R>>,
        older: &mut Vec<Seen<R>>,
        config: &FrictionConfig,
    ) -> Self {
        older.clear();
        older.extend_from_slice(seen);
        let (kept, changed_at_us) = keep_present(seen, config);
        seen.truncate(kept);
        let Some(changed_at_us) = changed_at_us else {
            return Self::default();
        };
        let witnesses: u64 = seen.iter().map(|one| one.passes).sum();
        if witnesses > 1 {
            return Self {
                is_unconfirmed: false,
                changed_at_us: Some(changed_at_us),
            };
        }
        // One pass against all before it. Without it, what was there stands as it stood.
        let now = seen.first().map(|one| one.theta.value);
        if let Some(first) = older.first_mut() {
            match first.contradicted() {
                Some((_newest, rest)) => *first = first.without_newest(rest),
                None => {
                    older.remove(0);
                }
            }
        }
        let (kept, earlier_us) = keep_present(older, config);
        older.truncate(kept);
        let was = older.first().map(|one| one.theta.value);
        let is_bad_news = was.zip(now).is_none_or(|(was, now)| now > was);
        if is_bad_news {
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

/// How many of the newest agree, those that changed within their epoch cut down to their newest
/// pass; and since when, if others were left out.
fn keep_present<R: Ord + Copy>(
    seen: &mut [Seen<R>],
    config: &FrictionConfig,
) -> (usize, Option<i64>) {
    let mut changed_at_us = None;
    let mut oldest_kept_us = None;
    // Λ and Λ·θ of what is kept, and whose it is while it is one robot's.
    let (mut information, mut weighted) = (0.0_f64, 0.0_f64);
    let mut only: Option<R> = None;
    let mut newest_kept_us = 0;
    for (index, one) in seen.iter_mut().enumerate() {
        let mixed = one.contradicted();
        let word = mixed.map_or(one.theta, |(newest, _before)| newest);
        if information > 0.0 {
            let mean = weighted / information;
            let bias = if only == Some(one.robot) {
                0.0
            } else {
                // If nothing has changed, robots differ by a share of the θ that they have in
                // common, which is nearest to what is known best, not of the larger one.
                let common =
                    (weighted + word.information * word.value) / (information + word.information);
                2.0 * (config.robot_bias_ratio * common).powi(2)
            };
            let apart_s = seconds(newest_kept_us - one.newest_at_us);
            let variance = information.recip()
                + word.information.recip()
                + bias
                + config.drift_variance_per_s * apart_s;
            if (word.value - mean).abs() > CHANGE_DEVIATIONS * variance.sqrt() {
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
        information += word.information;
        weighted += word.information * word.value;
    }
    (seen.len(), changed_at_us)
}

/// How far apart measurements lie, as sums of squares with their degrees of freedom.
#[derive(Debug, Clone, Copy, Default)]
struct Spread {
    robots: u32,
    between: f64,
    within: f64,
    within_freedom: u64,
    scatter: f64,
    scatter_freedom: u64,
}

impl Spread {
    /// One robot's measurements of an area may differ from place to place; those of a cell may not.
    fn is_dispute(&self, ground: Ground) -> bool {
        let between = u64::from(self.robots.saturating_sub(1));
        self.between > chi_square_bound(between)
            || ground == Ground::Cell
                && (self.within > chi_square_bound(self.within_freedom)
                    || self.scatter > chi_square_bound(self.scatter_freedom))
    }

    /// Robots that differ by more than their bias may be trusted less, all of them.
    fn widening(&self) -> f64 {
        let freedom = u64::from(self.robots.saturating_sub(1));
        if freedom > 0 && self.between > chi_square_bound(freedom) {
            (self.between / as_f64(freedom)).sqrt().max(1.0)
        } else {
            1.0
        }
    }
}

/// What a sum of squares exceeds once in a thousand cases, by Wilson and Hilferty.
fn chi_square_bound(freedom: u64) -> f64 {
    if freedom == 0 {
        return f64::INFINITY;
    }
    let freedom = as_f64(freedom);
    let part = 2.0 / (9.0 * freedom);
    freedom * (1.0 - part + DISPUTE_QUANTILE * part.sqrt()).powi(3)
}

#[expect(clippy::cast_precision_loss, reason = "counts and times below 2^53")]
fn as_f64(count: u64) -> f64 {
    count as f64
}

#[expect(clippy::cast_precision_loss, reason = "times below 2^53 µs until 2255")]
pub(super) fn seconds(span_us: i64) -> f64 {
    span_us as f64 / SECOND_US
}

/// A robot's clock may run ahead; what it measured is at most new.
fn age_s<R>(one: &Seen<R>, now_us: i64) -> f64 {
    seconds(now_us - one.newest_at_us).max(0.0)
}

/// One value out of the epochs of robots, which are sorted by robot; `drift` is the growth of a
/// measurement's variance with its age.
fn joined<R: Ord + Copy>(
    seen: &[Seen<R>],
    robots: &mut Vec<Word>,
    value_of: impl Fn(&Seen<R>) -> Option<Known>,
    config: &FrictionConfig,
    (now_us, drift): (i64, f64),
) -> Option<(Estimate, Spread)> {
    robots.clear();
    let mut spread = Spread::default();
    for epochs in seen.chunk_by(|left, right| left.robot == right.robot) {
        let (mut information, mut weighted, mut square) = (0.0, 0.0, 0.0);
        for one in epochs {
            let Some(known) = value_of(one) else { continue };
            let weight = (known.information.recip() + drift * age_s(one, now_us)).recip();
            information += weight;
            weighted += weight * known.value;
            square += weight * known.value * known.value;
            spread.within_freedom += 1;
            spread.scatter += one.scatter;
            spread.scatter_freedom += one.passes.saturating_sub(1);
        }
        if information > 0.0 {
            let value = weighted / information;
            spread.within += (square - weighted * value).max(0.0);
            spread.within_freedom -= 1;
            let variance = f64::recip(information);
            robots.push(Word { variance, value });
        }
    }
    let (mut value, mut information) = weighed(robots, 0.0)?;
    for _ in 0..ROUNDS_MAX {
        let bias_variance = (config.robot_bias_ratio * value).powi(2);
        let (next, sum) = weighed(robots, bias_variance)?;
        let change = (next - value).abs();
        (value, information) = (next, sum);
        if change <= SETTLED_RATIO * value.abs() {
            break;
        }
    }
    let bias_variance = (config.robot_bias_ratio * value).powi(2);
    for robot in robots.iter() {
        let weight = (bias_variance + robot.variance).recip();
        spread.between += weight * (robot.value - value).powi(2);
    }
    spread.robots = u32::try_from(robots.len()).unwrap_or(u32::MAX);
    let std_dev = information.sqrt().recip();
    Some((Estimate { value, std_dev }, spread))
}

/// The mean of robots with this variance of their bias, and its information.
fn weighed(robots: &[Word], bias_variance: f64) -> Option<(f64, f64)> {
    let (mut sum, mut weighted) = (0.0, 0.0);
    for robot in robots {
        let weight = (bias_variance + robot.variance).recip();
        sum += weight;
        weighted += weight * robot.value;
    }
    (sum > 0.0).then(|| (weighted / sum, sum))
}

impl Estimate {
    /// The value that is undercut with this normal quantile, not below `least`.
    pub fn quantile(&self, deviations: f64, least: f64) -> f64 {
        (self.value + deviations * self.std_dev).max(least)
    }

    /// The 95 % interval; θ is never negative.
    pub fn interval_95(&self) -> (f64, f64) {
        (
            self.quantile(-NORMAL_95, 0.0),
            self.quantile(NORMAL_95, 0.0),
        )
    }
}
