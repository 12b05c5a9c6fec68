//! Compares position fixes with dead reckoning: jumps immediately, speeds and turn rates over a
//! span.
//!
//! The difference between fixes and dead reckoning is fitted, by least squares, with a straight
//! line that bends where the span begins:
//! ```text
//! e(t) = a + s·t + b·max(0, t − begin)      s ~ N(0, usual error), a and b free
//! ```
//! The fixes before the span determine its start better than those in it could, so that a fault
//! that began with the span shows soon; `s + b` is the difference of speed in the span. A single
//! outlier between two fixes that agree is left out, and deviations from the line count as noise.

use super::history::{Edge, History, Span};
use crate::geometry::{Point, Pose, wrap_angle_rad};
use crate::localisation::FixNoise;

/// Number of fixes kept: the longest span and [`BEFORE_S`] at 20 Hz.
const FIXES: usize = 52;
/// Minimum number of fixes in a span, and minimum number of these and those in [`BEFORE_S`]
/// together.
const FIXES_MIN: (usize, usize) = (3, 5);
/// Time before a span whose fixes are used too, seconds.
const BEFORE_S: f64 = 0.6;
/// Usual difference between fixes and healthy channels, metres per second and radians per second:
/// slip, and the gyro's offset.
const USUAL: (f64, f64) = (0.06, 0.03);
/// Random walk of the fixes' error, metres and radians per square root of a second: part of their
/// noise is correlated.
const DRIFT: (f64, f64) = (0.01, 0.002);
/// Number of standard deviations from both neighbours above which a fix is an outlier.
const OUTLIER_STD_DEVS: f64 = 6.0;
/// Minimum standard deviation of a fix, metres and radians.
const STD_DEV_MIN: (f64, f64) = (0.02, 0.008);
/// Number of standard deviations of noise that are tolerated; spans overlap, so few are
/// independent.
const STD_DEVS: f64 = 4.3;
/// Number of standard deviations that are tolerated in spans shorter than [`SHORT_S`] seconds.
const STD_DEVS_SHORT: f64 = 5.0;
const SHORT_S: f64 = 0.5;
/// Minimum jump of the position, metres; smaller ones are left to localisation.
const JUMP_M: f64 = 0.5;
/// Minimum jump of the heading, radians.
const JUMP_RAD: f64 = 0.5;
/// Tolerated error of dead reckoning as a fraction of the distance since the last fix.
const JUMP_SLIP_RATIO: f64 = 1.0;
/// Number of consecutive fixes that must agree with each other to confirm a jump.
const JUMP_FIXES: u32 = 3;
/// Time for which fixes must agree on another position of the robot until it is accepted, seconds.
const MOVED_AFTER_S: f64 = 10.0;
/// Time for which fixes must be back at the expected position until a jump is over, seconds.
const BACK_AFTER_S: f64 = 1.0;

/// Position fix, and dead reckoning at its time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Fix {
    at_s: f64,
    pose: Pose,
    /// Position and heading by dead reckoning with wheels and gyro.
    integrated: Point,
    integrated_rad: f64,
    /// Heading by wheels minus heading by gyro, radians.
    wheels_lead_rad: f64,
    /// Distance by odometry minus distance by wheels, metres.
    odometry_lead_m: f64,
}

impl Fix {
    fn new(pose: Pose, edge: &Edge) -> Self {
        Self {
            at_s: edge.at_s,
            pose,
            integrated: edge.at,
            integrated_rad: edge.heading_rad(),
            wheels_lead_rad: edge.wheels_lead_rad(),
            odometry_lead_m: edge.odometry_lead_m(),
        }
    }

