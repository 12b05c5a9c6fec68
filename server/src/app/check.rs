//! Dry runs: what a trajectory would ask of a robot, planned by the robot's own planner.

use std::ops::RangeInclusive;

use tread_api::geometry::{Point, Pose};
use tread_api::robot::RobotModel;
use tread_api::trajectory::{
    BINDINGS_MAX, Binding, BindingLimit, CheckTrajectory, Direction, ExpectedMeasurement, Place,
    THETA_ASSUMED, Trajectory, TrajectoryCheck, Waypoint,
};
use tread_control::estimation::{SensorNoise, expected_accuracy};
use tread_control::excitation::{Excitation, ExcitationSpec};
use tread_control::geometry as control;
use tread_control::plan::{Plan, PlanError, PlanOptions, Slowed, SlowedBy};
use tread_control::robot::{self, RobotModelError, RobotModelSpec};
use tread_control::trajectory as planned;

use super::{App, AppError, site_row};
use crate::db;

/// Dry runs that may be planned at once: a long path keeps a core busy.
pub const CHECKS_MAX: usize = 2;
/// θ that may be assumed: from K 1000 to K 0.1.
const THETA_RANGE: RangeInclusive<f64> = 0.001..=10.0;

impl App {
    /// Plans a trajectory for a robot without moving anything.
    ///
    /// # Errors
    /// [`AppError::Impossible`] names place and reason; site and robot must be known.
    pub async fn check_trajectory(
        &self,
        request: CheckTrajectory,
    ) -> Result<TrajectoryCheck, AppError> {
        let CheckTrajectory {
            site,
            robot,
            trajectory,
            start,
            theta,
        } = request;
        if let Some(theta) = theta.filter(|theta| !THETA_RANGE.contains(theta)) {
            let (least, most) = (THETA_RANGE.start(), THETA_RANGE.end());
            return Err(AppError::Invalid {
                field: "theta",
                detail: format!("theta must be {least} to {most}, not {theta}"),
            });
        }
        let mut tx = self.db().read().await?;
        let site_pk = site_row(&mut tx, &site).await?.pk;
        let row = db::robots::find(&mut tx, site_pk, &robot).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        let row = row.ok_or_else(unknown)?;
        drop(tx);
        let presence = self.presences().get(&(site.clone(), robot.clone()));
        let shown = presence.state().and_then(|state| state.pose);
        let start = start
            .or(shown.map(|pose| pose.value))
            .unwrap_or_else(|| begin_of(&trajectory));
        let measured = presence.friction().and_then(|said| said.theta_measured);
        let ground = AssumedGround {
            theta: theta
                .or(measured.map(|measured| measured.theta))
                .unwrap_or(THETA_ASSUMED),
            has_torque: row.capabilities.wheel_torque,
        };
        let _turn = self.check_turn().await;
        // The planner works on a thread of its own: a path may have 100 000 points.
        let model = row.model;
        let planning =
            tokio::task::spawn_blocking(move || check(&model, &trajectory, start, ground)).await;
        match planning {
            Ok(checked) => checked.map_err(|refused| AppError::Impossible {
                robot,
                detail: refused.detail,
                place: refused.place,
            }),
            Err(_panic) => Err(AppError::Impossible {
                robot,
                detail: "the planner broke on it".to_owned(),
                place: None,
            }),
        }
    }
}

/// The begin of the path, in its direction.
fn begin_of(trajectory: &Trajectory) -> Pose {
    match trajectory {
        Trajectory::Circle(circle) => Pose {
            x_m: circle.center.x_m + circle.radius_m,
            y_m: circle.center.y_m,
            heading_rad: match circle.direction {
                Direction::CounterClockwise => std::f64::consts::FRAC_PI_2,
                Direction::Clockwise => -std::f64::consts::FRAC_PI_2,
            },
        },
        Trajectory::Waypoints(waypoints) => {
            let mut points = waypoints.points.iter();
            let (first, second) = (points.next(), points.next());
            let place = first.map_or(Point { x_m: 0.0, y_m: 0.0 }, Waypoint::position);
            let heading_rad = first
                .and_then(|first| first.heading_rad)
                .unwrap_or_else(|| {
                    second.map_or(0.0, |next| {
                        (next.y_m - place.y_m).atan2(next.x_m - place.x_m)
                    })
                });
            Pose {
                x_m: place.x_m,
                y_m: place.y_m,
                heading_rad,
            }
        }
    }
}

/// What is assumed of the ground and of the base's sensors.
#[derive(Debug, Clone, Copy)]
struct AssumedGround {
    theta: f64,
    has_torque: bool,
}

/// Why a trajectory cannot be driven, and where.
struct Refused {
    detail: String,
    place: Option<Place>,
}

