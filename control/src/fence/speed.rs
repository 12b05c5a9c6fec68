//! Speed limit that keeps a robot inside its fence.
//!
//! The limit is the speed from which the robot still stops within its free distance `d`,
//! `v t + v²/2a = d`, with the reaction time `t` and the deceleration `a` that the lower bound of
//! friction allows. A robot outside may only drive slowly to where its clearance increases, or
//! turn on the spot.

use super::{Fence, MARGIN_M, disc_radius_m};
use crate::geometry::{Pose, Twist};
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Number of standard deviations of the position that are added to the margin.
pub const MARGIN_STD_DEVS: f64 = 2.0;
/// Maximum speed on the way back inside, metres per second.
pub const RETURN_MAX_M_S: f64 = 0.15;
/// Friction coefficient assumed on ground of unknown friction.
pub const MU_UNKNOWN: f64 = 0.15;
/// Time from a decision until the wheels brake, seconds: one period of the slowest loop, the servo
/// lag, and the age of the position.
pub const REACTION_S: f64 = 0.20;
/// Maximum number of steps along an arc; what lies beyond counts as not free.
const STEPS_MAX: u32 = 24;
/// Clearance below which a point counts as not free, metres.
const STEP_MIN_M: f64 = 0.005;
/// Distance ahead at which a robot outside checks that its clearance increases, metres.
const RETURN_STEP_M: f64 = 0.05;

/// Input of [`Fence::limit_speed`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FenceInput {
    /// Robot pose in the site frame.
    pub pose: Pose,
    /// Standard deviation of the position per axis, metres; a non-finite value stops the robot.
    pub position_std_dev_m: f64,
    /// Measured twist, body frame.
    pub present: Twist,
    /// Commanded twist before the limit, body frame.
    pub requested: Twist,
    /// Lower bound of the ground's friction coefficient; None, or a value not above zero, acts as
    /// [`MU_UNKNOWN`].
    pub mu_lower: Option<f64>,
}

/// Clearance of a robot, and the speed limit of its fence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FenceLimit {
    /// Distance from the robot's disc, enlarged by the margin and twice the standard deviation of
    /// the position, to the fence, metres; negative outside, ∞ without a fence, −∞ for input that
    /// is not finite.
    pub clearance_m: f64,
    /// Maximum magnitude of the forward speed, metres per second; None if the robot stops before
    /// the fence anyway.
    pub speed_max_m_s: Option<f64>,
}

/// Braking of a robot with a deceleration that the ground certainly allows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Braking {
    /// Deceleration, metres per second squared, above 0.
    pub deceleration_m_s2: f64,
}

impl Braking {
    /// Returns the deceleration that is certain with `mu_lower`, the lower bound of the ground's
    /// friction coefficient μ: the smaller of the robot's acceleration limit and half of `μg`; the
    /// other half is left for steering. None, or a value not above zero, acts as [`MU_UNKNOWN`].
    pub fn guaranteed(model: &RobotModel, mu_lower: Option<f64>) -> Self {
        let mu = mu_lower
            .filter(|mu| mu.is_finite() && *mu > 0.0)
            .unwrap_or(MU_UNKNOWN);
        let own_m_s2 = model.limits().linear_acceleration_max_m_s2;
        Self {
            deceleration_m_s2: own_m_s2.min(0.5 * mu * GRAVITY_M_S2),
        }
    }

    /// Returns the distance from a decision at a speed of either sign until the robot stands, with
    /// the reaction time t = [`REACTION_S`]: `v t + v²/2a`, metres.
    pub fn stopping_distance_m(self, speed_m_s: f64) -> f64 {
        let speed_m_s = speed_m_s.abs();
        speed_m_s * REACTION_S + speed_m_s * speed_m_s / (2.0 * self.deceleration_m_s2)
    }

    /// Returns the maximum speed from which the robot stops within a distance, metres per second:
    /// the inverse of [`Self::stopping_distance_m`]. A negative distance counts as 0.
    pub fn speed_within_m_s(self, distance_m: f64) -> f64 {
        let delay_m_s = self.deceleration_m_s2 * REACTION_S;
        let free_m2_s2 = 2.0 * self.deceleration_m_s2 * distance_m.max(0.0);
        (delay_m_s * delay_m_s + free_m2_s2).sqrt() - delay_m_s
    }
}

/// Arc of constant curvature, positive to the left; a negative distance is driven backwards.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arc {
    pub(super) curvature_1_m: f64,
    pub(super) distance_m: f64,
}

