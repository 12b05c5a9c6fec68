//! Samples a plan's path as points for display.

use tread_api::geometry::Point;
use tread_api::trajectory::{PLANNED_POINTS_MAX, PlannedPath, Trajectory};
use tread_control::plan::Plan;

use super::once_m;

/// Minimum distance between two points, metres; it is larger for long paths.
const STEP_MIN_M: f64 = 0.1;

/// Points along a plan, evenly spaced, at most [`PLANNED_POINTS_MAX`].
pub(in crate::app) fn drawn(plan: &Plan, trajectory: &Trajectory) -> PlannedPath {
    let length_m = once_m(plan, trajectory);
    #[expect(clippy::cast_precision_loss, reason = "a thousand")]
    let steps_max = (PLANNED_POINTS_MAX - 1) as f64;
    let steps = (length_m / STEP_MIN_M).ceil().clamp(1.0, steps_max);
    let step_m = length_m / steps;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "1 to 999"
    )]
    let points = (0..=steps as u32).map(|step| {
        let pose = plan.path().sample(f64::from(step) * step_m).pose;
        Point {
            x_m: pose.x_m,
            y_m: pose.y_m,
        }
    });
    PlannedPath {
        step_m,
        points: points.collect(),
    }
}
