//! Robust mean of the robots' values, which limits the influence of any single robot.
//!
//! One robot may be arbitrarily wrong, for example by a wrong wheel radius or by manipulation. With
//! three robots or more, the mean and its 95 % interval are computed for each group that leaves one
//! robot out, and the result is the hull of these intervals. A group is dropped if its χ² exceeds
//! that of the most consistent group by more than [`GROUP_CHI_SQUARE_MAX`]. Of two robots the wrong
//! one cannot be identified: both count, and the interval widens with their difference.

use tread_api::friction::NORMAL_95;

use super::epoch_measurement::{EpochMeasurement, Estimate, Ground, age_s};
use super::sums::Known;

/// Maximum number of iterations for the common θ; it converges within about ten.
const ROUNDS_MAX: u32 = 100;
/// Relative change of the common θ below which the iteration ends.
const SETTLED_RATIO: f64 = 1.0e-12;
/// Normal quantile for disputes, with a false alarm rate of one in a thousand.
const DISPUTE_QUANTILE: f64 = 3.090_232_306_167_813;
/// Maximum excess of a group's χ² over the smallest one; a group beyond it is dropped. At this
/// bound its likelihood is e² = 7.4 times smaller.
const GROUP_CHI_SQUARE_MAX: f64 = 4.0;
/// Reusable buffers of [`joined`].
#[derive(Debug, Default)]
pub(super) struct JoinBuffers {
    robots: Vec<RobotValue>,
    groups: Vec<Group>,
    ratios: Vec<f64>,
}

/// Value of one robot in one epoch, with its errors.
#[derive(Debug, Clone, Copy)]
pub(super) struct EpochValue {
    /// Value, with the information of its independent error.
    pub(super) known: Known,
    /// Standard deviation of the robot's bias, relative to the value.
    pub(super) bias_ratio: f64,
    /// Standard deviation of the error common to all robots with the same tyres, relative to the
    /// value.
    pub(super) tyre_ratio: f64,
}

/// Value of one robot over all epochs, with the variance of its independent errors.
#[derive(Debug, Clone, Copy)]
struct RobotValue {
    variance: f64,
    value: f64,
    bias_ratio: f64,
    tyre_ratio: f64,
}

impl RobotValue {
    /// Returns the weight of the robot in a mean with others whose common value is `common`.
    fn weight(&self, common: f64) -> f64 {
        ((self.bias_ratio * common).powi(2) + self.variance).recip()
    }
}

/// Heterogeneity of measurements: χ² sums between robots, between epochs of a robot, and between
/// passes of an epoch, with their degrees of freedom.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Heterogeneity {
    /// Number of robots.
    pub(super) robots: u32,
    between: f64,
    within: f64,
    within_freedom: u64,
    scatter: f64,
    scatter_freedom: u64,
}

impl Heterogeneity {
    /// Returns whether the measurements differ significantly: between robots, and for a cell also
    /// between and within epochs. Measurements of an area may differ from place to place.
    pub(super) fn is_dispute(&self, ground: Ground) -> bool {
        let between = u64::from(self.robots.saturating_sub(1));
        self.between > chi_square_bound(between)
            || ground == Ground::Cell
                && (self.within > chi_square_bound(self.within_freedom)
                    || self.scatter > chi_square_bound(self.scatter_freedom))
    }

    /// Returns the factor for the standard deviation, at least 1, if two robots differ by more than
    /// their biases explain.
    pub(super) fn widening(&self) -> f64 {
        let freedom = u64::from(self.robots.saturating_sub(1));
        // The hull of groups already widens with their differences.
        let is_robust = self.robots as usize >= ROBUST_ROBOTS_MIN;
        if !is_robust && freedom > 0 && self.between > chi_square_bound(freedom) {
            (self.between / as_f64(freedom)).sqrt().max(1.0)
        } else {
            1.0
        }
    }
}

/// Returns the 99.9 % quantile of χ² with these degrees of freedom (Wilson–Hilferty approximation).
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

