//! `tread send`: a circle or waypoints for a robot.

use std::io::IsTerminal;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use jiff::Timestamp;
use tread_api::ids::MissionId;
use tread_api::mission::{
    CreateMission, LinkPolicy, Mission, MissionState, ReplaceMission, StartPolicy,
};
use tread_api::trajectory::{
    CheckTrajectory, Circle, Direction, Excitation, Trajectory, TrajectoryCheck, TrajectoryOptions,
    Waypoint, Waypoints,
};

use super::missions::summary;
use crate::args::{Order, SendArguments, SendCircle, SendTrajectory, SendWaypoints, waypoint};
use crate::client::Client;
use crate::output::Output;

/// Time between two looks at a mission that is waited for.
const LOOK_EVERY: Duration = Duration::from_millis(250);

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
    if let Some(mission) = order.replaces {
        let replacement = ReplaceMission { trajectory };
        let mission = client.replace_mission(mission, &replacement).await?;
        output.show(&mission, summary)?;
        return Ok(ExitCode::SUCCESS);
    }
    let request = CreateMission {
        site: order.connection.site.clone(),
        robot: order.robot.clone(),
        trajectory,
        latest_start: order.start_within.map(latest_start).transpose()?,
        priority: order.priority,
        start_policy: StartPolicy::default(),
        link_policy: LinkPolicy::default(),
        lost_after_s: None,
    };
    let mut mission = client.create_mission(&request).await?;
    if order.wait {
        mission = wait(client, mission.id, output).await?;
    }
    output.show(&mission, summary)?;
    let went_wrong = order.wait && mission.state != MissionState::Succeeded;
    Ok(if went_wrong {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

/// Tells what a trajectory would ask of its robot.
async fn check(
    trajectory: Trajectory,
    order: &Order,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let request = CheckTrajectory {
        site: order.connection.site.clone(),
        robot: order.robot.clone(),
        trajectory,
        start: None,
        theta: None,
    };
    let checked = client.check_trajectory(&request).await?;
    output.show(&checked, demands)?;
    Ok(ExitCode::SUCCESS)
}

fn demands(checked: &TrajectoryCheck) -> String {
    let mut lines = vec![
        format!(
            "{:.2} m, {:.2} m of it on the way there, in {:.1} s",
            checked.length_m, checked.approach_length_m, checked.duration_s
        ),
        format!(
            "at most {:.2} m/s, {:.2} m/s² along, {:.2} m/s² across, {:.2} rad/s",
            checked.speed_peak_m_s,
            checked.linear_acceleration_peak_m_s2,
            checked.lateral_acceleration_peak_m_s2,
            checked.angular_peak_rad_s
        ),
    ];
    lines.extend(checked.bindings.iter().map(|binding| {
        format!(
            "slower than asked, down to {:.2} m/s, from {:.2} to {:.2} m: {:?}",
            binding.speed_min_m_s,
            binding.from.arc_m.unwrap_or_default(),
            binding.to.arc_m.unwrap_or_default(),
            binding.limit
        )
    }));
    if let Some(depth_ratio) = checked.excitation_depth_ratio {
        lines.push(format!("the speed wiggles by {:.0} %", 1e2 * depth_ratio));
    }
    let measurement = checked.measurement;
    let sensing = if measurement.wheel_torque {
        "with wheel torque"
    } else {
        "without wheel torque"
    };
    let assumed = format!("theta {:.2}, {sensing}", measurement.theta_assumed);
    lines.push(match (measurement.relative_sd, measurement.first_after_s) {
        (Some(relative_sd), Some(first_after_s)) => format!(
            "friction measured to about {:.1} % in the end, first after {first_after_s:.0} s ({assumed})",
            1e2 * relative_sd
        ),
        _ => format!("friction not measured: too little excitation ({assumed})"),
    });
    lines.join("\n")
}

/// What the flags ask for beside the trajectory.
fn options(order: &Order) -> TrajectoryOptions {
    TrajectoryOptions {
        approach_speed_m_s: order.approach_speed,
        excitation: order.excite.then(Excitation::default),
    }
}

fn circle(send: SendCircle) -> (Trajectory, Order) {
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

fn waypoints(send: SendWaypoints) -> anyhow::Result<(Trajectory, Order)> {
    let points = match &send.file {
        Some(file) => read_points(file)?,
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

/// Reads points from a file of lines `x,y`, or of a JSON list.
fn read_points(file: &Path) -> anyhow::Result<Vec<Waypoint>> {
    let name = file.display();
    let text = std::fs::read_to_string(file).with_context(|| format!("cannot read {name}"))?;
    if text.trim_start().starts_with('[') {
        return serde_json::from_str(&text).with_context(|| format!("{name} is no list of points"));
    }
    let is_point = |line: &str| !line.trim().is_empty() && !line.trim_start().starts_with('#');
    text.lines()
        .enumerate()
        .filter(|(_, line)| is_point(line))
        .map(|(index, line)| {
            waypoint(line).map_err(|error| anyhow::anyhow!("{name}, line {}: {error}", index + 1))
        })
        .collect()
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

/// Follows a mission to its end.
async fn wait(client: &Client, mission: MissionId, output: Output) -> anyhow::Result<Mission> {
    let bar = ProgressBar::with_draw_target(Some(100), ProgressDrawTarget::hidden());
    if !output.is_json() && std::io::stderr().is_terminal() {
        bar.set_draw_target(ProgressDrawTarget::stderr());
    }
    bar.set_style(ProgressStyle::with_template(
        "{msg:10} {bar:40} {pos:>3} %",
    )?);
    loop {
        let seen = client.mission(mission).await?.mission;
        bar.set_message(seen.state.as_str());
        if let Some(progress) = seen.progress.filter(|progress| progress.length_m > 0.0) {
            let percent = (100.0 * progress.driven_m / progress.length_m).clamp(0.0, 100.0);
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "0 to 100"
            )]
            bar.set_position(percent as u64);
        }
        if seen.state.is_terminal() {
            bar.finish_and_clear();
            return Ok(seen);
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn points_of(text: &str) -> anyhow::Result<Vec<Waypoint>> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        read_points(file.path())
    }

    #[test]
    fn points_are_read_from_lines_and_from_json() {
        let lines = points_of("# a path\n0,0\n\n 1.5 , -2\n").unwrap();
        let json = points_of(r#"[{"x_m":0,"y_m":0},{"x_m":1.5,"y_m":-2}]"#).unwrap();
        assert_eq!(lines, json);
    }

    #[test]
    fn a_wrong_line_is_named() {
        let error = points_of("0,0\n1;2\n").unwrap_err();
        assert!(error.to_string().contains("line 2"), "{error}");
    }
}
