//! Dry runs: plans a trajectory with the robot's own planner, without moving the robot.

mod conversion;
mod drawn;
mod refused;
mod start;
mod traction;

use std::ops::RangeInclusive;

use tread_api::geometry::{Point, Pose};
use tread_api::ids::{RobotId, SiteId};
use tread_api::robot::RobotModel;
use tread_api::site::Grid;
use tread_api::trajectory::{
    BINDINGS_MAX, Binding, BindingLimit, CheckTrajectory, Direction, ExpectedMeasurement, Place,
    StartSource, THETA_ASSUMED, Trajectory, TrajectoryCheck, Waypoint,
};
use tread_control::estimation::{SensorNoise, expected_accuracy};
use tread_control::excitation::Excitation;
use tread_control::fence::{Fence, MARGIN_M, disc_radius_m};
use tread_control::geometry as control;
use tread_control::plan::{Plan, Slowed, SlowedBy};
use tread_control::robot;
use tread_control::trajectory as planned;

pub(super) use self::conversion::{control_fence, control_model};
use self::conversion::{control_trajectory, plan_options};
pub(super) use self::drawn::drawn;
pub(super) use self::refused::Refused;
pub(super) use self::start::Place as StartPlace;
use self::start::{PrecedingMission, Start, after, earlier};
use self::traction::Traction;
use super::{App, AppError, site_row};
use crate::db;

/// Maximum number of dry runs planned at once: a long path keeps a processor core busy.
pub const CHECKS_MAX: usize = 2;
/// Range of θ that a dry run may assume: K from 1000 down to 0.1.
const THETA_RANGE: RangeInclusive<f64> = 0.001..=10.0;
/// Least step in which a path is compared with a geofence, metres.
const FENCE_STEP_M: f64 = 0.02;
/// Maximum number of steps per path in the geofence comparison; longer paths use a longer least
/// step.
const FENCE_STEPS_MAX: f64 = 500_000.0;

impl App {
    /// Plans a trajectory for a robot without moving it, with the traction limits that an offer
    /// would carry. Planning begins at the pose expected after the robot's active and queued
    /// missions, unless the request gives a pose.
    ///
    /// # Errors
    /// [`AppError::Impossible`], [`AppError::TurnTooSharp`] and [`AppError::CrossesGeofence`] name
    /// reason and place; site and robot must be known.
    pub async fn check_trajectory(
        &self,
        request: CheckTrajectory,
    ) -> Result<TrajectoryCheck, AppError> {
        let CheckTrajectory {
            site,
            robot,
            trajectory,
            start,
            priority,
            start_policy,
            replaces,
            theta,
        } = request;
        if let Some(theta) = theta.filter(|theta| !THETA_RANGE.contains(theta)) {
            let (least, most) = (THETA_RANGE.start(), THETA_RANGE.end());
            return Err(AppError::Invalid {
                field: "theta",
                detail: format!("theta must be {least} to {most}, not {theta}"),
            });
        }
        let mut tx = self.db().read("check").await?;
        let site_row = site_row(&mut tx, &site).await?;
        let row = db::robots::find(&mut tx, site_row.pk, &robot).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        let row = row.ok_or_else(unknown)?;
        if let Some(replaced) = replaces {
            let found = db::missions::find(&mut tx, replaced).await?;
            let found = found.filter(|found| found.robot_pk == row.pk);
            let state = found
                .ok_or(AppError::UnknownMission(replaced))?
                .mission
                .state;
            if state.is_terminal() {
                return Err(AppError::MissionEnded {
                    id: replaced,
                    state,
                });
            }
        }
        let fence = control_fence(&db::geofences::present(&mut tx, site_row.pk).await?);
        let place = start::Place {
            priority,
            policy: start_policy,
            replaces,
        };
        let before = match start {
            Some(_) => Vec::new(),
            None => earlier(&mut tx, row.pk, place).await?,
        };
        drop(tx);
        let named = (&site, &robot);
        let grid = &site_row.site.grid;
        let before = self.with_tractions(named, grid, before).await?;
        let traction = self.traction_along(named, grid, &trajectory).await?;
        let first = match start {
            Some(pose) => Start {
                pose,
                source: StartSource::Request,
                after_mission: None,
            },
            None => self.expected_start((&site, &robot), &trajectory),
        };
        let presence = self.presences().get(&(site.clone(), robot.clone()));
        let measured = presence.friction().and_then(|report| report.theta_measured);
        let ground = AssumedGround {
            theta: theta
                .or(measured.map(|measured| measured.theta))
                .unwrap_or(THETA_ASSUMED),
            has_torque: row.capabilities.wheel_torque,
        };
        let _turn = self.check_turn().await;
        // The planner works on a thread of its own: a path may have 100 000 points.
        let model = row.model;
        let checking = move || {
            let start = after(first, &before, &model);
            let planning = Planning {
                trajectory: &trajectory,
                traction: &traction,
            };
            check(&model, planning, start, ground, &fence)
        };
        match tokio::task::spawn_blocking(checking).await {
            Ok(checked) => checked.map_err(|refused| refused.of(robot)),
            Err(_panic) => Err(AppError::Impossible {
                robot,
                detail: "the planner broke on it".to_owned(),
                field: None,
                place: None,
            }),
        }
    }
}

