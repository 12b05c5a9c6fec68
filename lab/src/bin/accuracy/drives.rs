//! Drives of the part `theta`.

use tread_control::geometry::{Pose, Twist, wrap_angle_rad};
use tread_control::measured::WheelSpeeds;
use tread_control::reference::ReferenceSample;
use tread_control::tracking::{Tracker, TrackerConfig};

use crate::robot::{LOOP_S, SeededRobot};

/// A motion of the robot over one run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Drive {
    /// 10 s straight, then 25 s on a circle to the left and 25 s to the right.
    StraightThenCircles { radius_m: f64, speed_m_s: f64 },
    /// Bends that swing from side to side, for 40 s from standstill.
    Weave {
        speed_m_s: f64,
        curvature_1_m: f64,
        period_s: f64,
    },
    /// (6 sin 0.15t, 2 sin 0.3t) m for 40 s from standstill, tracked with noisy localisation.
    Figure8,
    /// Straight, from standstill to 0.6 m/s and back every 4 s, for 60 s.
    StopAndGo,
    /// Straight at 0.6 m/s; measured for 40 s from when it is steady.
    SteadyStraight,
    /// Circle of 6 m radius at 0.6 m/s; measured for 40 s from when it is steady.
    SteadyCircle,
}

/// Usual speed of all but the figure-8, metres per second.
pub(crate) const SPEED_M_S: f64 = 0.6;
/// Acceleration from and to standstill, metres per second squared.
const RAMP_M_S2: f64 = 0.5;
/// Duration of a change of curvature, seconds.
const CURVE_S: f64 = 1.0;
/// Time from the start after which a steady drive is measured, seconds.
const SETTLE_S: f64 = 6.0;
/// Duration of the figure-8's acceleration from standstill, seconds.
const GATHER_S: f64 = 3.0;

/// Result of a drive.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Driven {
    /// Number of false alarms: the ground never changes here.
    pub(crate) ground_changes: u32,
    /// Whether the estimator reported a measured θ at any time.
    pub(crate) ever_measured: bool,
    /// Whether the estimator reported new information at any time.
    pub(crate) ever_informed: bool,
    /// First reported θ and its standard deviation.
    pub(crate) first: Option<(f64, f64)>,
    /// Sums of the segments' information on θ, and of that times θ.
    pub(crate) segments: (f64, f64),
}

/// Time of a segment, seconds: about a metre.
const SEGMENT_S: f64 = 1.7;

impl Drive {
    /// Drives the motion and returns the estimator's results.
    pub(crate) fn run(self, robot: &mut SeededRobot) -> Driven {
        let (duration_s, settle_s) = match self {
            Self::StraightThenCircles { .. } | Self::StopAndGo => (60.0, None),
            Self::Figure8 | Self::Weave { .. } => (40.0, None),
            Self::SteadyStraight | Self::SteadyCircle => (SETTLE_S + 40.0, Some(SETTLE_S)),
        };
        let mut tracker = Tracker::new(robot.model, TrackerConfig::default())
            .expect("the default configuration is valid");
        let mut driven = Driven::default();
        let mut time_s = 0.0;
        let mut settles_at_s = settle_s;
        let mut segment_end_s = SEGMENT_S;
        while time_s < duration_s {
            let command = self.command(time_s, robot, &mut tracker);
            let outcome = robot.act(command);
            time_s += LOOP_S;
            if outcome.ground_changed {
                driven.ground_changes += 1;
                robot.estimator.close_segment();
                robot.estimator.begin_ground();
            }
            if settles_at_s.is_some_and(|at_s| time_s >= at_s) {
                settles_at_s = None;
                driven = Driven::default();
                robot.estimator.close_segment();
                robot.estimator.begin_ground();
            }
            if time_s > segment_end_s {
                segment_end_s += SEGMENT_S;
                let segment = robot.estimator.close_segment();
                driven.segments.0 += segment.theta_information;
                driven.segments.1 += segment.theta_weighted;
            }
            if outcome.block_done {
                let estimate = robot.estimator.estimate();
                let now = estimate.theta.map(|found| (found.theta, found.std_dev));
                driven.first = driven.first.or(now);
                driven.ever_measured |= estimate.theta.is_some();
                driven.ever_informed |= !estimate.no_new_information;
            }
        }
        driven
    }

