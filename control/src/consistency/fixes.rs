//! Position fixes against dead reckoning: jumps at once, speeds and turn rates over a span.
//!
//! Each half of a span gives the median of what fixes and dead reckoning differ by, so that one
//! wild fix moves neither; the difference of both medians over the time between them is a speed.

use super::history::{Edge, History};
use crate::geometry::{Point, Pose, wrap_angle_rad};
use crate::localisation::FixNoise;

/// Fixes that are kept: two seconds of 20 Hz.
const FIXES: usize = 40;
/// Fewest fixes in half a span.
const HALF_MIN: usize = 3;
/// Smallest deviation of a fix that is assumed, metres and radians.
const DEVIATION_MIN: (f64, f64) = (0.02, 0.008);
/// Standard deviations that noise is let reach; spans overlap, so there are few independent ones.
const DEVIATIONS: f64 = 5.5;
/// Standard deviation of a median over that of a mean.
const MEDIAN_RATIO: f64 = 1.25;
/// Shortest jump that is one, metres; smaller ones are a matter of localisation.
const JUMP_M: f64 = 0.5;
/// The same of the heading, radians.
const JUMP_RAD: f64 = 0.5;
/// Share of the path since the last fix that wheels may err by without a jump.
const JUMP_SLIP_RATIO: f64 = 1.0;
/// Fixes in a row that must agree with each other on a jump.
const JUMP_FIXES: u32 = 3;
/// How long fixes must agree on another place of a standing robot until it is believed, seconds.
const MOVED_AFTER_S: f64 = 10.0;
/// How long fixes must be back where they are expected until a jump is over, seconds.
const BACK_AFTER_S: f64 = 1.0;

/// A fix and dead reckoning at its time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Fix {
    at_s: f64,
    pose: Pose,
    integrated: Point,
    integrated_rad: f64,
    /// How far the wheels' heading is before the gyro's, and odometry's path before the wheels'.
    wheels_lead_rad: f64,
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

    /// Where dead reckoning comes from this fix, and how far that is.
    fn carried(&self, to: &Self) -> (Pose, f64) {
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

    /// By how much the other is not where dead reckoning comes from this one: metres and radians.
    fn error(&self, other: &Self) -> (f64, f64, f64) {
        let (expected, driven_m) = self.carried(other);
        let by_gyro_rad = wrap_angle_rad(other.pose.heading_rad - expected.heading_rad);
        let by_wheels_rad =
            wrap_angle_rad(by_gyro_rad - (other.wheels_lead_rad - self.wheels_lead_rad));
        // A gyro that is wrong is no jump of the position.
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

/// How fixes say that the robot moved over a span, beside what dead reckoning says.
#[expect(clippy::struct_field_names, reason = "units stand last")]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seen {
    /// When the span's halves lie.
    pub(super) from_s: f64,
    pub(super) to_s: f64,
    /// Ahead and to the left over dead reckoning's, metres per second.
    pub(super) ahead_error_m_s: f64,
    pub(super) left_error_m_s: f64,
    /// Ahead over odometry's, where there is any, metres per second.
    pub(super) odometry_error_m_s: f64,
    /// Turn rate over the gyro's, and over the wheels', radians per second.
    pub(super) turn_error_rad_s: f64,
    pub(super) wheels_turn_error_rad_s: f64,
    /// What noise may do to them.
    pub(super) noise_m_s: f64,
    pub(super) noise_rad_s: f64,
}

/// A jump of the position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Jump {
    pub(super) by_m: f64,
    pub(super) by_rad: f64,
}

/// The fixes of late.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fixes {
    ring: [Fix; FIXES],
    count: usize,
    newest: usize,
    deviations: (f64, f64),
    /// When the newest was measured, used or not; older ones come too late.
    last_s: Option<f64>,
    /// The last fix where it was expected.
    anchor: Option<Fix>,
    /// The newest of fixes that agree on another place, the first one's time, and how many.
    elsewhere: Option<(Fix, f64, u32)>,
    jump: Option<Jump>,
    back_since_s: Option<f64>,
}

