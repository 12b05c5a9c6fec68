//! Reads millions of mutated messages: none may make a reader panic, or allocate more than the
//! message is long.
//!
//! `cargo run --release -p tread-ros2 --example mutate -- --json` exits with 1 if a check does not
//! hold.

use std::alloc::System;
use std::process::ExitCode;

use clap::Parser;
use serde::Serialize;
use stats_alloc::{INSTRUMENTED_SYSTEM, StatsAlloc};

mod mutants;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Reads mutated messages of every type.
#[derive(Debug, Parser)]
struct Words {
    /// How many
    #[arg(long, default_value_t = 10_000_000)]
    inputs: u64,
    /// What makes them these
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Check {
    name: &'static str,
    goal: u64,
    value: u64,
    holds: bool,
}

#[derive(Debug, Serialize)]
struct Report {
    inputs: u64,
    seed: u64,
    accepted_readings: u64,
    allocated_max_bytes: usize,
    checks: [Check; 3],
}

#[expect(clippy::print_stdout, reason = "this is a report program")]
fn main() -> ExitCode {
    let words = Words::parse();
    let outcome = mutants::run(words.seed, words.inputs, || {
        ALLOCATOR.stats().bytes_allocated
    });
    let none = |name, value| Check {
        name,
        goal: 0,
        value,
        holds: value == 0,
    };
    let report = Report {
        inputs: outcome.inputs,
        seed: words.seed,
        accepted_readings: outcome.accepted,
        allocated_max_bytes: outcome.allocated_max_bytes,
        checks: [
            Check {
                name: "inputs",
                goal: words.inputs,
                value: outcome.inputs,
                holds: outcome.inputs == words.inputs,
            },
            none("panics", outcome.panics),
            none(
                "allocations above the message's size",
                outcome.allocated_above_size,
            ),
        ],
    };
    if words.json {
        match serde_json::to_string(&report) {
            Ok(line) => println!("{line}"),
            Err(_) => return ExitCode::FAILURE,
        }
    } else {
        println!(
            "{} mutated messages, {} readings gave a message all the same, at most {} B allocated",
            report.inputs, report.accepted_readings, report.allocated_max_bytes
        );
        for check in &report.checks {
            let mark = if check.holds {
                "holds"
            } else {
                "DOES NOT HOLD"
            };
            println!(
                "{}: {} (goal {}): {mark}",
                check.name, check.value, check.goal
            );
        }
    }
    if report.checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