    /// Propagates this fix to the time of `to` by dead reckoning. Returns the pose in the site
    /// frame, and the distance between both positions by dead reckoning, metres.
    fn propagated(&self, to: &Self) -> (Pose, f64) {
        let offset_rad = self.pose.heading_rad - self.integrated_rad;
        let (sin, cos) = offset_rad.sin_cos();
        let (x_m, y_m) = (
            to.integrated.x_m - self.integrated.x_m,
            to.integrated.y_m - self.integrated.y_m,
        );
        let pose = Pose {
            x_m: self.pose.x_m + cos * x_m - sin * y_m,
            y_m: self.pose.y_m + sin * x_m + cos * y_m,
            heading_rad: to.integrated_rad + offset_rad,
        };
        (pose, x_m.hypot(y_m))
    }

    /// Compares `other` with the pose propagated from this fix. Returns distance, metres, heading
    /// difference, radians, and the distance between both positions by dead reckoning, metres.
    fn error(&self, other: &Self) -> (f64, f64, f64) {
        let (expected, driven_m) = self.propagated(other);
        let by_gyro_rad = wrap_angle_rad(other.pose.heading_rad - expected.heading_rad);
        let by_wheels_rad =
            wrap_angle_rad(by_gyro_rad - (other.wheels_lead_rad - self.wheels_lead_rad));
        // The smaller heading error counts, so that a wrong gyro is no jump of the position.
        let by_rad = if by_wheels_rad.abs() < by_gyro_rad.abs() {
            by_wheels_rad
        } else {
            by_gyro_rad
        };
        (
            expected.point().distance_m(other.pose.point()),
            by_rad,
            driven_m,
        )
    }
}

/// Residual of fixes over a span: motion by fixes minus motion by dead reckoning.
#[expect(clippy::struct_field_names, reason = "units stand last")]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FixResidual {
    /// Start and end of the span, seconds.
    pub(super) from_s: f64,
    pub(super) to_s: f64,
    /// Forward and lateral speed by fixes minus that by dead reckoning, metres per second.
    pub(super) forward_error_m_s: f64,
    pub(super) left_error_m_s: f64,
    /// Forward speed by fixes minus that by odometry, metres per second; meaningless without
    /// odometry.
    pub(super) odometry_error_m_s: f64,
    /// Turn rate by fixes minus that by gyro, and minus that by wheels, radians per second.
    pub(super) turn_error_rad_s: f64,
    pub(super) wheels_turn_error_rad_s: f64,
    /// Tolerated noise of the speeds against dead reckoning and odometry, and of the turn rates
    /// against gyro and wheels.
    pub(super) noise_m_s: f64,
    pub(super) odometry_noise_m_s: f64,
    pub(super) noise_rad_s: f64,
    pub(super) wheels_noise_rad_s: f64,
}

impl FixResidual {
    /// Returns the span over which it was computed.
    pub(super) fn span(&self) -> Span {
        Span {
            from_s: self.from_s,
            to_s: self.to_s,
        }
    }
}

/// Jump of the fixes relative to dead reckoning: distance and heading difference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Jump {
    pub(super) by_m: f64,
    pub(super) by_rad: f64,
}

/// Recent fixes in a ring buffer, and the state of a jump.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fixes {
    recent: [Fix; FIXES],
    count: usize,
    newest: usize,
    std_devs: (f64, f64),
    /// Time of the newest fix, used or not, seconds; older fixes are ignored.
    last_s: Option<f64>,
    /// Last fix at the expected position.
    anchor: Option<Fix>,
    /// Fix at the expected position before `anchor`, used if `anchor` was an outlier.
    before: Option<Fix>,
    /// Number of fixes at the expected position since the start.
    agreed: u32,
    /// Newest of the fixes that agree on another position, time of the first one, and their number.
    other_position: Option<(Fix, f64, u32)>,
    jump: Option<Jump>,
    back_since_s: Option<f64>,
}

impl Default for Fixes {
    fn default() -> Self {
        Self {
            recent: [Fix::default(); FIXES],
            count: 0,
            newest: 0,
            std_devs: STD_DEV_MIN,
            last_s: None,
            anchor: None,
            before: None,
            agreed: 0,
            other_position: None,
            jump: None,
            back_since_s: None,
        }
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let middle = values.len() / 2;
    if values.len().is_multiple_of(2) {
        0.5 * (values[middle - 1] + values[middle])
    } else {
        values[middle]
    }
}

impl Fixes {
    /// Clears all fixes but keeps a jump: the motion since is unknown.
    pub(super) fn restart(&mut self) {
        *self = Self {
            jump: self.jump,
            ..Self::default()
        };
    }

