//! The speed that keeps a robot inside its fence.
//!
//! It is the fastest from which the robot still stops within its free distance `d`, `v t + v²/2a =
//! d`, with the time `t` until it brakes and the braking `a` that the ground's lower bound of
//! friction surely gives. Outside already, only motion that gains clearance is let through, slowly.

use super::{Fence, MARGIN_M, disc_radius_m};
use crate::geometry::{Pose, Twist};
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Standard deviations of the position by which the margin grows.
pub const MARGIN_STD_DEVS: f64 = 2.0;
/// Fastest drive back in from outside, metres per second.
pub const RETURN_MAX_M_S: f64 = 0.15;
/// Friction coefficient that ground of unknown friction is taken to have.
pub const MU_UNKNOWN: f64 = 0.15;
/// Time from a decision until the wheels brake, seconds: a tick of the slowest loop, the servo,
/// and the age of the position.
pub const REACTION_S: f64 = 0.20;
/// Steps along an arc before the rest of it counts as not free.
const STEPS_MAX: u32 = 24;
/// Shortest step along an arc, metres; clearance below this counts as none.
const STEP_MIN_M: f64 = 0.005;
/// Step by which motion from outside is tried, metres.
const RETURN_STEP_M: f64 = 0.05;

/// What the cap of the speed depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FenceInput {
    /// Where the robot is.
    pub pose: Pose,
    /// Standard deviation of its position, metres.
    pub position_std_dev_m: f64,
    /// How it moves.
    pub present: Twist,
    /// How it is to move.
    pub wanted: Twist,
    /// Friction coefficient that the ground surely gives; [`MU_UNKNOWN`] when absent.
    pub mu_lower: Option<f64>,
}

/// How a robot stands to its fence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FenceVerdict {
    /// Clearance of the robot's disc with its margin, metres; below zero it is outside.
    pub clearance_m: f64,
    /// Fastest speed along its arc, metres per second; none while the fence is out of reach.
    pub speed_max_m_s: Option<f64>,
}

/// Braking that a robot has.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Braking {
    /// Deceleration, metres per second squared.
    pub deceleration_m_s2: f64,
}

impl Braking {
    /// What a robot surely has: its own limit, and half of what the ground gives, for the rest goes into
    /// steering.
    pub fn sure(model: &RobotModel, mu_lower: Option<f64>) -> Self {
        let mu = mu_lower
            .filter(|mu| mu.is_finite() && *mu > 0.0)
            .unwrap_or(MU_UNKNOWN);
        let own_m_s2 = model.limits().linear_acceleration_max_m_s2;
        Self {
            deceleration_m_s2: own_m_s2.min(0.5 * mu * GRAVITY_M_S2),
        }
    }

    /// Distance from a decision to standstill, metres.
    pub fn stopping_distance_m(self, speed_m_s: f64) -> f64 {
        let speed_m_s = speed_m_s.abs();
        speed_m_s * REACTION_S + speed_m_s * speed_m_s / (2.0 * self.deceleration_m_s2)
    }

    /// Fastest speed with which the robot stops within a distance, metres per second.
    pub fn speed_within_m_s(self, distance_m: f64) -> f64 {
        let delay_m_s = self.deceleration_m_s2 * REACTION_S;
        let free_m2_s2 = 2.0 * self.deceleration_m_s2 * distance_m.max(0.0);
        (delay_m_s * delay_m_s + free_m2_s2).sqrt() - delay_m_s
    }
}

/// A stretch of an arc; a negative distance goes backwards.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arc {
    pub(super) curvature_1_m: f64,
    pub(super) distance_m: f64,
}

/// The pose at the end of an arc that begins at a pose.
pub(super) fn along_arc(pose: Pose, arc: Arc) -> Pose {
    let Arc {
        curvature_1_m,
        distance_m,
    } = arc;
    let turn_rad = curvature_1_m * distance_m;
    let middle_rad = pose.heading_rad + 0.5 * turn_rad;
    // The chord of the arc: sin(x)/x of half the turn.
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

impl Fence {
    /// How far a disc may go along its arc, metres, at most `most_m`; 0 outside.
    fn free_distance_m(&self, pose: Pose, twist: Twist, radius_m: f64, most_m: f64) -> f64 {
        if twist.linear_m_s.abs() < 1.0e-6 {
            return most_m;
        }
        let curvature_1_m = twist.angular_rad_s / twist.linear_m_s;
        let direction = twist.linear_m_s.signum();
        let mut distance_m = 0.0;
        for _ in 0..STEPS_MAX {
            let at = along_arc(
                pose,
                Arc {
                    curvature_1_m,
                    distance_m: direction * distance_m,
                },
            );
            let clearance_m = self.clearance_m(at.point()) - radius_m;
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

    /// Whether motion from outside leads back in.
    fn leads_back(&self, pose: Pose, twist: Twist, clearance_m: f64) -> bool {
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

    /// The speed that keeps a robot inside, looking along the arc that is wanted and along the one
    /// that is driven.
    pub fn judge(&self, input: &FenceInput, model: &RobotModel) -> FenceVerdict {
        if self.is_empty() {
            return FenceVerdict {
                clearance_m: f64::INFINITY,
                speed_max_m_s: None,
            };
        }
        let all_stop = FenceVerdict {
            clearance_m: f64::NEG_INFINITY,
            speed_max_m_s: Some(0.0),
        };
        if !(input.pose.is_finite() && input.present.is_finite() && input.wanted.is_finite()) {
            return all_stop;
        }
        if !input.position_std_dev_m.is_finite() {
            return all_stop;
        }
        let radius_m =
            disc_radius_m(model) + MARGIN_M + MARGIN_STD_DEVS * input.position_std_dev_m.max(0.0);
        let here_m = self.clearance_m(input.pose.point());
        let clearance_m = here_m - radius_m;
        let cap = |most_m_s: f64| FenceVerdict {
            clearance_m,
            speed_max_m_s: Some(most_m_s),
        };
        if clearance_m < STEP_MIN_M {
            return cap(if self.leads_back(input.pose, input.wanted, here_m) {
                RETURN_MAX_M_S
            } else {
                0.0
            });
        }
        let braking = Braking::sure(model, input.mu_lower);
        let fastest_m_s = input
            .present
            .linear_m_s
            .abs()
            .max(input.wanted.linear_m_s.abs());
        // A little more than is needed, so that the cap does not flicker at its own edge.
        let reach_m = 1.2 * braking.stopping_distance_m(fastest_m_s);
        if clearance_m >= reach_m {
            return FenceVerdict {
                clearance_m,
                speed_max_m_s: None,
            };
        }
        let free_m = [input.present, input.wanted]
            .into_iter()
            .map(|twist| self.free_distance_m(input.pose, twist, radius_m, reach_m))
            .fold(reach_m, f64::min);
        if free_m >= reach_m {
            return FenceVerdict {
                clearance_m,
                speed_max_m_s: None,
            };
        }
        cap(braking.speed_within_m_s(free_m))
    }
}
