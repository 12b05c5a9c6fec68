//! Text output of `tread watch`: a line for each object and for each later change of it.

use std::collections::HashMap;

use jiff::Timestamp;
use tread_api::event::Event;
use tread_api::robot::Robot;

use crate::commands::mission_text::{state, trajectory};
use crate::commands::robots::{link_name, mode_name};

/// Maximum number of objects whose last line is kept; beyond it, all are dropped and printed once
/// more.
const PRINTED_MAX: usize = 100_000;

/// Last line printed for each object.
#[derive(Debug, Default)]
pub(super) struct Lines {
    printed: HashMap<String, String>,
}

impl Lines {
    /// Returns the line for an event; `None` if it equals the last line of the object, or the event
    /// has none.
    pub(super) fn take(&mut self, event: &Event) -> Option<String> {
        let (object, text) = match event {
            Event::Robot(robot) => (format!("robot    {}", robot.id), robot_text(robot)),
            Event::Mission(mission) => {
                let reason = mission.reason.as_deref().filter(|text| !text.is_empty());
                let reason = reason.map(|text| format!(": {text}")).unwrap_or_default();
                (
                    format!("mission  {}", mission.id),
                    format!(
                        "{} {}, {}{reason}",
                        mission.robot,
                        state(mission),
                        trajectory(&mission.trajectory)
                    ),
                )
            }
            Event::Alert(alert) => {
                let how = match (alert.cleared_at, alert.acknowledged_at) {
                    (Some(_), _) => "cleared",
                    (None, Some(_)) => "seen",
                    (None, None) => alert.severity.as_str(),
                };
                (
                    format!("alert    {}", alert.id),
                    format!("{} {how}: {}", alert.about(), alert.text),
                )
            }
            Event::SnapshotBegin
            | Event::SnapshotEnd
            | Event::Step(_)
            | Event::Map(_)
            | Event::End(_) => {
                return None;
            }
        };
        if self.printed.get(&object) == Some(&text) {
            return None;
        }
        if self.printed.len() >= PRINTED_MAX {
            self.printed.clear();
        }
        let line = format!("{}  {object}  {text}", now());
        self.printed.insert(object, text);
        Some(line)
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "the lines are for people who look now"
)]
fn now() -> String {
    Timestamp::now().strftime("%H:%M:%SZ").to_string()
}

/// Returns the text for a robot, without its pose, which changes all the time.
fn robot_text(robot: &Robot) -> String {
    let mut text = link_name(robot.link).to_owned();
    let Some(live) = &robot.live else {
        return format!("{text}, no message since the server started");
    };
    text = format!("{text}, {}", mode_name(live.mode));
    if let Some(stop) = &live.safety.stop {
        text = format!("{text}, STOPPED by {}: {}", stop.by, stop.reason);
    }
    if let Some(lease) = &live.safety.lease {
        text = format!("{text}, driven by {}", lease.driver.name);
    }
    if let Some(fault) = &live.fault {
        text = format!("{text}, fault: {fault}");
    }
    text
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_thing_is_said_again_only_when_it_has_changed() {
        let alert = |acknowledged: bool| -> Event {
            let at = "2026-11-21T08:00:00Z";
            let id = "0192f0c1-2b3c-7d4e-8f50-617283940a1b";
            serde_json::from_value(json!({"alert": {
                "id": id, "site": "yard", "robot": "rover-1", "code": "battery-low",
                "severity": "warning", "text": "12 % left", "raised_at": at,
                "acknowledged_at": acknowledged.then_some(at), "cleared_at": null,
            }}))
            .unwrap()
        };
        let mut lines = Lines::default();
        let first = lines.take(&alert(false)).expect("it is new");
        assert!(first.ends_with("rover-1 warning: 12 % left"), "{first}");
        assert_eq!(lines.take(&alert(false)), None);
        let seen = lines.take(&alert(true)).expect("somebody has seen it");
        assert!(seen.ends_with("rover-1 seen: 12 % left"), "{seen}");
        assert_eq!(lines.take(&Event::SnapshotEnd), None);
    }
}
