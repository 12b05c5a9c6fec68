//! Timing along a path: speed as a function of time, jerk-bounded and within all limits.
//!
//! Two steps. First the quickest timing `s₀(t)` with piecewise constant acceleration under the
//! limits, by a forward and a backward pass over `E = v²/2`. Then its mean over a window T,
//! `s₁(t) = (1/T) ∫ s₀(u) du` for u from t − T to t. The mean's acceleration is a mean of
//! accelerations, so within the bound; its jerk is at most `2a/T`, which determines T. Its speed at
//! a point of the path is a mean of speeds at points that are driven at most T before and after. No
//! timing under the limits drives farther in T than the quickest one, nor farther than
//! `D = T·v_max`. So the passes use, at each node, the minimum of the limits within time T or
//! within distance D, and the bound holds exactly. Speed is zero at both ends.

#![expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "counts of grid cells stay far below 2^52"
)]

use std::collections::VecDeque;

/// Limits at one node of an even grid along the path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct NodeLimits {
    /// Maximum speed, metres per second, above zero.
    pub(crate) speed_m_s: f64,
    /// Maximum acceleration and deceleration along the path, metres per second squared, above zero.
    pub(crate) acceleration_m_s2: f64,
}

impl NodeLimits {
    /// Returns the smaller of each limit.
    pub(crate) fn stricter(&self, other: &Self) -> Self {
        Self {
            speed_m_s: self.speed_m_s.min(other.speed_m_s),
            acceleration_m_s2: self.acceleration_m_s2.min(other.acceleration_m_s2),
        }
    }
}

/// Arc length, speed and acceleration along the path at one time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ProfileSample {
    /// Arc length, metres.
    pub arc_m: f64,
    /// Speed, metres per second, ≥ 0.
    pub speed_m_s: f64,
    /// Acceleration, metres per second squared.
    pub acceleration_m_s2: f64,
}

/// Node of the timing `s₀`: constant acceleration until the next node.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    time_s: f64,
    arc_m: f64,
    speed_m_s: f64,
    acceleration_m_s2: f64,
    /// `∫ s₀ dt` from the start to this node, metre seconds.
    arc_integral_m_s: f64,
}

/// Timing along a path, with zero speed at both ends.
#[derive(Debug, Clone, PartialEq)]
pub struct SpeedProfile {
    nodes: Vec<Node>,
    window_s: f64,
    length_m: f64,
}

/// Input of [`SpeedProfile::new`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct ProfileInput<'a> {
    /// Length of the path, metres.
    pub(crate) length_m: f64,
    /// Limits at the nodes of an even grid along the path, at least two.
    pub(crate) limits: &'a [NodeLimits],
    /// Number of nodes at the start that keep to the limits within time T only, which is quicker;
    /// the others keep to those within distance D (see module).
    pub(crate) time_limited_nodes: usize,
    /// Maximum jerk, metres per second cubed.
    pub(crate) jerk_max_m_s3: f64,
}

/// Window of the mean: time T and distance D, see module.
#[derive(Debug, Clone, Copy)]
struct AveragingWindow {
    window_s: f64,
    /// D as a number of cells.
    cells: usize,
}

impl SpeedProfile {
    /// Computes the timing from zero speed to zero speed.
    pub(crate) fn new(input: &ProfileInput<'_>) -> Self {
        let &ProfileInput {
            length_m,
            limits,
            time_limited_nodes,
            jerk_max_m_s3,
        } = input;
        let cells = limits.len().saturating_sub(1).max(1);
        let cell_m = length_m / cells as f64;
        let hardest_m_s2 = limits
            .iter()
            .map(|node| node.acceleration_m_s2)
            .fold(f64::MIN_POSITIVE, f64::max);
        let fastest_m_s = limits.iter().map(|node| node.speed_m_s).fold(0.0, f64::max);
        let window_s = 2.0 * hardest_m_s2 / jerk_max_m_s3;
        // One cell more than the distance, to cover limits between nodes.
        let averaging = AveragingWindow {
            window_s,
            cells: ((window_s * fastest_m_s / cell_m).ceil() + 1.0).min(cells as f64) as usize,
        };
        let spans = spans(limits, cell_m, averaging, time_limited_nodes);
        let speeds = lowest_within(limits, &spans, |node| node.speed_m_s);
        let accelerations = lowest_within(limits, &spans, |node| node.acceleration_m_s2);
        let lowest = speeds.into_iter().zip(accelerations);
        let lowest: Vec<NodeLimits> = lowest
            .map(|(speed_m_s, acceleration_m_s2)| NodeLimits {
                speed_m_s,
                acceleration_m_s2,
            })
            .collect();
        let energies = quickest(&lowest, cell_m);
        Self {
            nodes: time_nodes(&energies, cell_m),
            window_s,
            length_m,
        }
    }