/// Computes one estimate from the epochs in `seen`, which must be sorted by robot; `None` without
/// any value. `value_of` extracts the value of an epoch; `drift` is the growth of a measurement's
/// variance with its age, per second.
pub(super) fn joined<R: Ord + Copy>(
    seen: &[EpochMeasurement<R>],
    JoinBuffers {
        robots,
        groups,
        ratios,
    }: &mut JoinBuffers,
    value_of: impl Fn(&EpochMeasurement<R>) -> Option<EpochValue>,
    (now_us, drift): (i64, f64),
) -> Option<(Estimate, Heterogeneity)> {
    robots.clear();
    let mut heterogeneity = Heterogeneity::default();
    for epochs in seen.chunk_by(|left, right| left.robot == right.robot) {
        let (mut information, mut weighted, mut square) = (0.0, 0.0, 0.0);
        // The bias of a robot is the same in all epochs, so its standard deviations add linearly.
        let (mut bias, mut tyre) = (0.0, 0.0);
        for one in epochs {
            let Some(value) = value_of(one) else { continue };
            let known = value.known;
            let weight = (known.information.recip() + drift * age_s(one, now_us)).recip();
            information += weight;
            weighted += weight * known.value;
            square += weight * known.value * known.value;
            bias += weight * value.bias_ratio;
            tyre += weight * value.tyre_ratio;
            heterogeneity.within_freedom += 1;
            heterogeneity.scatter += one.scatter;
            heterogeneity.scatter_freedom += one.passes.saturating_sub(1);
        }
        if information > 0.0 {
            let value = weighted / information;
            heterogeneity.within += (square - weighted * value).max(0.0);
            heterogeneity.within_freedom -= 1;
            let variance = f64::recip(information);
            robots.push(RobotValue {
                variance,
                value,
                bias_ratio: bias / information,
                tyre_ratio: tyre / information,
            });
        }
    }
    // Robots with vague values must not count towards the number of robots for robustness.
    let knows_little = |robot: &RobotValue| robot.variance > VAGUE_STD_DEV * VAGUE_STD_DEV;
    if !robots.iter().all(knows_little) {
        robots.retain(|robot| !knows_little(robot));
    }
    heterogeneity.robots = u32::try_from(robots.len()).unwrap_or(u32::MAX);
    if robots.len() >= ROBUST_ROBOTS_MIN {
        return Some(hull_of_groups(robots, (groups, ratios), heterogeneity));
    }
    let (mut value, mut information) = weighed(robots, 0.0)?;
    for _ in 0..ROUNDS_MAX {
        let (next, sum) = weighed(robots, value)?;
        let change = (next - value).abs();
        (value, information) = (next, sum);
        if change <= SETTLED_RATIO * value.abs() {
            break;
        }
    }
    let mut tyre_ratio = 0.0;
    for robot in robots.iter() {
        let weight = robot.weight(value);
        heterogeneity.between += weight * (robot.value - value).powi(2);
        tyre_ratio += weight * robot.tyre_ratio / information;
    }
    let std_dev = information.sqrt().recip().hypot(tyre_ratio * value);
    Some((Estimate { value, std_dev }, heterogeneity))
}

/// Standard deviation above which a robot's value is dropped if others are more precise.
const VAGUE_STD_DEV: f64 = 1.0;
/// Minimum number of robots of which a wrong one can be identified.
const ROBUST_ROBOTS_MIN: usize = 3;

/// Weighted sums of a group of robots, with values relative to the median.
#[derive(Debug, Clone, Copy, Default)]
struct Group {
    weight: f64,
    weighted: f64,
    square: f64,
}

impl Group {
    fn plus(self, robot: &RobotValue, origin: f64) -> Self {
        let weight = robot.weight(origin);
        let value = robot.value - origin;
        Self {
            weight: self.weight + weight,
            weighted: self.weighted + weight * value,
            square: self.square + weight * value * value,
        }
    }