    /// Returns the newest fix that is used.
    pub(super) fn newest(&self) -> Option<Pose> {
        (self.count > 0).then(|| self.recent[self.newest].pose)
    }

    /// Returns the standard deviations of a fix, metres and radians.
    pub(super) fn std_devs(&self) -> (f64, f64) {
        self.std_devs
    }

    /// Returns the jump that is not over yet.
    pub(super) fn jump(&self) -> Option<Jump> {
        self.jump
    }

    /// Adds a fix measured at `at_s`, site frame; returns whether it is used. It is not if the
    /// history does not reach back to it, if it is not newer than the last one, if it is off the
    /// expected position, or until a jump is over.
    pub(super) fn take(
        &mut self,
        at_s: f64,
        pose: Pose,
        noise: Option<FixNoise>,
        history: &History,
    ) -> bool {
        let Some(edge) = history.at(at_s) else {
            return false;
        };
        self.std_devs = noise.map_or(STD_DEV_MIN, |noise| {
            (
                noise.position_m.max(STD_DEV_MIN.0),
                noise.heading_rad.max(STD_DEV_MIN.1),
            )
        });
        if self.last_s.is_some_and(|last_s| at_s <= last_s) {
            return false;
        }
        self.last_s = Some(at_s);
        let fix = Fix::new(pose, &edge);
        if self.is_expected(fix) {
            self.newest = (self.newest + 1) % FIXES;
            self.recent[self.newest] = fix;
            self.count = (self.count + 1).min(FIXES);
            true
        } else {
            false
        }
    }

    /// Returns whether a fix is at the position expected by dead reckoning from the last one, and
    /// updates the jump.
    fn is_expected(&mut self, fix: Fix) -> bool {
        let Some(anchor) = self.anchor else {
            self.anchor = Some(fix);
            return true;
        };
        let (position_m, heading_rad) = self.std_devs;
        let agrees = |from: &Fix| {
            let (by_m, by_rad, driven_m) = from.error(&fix);
            let most_m =
                JUMP_M.max(2.0 * STD_DEVS * position_m) + JUMP_SLIP_RATIO * driven_m.min(2.0);
            by_m <= most_m && by_rad.abs() <= JUMP_RAD.max(2.0 * STD_DEVS * heading_rad)
        };
        let with_newest = agrees(&anchor);
        if with_newest || self.before.is_some_and(|before| agrees(&before)) {
            if self.jump.is_some() {
                let since_s = *self.back_since_s.get_or_insert(fix.at_s);
                if fix.at_s - since_s < BACK_AFTER_S {
                    return false;
                }
            }
            if with_newest {
                self.before = Some(anchor);
            }
            self.clear_jump(fix);
            self.agreed = self.agreed.saturating_add(1);
            return true;
        }
        self.back_since_s = None;
        let (by_m, by_rad, _) = anchor.error(&fix);
        let (since_s, count) = match self.other_position {
            Some((last, since_s, count)) if agrees(&last) => (since_s, count + 1),
            Some(_) | None => (fix.at_s, 1),
        };
        self.other_position = Some((fix, since_s, count));
        if count >= JUMP_FIXES && self.agreed < JUMP_FIXES && self.jump.is_none() {
            // The first of all fixes was the outlier.
            self.count = 0;
            self.before = None;
            self.clear_jump(fix);
            return true;
        }
        if count >= JUMP_FIXES && self.jump.is_none() {
            self.jump = Some(Jump { by_m, by_rad });
        }
        if self.jump.is_some() && fix.at_s - since_s >= MOVED_AFTER_S {
            self.count = 0;
            self.before = None;
            self.clear_jump(fix);
            return true;
        }
        false
    }

