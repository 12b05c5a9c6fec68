//! Records the driven path of a mission and its quality.
//!
//! All memory is allocated before the mission reaches the loop. When a buffer is full, every other
//! entry is dropped and the spacing is doubled, so a mission of any length fits; the error of the
//! dropped points is added to the tolerance reported with the path. [`Driven::quality`] and
//! [`Driven::path`] allocate and are called outside the loop.

mod stretch;

use tread_api::geometry::Point as WirePoint;
use tread_api::mission::{
    DRIVEN_POINTS_MAX, DrivenPath, MissionQuality, THETA_SAMPLES_MAX, ThetaSample,
};
use tread_control::gate::GateCause;
use tread_control::geometry::Point;

use self::stretch::Stretch;
use super::gain::{Gain, GainTick, GroundRecord};
use super::surface::Comparison;

/// Initial distance between two recorded points, metres.
const POINT_SPACING_M: f64 = 0.05;
/// Initial distance between two samples of θ, metres.
const THETA_SPACING_M: f64 = 0.25;
/// Largest distance of a point dropped from the report to the straight line that replaces it,
/// metres.
const LINE_TOLERANCE_M: f64 = 0.01;
/// Resolution of the reported coordinates, metres.
const RESOLUTION_M: f64 = 1.0e-4;
/// Largest distance, metres, of a point dropped from the report to its position at the same time by
/// constant velocity between the points that are kept.
const MOTION_TOLERANCE_M: f64 = 0.1;
/// Resolution of the reported times, seconds.
const RESOLUTION_S: f64 = 1.0e-2;

/// A position in the site frame, and its time since the begin of the mission, seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PathPosition {
    at: Point,
    time_s: f64,
}

/// Values of one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TickRecord {
    pub(crate) dt_s: f64,
    /// Position of the robot in the site frame; `None` if unknown.
    pub(crate) at: Option<Point>,
    /// Distance driven in this tick, metres.
    pub(crate) driven_m: f64,
    /// Signed cross-track error, metres; `None` while turning on the spot or stopped on hold.
    pub(crate) cross_track_m: Option<f64>,
    /// Whether a wheel speed was saturated.
    pub(crate) is_saturated: bool,
    /// Whether the mission is paused.
    pub(crate) is_paused: bool,
    /// Whether a wheel slips beyond the model's range, or a change of ground was detected.
    pub(crate) slips: bool,
    /// Cause for which the gate reduced the command.
    pub(crate) gate: Option<GateCause>,
    /// θ̂ of the tracking law.
    pub(crate) theta_loop: Option<f64>,
    /// Measured θ and its standard deviation.
    pub(crate) theta_measured: Option<(f64, f64)>,
    /// Knowledge of the ground.
    pub(crate) ground: GroundRecord,
}

/// The record of one mission.
#[derive(Debug, Clone)]
pub(crate) struct Driven {
    points: Vec<PathPosition>,
    spacing_m: f64,
    /// Largest distance of the driven path to the polyline of the recorded points, metres.
    tolerance_m: f64,
    last: Option<PathPosition>,
    since_point_m: f64,
    theta: Vec<ThetaSample>,
    theta_spacing_m: f64,
    theta_at_m: f64,
    duration_s: f64,
    paused_s: f64,
    distance_m: f64,
    tracked_s: f64,
    cross_squared_m2_s: f64,
    cross_max_m: f64,
    ticks: u64,
    saturated_ticks: u64,
    reduced_ticks: u64,
    slip_events: u32,
    gate_stops: u32,
    was_slipping: bool,
    was_held_by_gate: bool,
    gain: Gain,
}

impl Driven {
    /// Creates an empty record with its final capacity.
    pub(crate) fn new() -> Self {
        Self {
            points: Vec::with_capacity(DRIVEN_POINTS_MAX),
            spacing_m: POINT_SPACING_M,
            tolerance_m: 0.0,
            last: None,
            since_point_m: 0.0,
            theta: Vec::with_capacity(THETA_SAMPLES_MAX),
            theta_spacing_m: THETA_SPACING_M,
            theta_at_m: 0.0,
            duration_s: 0.0,
            paused_s: 0.0,
            distance_m: 0.0,
            tracked_s: 0.0,
            cross_squared_m2_s: 0.0,
            cross_max_m: 0.0,
            ticks: 0,
            saturated_ticks: 0,
            reduced_ticks: 0,
            slip_events: 0,
            gate_stops: 0,
            was_slipping: false,
            was_held_by_gate: false,
            gain: Gain::default(),
        }
    }

