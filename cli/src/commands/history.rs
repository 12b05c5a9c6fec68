//! A mission's history for people: steps that repeat are one row.

use tread_api::mission::{MissionEvent, MissionState};

use crate::output::{or_dash, render, table};

/// Numbers of steps that may repeat together: one that is recorded again and again, and being
/// offered and given back.
const PERIODS: [usize; 2] = [1, 2];

/// Steps of a history that came `times` in the same order.
struct Repeated<'events> {
    steps: &'events [MissionEvent],
    times: usize,
    last: &'events MissionEvent,
}

/// Returns how often the first `period` steps come again in the same order, at least once.
fn repeats(events: &[MissionEvent], period: usize) -> usize {
    let kind = |event: &MissionEvent| (event.to, event.cause);
    let same = events
        .iter()
        .zip(events.iter().take(period).cycle())
        .take_while(|(event, model)| kind(event) == kind(model))
        .count();
    same / period
}

/// Groups steps that repeat.
fn collapsed(mut events: &[MissionEvent]) -> Vec<Repeated<'_>> {
    let mut lines = Vec::new();
    while !events.is_empty() {
        let period = PERIODS
            .into_iter()
            .find(|period| repeats(events, *period) > 1)
            .unwrap_or(1);
        let times = repeats(events, period);
        let (these, rest) = events.split_at(period * times);
        if let Some(last) = these.last() {
            lines.push(Repeated {
                steps: &these[..period],
                times,
                last,
            });
        }
        events = rest;
    }
    lines
}

/// Returns the table of a history.
pub(super) fn history_table(events: &[MissionEvent]) -> String {
    let mut table = table(["AT", "WHO", "FROM", "TO", "WHY"]);
    for Repeated { steps, times, last } in collapsed(events) {
        let first = &steps[0];
        let reason = last.reason.clone().unwrap_or_default();
        let why = if times == 1 {
            reason
        } else {
            let end = if reason.is_empty() { "" } else { ": " };
            format!(
                "{} {times} times, last {:.3}{end}{reason}",
                first.to.as_str(),
                last.at
            )
        };
        table.add_row([
            format!("{:.3}", first.at),
            first.actor.as_str().to_owned(),
            or_dash(first.from.map(MissionState::as_str)),
            last.to.as_str().to_owned(),
            why,
        ]);
    }
    render(&table)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(words: &[(&str, &str)]) -> Vec<MissionEvent> {
        let step = |(second, (to, cause)): (usize, &(&str, &str))| {
            serde_json::from_value(serde_json::json!({
                "at": format!("2026-01-01T00:00:{second:02}Z"), "actor": "server",
                "from": null, "to": to, "cause": cause,
                "reason": (*cause == "returned").then_some("the robot is stopped"),
            }))
            .unwrap()
        };
        words.iter().enumerate().map(step).collect()
    }

    #[test]
    fn a_mission_that_was_offered_again_and_again_has_one_row_for_it() {
        let mut words = vec![("queued", "requested")];
        for _ in 0..12 {
            words.extend([("offered", "offered"), ("queued", "returned")]);
        }
        words.extend([("offered", "offered"), ("active", "accepted")]);
        let events = steps(&words);
        let shown = history_table(&events);
        assert_eq!(shown.lines().count(), 5, "{shown}");
        let row = "offered 12 times, last 2026-01-01T00:00:24.000Z: the robot is stopped";
        assert!(shown.contains(row), "{shown}");
        let counted: usize = collapsed(&events)
            .iter()
            .map(|line| line.times * line.steps.len())
            .sum();
        assert_eq!(counted, events.len(), "no step is lost");
    }

    #[test]
    fn steps_that_came_once_each_keep_rows_of_their_own() {
        let events = steps(&[
            ("queued", "requested"),
            ("offered", "offered"),
            ("queued", "returned"),
            ("cancelled", "cancelled"),
        ]);
        let shown = history_table(&events);
        assert_eq!(shown.lines().count(), 5, "{shown}");
        assert!(!shown.contains("times"), "{shown}");
    }
}