impl Default for Fixes {
    fn default() -> Self {
        Self {
            ring: [Fix::default(); FIXES],
            count: 0,
            newest: 0,
            deviations: DEVIATION_MIN,
            last_s: None,
            anchor: None,
            elsewhere: None,
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
    /// Forgets all fixes but a jump: where the robot went since, nobody knows.
    pub(super) fn restart(&mut self) {
        *self = Self {
            jump: self.jump,
            ..Self::default()
        };
    }

    /// The jump that is not over yet.
    pub(super) fn jump(&self) -> Option<Jump> {
        self.jump
    }

    /// Takes a fix; true if it is used.
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
        self.deviations = noise.map_or(DEVIATION_MIN, |noise| {
            (
                noise.position_m.max(DEVIATION_MIN.0),
                noise.heading_rad.max(DEVIATION_MIN.1),
            )
        });
        if self.last_s.is_some_and(|last_s| at_s <= last_s) {
            return false;
        }
        self.last_s = Some(at_s);
        let fix = Fix::new(pose, &edge);
        if self.is_expected(fix) {
            self.newest = (self.newest + 1) % FIXES;
            self.ring[self.newest] = fix;
            self.count = (self.count + 1).min(FIXES);
            true
        } else {
            false
        }
    }

    /// Whether a fix is where the last one and dead reckoning let it be.
    fn is_expected(&mut self, fix: Fix) -> bool {
        let Some(anchor) = self.anchor else {
            self.anchor = Some(fix);
            return true;
        };
        let (position_m, heading_rad) = self.deviations;
        let agrees = |from: &Fix| {
            let (by_m, by_rad, driven_m) = from.error(&fix);
            let most_m =
                JUMP_M.max(2.0 * DEVIATIONS * position_m) + JUMP_SLIP_RATIO * driven_m.min(2.0);
            by_m <= most_m && by_rad.abs() <= JUMP_RAD.max(2.0 * DEVIATIONS * heading_rad)
        };
        if agrees(&anchor) {
            if self.jump.is_some() {
                let since_s = *self.back_since_s.get_or_insert(fix.at_s);
                if fix.at_s - since_s < BACK_AFTER_S {
                    return false;
                }
            }
            self.forget_jump(fix);
            return true;
        }
        self.back_since_s = None;
        let (by_m, by_rad, _) = anchor.error(&fix);
        let (since_s, count) = match self.elsewhere {
            Some((last, since_s, count)) if agrees(&last) => (since_s, count + 1),
            Some(_) | None => (fix.at_s, 1),
        };
        self.elsewhere = Some((fix, since_s, count));
        if count >= JUMP_FIXES && self.jump.is_none() {
            self.jump = Some(Jump { by_m, by_rad });
        }
        if self.jump.is_some() && fix.at_s - since_s >= MOVED_AFTER_S {
            self.count = 0;
            self.forget_jump(fix);
            return true;
        }
        false
    }

    fn forget_jump(&mut self, fix: Fix) {
        self.anchor = Some(fix);
        self.elsewhere = None;
        self.jump = None;
        self.back_since_s = None;
    }

    /// What the fixes of the last `span_s` seconds say.
    pub(super) fn seen(&self, span_s: f64) -> Option<Seen> {
        let newest = self.ring[self.newest];
        let reference = newest;
        let offset_rad = |fix: &Fix| wrap_angle_rad(fix.pose.heading_rad - fix.integrated_rad);
        let reference_rad = offset_rad(&reference);
        let mut halves = [Half::default(), Half::default()];
        let mut angles = [0.0; FIXES];
        let mut used = 0;
        // The median angle first: positions are turned by it.
        for places in 0..self.count {
            let fix = &self.ring[(self.newest + FIXES - places) % FIXES];
            if newest.at_s - fix.at_s > span_s {
                break;
            }
            angles[used] = wrap_angle_rad(offset_rad(fix) - reference_rad);
            used += 1;
        }
        if used < 2 * HALF_MIN {
            return None;
        }
        let turned_rad = reference_rad + median(&mut angles[..used]);
        let (sin, cos) = turned_rad.sin_cos();
        let middle = &self.ring[(self.newest + FIXES - used / 2) % FIXES];
        let (middle_sin, middle_cos) = middle.integrated_rad.sin_cos();
        for places in 0..used {
            let fix = &self.ring[(self.newest + FIXES - places) % FIXES];
            let (x_m, y_m) = (
                fix.pose.x_m - reference.pose.x_m,
                fix.pose.y_m - reference.pose.y_m,
            );
            let east_m = cos * x_m + sin * y_m - (fix.integrated.x_m - reference.integrated.x_m);
            let north_m = cos * y_m - sin * x_m - (fix.integrated.y_m - reference.integrated.y_m);
            let ahead_m = middle_cos * east_m + middle_sin * north_m;
            let left_m = middle_cos * north_m - middle_sin * east_m;
            let turned_rad = wrap_angle_rad(offset_rad(fix) - reference_rad);
            let half = &mut halves[usize::from(2 * places >= used)];
            let odometry_m = ahead_m - (fix.odometry_lead_m - reference.odometry_lead_m);
            let by_wheels_rad = turned_rad - (fix.wheels_lead_rad - reference.wheels_lead_rad);
            half.add(
                fix.at_s,
                [ahead_m, left_m, odometry_m, turned_rad, by_wheels_rad],
            );
        }
        let [late, early] = &mut halves;
        let fewest = late.count.min(early.count);
        if fewest < HALF_MIN {
            return None;
        }
        let (to_s, late) = late.median();
        let (from_s, early) = early.median();
        let between_s = to_s - from_s;
        if between_s < 0.25 * span_s {
            return None;
        }
        let rate = |index: usize| (late[index] - early[index]) / between_s;
        #[expect(clippy::cast_precision_loss, reason = "there are few fixes")]
        let share = DEVIATIONS * MEDIAN_RATIO * (2.0 / fewest as f64).sqrt() / between_s;
        Some(Seen {
            from_s,
            to_s,
            ahead_error_m_s: rate(0),
            left_error_m_s: rate(1),
            odometry_error_m_s: rate(2),
            turn_error_rad_s: rate(3),
            wheels_turn_error_rad_s: rate(4),
            noise_m_s: share * self.deviations.0,
            noise_rad_s: share * self.deviations.1,
        })
    }
}

/// What is compared of a fix.
const COLUMNS: usize = 5;

/// Half of a span.
#[derive(Debug, Clone, Copy)]
struct Half {
    count: usize,
    at_s: f64,
    values: [[f64; FIXES]; COLUMNS],
}

impl Default for Half {
    fn default() -> Self {
        Self {
            count: 0,
            at_s: 0.0,
            values: [[0.0; FIXES]; COLUMNS],
        }
    }
}

impl Half {
    fn add(&mut self, at_s: f64, values: [f64; COLUMNS]) {
        self.at_s += at_s;
        for (column, value) in self.values.iter_mut().zip(values) {
            column[self.count] = value;
        }
        self.count += 1;
    }

    /// Mean time, and the median of each column.
    fn median(&mut self) -> (f64, [f64; COLUMNS]) {
        let count = self.count;
        #[expect(clippy::cast_precision_loss, reason = "there are few fixes")]
        let at_s = self.at_s / count as f64;
        let mut medians = [0.0; COLUMNS];
        for (found, column) in medians.iter_mut().zip(&mut self.values) {
            *found = median(&mut column[..count]);
        }
        (at_s, medians)
    }
}