    /// Records the comparison of a cell's measured θ with the map's.
    pub(crate) fn compare(&mut self, comparison: &Comparison) {
        self.gain.compare(comparison);
    }

    /// Adds a tick. Does not allocate.
    pub(crate) fn add(&mut self, tick: &TickRecord) {
        self.duration_s += tick.dt_s;
        if tick.is_paused {
            self.paused_s += tick.dt_s;
        }
        self.ticks += 1;
        self.saturated_ticks += u64::from(tick.is_saturated);
        self.reduced_ticks += u64::from(tick.gate.is_some());
        if let Some(cross_track_m) = tick
            .cross_track_m
            .filter(|cross_track_m| cross_track_m.is_finite())
        {
            self.tracked_s += tick.dt_s;
            self.cross_squared_m2_s += cross_track_m * cross_track_m * tick.dt_s;
            self.cross_max_m = self.cross_max_m.max(cross_track_m.abs());
        }
        if tick.slips && !self.was_slipping {
            self.slip_events = self.slip_events.saturating_add(1);
        }
        self.was_slipping = tick.slips;
        let is_held_by_gate = tick.gate.is_some_and(|cause| cause > GateCause::Speed);
        if is_held_by_gate && !self.was_held_by_gate {
            self.gate_stops = self.gate_stops.saturating_add(1);
        }
        self.was_held_by_gate = is_held_by_gate;
        let driven_m = if tick.driven_m.is_finite() {
            tick.driven_m.max(0.0)
        } else {
            0.0
        };
        self.distance_m += driven_m;
        if let Some(at) = tick.at.filter(|at| at.is_finite()) {
            let time_s = self.duration_s;
            self.add_point(PathPosition { at, time_s });
        }
        self.add_theta(tick);
        let gain_tick = GainTick {
            dt_s: tick.dt_s,
            driven_m,
            since_start_s: self.duration_s,
        };
        self.gain.add(&tick.ground, gain_tick);
    }

    fn add_point(&mut self, passed: PathPosition) {
        let Some(last) = self.last.replace(passed) else {
            self.points.push(passed);
            return;
        };
        self.since_point_m += last.at.distance_m(passed.at);
        if self.since_point_m < self.spacing_m {
            return;
        }
        // Between two points the path is no longer than this, so its distance to the line is at
        // most half.
        self.tolerance_m = self.tolerance_m.max(0.5 * self.since_point_m);
        self.since_point_m = 0.0;
        if self.points.len() >= DRIVEN_POINTS_MAX - 1 {
            self.drop_every_other_point();
        }
        self.points.push(passed);
    }

    fn drop_every_other_point(&mut self) {
        let mut farthest_m: f64 = 0.0;
        let mut kept = 1;
        for index in 1..self.points.len() {
            if index % 2 == 1
                && let Some(&to) = self.points.get(index + 1)
            {
                // `kept` never exceeds `index`, so only entries already read are overwritten.
                let from = self.points[kept - 1];
                let off_m = Stretch { from, to }.distance_m(self.points[index].at);
                farthest_m = farthest_m.max(off_m);
                continue;
            }
            self.points[kept] = self.points[index];
            kept += 1;
        }
        self.points.truncate(kept);
        self.tolerance_m += farthest_m;
        self.spacing_m *= 2.0;
    }

    fn add_theta(&mut self, tick: &TickRecord) {
        let Some(theta_loop) = tick.theta_loop.filter(|theta| theta.is_finite()) else {
            return;
        };
        if self.distance_m < self.theta_at_m {
            return;
        }
        if self.theta.len() >= THETA_SAMPLES_MAX {
            let mut index = 0;
            self.theta.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.theta_spacing_m *= 2.0;
        }
        let measured = tick
            .theta_measured
            .filter(|(theta, std_dev)| theta.is_finite() && std_dev.is_finite());
        self.theta.push(ThetaSample {
            driven_m: self.distance_m,
            theta_loop,
            theta_measured: measured.map(|(theta, _)| theta),
            theta_std_dev: measured.map(|(_, std_dev)| std_dev),
        });
        self.theta_at_m = self.distance_m + self.theta_spacing_m;
    }

