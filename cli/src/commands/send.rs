//! `tread send`: creates, replaces or checks a mission on a circle or through waypoints.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use jiff::Timestamp;
use tread_api::mission::{CreateMission, ReplaceMission};
use tread_api::trajectory::{
    BindingLimit, CheckTrajectory, Circle, Direction, Excitation, StartSource, Trajectory,
    TrajectoryCheck, TrajectoryOptions, Waypoints,
};

use super::mission_text::summary;
use super::naming::mission_id;
use super::points::read_waypoints;
use super::waiting::{have_succeeded, wait};
use crate::args::{MissionOptions, SendArguments, SendCircle, SendTrajectory, SendWaypoints};
use crate::client::Client;
use crate::output::{Output, fixed};

pub(super) async fn run(
    arguments: SendArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let (trajectory, order) = match arguments.trajectory {
        SendTrajectory::Circle(send) => circle(send),
        SendTrajectory::Waypoints(send) => waypoints(send)?,
    };
    if order.check {
        return check(trajectory, &order, client, output).await;
    }
    if let Some(mission) = &order.replaces {
        let mission_id = mission_id(client, &order.connection.site, mission).await?;
        let replacement = ReplaceMission { trajectory };
        let mission = client.replace_mission(mission_id, &replacement).await?;
        output.show(&mission, summary)?;
        return Ok(ExitCode::SUCCESS);
    }
    let request = CreateMission {
        site: order.connection.site.clone(),
        robot: order.robot.clone(),
        trajectory,
        latest_start: order.start_within.map(latest_start).transpose()?,
        priority: order.priority,
        start_policy: order.start_policy(),
        link_policy: order.link_policy(),
        lost_after_s: order.lost_after.map(|away| away.as_secs_f64()),
    };
    let mission = client.create_mission(&request).await?;
    if !order.wait {
        output.show(&mission, summary)?;
        return Ok(ExitCode::SUCCESS);
    }
    let ended = wait(client, &[mission.id], order.timeout, output).await?;
    for mission in &ended {
        output.show(mission, summary)?;
    }
    Ok(if have_succeeded(&ended) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// Checks a trajectory and prints its plan.
async fn check(
    trajectory: Trajectory,
    order: &MissionOptions,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let request = CheckTrajectory {
        site: order.connection.site.clone(),
        robot: order.robot.clone(),
        trajectory,
        start: None,
        priority: order.priority,
        start_policy: order.start_policy(),
        replaces: None,
        theta: None,
    };
    let checked = client.check_trajectory(&request).await?;
    output.show(&checked, demands)?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the origin of the plan, in words.
fn planned_from(checked: &TrajectoryCheck) -> String {
    let place = format!(
        "x {} m, y {} m",
        fixed(checked.start.x_m, 2),
        fixed(checked.start.y_m, 2)
    );
    match (checked.start_source, checked.after_mission) {
        (StartSource::Mission, Some(mission)) => {
            format!("planned from the end of mission {mission}, at {place}")
        }
        (StartSource::Request, _) => format!("planned from {place}, as requested"),
        (StartSource::Robot, _) => format!("planned from the robot's position, {place}"),
        (StartSource::Mission | StartSource::Trajectory, _) => {
            format!(
                "planned from the start of the path, {place}: the robot's position is not known"
            )
        }
    }
}

fn demands(checked: &TrajectoryCheck) -> String {
    let mut lines = vec![
        planned_from(checked),
        format!(
            "{:.2} m, {:.2} m of it on the way there, in {:.1} s",
            checked.length_m, checked.approach_length_m, checked.duration_s
        ),
        format!(
            "at most {:.2} m/s, {:.2} m/s² longitudinal, {:.2} m/s² lateral, {:.2} rad/s",
            checked.speed_peak_m_s,
            checked.linear_acceleration_peak_m_s2,
            checked.lateral_acceleration_peak_m_s2,
            checked.angular_peak_rad_s
        ),
    ];
    lines.extend(checked.bindings.iter().map(|binding| {
        format!(
            "slower than requested, down to {:.2} m/s, from {:.2} to {:.2} m: {}",
            binding.speed_min_m_s,
            binding.from.arc_m.unwrap_or_default(),
            binding.to.arc_m.unwrap_or_default(),
            limit_name(binding.limit)
        )
    }));
    if let Some(depth_ratio) = checked.excitation_depth_ratio {
        lines.push(format!("the speed varies by {:.0} %", 1e2 * depth_ratio));
    }
    let measurement = checked.measurement;
    let sensing = if measurement.wheel_torque {
        "with wheel torque"
    } else {
        "without wheel torque"
    };
    let assumed = format!("theta {:.2}, {sensing}", measurement.theta_assumed);
    lines.push(match (measurement.relative_std_dev, measurement.first_after_s) {
        (Some(relative_std_dev), Some(first_after_s)) => format!(
            "friction measured to about {:.1} % in the end, first after {first_after_s:.0} s ({assumed})",
            1e2 * relative_std_dev
        ),
        _ => format!("friction not measured: too little excitation ({assumed})"),
    });
    lines.join("\n")
}

/// Returns the options of the trajectory that the flags select.
fn options(order: &MissionOptions) -> TrajectoryOptions {
    TrajectoryOptions {
        expected_start: None,
        approach_speed_m_s: order.approach_speed,
        excitation: order.excite.then(Excitation::default),
    }
}

fn circle(send: SendCircle) -> (Trajectory, MissionOptions) {
    let direction = if send.clockwise {
        Direction::Clockwise
    } else {
        Direction::CounterClockwise
    };
    let circle = Circle {
        center: send.center,
        radius_m: send.radius,
        speed_m_s: Some(send.speed),
        period_s: None,
        direction,
        turns: send.turns,
        options: options(&send.order),
    };
    (Trajectory::Circle(circle), send.order)
}

fn waypoints(send: SendWaypoints) -> anyhow::Result<(Trajectory, MissionOptions)> {
    let points = match &send.file {
        Some(file) => read_waypoints(file)?,
        None => send.points,
    };
    Ok((
        Trajectory::Waypoints(Waypoints {
            points,
            speed_m_s: send.speed,
            options: options(&send.order),
        }),
        send.order,
    ))
}

#[expect(
    clippy::disallowed_methods,
    reason = "a person's `within 5m` counts from now"
)]
fn latest_start(within: Duration) -> anyhow::Result<Timestamp> {
    Timestamp::now()
        .checked_add(within)
        .context("--start-within is too far in the future")
}

/// Returns the name of the limit that slows the robot.
fn limit_name(limit: BindingLimit) -> &'static str {
    match limit {
        BindingLimit::LateralAcceleration => "lateral acceleration",
        BindingLimit::AngularSpeed => "turning speed",
        BindingLimit::WheelSpeed => "wheel speed",
        BindingLimit::WheelAcceleration => "wheel acceleration in a bend",
        BindingLimit::LinearAcceleration => "acceleration or braking",
        BindingLimit::Traction => "traction limit of the ground",
    }
}