    fn clear_jump(&mut self, fix: Fix) {
        self.anchor = Some(fix);
        self.other_position = None;
        self.jump = None;
        self.back_since_s = None;
    }

    /// Fits the residual over the last `span_s` seconds; None with too few fixes, or if the fit is
    /// singular.
    pub(super) fn residual(&self, span_s: f64) -> Option<FixResidual> {
        let newest = self.recent[self.newest];
        let fix = |places: usize| &self.recent[(self.newest + FIXES - places) % FIXES];
        let age_s = |places: usize| newest.at_s - fix(places).at_s;
        let within = |most_s: f64| {
            (0..self.count)
                .take_while(|places| age_s(*places) <= most_s + 1.0e-9)
                .count()
        };
        let (in_span, used) = (within(span_s), within(span_s + BEFORE_S));
        if in_span < FIXES_MIN.0 || used < FIXES_MIN.1 || age_s(in_span - 1) < 0.6 * span_s {
            return None;
        }
        // The median angle first: positions are rotated by it.
        let offset_rad = |fix: &Fix| wrap_angle_rad(fix.pose.heading_rad - fix.integrated_rad);
        let reference_rad = offset_rad(&newest);
        let mut angles = [0.0; FIXES];
        for (places, angle) in angles.iter_mut().enumerate().take(in_span) {
            *angle = wrap_angle_rad(offset_rad(fix(places)) - reference_rad);
        }
        let turned_rad = reference_rad + median(&mut angles[..in_span]);
        let (sin, cos) = turned_rad.sin_cos();
        let (middle_sin, middle_cos) = fix(in_span / 2).integrated_rad.sin_cos();
        let mut errors = [[0.0; COLUMNS]; FIXES];
        let mut times_s = [0.0; FIXES];
        for places in 0..used {
            let fix = fix(places);
            let (x_m, y_m) = (
                fix.pose.x_m - newest.pose.x_m,
                fix.pose.y_m - newest.pose.y_m,
            );
            let east_m = cos * x_m + sin * y_m - (fix.integrated.x_m - newest.integrated.x_m);
            let north_m = cos * y_m - sin * x_m - (fix.integrated.y_m - newest.integrated.y_m);
            let forward_m = middle_cos * east_m + middle_sin * north_m;
            let left_m = middle_cos * north_m - middle_sin * east_m;
            let turned_rad = wrap_angle_rad(offset_rad(fix) - reference_rad);
            times_s[places] = fix.at_s - newest.at_s;
            errors[places] = [
                forward_m,
                left_m,
                forward_m - (fix.odometry_lead_m - newest.odometry_lead_m),
                turned_rad,
                turned_rad - (fix.wheels_lead_rad - newest.wheels_lead_rad),
            ];
        }
        let (position_m, heading_rad) = self.std_devs;
        let fit = |column: usize| {
            let (std_dev, slope_std_dev) = if column < HEADING {
                (position_m, USUAL.0)
            } else {
                (heading_rad, USUAL.1)
            };
            let points = (0..used).map(|places| (times_s[places], errors[places][column]));
            let away = |one: usize, other: usize| errors[one][column] - errors[other][column];
            let most = OUTLIER_STD_DEVS * std_dev;
            let is_outlier = |places: usize| match places {
                // The newest fix has one neighbour only; the next fix decides.
                0 => away(0, 1).abs() > most && away(1, 2).abs() < 0.5 * most,
                _ if places + 1 == used => false,
                _ => {
                    let (later, earlier) = (away(places, places - 1), away(places, places + 1));
                    later.abs() > most && earlier.abs() > most && later * earlier > 0.0
                }
            };
            let points = points
                .enumerate()
                .filter(|(places, _)| !is_outlier(*places))
                .map(|(_, point)| point);
            let bend = Bend {
                begin_s: -span_s,
                std_dev,
                slope_std_dev,
            };
            let (speed, std_dev) = bend.fit(points)?;
            let drift = if column < HEADING { DRIFT.0 } else { DRIFT.1 };
            Some((speed, std_dev.hypot(drift / span_s.sqrt())))
        };
        let [forward, left, odometry, turn, wheels_turn] = [0, 1, 2, 3, 4].map(fit);
        let (forward, left, odometry) = (forward?, left?, odometry?);
        let (turn, wheels_turn) = (turn?, wheels_turn?);
        // A short span has few fixes, and there are many short spans.
        let std_devs = if span_s < SHORT_S {
            STD_DEVS_SHORT
        } else {
            STD_DEVS
        };
        Some(FixResidual {
            from_s: newest.at_s - span_s,
            to_s: newest.at_s,
            forward_error_m_s: forward.0,
            left_error_m_s: left.0,
            odometry_error_m_s: odometry.0,
            turn_error_rad_s: turn.0,
            wheels_turn_error_rad_s: wheels_turn.0,
            noise_m_s: std_devs * forward.1.max(left.1),
            odometry_noise_m_s: std_devs * odometry.1,
            noise_rad_s: std_devs * turn.1,
            wheels_noise_rad_s: std_devs * wheels_turn.1,
        })
    }
}

/// Number of compared quantities of a fix, and index of the first one that is an angle.
const COLUMNS: usize = 5;
const HEADING: usize = 3;

/// Fit of a line that bends at `begin_s`.
#[derive(Debug, Clone, Copy)]
struct Bend {
    begin_s: f64,
    /// Minimum standard deviation of a point.
    std_dev: f64,
    /// Standard deviation of the slope before the bend.
    slope_std_dev: f64,
}

impl Bend {
    /// Returns the slope after the bend and its standard deviation; None if the system is singular.
    fn fit(&self, points: impl Iterator<Item = (f64, f64)> + Clone) -> Option<(f64, f64)> {
        let basis = |at_s: f64| [1.0, at_s, (at_s - self.begin_s).max(0.0)];
        let (mut normal, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
        let mut count: f64 = 0.0;
        for (at_s, value) in points.clone() {
            let row = basis(at_s);
            for i in 0..3 {
                for j in 0..3 {
                    normal[i][j] += row[i] * row[j];
                }
                right[i] += row[i] * value;
            }
            count += 1.0;
        }
        normal[1][1] += (self.std_dev / self.slope_std_dev).powi(2);
        let inverse = inverse(&normal)?;
        let solution = [0, 1, 2].map(|i| {
            let row: &[f64; 3] = &inverse[i];
            row[0] * right[0] + row[1] * right[1] + row[2] * right[2]
        });
        let residual: f64 = points
            .map(|(at_s, value)| {
                let row = basis(at_s);
                let fitted = row[0] * solution[0] + row[1] * solution[1] + row[2] * solution[2];
                (value - fitted).powi(2)
            })
            .sum();
        let variance = (residual / (count - 2.0).max(1.0)).max(self.std_dev.powi(2));
        let unit_variance = inverse[1][1] + 2.0 * inverse[1][2] + inverse[2][2];
        Some((solution[1] + solution[2], (variance * unit_variance).sqrt()))
    }
}

/// Returns the inverse of a symmetric matrix; None if it is singular.
fn inverse(matrix: &[[f64; 3]; 3]) -> Option<[[f64; 3]; 3]> {
    let minor = |row: usize, column: usize| {
        let rows = [(row + 1) % 3, (row + 2) % 3].map(|row| matrix[row]);
        let (left, right) = ((column + 1) % 3, (column + 2) % 3);
        rows[0][left] * rows[1][right] - rows[0][right] * rows[1][left]
    };
    let determinant = (0..3)
        .map(|column| matrix[0][column] * minor(0, column))
        .sum::<f64>();
    if determinant.is_nan() || determinant <= 1.0e-12 {
        return None;
    }
    Some([0, 1, 2].map(|row| [0, 1, 2].map(|column| minor(column, row) / determinant)))
}