/// Returns the pose at the end of an arc that starts at `pose`.
pub(super) fn along_arc(pose: Pose, arc: Arc) -> Pose {
    let Arc {
        curvature_1_m,
        distance_m,
    } = arc;
    let turn_rad = curvature_1_m * distance_m;
    let middle_rad = pose.heading_rad + 0.5 * turn_rad;
    // Chord of the arc: sin(x)/x of half the turn.
    let half_rad = 0.5 * turn_rad;
    let chord_m = if half_rad.abs() < 1.0e-6 {
        distance_m
    } else {
        distance_m * half_rad.sin() / half_rad
    };
    Pose {
        x_m: pose.x_m + chord_m * middle_rad.cos(),
        y_m: pose.y_m + chord_m * middle_rad.sin(),
        heading_rad: pose.heading_rad + turn_rad,
    }
}

/// Disc around a robot.
#[derive(Debug, Clone, Copy)]
struct Disc {
    pose: Pose,
    radius_m: f64,
}

impl Fence {
    /// Returns the free distance of a disc along the arc of a twist, metres, at most `most_m`; 0
    /// outside. Steps as far as the clearance, which falls by at most the distance driven (sphere
    /// tracing).
    fn free_distance_m(&self, disc: Disc, twist: Twist, most_m: f64) -> f64 {
        if twist.linear_m_s.abs() < 1.0e-6 {
            return most_m;
        }
        let curvature_1_m = twist.angular_rad_s / twist.linear_m_s;
        let direction = twist.linear_m_s.signum();
        let mut distance_m = 0.0;
        for _ in 0..STEPS_MAX {
            let at = along_arc(
                disc.pose,
                Arc {
                    curvature_1_m,
                    distance_m: direction * distance_m,
                },
            );
            let clearance_m = self.clearance_m(at.point()) - disc.radius_m;
            if clearance_m < STEP_MIN_M {
                return distance_m;
            }
            distance_m += clearance_m;
            if distance_m >= most_m {
                return most_m;
            }
        }
        distance_m
    }

    /// Returns whether a motion of a robot outside increases the clearance of its centre, which is
    /// `clearance_m`, or leaves the disc in place.
    fn returns_inside(&self, pose: Pose, twist: Twist, clearance_m: f64) -> bool {
        if twist.linear_m_s.abs() < 1.0e-6 {
            // Turning on the spot leaves the disc where it is.
            return true;
        }
        let curvature_1_m = twist.angular_rad_s / twist.linear_m_s;
        let step = Arc {
            curvature_1_m,
            distance_m: RETURN_STEP_M.copysign(twist.linear_m_s),
        };
        let next = along_arc(pose, step);
        self.clearance_m(next.point()) > clearance_m + 0.1 * RETURN_STEP_M
    }

    /// Computes the clearance, and the speed limit from the free distance along both the present
    /// and the requested arc. A robot outside is limited to [`RETURN_MAX_M_S`] where its motion
    /// increases the clearance, else to 0. Input that is not finite gives a limit of 0; an empty
    /// fence gives none.
    pub fn limit_speed(&self, input: &FenceInput, model: &RobotModel) -> FenceLimit {
        if self.is_empty() {
            return FenceLimit {
                clearance_m: f64::INFINITY,
                speed_max_m_s: None,
            };
        }
        let stop = FenceLimit {
            clearance_m: f64::NEG_INFINITY,
            speed_max_m_s: Some(0.0),
        };
        if !(input.pose.is_finite() && input.present.is_finite() && input.requested.is_finite()) {
            return stop;
        }
        if !input.position_std_dev_m.is_finite() {
            return stop;
        }
        let radius_m =
            disc_radius_m(model) + MARGIN_M + MARGIN_STD_DEVS * input.position_std_dev_m.max(0.0);
        let centre_clearance_m = self.clearance_m(input.pose.point());
        let clearance_m = centre_clearance_m - radius_m;
        let cap = |most_m_s: f64| FenceLimit {
            clearance_m,
            speed_max_m_s: Some(most_m_s),
        };
        if clearance_m < STEP_MIN_M {
            return cap(
                if self.returns_inside(input.pose, input.requested, centre_clearance_m) {
                    RETURN_MAX_M_S
                } else {
                    0.0
                },
            );
        }
        let braking = Braking::guaranteed(model, input.mu_lower);
        let fastest_m_s = input
            .present
            .linear_m_s
            .abs()
            .max(input.requested.linear_m_s.abs());
        // Farther than the stopping distance, so that the limit does not switch on and off at its
        // edge.
        let lookahead_m = 1.2 * braking.stopping_distance_m(fastest_m_s);
        if clearance_m >= lookahead_m {
            return FenceLimit {
                clearance_m,
                speed_max_m_s: None,
            };
        }
        let disc = Disc {
            pose: input.pose,
            radius_m,
        };
        let free_m = [input.present, input.requested]
            .into_iter()
            .map(|twist| self.free_distance_m(disc, twist, lookahead_m))
            .fold(lookahead_m, f64::min);
        if free_m >= lookahead_m {
            return FenceLimit {
                clearance_m,
                speed_max_m_s: None,
            };
        }
        cap(braking.speed_within_m_s(free_m))
    }
}
