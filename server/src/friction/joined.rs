//! Robots' values joined to one, so that one wrong robot cannot lead the others astray.
//!
//! One robot may be wrong without limit: a wheel of another radius, or a robot that lies. Of three
//! robots or more, what each group that leaves one of them out has in common is found, and the 95 %
//! interval is the hull of the groups' intervals. A group that contradicts itself by
//! [`GROUP_CHI_SQUARE_MAX`] more than the most consistent one does not count. So one wrong robot
//! moves the interval only as far as the others cannot tell. Of two robots nobody can say which
//! one is wrong; they count both, and the interval widens with their contradiction.

use tread_api::friction::NORMAL_95;

use super::seen::{Estimate, Ground, Seen, age_s};
use super::sums::Known;

/// Most rounds of the iteration for the common θ; it settles within about ten.
const ROUNDS_MAX: u32 = 100;
/// Relative change at which the common θ counts as settled.
const SETTLED_RATIO: f64 = 1.0e-12;
/// Normal quantile from which differences are called a dispute: one in a thousand by chance.
const DISPUTE_QUANTILE: f64 = 3.090_232_306_167_813;
/// How much larger a group's χ² may be than the smallest, for the group to count: its robots are
/// e² = 7.4 times less likely to agree.
const GROUP_CHI_SQUARE_MAX: f64 = 4.0;
/// Room for what is joined.
#[derive(Debug, Default)]
pub(super) struct Room {
    robots: Vec<Word>,
    groups: Vec<Group>,
    ratios: Vec<f64>,
}

/// What one robot says in one epoch.
#[derive(Debug, Clone, Copy)]
pub(super) struct Said {
    /// The value, with its independent error.
    pub(super) known: Known,
    /// Standard deviation of the robot's bias as a share of the value.
    pub(super) bias_ratio: f64,
    /// Standard deviation of the error that all robots on its tyres have, as a share of the value.
    pub(super) tyre_ratio: f64,
}

/// What one robot says, with the variance that its own measurements leave.
#[derive(Debug, Clone, Copy)]
struct Word {
    variance: f64,
    value: f64,
    bias_ratio: f64,
    tyre_ratio: f64,
}

impl Word {
    /// Its weight beside other robots, about their common value.
    fn weight(&self, common: f64) -> f64 {
        ((self.bias_ratio * common).powi(2) + self.variance).recip()
    }
}

/// How far apart measurements lie, as sums of squares with their degrees of freedom.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Heterogeneity {
    /// How many robots.
    pub(super) robots: u32,
    between: f64,
    within: f64,
    within_freedom: u64,
    scatter: f64,
    scatter_freedom: u64,
}

impl Heterogeneity {
    /// One robot's measurements of an area may differ from place to place; those of a cell may not.
    pub(super) fn is_dispute(&self, ground: Ground) -> bool {
        let between = u64::from(self.robots.saturating_sub(1));
        self.between > chi_square_bound(between)
            || ground == Ground::Cell
                && (self.within > chi_square_bound(self.within_freedom)
                    || self.scatter > chi_square_bound(self.scatter_freedom))
    }

    /// Robots that differ by more than their bias may be trusted less, all of them.
    pub(super) fn widening(&self) -> f64 {
        let freedom = u64::from(self.robots.saturating_sub(1));
        // The hull of groups is wide where they contradict each other.
        let is_robust = self.robots as usize >= ROBUST_ROBOTS_MIN;
        if !is_robust && freedom > 0 && self.between > chi_square_bound(freedom) {
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

/// One value out of the epochs of robots, which are sorted by robot; `drift` is the growth of a
/// measurement's variance with its age.
pub(super) fn joined<R: Ord + Copy>(
    seen: &[Seen<R>],
    Room {
        robots,
        groups,
        ratios,
    }: &mut Room,
    said_of: impl Fn(&Seen<R>) -> Option<Said>,
    (now_us, drift): (i64, f64),
) -> Option<(Estimate, Heterogeneity)> {
    robots.clear();
    let mut heterogeneity = Heterogeneity::default();
    for epochs in seen.chunk_by(|left, right| left.robot == right.robot) {
        let (mut information, mut weighted, mut square) = (0.0, 0.0, 0.0);
        // One robot's biases of two epochs are one, so their standard deviations add up, not their
        // squares.
        let (mut bias, mut tyre) = (0.0, 0.0);
        for one in epochs {
            let Some(said) = said_of(one) else { continue };
            let known = said.known;
            let weight = (known.information.recip() + drift * age_s(one, now_us)).recip();
            information += weight;
            weighted += weight * known.value;
            square += weight * known.value * known.value;
            bias += weight * said.bias_ratio;
            tyre += weight * said.tyre_ratio;
            heterogeneity.within_freedom += 1;
            heterogeneity.scatter += one.scatter;
            heterogeneity.scatter_freedom += one.passes.saturating_sub(1);
        }
        if information > 0.0 {
            let value = weighted / information;
            heterogeneity.within += (square - weighted * value).max(0.0);
            heterogeneity.within_freedom -= 1;
            let variance = f64::recip(information);
            robots.push(Word {
                variance,
                value,
                bias_ratio: bias / information,
                tyre_ratio: tyre / information,
            });
        }
    }
    // Who knows next to nothing is no check on the others.
    let knows_little = |robot: &Word| robot.variance > VAGUE_STD_DEV * VAGUE_STD_DEV;
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

/// Standard deviation above which a robot's own word does not count beside others.
const VAGUE_STD_DEV: f64 = 1.0;
/// Fewest robots of which one can be identified as wrong.
const ROBUST_ROBOTS_MIN: usize = 3;

/// What robots say with one of them left out: sums of weights, of weighted values and of weighted
/// squares.
#[derive(Debug, Clone, Copy, Default)]
struct Group {
    weight: f64,
    weighted: f64,
    square: f64,
}

impl Group {
    fn plus(self, robot: &Word, origin: f64) -> Self {
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

/// The hull of the 95 % intervals of all groups that leave one robot out and agree about as well as
/// the best.
fn hull_of_groups(
    robots: &mut [Word],
    (behind, ratios): (&mut Vec<Group>, &mut Vec<f64>),
    mut heterogeneity: Heterogeneity,
) -> (Estimate, Heterogeneity) {
    robots.sort_unstable_by(|left, right| {
        let by_value = left.value.total_cmp(&right.value);
        by_value.then_with(|| left.variance.total_cmp(&right.variance))
    });
    // The common θ that the bias is a share of: no single robot moves a median far.
    let middle = robots.len() / 2;
    let median = if robots.len() % 2 == 1 {
        robots[middle].value
    } else {
        f64::midpoint(robots[middle - 1].value, robots[middle].value)
    };
    // Nor does one that claims to have hardly any bias, or tyres of which nobody knows anything.
    let mut middle_of = |ratio_of: fn(&Word) -> f64| {
        ratios.clear();
        ratios.extend(robots.iter().map(ratio_of));
        // Most fleets say the same of all their robots.
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
    // What comes behind each robot; with what comes before it that is all but that robot.
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
        // Where even the best groups contradict themselves, more than one robot is wrong.
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

/// The mean of robots whose biases are shares of this value, and its information.
fn weighed(robots: &[Word], common: f64) -> Option<(f64, f64)> {
    let (mut sum, mut weighted) = (0.0, 0.0);
    for robot in robots {
        let weight = robot.weight(common);
        sum += weight;
        weighted += weight * robot.value;
    }
    (sum > 0.0).then(|| (weighted / sum, sum))
}