    /// Returns the quality of the mission so far.
    pub(crate) fn quality(&self) -> MissionQuality {
        #[expect(
            clippy::cast_precision_loss,
            reason = "a mission has fewer than 2⁵³ ticks"
        )]
        let share = |ticks: u64| ticks as f64 / self.ticks.max(1) as f64;
        let mean_square_m2 = if self.tracked_s > 0.0 {
            self.cross_squared_m2_s / self.tracked_s
        } else {
            0.0
        };
        MissionQuality {
            duration_s: self.duration_s,
            paused_s: self.paused_s,
            distance_m: self.distance_m,
            cross_track_rms_m: mean_square_m2.sqrt(),
            cross_track_max_m: self.cross_max_m,
            saturated_ratio: share(self.saturated_ticks),
            slip_events: self.slip_events,
            gate_reduced_ratio: share(self.reduced_ticks),
            gate_stops: self.gate_stops,
            theta: self.theta.clone(),
            prior: self.gain.report(self.distance_m),
        }
    }

    /// Returns the driven path, simplified within [`LINE_TOLERANCE_M`] and [`MOTION_TOLERANCE_M`].
    pub(crate) fn path(&self) -> DrivenPath {
        let mut whole = self.points.clone();
        if let Some(last) = self.last.filter(|last| whole.last() != Some(last)) {
            whole.push(last);
        }
        let passed = simplified(&whole);
        let wire = |passed: &PathPosition| WirePoint {
            x_m: (passed.at.x_m / RESOLUTION_M).round() * RESOLUTION_M,
            y_m: (passed.at.y_m / RESOLUTION_M).round() * RESOLUTION_M,
        };
        let time_s = |passed: &PathPosition| (passed.time_s / RESOLUTION_S).round() * RESOLUTION_S;
        DrivenPath {
            tolerance_m: self.tolerance_m.max(0.5 * self.since_point_m)
                + LINE_TOLERANCE_M
                + RESOLUTION_M,
            points: passed.iter().map(wire).collect(),
            times_s: passed.iter().map(time_s).collect(),
        }
    }
}

