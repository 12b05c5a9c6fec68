//! Stretches on which a plan is slower than requested, and the limit that causes each.

use crate::profile::ProfileSample;

/// Limit that keeps the speed below the requested one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SlowedBy {
    /// Lateral acceleration.
    LateralAcceleration,
    /// Turn rate of the body.
    AngularSpeed,
    /// Wheel speed.
    WheelSpeed,
    /// Wheel or yaw acceleration where the curvature changes.
    WheelAcceleration,
    /// Acceleration or deceleration along the path.
    LinearAcceleration,
    /// Traction limit of the ground, along or across the path.
    Traction,
}

/// Stretch of the path on which one limit keeps the speed below the requested one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slowed {
    /// Cause.
    pub by: SlowedBy,
    /// Arc length of its start, metres.
    pub from_m: f64,
    /// Arc length of its end, metres.
    pub to_m: f64,
    /// Lowest planned speed on the stretch, metres per second.
    pub speed_min_m_s: f64,
}

/// Maximum number of stretches that a plan reports; further ones are dropped.
pub const SLOWED_MAX: usize = 1_000;
/// Ratio of planned to requested speed from which the plan counts as not slowed.
const UNSLOWED_RATIO: f64 = 0.98;
/// Distance below which stretches of the same cause are merged, at zero speed, metres.
const STRETCH_GAP_M: f64 = 0.08;
/// Addition to [`STRETCH_GAP_M`] per speed, seconds.
const STRETCH_GAP_S: f64 = 0.2;

/// Requested and allowed speed in one cell of the timing.
#[derive(Debug, Clone, Copy)]
pub(super) struct CellBounds {
    /// Requested speed, metres per second.
    pub requested_m_s: f64,
    /// Speed that the limits at this cell allow, metres per second.
    pub allowed_m_s: f64,
    /// Limit that keeps the allowed speed below the requested one; None if there is none.
    pub by: Option<SlowedBy>,
    /// Cause to report where the plan is slower than this cell allows, because the robot
    /// accelerates or brakes.
    pub longitudinal: SlowedBy,
}

/// Stretches of a plan in driving order.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Stretches {
    slowed: Vec<Slowed>,
}

impl Stretches {
    /// Adds the planned speed at one point of the path.
    pub(super) fn record(&mut self, timing: &ProfileSample, cell: &CellBounds) {
        let ProfileSample {
            arc_m, speed_m_s, ..
        } = *timing;
        if speed_m_s >= UNSLOWED_RATIO * cell.requested_m_s {
            return;
        }
        let is_near = speed_m_s >= UNSLOWED_RATIO * UNSLOWED_RATIO * cell.allowed_m_s;
        let by = cell.by.filter(|_| is_near).unwrap_or(cell.longitudinal);
        let gap_max_m = STRETCH_GAP_M + STRETCH_GAP_S * speed_m_s;
        let has_space = self.slowed.len() < SLOWED_MAX;
        match self.slowed.last_mut() {
            Some(last) if last.by == by && arc_m - last.to_m <= gap_max_m => {
                last.to_m = arc_m;
                last.speed_min_m_s = last.speed_min_m_s.min(speed_m_s);
            }
            _ if has_space => self.slowed.push(Slowed {
                by,
                from_m: arc_m,
                to_m: arc_m,
                speed_min_m_s: speed_m_s,
            }),
            _ => {}
        }
    }

    /// Returns the stretches in driving order.
    pub(super) fn as_slice(&self) -> &[Slowed] {
        &self.slowed
    }
}
