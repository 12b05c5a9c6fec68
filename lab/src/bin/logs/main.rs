//! `logs`: reads recordings of other robots and says what Tread's estimator makes of them.
//!
//! `cargo run --release -p tread-lab --bin logs -- FILE… [--list] [--robot robot.toml] [--json]`
//!
//! `docs/logs.md` says what to record and what the figures mean.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

mod arguments;
mod print;

use std::process::ExitCode;

use anyhow::Context;
use clap::Parser as _;
use tread_lab::logs::analysis::analyse;
use tread_lab::logs::mapping::{choose, missing};
use tread_lab::logs::recording::{Contents, Recording};

use arguments::Arguments;

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let recording = Recording::open(&arguments.files)?;
    let contents = recording.contents()?;
    if arguments.list {
        list(&contents, arguments.json);
        return Ok(ExitCode::SUCCESS);
    }
    let robot = arguments.robot()?;
    let mapping = choose(&recording, &contents, &robot, &arguments.requested_topics())?;
    let first_ns = contents.topics.iter().map(|topic| topic.first_ns).min();
    let begin_ns = first_ns.context("a recording has messages")?;
    let options = arguments.options()?;
    let analysis = analyse(&recording, &mapping, &robot, &options, begin_ns)?;
    if arguments.json {
        println!("{}", print::json(&recording, &mapping, &analysis));
    } else {
        print::text(&mapping, &analysis);
    }
    Ok(if analysis.checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn list(contents: &Contents, is_json: bool) {
    let missing = missing(contents);
    if is_json {
        let topics: Vec<serde_json::Value> = contents
            .topics
            .iter()
            .map(|topic| {
                serde_json::json!({
                    "name": topic.name, "type": topic.message_type, "encoding": topic.encoding,
                    "count": topic.count, "rate_hz": topic.rate_hz(),
                })
            })
            .collect();
        println!(
            "{}",
            serde_json::json!({ "topics": topics, "torn": contents.torn, "missing": missing })
        );
        return;
    }
    print!("{}", contents.lines());
    for torn in &contents.torn {
        println!("torn: {torn}");
    }
    if missing.is_empty() {
        println!("nothing is missing for an estimate");
    }
    for missing in missing {
        println!("missing: {missing}");
    }
}
