//! `tread robots` and `tread leases`: list robots, show one, list leases.

use std::process::ExitCode;

use serde::Serialize;
use tread_api::friction::NORMAL_95;
use tread_api::ids::{RobotId, SiteId};
use tread_api::robot::{LinkState, MissionProgress, Robot, RobotLive, RobotMode};
use tread_api::safety::{Driver, SafetyStatus};

use crate::args::RobotsArguments;
use crate::client::Client;
use crate::output::{Output, age, fixed, joined, or_dash, render, table};

pub(super) async fn run(
    arguments: &RobotsArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &arguments.connection.site;
    if let Some(robot) = &arguments.robot {
        let robot = client.robot(site, robot).await?;
        output.show(&robot, details)?;
    } else {
        let robots = client.robots(site, arguments.retired).await?;
        output.show(&robots, |robots| list(robots))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Lease of a robot.
#[derive(Serialize)]
struct Leased<'robot> {
    robot: &'robot RobotId,
    epoch: u64,
    driver: &'robot Driver,
}

impl<'robot> Leased<'robot> {
    fn of(robot: &'robot Robot) -> Option<Self> {
        let lease = robot.live.as_ref()?.safety.lease.as_ref()?;
        Some(Self {
            robot: &robot.id,
            epoch: lease.epoch,
            driver: &lease.driver,
        })
    }
}

pub(super) async fn leases(
    site: &SiteId,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let robots = client.robots(site, false).await?;
    let leases: Vec<Leased<'_>> = robots.iter().filter_map(Leased::of).collect();
    output.show(&leases, |leases| {
        if leases.is_empty() {
            return "no robot is being teleoperated".to_owned();
        }
        let mut table = table(["ROBOT", "DRIVER", "LEASE", "CONNECTION"]);
        for lease in leases {
            table.add_row([
                lease.robot.to_string(),
                lease.driver.name.clone(),
                lease.epoch.to_string(),
                lease.driver.client.to_string(),
            ]);
        }
        render(&table)
    })?;
    Ok(ExitCode::SUCCESS)
}

/// Returns a table of robots.
pub(super) fn list(robots: &[Robot]) -> String {
    if robots.is_empty() {
        return "no robot has connected to this site yet".to_owned();
    }
    let mut table = table([
        "ROBOT",
        "LINK",
        "MODE",
        "X M",
        "Y M",
        "SPEED M/S",
        "MISSION",
        "DONE",
        "THETA",
        "HEARD",
    ]);
    for robot in robots {
        let live = robot.live.as_ref();
        let pose = live.and_then(|live| live.pose);
        let twist = live.and_then(|live| live.twist);
        let mission = live.and_then(|live| live.mission);
        table.add_row([
            robot.id.to_string(),
            link_name(robot.link).to_owned(),
            or_dash(live.map(|live| mode_name(live.mode))),
            or_dash(pose.map(|pose| fixed(pose.value.x_m, 2))),
            or_dash(pose.map(|pose| fixed(pose.value.y_m, 2))),
            or_dash(twist.map(|twist| fixed(twist.value.linear_m_s, 2))),
            or_dash(mission.map(|mission| mission.id)),
            or_dash(mission.map(percent)),
            or_dash(live.and_then(theta)),
            or_dash(live.map(|live| format!("{} ago", age(live.state_age_ms)))),
        ]);
    }
    render(&table)
}

/// Returns all about a robot, a line for each thing, the less important ones last.
pub(super) fn details(robot: &Robot) -> String {
    let mut lines = vec![
        format!("robot          {} of site {}", robot.id, robot.site),
        format!("name           {}", robot.name),
        format!(
            "model          {}, tyres {}",
            robot.model.name, robot.model.tyres
        ),
        format!("configuration  {}", robot.configuration),
        format!("agent          {}", robot.agent_version),
        format!("link           {}", link_name(robot.link)),
        format!("first seen     {}", robot.first_seen_at),
        format!("last hello     {}", robot.last_hello_at),
    ];
    if !robot.tags.is_empty() {
        lines.push(format!("tags           {}", joined(&robot.tags)));
    }
    match &robot.live {
        Some(live) => lines.extend(live_lines(live)),
        None => lines.push("it has sent no state since the server started".to_owned()),
    }
    lines.extend(
        robot
            .retired_at
            .map(|at| format!("retired        since {at:.0}")),
    );
    lines.extend(robot.awaits_release_since.map(|at| {
        format!(
            "waits          since {at:.0} for its release after a restoration: `tread robots release {}`",
            robot.id
        )
    }));
    lines.extend(robot.alerts.iter().map(|alert| {
        let severity = alert.severity.as_str();
        format!("alert          {severity}: {}", alert.text)
    }));
    // Last, since a small terminal shows the first lines.
    lines.extend(robot.live.iter().flat_map(friction_lines));
    lines.join("\n")
}

fn live_lines(live: &RobotLive) -> Vec<String> {
    let mut lines = vec![
        format!("boot           {}", live.boot),
        format!("heard          {} ago", age(live.state_age_ms)),
        format!("mode           {}", mode_name(live.mode)),
    ];
    lines.extend(
        live.fault
            .as_ref()
            .map(|fault| format!("fault          {fault}")),
    );
    lines.extend(safety_lines(&live.safety));
    lines.extend(live.battery.map(|battery| {
        let charging = if battery.charging { ", charging" } else { "" };
        let charge = 1e2 * battery.charge_ratio;
        format!("battery        {charge:.0} %{charging}")
    }));
    lines.extend(live.pose.map(|pose| {
        let (value, age) = (pose.value, age(pose.age_ms));
        format!(
            "pose           x {} m, y {} m, heading {} rad, {age} old",
            fixed(value.x_m, 3),
            fixed(value.y_m, 3),
            fixed(value.heading_rad, 3)
        )
    }));
    lines.extend(live.twist.map(|twist| {
        let (value, age) = (twist.value, age(twist.age_ms));
        format!(
            "speed          {} m/s, {} rad/s, {age} old",
            fixed(value.linear_m_s, 3),
            fixed(value.angular_rad_s, 3)
        )
    }));
    lines.extend(live.mission.map(|mission| {
        format!(
            "mission        {}, {} of {:.1} m, {} m off the path",
            mission.id,
            fixed(mission.driven_m, 1),
            mission.length_m,
            fixed(mission.cross_track_m, 3)
        )
    }));
    lines.push(format!(
        "outbox         {} waiting, {} dropped, {} refused",
        live.outbox.pending, live.outbox.dropped, live.outbox.refused
    ));
    lines.push(format!(
        "control loop   {} Hz, {} ticks, {} late, longest {} us",
        live.control_loop.rate_hz,
        live.control_loop.ticks,
        live.control_loop.overruns,
        live.control_loop.tick_max_us
    ));
    lines
}

/// Returns lines about the ground under a robot, and about the robot's parameters.
fn friction_lines(live: &RobotLive) -> Vec<String> {
    let mut lines = Vec::new();
    lines.extend(live.friction.map(|friction| {
        let excited = if friction.value.excited {
            "excited"
        } else {
            "no new information"
        };
        format!(
            "friction       theta measured {}, in the loop {}, {excited}, {} old",
            or_dash(theta(live)),
            or_dash(friction.value.theta_loop.map(|theta| format!("{theta:.4}"))),
            age(friction.age_ms)
        )
    }));
    let no_estimate = live
        .friction
        .and_then(|friction| friction.value.no_estimate);
    lines.extend(no_estimate.map(|why| {
        let help = why
            .help()
            .map_or_else(String::new, |help| format!("; {help}"));
        format!("no estimate    {}{help}", why.reason())
    }));
    lines.extend(parameters(live));
    let slip = live.friction.and_then(|friction| friction.value.slip);
    lines.extend(slip.map(|slip| {
        format!(
            "wheel slip     {} % left, {} % right",
            fixed(1e2 * slip.left_ratio, 1),
            fixed(1e2 * slip.right_ratio, 1)
        )
    }));
    lines
}

/// Returns lines about stop, driver and external limits of a robot.
fn safety_lines(safety: &SafetyStatus) -> Vec<String> {
    let mut lines = Vec::new();
    lines.extend(
        safety
            .stop
            .as_ref()
            .map(|stop| format!("STOPPED        by {}: {}", stop.by, stop.reason)),
    );
    lines.extend(
        safety
            .lease
            .as_ref()
            .map(|lease| format!("driven by      {}", lease.driver.name)),
    );
    lines.extend(safety.limits.iter().map(|limit| {
        let speed = limit.linear_max_m_s;
        let how = match speed.filter(|_| !limit.hold) {
            Some(speed_m_s) => format!("slows it to {speed_m_s} m/s"),
            None => "holds it".to_owned(),
        };
        format!("limited        {} {how}", limit.owner)
    }));
    lines
}

/// Returns the measured θ with its standard deviation; `None` if there is none.
pub(super) fn theta(live: &RobotLive) -> Option<String> {
    let measured = live.friction?.value.theta_measured?;
    Some(format!("{:.4} ± {:.4}", measured.theta, measured.std_dev))
}

/// Returns the parameters of the robot that were estimated while it drove, a line each.
fn parameters(live: &RobotLive) -> Vec<String> {
    let friction = live.friction.map(|friction| friction.value);
    let Some(found) = friction.and_then(|friction| friction.robot_parameters) else {
        return Vec::new();
    };
    let of_configured = " of the configured";
    [
        ("apparent mass", found.apparent_mass_ratio, of_configured),
        ("mass", found.mass_kg, " kg"),
        ("inertia / mass", found.yaw_inertia_ratio, of_configured),
        ("centre forward", found.center_of_mass_forward_m, " m"),
        ("centre left", found.center_of_mass_left_m, " m"),
    ]
    .map(|(name, estimate, unit)| {
        let half_width = NORMAL_95 * estimate.std_dev;
        let remark = if estimate.prior_dominated {
            " (mostly prior)"
        } else {
            ""
        };
        format!(
            "{name:<15}{} ± {half_width:.3}{unit}{remark}",
            fixed(estimate.value, 3)
        )
    })
    .to_vec()
}

/// Returns the progress of a mission in whole steps, 0 to `steps`; `None` while its length is
/// unknown.
pub(super) fn steps_driven(progress: MissionProgress, steps: usize) -> Option<usize> {
    let share = (progress.length_m > 0.0).then(|| progress.driven_m / progress.length_m)?;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        clippy::cast_precision_loss,
        reason = "0 to the steps of a bar"
    )]
    Some((share.clamp(0.0, 1.0) * steps as f64).round() as usize)
}

