//! The map: what many robots measured at many times, as one estimate. Pure.
//!
//! Each robot's measurements are joined first, over cells and hours, then the robots. A robot has
//! a bias of its own (tyres, wheel radius, mass), so many measurements of one robot never count
//! as much as a few of many:
//!
//! * hour `e` of robot `r` weighs `w_e = 1 / (1/Λ_e + q·age_e)`, so `θ_r = Σ w_e θ_e / Λ_r` with
//!   `Λ_r = Σ w_e`;
//! * robot `r` weighs `w_r = 1 / ((s_b·θ)² + 1/Λ_r)`, with θ the **common** estimate
//!   `Σ w_r θ_r / Σ w_r`, found by iterating; each robot's own θ there would make the intervals
//!   too small;
//! * the variance of θ is `1 / Σ w_r`.
//!
//! Age counts when the map is read, so nothing stored is ever rewritten.

pub mod fixed;

use std::collections::BTreeMap;

use jiff::Timestamp;
use tread_api::friction::{FusedFriction, Segment, ThetaEstimate};

use self::fixed::Fixed;
use crate::config::FrictionConfig;

/// Smallest θ that the map states: stiffer than K = 10⁶ is not told apart.
pub const THETA_MIN: f64 = 1.0e-6;
/// Most rounds of the iteration for the common θ; it settles within about ten.
const ROUNDS_MAX: u32 = 100;
/// Relative change at which the common θ counts as settled.
const SETTLED_RATIO: f64 = 1.0e-12;
/// Seconds of an epoch.
const EPOCH_S: i64 = 3_600;

/// Additive statistics of some measurements; the order of adding does not matter, to the bit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sums {
    /// Σ Λ, in 1/θ².
    pub information: Fixed,
    /// Σ Λ·θ.
    pub weighted: Fixed,
    /// How many segments.
    pub segments: u64,
    /// How many samples behind them.
    pub samples: u64,
    /// Largest friction coefficient seen.
    pub mu_peak: Option<f64>,
    /// End of the newest.
    pub newest_at: Timestamp,
}

impl Sums {
    /// The statistics of one segment; `None` if its numbers leave the range of fixed point.
    pub fn of(segment: &Segment) -> Option<Self> {
        Some(Self {
            information: Fixed::from_f64(segment.theta.information)?,
            weighted: Fixed::from_f64(segment.theta.weighted)?,
            segments: 1,
            samples: u64::from(segment.samples),
            mu_peak: segment.mu_peak_lower_bound,
            newest_at: segment.ended_at,
        })
    }

    /// Adds other measurements.
    pub fn add(&mut self, other: &Self) {
        self.information += other.information;
        self.weighted += other.weighted;
        self.segments += other.segments;
        self.samples += other.samples;
        self.mu_peak = match (self.mu_peak, other.mu_peak) {
            (Some(left), Some(right)) => Some(left.max(right)),
            (left, right) => left.or(right),
        };
        self.newest_at = self.newest_at.max(other.newest_at);
    }
}

/// The bucket of measuring time: whole hours since 1970.
pub fn epoch_h(time: Timestamp) -> i64 {
    time.as_second().div_euclid(EPOCH_S)
}

/// One estimate out of the sums of robots and hours; `None` when nothing is known.
///
/// The order of the parts does not matter: they are sorted by robot first.
pub fn fuse<R: Ord>(
    parts: impl IntoIterator<Item = (R, Sums)>,
    config: &FrictionConfig,
    now: Timestamp,
) -> Option<FusedFriction> {
    let mut robots: BTreeMap<R, BTreeMap<i64, Sums>> = BTreeMap::new();
    for (robot, sums) in parts {
        let epochs = robots.entry(robot).or_default();
        let epoch = epochs.entry(epoch_h(sums.newest_at));
        epoch
            .and_modify(|present| present.add(&sums))
            .or_insert(sums);
    }
    let total = robots
        .values()
        .flat_map(BTreeMap::values)
        .copied()
        .reduce(|mut left, right| {
            left.add(&right);
            left
        })?;
    let known: Vec<RobotEstimate> = robots
        .values()
        .filter_map(|epochs| RobotEstimate::of(epochs.values(), config, now))
        .collect();
    let theta = common_theta(&known, config)?;
    Some(FusedFriction {
        theta: theta.theta,
        std_dev: theta.std_dev,
        theta_low_95: theta.interval_95().0,
        theta_high_95: theta.interval_95().1,
        stiffness: theta.theta.recip(),
        mu_peak_lower_bound: total.mu_peak,
        segments: total.segments,
        robots: u32::try_from(known.len()).unwrap_or(u32::MAX),
        newest_at: total.newest_at,
    })
}

/// What one robot says, with the age of what it measured.
#[derive(Debug, Clone, Copy)]
struct RobotEstimate {
    theta: f64,
    information: f64,
}

impl RobotEstimate {
    fn of<'sums>(
        epochs: impl Iterator<Item = &'sums Sums>,
        config: &FrictionConfig,
        now: Timestamp,
    ) -> Option<Self> {
        let (mut information, mut weighted) = (0.0, 0.0);
        for sums in epochs {
            let measured = sums.information.to_f64();
            if measured <= 0.0 {
                continue;
            }
            // A robot's clock may run ahead; what it measured is at most new.
            let age_s = now.duration_since(sums.newest_at).as_secs_f64().max(0.0);
            let weight = (measured.recip() + config.drift_variance_per_s * age_s).recip();
            information += weight;
            weighted += weight * sums.weighted.to_f64() / measured;
        }
        (information > 0.0).then(|| Self {
            theta: weighted / information,
            information,
        })
    }
}

fn common_theta(robots: &[RobotEstimate], config: &FrictionConfig) -> Option<ThetaEstimate> {
    let weighed = |bias_variance: f64| {
        let (mut sum, mut weighted) = (0.0, 0.0);
        for robot in robots {
            let weight = (bias_variance + robot.information.recip()).recip();
            sum += weight;
            weighted += weight * robot.theta;
        }
        (weighted / sum, sum)
    };
    let (mut theta, mut information) = weighed(0.0);
    if !theta.is_finite() {
        return None;
    }
    for _ in 0..ROUNDS_MAX {
        let (next, sum) = weighed((config.robot_bias_ratio * theta).powi(2));
        let change = (next - theta).abs();
        (theta, information) = (next, sum);
        if change <= SETTLED_RATIO * theta.abs() {
            break;
        }
    }
    Some(ThetaEstimate {
        theta: theta.max(THETA_MIN),
        std_dev: information.sqrt().recip(),
    })
}

/// Groups what is sorted by nothing into what is sorted by key.
pub fn grouped<K: Ord, V>(pairs: impl IntoIterator<Item = (K, V)>) -> BTreeMap<K, Vec<V>> {
    let mut groups: BTreeMap<K, Vec<V>> = BTreeMap::new();
    for (key, value) in pairs {
        groups.entry(key).or_default().push(value);
    }
    groups
}

#[cfg(test)]
mod tests;
