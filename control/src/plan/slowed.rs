//! Where a plan is slower than it was asked to be, and what makes it so.

use crate::profile::ProfileSample;

/// What makes the robot slower than it was asked to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SlowedBy {
    /// Acceleration across the path.
    LateralAcceleration,
    /// Yaw rate.
    AngularSpeed,
    /// Wheel speed.
    WheelSpeed,
    /// Wheel or yaw acceleration where the bend changes.
    WheelAcceleration,
    /// Acceleration or braking along the path.
    LinearAcceleration,
    /// What the ground is known to give, along or across the path.
    Traction,
}

/// A stretch of the path on which one limit makes the robot slower than it was asked to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slowed {
    /// Which limit.
    pub by: SlowedBy,
    /// Arc length of its begin, metres.
    pub from_m: f64,
    /// Arc length of its end, metres.
    pub to_m: f64,
    /// Slowest speed of the stretch, metres per second.
    pub speed_min_m_s: f64,
}

/// Most stretches that a plan names.
pub const SLOWED_MAX: usize = 1_000;
/// A robot this near to the speed that was asked for counts as driving it.
const AS_ASKED: f64 = 0.98;
/// What lies nearer than this to the same limit is one stretch, metres at rest.
const STRETCH_GAP_M: f64 = 0.08;
/// The same for a moving robot, seconds.
const STRETCH_GAP_S: f64 = 0.2;

/// What holds in one cell of the timing.
#[derive(Debug, Clone, Copy)]
pub(super) struct CellBounds {
    /// Speed that was asked for, metres per second.
    pub asked_m_s: f64,
    /// Speed that the limits leave, metres per second.
    pub left_m_s: f64,
    /// The limit that leaves less than was asked for.
    pub by: Option<SlowedBy>,
    /// The limit to blame where the robot has yet to reach, or already leaves, the speed that the place
    /// itself would allow.
    pub longitudinal: SlowedBy,
}

/// The stretches of a plan, gathered in driving order.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Stretches {
    slowed: Vec<Slowed>,
}

impl Stretches {
    /// Takes the planned speed at one place.
    pub(super) fn note(&mut self, timing: &ProfileSample, cell: &CellBounds) {
        let ProfileSample {
            arc_m, speed_m_s, ..
        } = *timing;
        if speed_m_s >= AS_ASKED * cell.asked_m_s {
            return;
        }
        let is_near = speed_m_s >= AS_ASKED * AS_ASKED * cell.left_m_s;
        let by = cell.by.filter(|_| is_near).unwrap_or(cell.longitudinal);
        let reach_m = STRETCH_GAP_M + STRETCH_GAP_S * speed_m_s;
        let has_room = self.slowed.len() < SLOWED_MAX;
        match self.slowed.last_mut() {
            Some(last) if last.by == by && arc_m - last.to_m <= reach_m => {
                last.to_m = arc_m;
                last.speed_min_m_s = last.speed_min_m_s.min(speed_m_s);
            }
            _ if has_room => self.slowed.push(Slowed {
                by,
                from_m: arc_m,
                to_m: arc_m,
                speed_min_m_s: speed_m_s,
            }),
            _ => {}
        }
    }

    /// In driving order.
    pub(super) fn as_slice(&self) -> &[Slowed] {
        &self.slowed
    }
}
