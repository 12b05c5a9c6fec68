//! The courses of the comparison.

use std::f64::consts::FRAC_PI_2;

use tread_control::geometry::{Point, Pose};
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;
use tread_control::trajectory::{CircleSpec, Direction, Trajectory, Waypoint, WaypointsSpec};
use tread_lab::bench::{CLOSED_PATH_M, Course, Figure8};

/// How often the path is driven.
const LAPS: usize = 2;

/// Circle, figure-8 and waypoints.
pub(super) fn all() -> [(&'static str, Course); 3] {
    [
        ("circle", circle()),
        ("figure-8", Course::Figure8(Figure8::usual())),
        ("waypoints", waypoints()),
    ]
}

/// A planned course.
pub(super) fn plan(trajectory: &Trajectory, start: Pose, model: &RobotModel) -> Course {
    let plan = Plan::new(trajectory, start, model);
    Course::Plan(plan.expect("the courses can be driven"))
}

/// The circle of the figures.
pub(super) fn circle_trajectory() -> Trajectory {
    Trajectory::Circle(CircleSpec {
        center: Point::default(),
        radius_m: 6.0,
        speed_m_s: 0.6,
        direction: Direction::CounterClockwise,
        turns: 2.0,
    })
}

fn circle() -> Course {
    let start = Pose {
        x_m: 6.0,
        y_m: 0.0,
        heading_rad: FRAC_PI_2,
    };
    plan(&circle_trajectory(), start, &RobotModel::yi2007())
}

fn waypoints() -> Course {
    let points = CLOSED_PATH_M
        .iter()
        .cycle()
        .take(LAPS * CLOSED_PATH_M.len() + 1)
        .map(|&(x_m, y_m)| Waypoint::from(Point { x_m, y_m }))
        .collect();
    let trajectory = Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.6,
    });
    let start = Pose {
        heading_rad: -0.1,
        ..Pose::default()
    };
    plan(&trajectory, start, &RobotModel::yi2007())
}
