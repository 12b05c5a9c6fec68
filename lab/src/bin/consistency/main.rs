//! How soon and how surely the consistency monitor names a fault, and whether it stays silent without
//! one: `consistency [--json] [--hours N] [--trials N]`. Exits 1 if a check fails.

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

use figures::{Options, checks};
use serde_json::json;

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
    if options.json {
        let checks: Vec<_> = checks
            .iter()
            .map(|check| {
                json!({
                    "name": check.name, "goal": check.goal,
                    "value": check.value, "holds": check.holds,
                })
            })
            .collect();
        println!("{}", json!({ "checks": checks }));
    } else {
        for check in &checks {
            let mark = if check.holds { "holds" } else { "FAILS" };
            println!(
                "{mark}  {:<62} {:>9.3}  goal {}",
                check.name, check.value, check.goal
            );
        }
    }
    if holds {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