    /// Returns the start pose of the drive, site frame.
    pub(crate) fn start(self) -> Pose {
        match self {
            Self::Figure8 => Pose {
                x_m: 0.0,
                y_m: 0.0,
                heading_rad: 0.6_f64.atan2(0.9),
            },
            Self::StraightThenCircles { .. }
            | Self::Weave { .. }
            | Self::StopAndGo
            | Self::SteadyStraight
            | Self::SteadyCircle => Pose::default(),
        }
    }

    fn command(self, time_s: f64, robot: &SeededRobot, tracker: &mut Tracker) -> WheelSpeeds {
        let straight = |linear_m_s: f64| Twist {
            linear_m_s,
            angular_rad_s: 0.0,
        };
        let gathered = |speed_m_s: f64, curvature_1_m: f64| {
            let linear_m_s = (RAMP_M_S2 * time_s).min(speed_m_s);
            Twist {
                linear_m_s,
                angular_rad_s: linear_m_s * curvature_1_m,
            }
        };
        let twist = match self {
            Self::Figure8 => {
                let reference = figure_8(time_s);
                return tracker
                    .step(&reference, &robot.measured(), None, LOOP_S)
                    .wheel_speeds;
            }
            Self::StopAndGo => {
                // Up 1.2 s, on 1 s, down 1.2 s, rest.
                let phase_s = time_s % 4.0;
                let up_m_s = RAMP_M_S2 * phase_s;
                let down_m_s = RAMP_M_S2 * (3.4 - phase_s);
                straight(up_m_s.min(down_m_s).clamp(0.0, SPEED_M_S))
            }
            Self::SteadyStraight => gathered(SPEED_M_S, 0.0),
            Self::SteadyCircle => gathered(SPEED_M_S, 1.0 / 6.0),
            Self::Weave {
                speed_m_s,
                curvature_1_m,
                period_s,
            } => {
                let phase_rad = std::f64::consts::TAU * time_s / period_s;
                gathered(speed_m_s, curvature_1_m * phase_rad.sin())
            }
            Self::StraightThenCircles {
                radius_m,
                speed_m_s,
            } => {
                let left = ((time_s - 10.0) / CURVE_S).clamp(0.0, 1.0);
                let right = ((time_s - 35.0) / CURVE_S).clamp(0.0, 2.0);
                gathered(speed_m_s, (left - right) / radius_m)
            }
        };
        robot.model.wheel_speeds_from_twist(twist)
    }
}

/// The figure-8 at a time, gathering speed at first.
fn figure_8(time_s: f64) -> ReferenceSample {
    const STEP_S: f64 = 1.0e-4;
    let (pose, speed_m_s, turn_rad_s) = figure_8_motion(time_s);
    let (_, later_m_s, later_rad_s) = figure_8_motion(time_s + STEP_S);
    ReferenceSample {
        pose,
        speed_m_s,
        acceleration_m_s2: (later_m_s - speed_m_s) / STEP_S,
        turn_rad_s,
        turn_acceleration_rad_s2: (later_rad_s - turn_rad_s) / STEP_S,
        curvature_1_m: if speed_m_s > 1.0e-3 {
            turn_rad_s / speed_m_s
        } else {
            0.0
        },
        arc_m: 0.0,
    }
}

/// Pose, speed and turn rate.
fn figure_8_motion(time_s: f64) -> (Pose, f64, f64) {
    let share = (time_s / GATHER_S).min(1.0);
    let rate = share * share * (3.0 - 2.0 * share);
    let clock_s = if share < 1.0 {
        GATHER_S * share.powi(3) * (1.0 - 0.5 * share)
    } else {
        time_s - 0.5 * GATHER_S
    };
    let (sin, cos) = (0.15 * clock_s).sin_cos();
    let (sin_2, cos_2) = (0.3 * clock_s).sin_cos();
    let (slope_x, slope_y) = (0.9 * cos, 0.6 * cos_2);
    let (bend_x, bend_y) = (-0.135 * sin, -0.18 * sin_2);
    let squared = slope_x * slope_x + slope_y * slope_y;
    let pose = Pose {
        x_m: 6.0 * sin,
        y_m: 2.0 * sin_2,
        heading_rad: wrap_angle_rad(slope_y.atan2(slope_x)),
    };
    let turn = (slope_x * bend_y - slope_y * bend_x) / squared;
    (pose, rate * squared.sqrt(), rate * turn)
}
