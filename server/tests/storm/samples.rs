//! What is driven, and by what.

use tread_api::robot::RobotModel;
use tread_api::trajectory::{Circle, Direction, Trajectory, TrajectoryOptions};
use tread_samples::rover;

pub(super) fn circle(radius_m: f64) -> Trajectory {
    Trajectory::Circle(Circle {
        center: tread_api::geometry::Point { x_m: 0.0, y_m: 0.0 },
        radius_m,
        speed_m_s: Some(0.5),
        period_s: None,
        direction: Direction::CounterClockwise,
        turns: 1.0,
        options: TrajectoryOptions::default(),
    })
}

pub(super) fn model() -> RobotModel {
    RobotModel {
        tyres: "any".to_owned(),
        ..rover("storm")
    }
}
