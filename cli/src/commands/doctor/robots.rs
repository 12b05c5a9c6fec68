//! Findings of the doctor about one robot.

use jiff::SignedDuration;
use tread_api::diagnosis::{Finding, NextStep};
use tread_api::robot::{LinkState, Robot};

use super::CLOCK_DIFFERENCE_MAX;
use crate::output::{age, joined};

/// Maximum number of records in a robot's outbox that is normal.
const OUTBOX_LONG: u64 = 1_000;
/// Maximum share of missing states on a good link.
const MISSED_SHARE_MAX: f64 = 0.05;
/// Maximum round trip of a command; a longer one impairs teleoperation.
const ROUND_TRIP_MAX_MS: f64 = 250.0;
/// Maximum number of reconnections within an hour on a good link.
const RECONNECTS_MAX: u64 = 6;

/// Examines one robot. Returns one finding for each fault.
pub(super) fn of_robot(robot: &Robot, server_version: Option<&str>) -> Vec<Finding> {
    let name = format!("robot {}", robot.id);
    let mut findings = Vec::new();
    let heard = robot.live.as_ref().map(|live| live.state_age_ms);
    match robot.link {
        LinkState::Online => {}
        LinkState::Stale => findings.push(Finding::on(&name).warning(
            "some of its heartbeats are missing",
            NextStep("see its radio link; `tread watch` shows whether it lasts"),
        )),
        LinkState::Offline => {
            let since = heard.map_or_else(
                || format!("its last connection was at {:.0}", robot.last_hello_at),
                |heard_ms| format!("it was heard {} ago", age(heard_ms)),
            );
            let cause = robot.link_cause.and_then(|cause| {
                let name = serde_json::to_value(cause).ok()?;
                Some(format!(" ({})", name.as_str()?.replace('_', " ")))
            });
            findings.push(Finding::on(&name).problem(
                format!("it is offline{}; {since}", cause.unwrap_or_default()),
                NextStep(
                    "see docs/runbook.md, robot-lost; `tread robots retire` one that never returns",
                ),
            ));
        }
    }
    if let Some(live) = &robot.live {
        let offset = SignedDuration::from_millis(live.clock_offset_ms);
        if robot.link != LinkState::Offline && offset.abs() > CLOCK_DIFFERENCE_MAX {
            let which = if offset.is_negative() {
                "behind"
            } else {
                "ahead of"
            };
            findings.push(Finding::on(&name).problem(
                format!(
                    "its clock is {} s {which} the server's",
                    offset.abs().as_secs()
                ),
                NextStep(
                    "have the robot's clock synchronised (chrony), and start its agent again: an \
                     agent takes the wall time once",
                ),
            ));
        }
        if live.outbox.pending > OUTBOX_LONG {
            findings.push(Finding::on(&name).warning(
                format!("{} records wait in its outbox", live.outbox.pending),
                NextStep("see docs/runbook.md, outbox-long"),
            ));
        }
        if live.outbox.dropped > 0 {
            findings.push(Finding::on(&name).warning(
                format!("{} of its records were lost", live.outbox.dropped),
                NextStep("see docs/runbook.md, outbox-dropped"),
            ));
        }
    }
    findings.extend(link(&name, robot));
    if server_version.is_some_and(|version| version != robot.agent_version) {
        findings.push(Finding::on(&name).warning(
            format!(
                "its agent is of {}, and the server of {}",
                robot.agent_version,
                server_version.unwrap_or_default()
            ),
            NextStep("bring both to the same version; releases next to each other work together"),
        ));
    }
    if findings.is_empty() {
        let round_trip = robot.link_quality.and_then(|link| link.round_trip_ms);
        let round_trip = round_trip.map_or_else(String::new, |round_trip_ms| {
            format!(", it answers within {round_trip_ms:.0} ms")
        });
        findings.push(Finding::on(&name).ok(format!("it is online{round_trip}")));
    }
    findings
}

