//! Missions in words: one line, a state, a trajectory.

use tread_api::mission::{Mission, MissionState};
use tread_api::trajectory::{Direction, Trajectory};

/// Returns one line about a mission.
pub(super) fn summary(mission: &Mission) -> String {
    let reason = mission
        .reason
        .as_ref()
        .map(|reason| format!(": {reason}"))
        .unwrap_or_default();
    format!(
        "mission {} on {}: {}, {}{reason}",
        mission.id,
        mission.robot,
        trajectory(&mission.trajectory),
        state(mission)
    )
}

/// Returns a mission's state, with a change in progress in parentheses.
pub(super) fn state(mission: &Mission) -> String {
    let word = mission.state.as_str();
    if mission.state.is_terminal() {
        return word.to_owned();
    }
    let is_paused = mission.state == MissionState::Paused;
    let under_way = match (mission.pause_requested, is_paused) {
        (true, false) => Some("pausing"),
        (false, true) => Some("resuming"),
        (true, true) | (false, false) => mission.replacement.as_ref().map(|_next| "replacing"),
    };
    match under_way {
        Some(under_way) => format!("{word} ({under_way})"),
        None => word.to_owned(),
    }
}

/// Returns a short description of a trajectory.
pub(super) fn trajectory(trajectory: &Trajectory) -> String {
    match trajectory {
        Trajectory::Circle(circle) => {
            let direction = match circle.direction {
                Direction::CounterClockwise => "ccw",
                Direction::Clockwise => "cw",
            };
            let one = (circle.turns - 1.0).abs() < f64::EPSILON;
            let turns = if one { "turn" } else { "turns" };
            format!(
                "circle R {} m, {} {turns} {direction}",
                circle.radius_m, circle.turns
            )
        }
        Trajectory::Waypoints(waypoints) => format!("{} waypoints", waypoints.points.len()),
    }
}
