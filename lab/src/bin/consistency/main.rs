//! How soon and how surely the consistency monitor names a fault, and whether it stays silent without
//! one: `consistency [--json | --markdown] [--hours N] [--trials N]`. Exits 1 if a check fails.

#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a report program"
)]

mod figures;
#[cfg_attr(
    test,
    expect(dead_code, reason = "`lab/tests/consistency.rs` uses the rest")
)]
mod generator;

use std::process::ExitCode;

use figures::{Options, Output, checks};
use serde_json::json;
use tread_lab::report::{checks_json, checks_markdown};

fn main() -> ExitCode {
    let options = match Options::from_arguments(std::env::args().skip(1)) {
        Ok(options) => options,
        Err(usage) => {
            eprintln!("{usage}");
            return ExitCode::from(2);
        }
    };
    let checks = checks(&options);
    let holds = checks.iter().all(|check| check.holds);
    match options.output {
        Output::Json => println!("{}", json!({ "checks": checks_json(&checks) })),
        Output::Markdown => print!("{}", checks_markdown(&checks)),
        Output::Lines => {
            for check in &checks {
                println!(
                    "{}  {:<62} {:>9}  goal {}",
                    check.verdict(),
                    check.name,
                    check.figure(3),
                    check.goal
                );
            }
        }
    }
    if holds {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