/// Returns the points without those within tolerance of the rest (Douglas–Peucker with
/// [`Stretch::shortfall`] as the distance).
fn simplified(points: &[PathPosition]) -> Vec<PathPosition> {
    let Some(last) = points.len().checked_sub(1) else {
        return Vec::new();
    };
    let mut keep = vec![false; points.len()];
    keep[0] = true;
    keep[last] = true;
    let mut stretches = vec![(0, last)];
    while let Some((first, last)) = stretches.pop() {
        let (from, to) = (points[first], points[last]);
        let shortfall = |index: usize| Stretch { from, to }.shortfall(points[index]);
        let inner = (first + 1..last).map(|index| (index, shortfall(index)));
        if let Some((farthest, missed)) = inner.max_by(|a, b| a.1.total_cmp(&b.1))
            && missed > 1.0
        {
            keep[farthest] = true;
            stretches.push((first, farthest));
            stretches.push((farthest, last));
        }
    }
    let kept = points.iter().zip(keep).filter(|(_, keep)| *keep);
    kept.map(|(passed, _)| *passed).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn tick(at: Point, driven_m: f64, cross_track_m: f64) -> TickRecord {
        TickRecord {
            dt_s: 0.01,
            at: Some(at),
            driven_m,
            cross_track_m: Some(cross_track_m),
            is_saturated: false,
            is_paused: false,
            slips: false,
            gate: None,
            theta_loop: Some(0.4),
            theta_measured: None,
            ground: GroundRecord::default(),
        }
    }

    fn distance_from_path_m(point: Point, path: &DrivenPath) -> f64 {
        let passed = |point: &WirePoint| PathPosition {
            at: Point {
                x_m: point.x_m,
                y_m: point.y_m,
            },
            time_s: 0.0,
        };
        let lines = path.points.windows(2);
        lines
            .map(|pair| {
                let (from, to) = (passed(&pair[0]), passed(&pair[1]));
                Stretch { from, to }.distance_m(point)
            })
            .fold(f64::INFINITY, f64::min)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn a_path_of_any_length_is_bounded_and_keeps_the_tolerance_that_it_states(
            steps in prop::collection::vec((0.0..0.03_f64, -0.4..0.4_f64), 2..60),
            repeats in 1..400_usize,
        ) {
            let mut driven = Driven::new();
            let (mut at, mut heading_rad, mut travelled) = (Point::default(), 0.0_f64, Vec::new());
            for _ in 0..repeats {
                for &(step_m, turn_rad) in &steps {
                    heading_rad += turn_rad;
                    at.x_m += step_m * heading_rad.cos();
                    at.y_m += step_m * heading_rad.sin();
                    driven.add(&tick(at, step_m, 0.0));
                    travelled.push(at);
                }
            }
            let path = driven.path();
            prop_assert!((1..=DRIVEN_POINTS_MAX).contains(&path.points.len()));
            prop_assert!(path.has_possible_times() && !path.times_s.is_empty());
            prop_assert!(driven.quality().theta.len() <= THETA_SAMPLES_MAX);
            if path.points.len() > 1 {
                for point in travelled.iter().step_by(1 + travelled.len() / 200) {
                    let off_m = distance_from_path_m(*point, &path);
                    prop_assert!(off_m <= path.tolerance_m + 1.0e-9, "{off_m} {}", path.tolerance_m);
                }
            }
        }
    }

    #[test]
    fn a_straight_kilometre_is_its_two_ends() {
        let mut driven = Driven::new();
        for step in 0..100_000_u32 {
            let x_m = 0.01 * f64::from(step);
            driven.add(&tick(Point { x_m, y_m: 2.0 }, 0.01, 0.02));
        }
        let path = driven.path();
        assert_eq!(path.points.len(), 2, "{:?}", path.points);
        assert!((path.points[1].x_m - 999.99).abs() < 1.0e-6);
        let quality = driven.quality();
        assert!((quality.cross_track_rms_m - 0.02).abs() < 1.0e-9);
        assert!((quality.distance_m - 1_000.0).abs() < 1.0e-6);
        assert!((32..=THETA_SAMPLES_MAX).contains(&quality.theta.len()));
        let far = quality.theta.last().unwrap().driven_m;
        assert!(far > 900.0, "θ was traced to {far} m only");
    }

    #[test]
    fn a_pause_is_seen_in_the_times_and_motion_between_two_points_is_even() {
        let mut driven = Driven::new();
        let mut at = Point::default();
        let mut travelled = Vec::new();
        for step in 0..3_000_u32 {
            // Ten seconds ahead, ten standing, ten ahead at half the speed.
            let step_m = match step {
                0..1_000 => 0.01,
                1_000..2_000 => 0.0,
                _ => 0.005,
            };
            at.x_m += step_m;
            driven.add(&tick(at, step_m, 0.0));
            travelled.push((0.01 * f64::from(step + 1), at));
        }
        let path = driven.path();
        assert!(path.has_possible_times());
        assert!((3..=8).contains(&path.points.len()), "{path:?}");
        for (time_s, at) in travelled {
            let after = path.times_s.partition_point(|known| *known < time_s);
            let after = after.clamp(1, path.times_s.len() - 1);
            let (from_s, to_s) = (path.times_s[after - 1], path.times_s[after]);
            let share = ((time_s - from_s) / (to_s - from_s)).clamp(0.0, 1.0);
            let (from, to) = (path.points[after - 1], path.points[after]);
            let x_m = from.x_m + share * (to.x_m - from.x_m);
            // What lies between two points of the record is not known finer than they stand apart.
            let allowed_m = MOTION_TOLERANCE_M + 2.0 * POINT_SPACING_M;
            assert!(
                (x_m - at.x_m).abs() < allowed_m,
                "{time_s} s: {x_m} m, {at:?}"
            );
        }
    }

    #[test]
    fn events_are_counted_by_their_beginnings_and_shares_by_ticks() {
        let mut driven = Driven::new();
        let usual = tick(Point::default(), 0.0, 0.1);
        for step in 0..100_u32 {
            driven.add(&TickRecord {
                slips: (10..20).contains(&step) || step == 50,
                gate: match step {
                    30..40 => Some(GateCause::StaleFeedback),
                    60..70 => Some(GateCause::Acceleration),
                    _ => None,
                },
                is_saturated: step < 25,
                is_paused: step >= 90,
                cross_track_m: (step != 3).then_some(f64::from(step % 2) * 0.2),
                ..usual
            });
        }
        let quality = driven.quality();
        assert_eq!((quality.slip_events, quality.gate_stops), (2, 1));
        assert!((quality.gate_reduced_ratio - 0.2).abs() < 1.0e-12);
        assert!((quality.saturated_ratio - 0.25).abs() < 1.0e-12);
        assert!((quality.paused_s - 0.1).abs() < 1.0e-12);
        assert!((quality.cross_track_max_m - 0.2).abs() < 1.0e-12);
        let expected_m = (0.04_f64 * 49.0 / 99.0).sqrt();
        assert!((quality.cross_track_rms_m - expected_m).abs() < 1.0e-12);
    }
}