impl App {
    /// Refuses a trajectory that leaves the site's geofence, on its path or on the approach from
    /// the pose expected after the robot's active and queued missions. Does nothing if the site has
    /// no geofence.
    ///
    /// # Errors
    /// [`AppError::CrossesGeofence`] gives the place.
    pub(super) async fn check_fence(
        &self,
        (site, robot): (&SiteId, &RobotId),
        trajectory: &Trajectory,
        place: start::Place,
    ) -> Result<(), AppError> {
        let mut tx = self.db().read("check").await?;
        let Some(site_row) = db::sites::find(&mut tx, site).await? else {
            return Ok(());
        };
        let fence = control_fence(&db::geofences::present(&mut tx, site_row.pk).await?);
        if fence.is_empty() {
            return Ok(());
        }
        let row = db::robots::find(&mut tx, site_row.pk, robot).await?;
        let Some(row) = row else {
            return Ok(());
        };
        let before = earlier(&mut tx, row.pk, place).await?;
        drop(tx);
        let grid = &site_row.site.grid;
        let before = self.with_tractions((site, robot), grid, before).await?;
        let traction = self.traction_along((site, robot), grid, trajectory).await?;
        let first = self.expected_start((site, robot), trajectory);
        let _turn = self.check_turn().await;
        let trajectory = trajectory.clone();
        let checking = move || {
            let start = after(first, &before, &row.model);
            let planning = Planning {
                trajectory: &trajectory,
                traction: &traction,
            };
            match planned(&row.model, planning, start.pose) {
                Ok(planned) => fenced(&planned, &trajectory, &fence),
                // A trajectory that cannot be planned is refused by the robot.
                Err(_impossible) => Ok(()),
            }
        };
        match tokio::task::spawn_blocking(checking).await {
            Ok(checked) => checked.map_err(|refused| refused.of(robot.clone())),
            Err(_panic) => Ok(()),
        }
    }

    /// Returns the traction limits with which the robot would plan a trajectory now.
    pub(super) async fn traction_along(
        &self,
        named: (&SiteId, &RobotId),
        grid: &Grid,
        trajectory: &Trajectory,
    ) -> Result<Traction, AppError> {
        let prior = self.prior_along(named, trajectory).await?;
        Ok(Traction::of_prior(prior.as_ref(), grid))
    }

    /// Returns missions with the traction limits along them.
    async fn with_tractions(
        &self,
        named: (&SiteId, &RobotId),
        grid: &Grid,
        missions: Vec<PrecedingMission>,
    ) -> Result<Vec<(PrecedingMission, Traction)>, AppError> {
        let mut with = Vec::with_capacity(missions.len());
        for mission in missions {
            let traction = self
                .traction_along(named, grid, mission.trajectory())
                .await?;
            with.push((mission, traction));
        }
        Ok(with)
    }

    /// Returns the robot's present pose, or, if it shows none, the begin of the trajectory.
    fn expected_start(&self, (site, robot): (&SiteId, &RobotId), trajectory: &Trajectory) -> Start {
        let presence = self.presences().get(&(site.clone(), robot.clone()));
        let shown = presence.state().and_then(|state| state.pose);
        let (pose, source) = match shown {
            Some(pose) => (pose.value, StartSource::Robot),
            None => (begin_of(trajectory), StartSource::Trajectory),
        };
        Start {
            pose,
            source,
            after_mission: None,
        }
    }
}

/// Returns the first pose of the path; its heading is along the path unless the waypoint gives one.
pub(super) fn begin_of(trajectory: &Trajectory) -> Pose {
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

/// Assumptions about the ground and the base's sensors.
#[derive(Debug, Clone, Copy)]
struct AssumedGround {
    theta: f64,
    has_torque: bool,
}

/// A plan and the robot model that it was made for.
pub(super) struct Planned {
    model: robot::RobotModel,
    pub(super) plan: Plan,
}

/// What is planned: a trajectory, and the traction limits of the ground along it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Planning<'a> {
    pub(super) trajectory: &'a Trajectory,
    pub(super) traction: &'a Traction,
}