    fn and(self, other: Self) -> Self {
        Self {
            weight: self.weight + other.weight,
            weighted: self.weighted + other.weighted,
            square: self.square + other.square,
        }
    }

    fn chi_square(self) -> f64 {
        (self.square - self.weighted * self.weighted / self.weight).max(0.0)
    }
}

/// Returns the hull of the 95 % intervals of all groups that leave one robot out and are nearly as
/// consistent as the best group.
fn hull_of_groups(
    robots: &mut [RobotValue],
    (behind, ratios): (&mut Vec<Group>, &mut Vec<f64>),
    mut heterogeneity: Heterogeneity,
) -> (Estimate, Heterogeneity) {
    robots.sort_unstable_by(|left, right| {
        let by_value = left.value.total_cmp(&right.value);
        by_value.then_with(|| left.variance.total_cmp(&right.variance))
    });
    // Biases are relative to the common θ: the median, which no single robot moves far.
    let middle = robots.len() / 2;
    let median = if robots.len() % 2 == 1 {
        robots[middle].value
    } else {
        f64::midpoint(robots[middle - 1].value, robots[middle].value)
    };
    // Medians also limit the effect of a robot that states a tiny bias or a huge tyre error.
    let mut middle_of = |ratio_of: fn(&RobotValue) -> f64| {
        ratios.clear();
        ratios.extend(robots.iter().map(ratio_of));
        // Usually all robots state the same ratios.
        if ratios
            .iter()
            .all(|ratio| ratio.to_bits() == ratios[0].to_bits())
        {
            return ratios[0];
        }
        let middle = (ratios.len() - 1) / 2;
        *ratios.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    let bias_ratio = middle_of(|robot| robot.bias_ratio);
    let tyre_ratio = middle_of(|robot| robot.tyre_ratio);
    for robot in robots.iter_mut() {
        robot.bias_ratio = robot.bias_ratio.max(bias_ratio);
    }
    // Suffix sums; with the prefix sums they give each group without one robot.
    behind.clear();
    behind.resize(robots.len() + 1, Group::default());
    for (index, robot) in robots.iter().enumerate().rev() {
        behind[index] = behind[index + 1].plus(robot, median);
    }
    heterogeneity.between = behind[0].chi_square();
    let mut before = Group::default();
    let mut least = f64::INFINITY;
    for (index, left_out) in robots.iter().enumerate() {
        behind[index] = before.and(behind[index + 1]);
        least = least.min(behind[index].chi_square());
        before = before.plus(left_out, median);
    }
    let groups = &behind[..robots.len()];
    let freedom = u64::from(heterogeneity.robots.saturating_sub(2));
    let bound = chi_square_bound(freedom);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for group in groups {
        let chi_square = group.chi_square();
        if chi_square > least + GROUP_CHI_SQUARE_MAX {
            continue;
        }
        let mean = median + group.weighted / group.weight;
        // If even the best groups are inconsistent, more than one robot is wrong.
        let widening = if chi_square > bound {
            (chi_square / as_f64(freedom)).sqrt().max(1.0)
        } else {
            1.0
        };
        let half = NORMAL_95 * widening * group.weight.sqrt().recip();
        (low, high) = (low.min(mean - half), high.max(mean + half));
    }
    let value = f64::midpoint(low, high);
    let estimate = Estimate {
        value,
        std_dev: ((high - low) / (2.0 * NORMAL_95)).hypot(tyre_ratio * value),
    };
    (estimate, heterogeneity)
}

/// Returns the weighted mean of the robots and its information, with biases relative to `common`;
/// `None` without robots.
fn weighed(robots: &[RobotValue], common: f64) -> Option<(f64, f64)> {
    let (mut sum, mut weighted) = (0.0, 0.0);
    for robot in robots {
        let weight = robot.weight(common);
        sum += weight;
        weighted += weight * robot.value;
    }
    (sum > 0.0).then(|| (weighted / sum, sum))
}