/// Returns the progress of a mission in per cent; `-` while its length is unknown.
pub(super) fn percent(progress: MissionProgress) -> String {
    if progress.length_m > 0.0 {
        let share = progress.driven_m / progress.length_m;
        format!("{} %", fixed(100.0 * share.min(1.0), 0))
    } else {
        "-".to_owned()
    }
}

pub(super) fn link_name(link: LinkState) -> &'static str {
    match link {
        LinkState::Online => "online",
        LinkState::Stale => "stale",
        LinkState::Offline => "offline",
    }
}

pub(super) fn mode_name(mode: RobotMode) -> &'static str {
    match mode {
        RobotMode::Idle => "idle",
        RobotMode::Tracking => "tracking",
        RobotMode::Teleoperated => "teleoperated",
        RobotMode::Stopped => "stopped",
        RobotMode::Fault => "fault",
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// A robot that says this of friction.
    fn live(friction: &serde_json::Value) -> RobotLive {
        let control_loop = json!({
            "rate_hz": 100.0, "ticks": 9, "overruns": 0, "tick_max_us": 90, "commands_refused": 0,
            "lost_segments": 0, "unmapped_blocks": 0,
        });
        let live = json!({
            "boot": "0192f0c1-2b3c-7d4e-8f50-000000000001",
            "state_age_ms": 20,
            "robot_time": "2026-01-31T14:05:09Z",
            "clock_offset_ms": 0,
            "mode": "idle",
            "fault": null,
            "pose": null,
            "twist": null,
            "mission": null,
            "friction": { "age_ms": 20, "value": friction },
            "outbox": { "pending": 0, "dropped": 0, "refused": 0 },
            "control_loop": control_loop,
            "battery": null,
            "safety": SafetyStatus::default(),
        });
        serde_json::from_value(live).unwrap()
    }

    #[test]
    fn a_robot_without_an_estimate_says_why_and_what_helps() {
        let lines = |no_estimate: &str| {
            let friction = json!({
                "theta_loop": null, "theta_measured": null, "excited": true,
                "no_estimate": no_estimate,
            });
            friction_lines(&live(&friction)).join("\n")
        };
        let one_sided = lines("one_sided");
        let said = "no estimate    nearly all turns were to one side; turn to both sides";
        assert!(one_sided.contains(said), "{one_sided}");
        let newer = lines("a_reason_of_next_year");
        assert!(newer.contains("no estimate    for a reason"), "{newer}");
    }

    #[test]
    fn parameters_have_intervals_and_say_what_is_mostly_prior() {
        let estimate = |value: f64, is_prior: bool| json!({ "value": value, "std_dev": 0.1, "prior_dominated": is_prior });
        let friction = json!({
            "theta_loop": null,
            "theta_measured": { "theta": 0.25, "std_dev": 0.01 },
            "excited": true,
            "robot_parameters": {
                "apparent_mass_ratio": estimate(1.2, false),
                "mass_kg": estimate(20.0, true),
                "yaw_inertia_ratio": estimate(0.9, false),
                "center_of_mass_forward_m": estimate(0.01, false),
                "center_of_mass_left_m": estimate(-0.02, false),
            },
        });
        let lines = friction_lines(&live(&friction)).join("\n");
        for expected in [
            "apparent mass  1.200 ± 0.196 of the configured",
            "mass           20.000 ± 0.196 kg (mostly prior)",
            "centre left    -0.020 ± 0.196 m",
        ] {
            assert!(lines.contains(expected), "{lines}");
        }
        assert!(!lines.contains("no estimate"), "{lines}");
    }
}