pub(super) fn planned(
    model: &RobotModel,
    Planning {
        trajectory,
        traction,
    }: Planning<'_>,
    start: Pose,
) -> Result<Planned, Refused> {
    let model = control_model(model).map_err(|error| Refused::always(error.to_string()))?;
    let start = trajectory.options().planning_start(start);
    let from = control::Pose {
        x_m: start.x_m,
        y_m: start.y_m,
        heading_rad: start.heading_rad,
    };
    let options = traction.limiting(&plan_options(trajectory));
    let plan = Plan::with_options(&control_trajectory(trajectory), from, &model, &options)
        .map_err(|error| Refused::unplanned(error, trajectory))?;
    Ok(Planned { model, plan })
}

fn check(
    model: &RobotModel,
    planning: Planning<'_>,
    start: Start,
    ground: AssumedGround,
    fence: &Fence,
) -> Result<TrajectoryCheck, Refused> {
    let planned = planned(model, planning, start.pose)?;
    let trajectory = planning.trajectory;
    let begin = trajectory.options().planning_start(start.pose);
    fenced(&planned, trajectory, fence)?;
    let plan = &planned.plan;
    let AssumedGround { theta, has_torque } = ground;
    let noise = SensorNoise::default();
    let expected = expected_accuracy(plan, &planned.model, noise, theta, has_torque);
    let bindings = plan.slowed().iter().take(BINDINGS_MAX);
    Ok(TrajectoryCheck {
        start: begin,
        start_source: start.source,
        after_mission: start.after_mission,
        length_m: plan.length_m(),
        approach_length_m: plan.approach_length_m(),
        duration_s: plan.duration_s(),
        speed_peak_m_s: plan.peak_speed_m_s(),
        linear_acceleration_peak_m_s2: plan.peak_acceleration_m_s2(),
        lateral_acceleration_peak_m_s2: plan.peak_lateral_acceleration_m_s2(),
        angular_peak_rad_s: plan.peak_angular_rad_s(),
        bindings: bindings.map(|slowed| binding(plan, slowed)).collect(),
        excitation_depth_ratio: plan.excitation().map(Excitation::depth_ratio),
        measurement: ExpectedMeasurement {
            theta_assumed: theta,
            wheel_torque: has_torque,
            relative_std_dev: expected.relative_std_dev,
            first_after_s: expected.first_after_s,
        },
        path: drawn(plan, trajectory),
    })
}

/// Length of a path in metres, with its approach; of a circle only the first turn counts.
pub(super) fn once_m(plan: &Plan, trajectory: &Trajectory) -> f64 {
    match trajectory {
        Trajectory::Circle(circle) => {
            let once_m = plan.approach_length_m() + std::f64::consts::TAU * circle.radius_m;
            plan.length_m().min(once_m)
        }
        Trajectory::Waypoints(_) => plan.length_m(),
    }
}

/// Checks a plan against the geofence in steps of the remaining clearance, so that no crossing is
/// missed.
fn fenced(
    Planned { model, plan }: &Planned,
    trajectory: &Trajectory,
    fence: &Fence,
) -> Result<(), Refused> {
    if fence.is_empty() {
        return Ok(());
    }
    let keep_m = disc_radius_m(model) + MARGIN_M;
    let length_m = once_m(plan, trajectory);
    let step_min_m = (length_m / FENCE_STEPS_MAX).max(FENCE_STEP_M);
    let mut arc_m = 0.0;
    while arc_m <= length_m {
        let pose = plan.path().sample(arc_m).pose;
        let point = control::Point {
            x_m: pose.x_m,
            y_m: pose.y_m,
        };
        let spare_m = fence.clearance_m(point) - keep_m;
        if spare_m.is_nan() || spare_m < 0.0 {
            let point = Point {
                x_m: point.x_m,
                y_m: point.y_m,
            };
            let detail = format!(
                "at x {:.2} m, y {:.2} m its body would come {:.2} m too near to the border of \
                 where robots may be",
                point.x_m, point.y_m, -spare_m
            );
            let place = Place {
                arc_m: Some(arc_m),
                waypoint: None,
                point,
            };
            return Err(Refused::outside(detail, place));
        }
        arc_m += spare_m.max(step_min_m);
    }
    Ok(())
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
            SlowedBy::Traction => BindingLimit::Traction,
        },
        from: place(slowed.from_m),
        to: place(slowed.to_m),
        speed_min_m_s: slowed.speed_min_m_s,
    }
}
