//! `tread-agent replay`: prints the result of a replay, as text or JSON.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use serde_json::{Value, json};

use super::VERSION;
use super::replay::{DifferingTick, Replayed, replay};

/// Arguments of `tread-agent replay`.
#[derive(Debug, Clone, Args)]
pub(crate) struct ReplayArgs {
    /// All files of one run, starting with its first part
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Replays a record and prints the result. Returns whether it equals the record.
///
/// # Errors
/// The record cannot be read, unless JSON is printed, which then contains the error; or the output
/// cannot be written.
pub(crate) fn run(args: &ReplayArgs) -> anyhow::Result<bool> {
    let replayed = replay(&args.files);
    let mut out = std::io::stdout().lock();
    if args.json {
        let (object, holds) = match replayed {
            Ok(found) => (object(&found), holds(&found)),
            Err(refused) => (unread(&refused.into()), false),
        };
        serde_json::to_writer(&mut out, &object)?;
        writeln!(out)?;
        return Ok(holds);
    }
    let found = replayed?;
    write!(out, "{}", text(&found))?;
    Ok(holds(&found))
}

/// A figure of the replay and its goal.
#[derive(Debug, Serialize)]
struct Check {
    name: &'static str,
    goal: &'static str,
    value: u64,
    holds: bool,
}

fn checks(found: &Replayed) -> [Check; 3] {
    let gaps = u64::from(found.gap.is_some());
    [
        Check {
            name: "ticks run again",
            goal: ">= 1",
            value: found.ticks,
            holds: found.ticks > 0,
        },
        Check {
            name: "ticks that differ from the record",
            goal: "0",
            value: found.differing,
            holds: found.differing == 0,
        },
        Check {
            name: "gaps in the record",
            goal: "0",
            value: gaps,
            holds: gaps == 0,
        },
    ]
}

/// Whether at least one tick was replayed and none differs or is missing; a torn end is allowed.
pub(crate) fn holds(found: &Replayed) -> bool {
    checks(found).iter().all(|check| check.holds)
}

fn tick_json(tick: &DifferingTick) -> Value {
    let differences: Vec<Value> = tick
        .differences
        .iter()
        .map(|it| json!({ "name": it.name, "recorded": it.recorded, "replayed": it.replayed }))
        .collect();
    json!({ "tick": tick.tick, "after_s": tick.after_s, "differences": differences })
}

/// Returns the result as JSON.
pub(crate) fn object(found: &Replayed) -> Value {
    json!({
        "robot": found.head.robot,
        "boot": found.head.boot,
        "recorded_by": found.head.version,
        "replayed_by": VERSION,
        "lasting_s": found.lasting.as_secs_f64(),
        "driving_ticks": found.driving_ticks,
        "torn": found.torn,
        "gap": found.gap,
        "differing": found.first_differing.iter().map(tick_json).collect::<Vec<_>>(),
        "checks": checks(found),
    })
}

/// Returns the JSON for a record that cannot be read or replayed.
fn unread(refused: &anyhow::Error) -> Value {
    let check = Check {
        name: "records that cannot be run again",
        goal: "0",
        value: 1,
        holds: false,
    };
    json!({
        "replayed_by": VERSION,
        "refused": format!("{refused:#}"),
        "checks": [check],
    })
}

/// Returns the result as text.
pub(crate) fn text(found: &Replayed) -> String {
    let mut lines = vec![format!(
        "{} of `{}`: {} ticks over {:.1} s, {} of them driving",
        found.head.boot,
        found.head.robot,
        found.ticks,
        found.lasting.as_secs_f64(),
        found.driving_ticks,
    )];
    if found.is_of_another_version() {
        lines.push(format!(
            "recorded by tread-agent {}, and this is {VERSION}: differences may be what was changed between them",
            found.head.version,
        ));
    }
    if let Some(torn) = &found.torn {
        lines.push(format!(
            "the record is torn, and was read up to there: {torn}"
        ));
    }
    lines.extend(found.gap.clone());
    for tick in &found.first_differing {
        lines.push(format!(
            "tick {} after {:.3} s differs:",
            tick.tick, tick.after_s
        ));
        for it in &tick.differences {
            lines.push(format!(
                "    {}: {:?}, now {:?}",
                it.name, it.recorded, it.replayed
            ));
        }
    }
    lines.push(match found.differing {
        0 if found.ticks == 0 => "nothing was run again".to_owned(),
        0 => "no tick differs from the record".to_owned(),
        number => format!("{number} ticks differ from the record"),
    });
    lines.push(String::new());
    lines.join("\n")
}