    /// Returns the time from start to end, seconds.
    pub fn duration_s(&self) -> f64 {
        self.nodes.last().map_or(0.0, |node| node.time_s) + self.window_s
    }

    /// Returns the timing at a time since the start, seconds; before 0 and after the end the speed
    /// is zero.
    pub fn sample(&self, time_s: f64) -> ProfileSample {
        let (late, early) = (
            self.unaveraged(time_s),
            self.unaveraged(time_s - self.window_s),
        );
        ProfileSample {
            arc_m: ((late.arc_integral_m_s - early.arc_integral_m_s) / self.window_s)
                .clamp(0.0, self.length_m),
            speed_m_s: ((late.arc_m - early.arc_m) / self.window_s).max(0.0),
            acceleration_m_s2: (late.speed_m_s - early.speed_m_s) / self.window_s,
        }
    }

    /// Returns the timing `s₀` before the mean.
    fn unaveraged(&self, time_s: f64) -> Node {
        let after = self.nodes.partition_point(|node| node.time_s <= time_s);
        let rest = Node {
            time_s,
            arc_m: 0.0,
            speed_m_s: 0.0,
            acceleration_m_s2: 0.0,
            arc_integral_m_s: 0.0,
        };
        let Some(node) = after.checked_sub(1).and_then(|index| self.nodes.get(index)) else {
            return rest;
        };
        let dt_s = time_s - node.time_s;
        let a_m_s2 = node.acceleration_m_s2;
        Node {
            time_s,
            arc_m: node.arc_m + dt_s * (node.speed_m_s + 0.5 * dt_s * a_m_s2),
            speed_m_s: node.speed_m_s + dt_s * a_m_s2,
            acceleration_m_s2: a_m_s2,
            arc_integral_m_s: node.arc_integral_m_s
                + dt_s * (node.arc_m + dt_s * (0.5 * node.speed_m_s + dt_s * a_m_s2 / 6.0)),
        }
    }
}

/// Returns `E = v²/2` at every node of the quickest timing under limits, by a forward and a
/// backward pass.
fn quickest(limits: &[NodeLimits], cell_m: f64) -> Vec<f64> {
    let energy = |node: &NodeLimits| 0.5 * node.speed_m_s * node.speed_m_s;
    let mut energies: Vec<f64> = limits.iter().map(energy).collect();
    energies[0] = 0.0;
    let last = energies.len() - 1;
    energies[last] = 0.0;
    let acceleration_m_s2 = |node: usize| limits[node].acceleration_m_s2;
    let gain = |cell: usize| acceleration_m_s2(cell).min(acceleration_m_s2(cell + 1)) * cell_m;
    for cell in 0..last {
        energies[cell + 1] = energies[cell + 1].min(energies[cell] + gain(cell));
    }
    for cell in (0..last).rev() {
        energies[cell] = energies[cell].min(energies[cell + 1] + gain(cell));
    }
    energies
}

/// Returns, for each node, the indices of the first and the last node whose limits it keeps to;
/// both are non-decreasing.
fn spans(
    limits: &[NodeLimits],
    cell_m: f64,
    averaging: AveragingWindow,
    time_limited_nodes: usize,
) -> Vec<(usize, usize)> {
    let AveragingWindow { window_s, cells } = averaging;
    let last = limits.len() - 1;
    let within_distance = |index: usize| (index.saturating_sub(cells), (index + cells).min(last));
    if time_limited_nodes == 0 {
        return (0..=last).map(within_distance).collect();
    }
    let timed = time_nodes(&quickest(limits, cell_m), cell_m);
    let (mut before, mut after) = (0, 0);
    let mut first = 0;
    (0..=last)
        .map(|index| {
            let (mut from, mut to) = within_distance(index);
            if index < time_limited_nodes {
                let time_s = timed[index].time_s;
                while timed[before].time_s < time_s - window_s {
                    before += 1;
                }
                while after < last && timed[after].time_s < time_s + window_s {
                    after += 1;
                }
                // One cell more on each side, to cover limits between nodes.
                from = from.max(before.saturating_sub(2));
                to = to.min(after + 1);
            }
            first = first.max(from);
            (first, to)
        })
        .collect()
}