fn check(
    model: &RobotModel,
    trajectory: &Trajectory,
    start: Pose,
    ground: AssumedGround,
) -> Result<TrajectoryCheck, Refused> {
    let model = control_model(model).map_err(|error| Refused {
        detail: error.to_string(),
        place: None,
    })?;
    let from = control::Pose {
        x_m: start.x_m,
        y_m: start.y_m,
        heading_rad: start.heading_rad,
    };
    let options = plan_options(trajectory);
    let plan = Plan::with_options(&control_trajectory(trajectory), from, &model, &options)
        .map_err(|error| Refused {
            detail: error.to_string(),
            place: place_of(error, trajectory),
        })?;
    let AssumedGround { theta, has_torque } = ground;
    let expected = expected_accuracy(&plan, &model, SensorNoise::default(), theta, has_torque);
    let bindings = plan.slowed().iter().take(BINDINGS_MAX);
    Ok(TrajectoryCheck {
        start,
        length_m: plan.length_m(),
        approach_length_m: plan.approach_length_m(),
        duration_s: plan.duration_s(),
        speed_peak_m_s: plan.peak_speed_m_s(),
        linear_acceleration_peak_m_s2: plan.peak_acceleration_m_s2(),
        lateral_acceleration_peak_m_s2: plan.peak_lateral_acceleration_m_s2(),
        angular_peak_rad_s: plan.peak_angular_rad_s(),
        bindings: bindings.map(|slowed| binding(&plan, slowed)).collect(),
        excitation_depth_ratio: plan.excitation().map(Excitation::depth_ratio),
        measurement: ExpectedMeasurement {
            theta_assumed: theta,
            wheel_torque: has_torque,
            relative_sd: expected.relative_std_dev,
            first_after_s: expected.first_after_s,
        },
    })
}

fn binding(plan: &Plan, slowed: &Slowed) -> Binding {
    let place = |arc_m: f64| {
        let pose = plan.path().sample(arc_m).pose;
        Place {
            arc_m: Some(arc_m),
            waypoint: None,
            point: Point {
                x_m: pose.x_m,
                y_m: pose.y_m,
            },
        }
    };
    Binding {
        limit: match slowed.by {
            SlowedBy::LateralAcceleration => BindingLimit::LateralAcceleration,
            SlowedBy::AngularSpeed => BindingLimit::AngularSpeed,
            SlowedBy::WheelSpeed => BindingLimit::WheelSpeed,
            SlowedBy::WheelAcceleration => BindingLimit::WheelAcceleration,
            SlowedBy::LinearAcceleration => BindingLimit::LinearAcceleration,
            SlowedBy::Grip => BindingLimit::Grip,
        },
        from: place(slowed.from_m),
        to: place(slowed.to_m),
        speed_min_m_s: slowed.speed_min_m_s,
    }
}

fn place_of(error: PlanError, trajectory: &Trajectory) -> Option<Place> {
    let index = match error {
        PlanError::NotFinite { place, .. }
        | PlanError::DuplicateWaypoint { place }
        | PlanError::SpeedNotPositive { place, .. }
        | PlanError::SpeedAboveLimit { place, .. }
        | PlanError::TooTight { place } => place,
        PlanError::Radius(_)
        | PlanError::Turns(_)
        | PlanError::TooFewWaypoints(_)
        | PlanError::TooManyWaypoints(_)
        | PlanError::TooLong(_)
        | PlanError::Excitation(_) => return None,
    };
    match trajectory {
        Trajectory::Circle(circle) => Some(Place {
            arc_m: None,
            waypoint: None,
            point: circle.center,
        }),
        Trajectory::Waypoints(waypoints) => waypoints.points.get(index).map(|point| Place {
            arc_m: None,
            waypoint: Some(index),
            point: point.position(),
        }),
    }
}

fn control_model(model: &RobotModel) -> Result<robot::RobotModel, RobotModelError> {
    let limits = model.limits;
    robot::RobotModel::try_from(RobotModelSpec {
        mass_kg: model.mass_kg,
        track_width_m: model.track_width_m,
        wheelbase_m: model.wheelbase_m,
        wheel_radius_m: model.wheel_radius_m,
        yaw_inertia_kg_m2: model.yaw_inertia_kg_m2,
        limits: robot::Limits {
            wheel_speed_max_rad_s: limits.wheel_speed_max_rad_s,
            wheel_acceleration_max_rad_s2: limits.wheel_acceleration_max_rad_s2,
            linear_max_m_s: limits.linear_max_m_s,
            angular_max_rad_s: limits.angular_max_rad_s,
            linear_acceleration_max_m_s2: limits.linear_acceleration_max_m_s2,
            linear_jerk_max_m_s3: limits.linear_jerk_max_m_s3,
            lateral_acceleration_max_m_s2: limits.lateral_acceleration_max_m_s2,
        },
    })
}

fn control_trajectory(asked: &Trajectory) -> planned::Trajectory {
    let control_point = |point: Point| control::Point {
        x_m: point.x_m,
        y_m: point.y_m,
    };
    match asked {
        Trajectory::Circle(circle) => planned::Trajectory::Circle(planned::CircleSpec {
            center: control_point(circle.center),
            radius_m: circle.radius_m,
            speed_m_s: circle.speed_m_s(),
            direction: match circle.direction {
                Direction::CounterClockwise => planned::Direction::CounterClockwise,
                Direction::Clockwise => planned::Direction::Clockwise,
            },
            turns: circle.turns,
        }),
        Trajectory::Waypoints(waypoints) => {
            let point = |point: &Waypoint| planned::Waypoint {
                point: control_point(point.position()),
                speed_m_s: point.speed_m_s,
                heading_rad: point.heading_rad,
            };
            planned::Trajectory::Waypoints(planned::WaypointsSpec {
                points: waypoints.points.iter().map(point).collect(),
                speed_m_s: waypoints.speed_m_s,
            })
        }
    }
}

/// What a user allows beside the trajectory, in the controller's words.
fn plan_options(asked: &Trajectory) -> PlanOptions {
    let options = asked.options();
    PlanOptions {
        approach_speed_m_s: options.approach_speed_m_s,
        excitation: options.excitation.map(|wiggle| ExcitationSpec {
            depth_ratio: wiggle.depth_ratio,
            period_s: wiggle.period_s,
        }),
        grip_mu: None,
    }
}