/// Examines the quality of a robot's link.
#[expect(clippy::cast_precision_loss, reason = "counts of an hour")]
fn link(name: &str, robot: &Robot) -> Option<Finding> {
    let link = robot.link_quality?;
    let all = link.states_received + link.states_missed;
    let missed = if all == 0 {
        0.0
    } else {
        link.states_missed as f64 / all as f64
    };
    let mut poor = Vec::new();
    if missed > MISSED_SHARE_MAX {
        poor.push(format!(
            "{:.0} % of its states did not arrive",
            missed * 100.0
        ));
    }
    if link.reconnects > RECONNECTS_MAX {
        poor.push(format!("it connected again {} times", link.reconnects));
    }
    if let Some(took_ms) = link.round_trip_ms.filter(|it| *it > ROUND_TRIP_MAX_MS) {
        poor.push(format!("its last answer took {took_ms:.0} ms"));
    }
    (!poor.is_empty()).then(|| {
        Finding::on(name).warning(
            format!("its link is poor; in the last hour: {}", joined(&poor)),
            NextStep("look after its radio link: place of antennas, channel, other traffic"),
        )
    })
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::super::describe;
    use super::*;

    fn robot(change: impl FnOnce(&mut Value)) -> Robot {
        let at = "2026-11-02T10:00:00Z";
        let mut robot = json!({
            "id": "rover-1", "name": "rover-1", "tags": [], "retired_at": null, "site": "yard",
            "model": {
                "name": "m", "tyres": "t", "mass_kg": 40.0, "track_width_m": 0.5,
                "wheelbase_m": 0.4, "wheel_radius_m": 0.1, "yaw_inertia_kg_m2": 2.0,
                "limits": {
                    "linear_max_m_s": 1.0, "angular_max_rad_s": 1.0,
                    "linear_acceleration_max_m_s2": 1.0, "lateral_acceleration_max_m_s2": 1.0,
                    "linear_jerk_max_m_s3": 1.0, "wheel_speed_max_rad_s": 10.0,
                    "wheel_acceleration_max_rad_s2": 10.0,
                },
            },
            "configuration": "0192f0c1-2b3c-7d4e-8f50-617283940a1b", "capabilities": {},
            "agent_version": "0.1.0", "first_seen_at": at, "last_hello_at": at,
            "measurements": {"refused": 0, "refusal_reason": null, "deferred": 0},
            "link": "online", "link_cause": null, "alerts": [], "live": null,
        });
        change(&mut robot);
        serde_json::from_value(robot).unwrap()
    }

    fn texts(robot: &Robot) -> String {
        describe(&of_robot(robot, Some("0.1.0")))
    }

    #[test]
    fn a_robot_that_is_well_is_one_line() {
        let well = robot(|robot| {
            robot["link_quality"] = json!({
                "round_trip_ms": 4.2, "round_trip_age_ms": 10, "delay_variation_ms": 1,
                "states_received": 100, "states_missed": 2, "reconnects": 1,
            });
        });
        assert_eq!(
            texts(&well),
            "ok    robot rover-1: it is online, it answers within 4 ms"
        );
    }

    #[test]
    fn each_thing_that_is_wrong_with_a_robot_is_said_with_what_to_do() {
        let poor = robot(|robot| {
            robot["link"] = json!("offline");
            robot["link_cause"] = json!("robot_off");
            robot["agent_version"] = json!("0.0.9");
            robot["link_quality"] = json!({
                "round_trip_ms": 900.0, "round_trip_age_ms": 10, "delay_variation_ms": null,
                "states_received": 50, "states_missed": 50, "reconnects": 9,
            });
        });
        let said = texts(&poor);
        for part in [
            "WRONG robot rover-1: it is offline (robot off); its last connection was at",
            "50 % of its states did not arrive, it connected again 9 times, its last answer took 900 ms",
            "its agent is of 0.0.9, and the server of 0.1.0",
        ] {
            assert!(said.contains(part), "`{part}` in {said}");
        }
        assert_eq!(said.matches("do: ").count(), 3, "{said}");
    }
}