/// Converts `E = v²/2` at the nodes to the timing `s₀`.
fn time_nodes(energies: &[f64], cell_m: f64) -> Vec<Node> {
    let mut nodes = Vec::with_capacity(energies.len());
    let mut node = Node {
        time_s: 0.0,
        arc_m: 0.0,
        speed_m_s: 0.0,
        acceleration_m_s2: 0.0,
        arc_integral_m_s: 0.0,
    };
    for (cell, pair) in energies.windows(2).enumerate() {
        let end_m_s = (2.0 * pair[1]).sqrt();
        let dt_s = 2.0 * cell_m / (node.speed_m_s + end_m_s).max(1.0e-9);
        node.acceleration_m_s2 = (end_m_s - node.speed_m_s) / dt_s;
        nodes.push(node);
        node.arc_integral_m_s += dt_s
            * (node.arc_m + dt_s * (0.5 * node.speed_m_s + dt_s * node.acceleration_m_s2 / 6.0));
        node.time_s += dt_s;
        node.arc_m = cell_m * (cell + 1) as f64;
        node.speed_m_s = end_m_s;
    }
    node.acceleration_m_s2 = 0.0;
    node.speed_m_s = 0.0;
    nodes.push(node);
    nodes
}

/// Returns the minimum over each span of nodes in linear time; span ends must be non-decreasing.
fn lowest_within(
    limits: &[NodeLimits],
    spans: &[(usize, usize)],
    value: impl Fn(&NodeLimits) -> f64,
) -> Vec<f64> {
    let mut lowest = Vec::with_capacity(limits.len());
    let mut window: VecDeque<usize> = VecDeque::new();
    let mut next = 0;
    for &(first, last) in spans {
        while next <= last {
            while window
                .back()
                .is_some_and(|&back| value(&limits[back]) >= value(&limits[next]))
            {
                window.pop_back();
            }
            window.push_back(next);
            next += 1;
        }
        while window.front().is_some_and(|&front| front < first) {
            window.pop_front();
        }
        lowest.push(
            window
                .front()
                .map_or(f64::MIN_POSITIVE, |&front| value(&limits[front])),
        );
    }
    lowest
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const CELL_M: f64 = 0.02;

    proptest! {
        #[test]
        fn no_window_passes_a_limit_and_that_of_time_is_never_slower(
            stretches in prop::collection::vec((1..60_usize, 0.05..1.0_f64, 0.1..1.0_f64), 2..12),
            time_limited_share in 0.0..=1.0_f64, jerk_m_s3 in 1.0..8.0_f64,
        ) {
            let limits: Vec<NodeLimits> = stretches
                .iter()
                .flat_map(|&(count, speed_m_s, acceleration_m_s2)| {
                    std::iter::repeat_n(NodeLimits { speed_m_s, acceleration_m_s2 }, count)
                })
                .chain([NodeLimits { speed_m_s: 1.0, acceleration_m_s2: 1.0 }])
                .collect();
            let cells = limits.len() - 1;
            let length_m = CELL_M * cells as f64;
            let time_limited_nodes = (time_limited_share * limits.len() as f64) as usize;
            let profile = |time_limited_nodes: usize| SpeedProfile::new(&ProfileInput {
                length_m,
                limits: &limits,
                time_limited_nodes,
                jerk_max_m_s3: jerk_m_s3,
            });
            let (cautious, quick) = (profile(0), profile(time_limited_nodes));
            prop_assert!(quick.duration_s() <= cautious.duration_s() + 1.0e-9);
            let (mut time_s, mut before_m_s2) = (0.0, 0.0);
            while time_s < quick.duration_s() {
                let now = quick.sample(time_s);
                let node = ((now.arc_m / CELL_M) as usize).min(cells - 1);
                let fastest_m_s = limits[node].speed_m_s.max(limits[node + 1].speed_m_s);
                let hardest_m_s2 =
                    limits[node].acceleration_m_s2.max(limits[node + 1].acceleration_m_s2);
                prop_assert!(now.speed_m_s <= fastest_m_s + 1.0e-9);
                prop_assert!(now.acceleration_m_s2.abs() <= hardest_m_s2 + 1.0e-6);
                let jerk = (now.acceleration_m_s2 - before_m_s2).abs() / 0.01;
                prop_assert!(jerk <= 1.01 * jerk_m_s3, "{jerk} m/s³");
                before_m_s2 = now.acceleration_m_s2;
                time_s += 0.01;
            }
        }
    }
}
