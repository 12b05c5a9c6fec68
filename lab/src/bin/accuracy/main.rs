//! Measures tracking errors, accuracy and coverage of θ, and the delay of change detection on our
//! own simulator.
//!
//! `cargo run --release -p tread-lab --no-default-features --bin accuracy --
//! [--runs N] [--threads N] [--json | --markdown] [--only tracking,theta,change,held-out]`
//!
//! Every run is seeded. Prints tables in Markdown, or with `--json` one object with the tables'
//! figures and `checks`; the process fails if one does not hold.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

mod change;
mod drives;
mod held_out;
mod report;
mod robot;
mod theta;
mod tracking;

use std::process::ExitCode;

use report::{Options, Section};

/// One part of the program.
type Part = fn(&Options) -> Section;

fn main() -> ExitCode {
    let options = match Options::from_arguments(std::env::args().skip(1)) {
        Ok(options) => options,
        Err(error) => {
            println!("{error}");
            return ExitCode::from(2);
        }
    };
    if let Err(error) = rayon::ThreadPoolBuilder::new()
        .num_threads(options.threads)
        .build_global()
    {
        println!(
            "accuracy: cannot start {} threads: {error}",
            options.threads
        );
        return ExitCode::from(2);
    }
    let parts: [(&str, Part); 4] = [
        ("tracking", tracking::run),
        ("theta", theta::run),
        ("change", change::run),
        ("held-out", held_out::run),
    ];
    let sections: Vec<(&str, Section)> = parts
        .into_iter()
        .filter(|(name, _)| options.wants(name))
        .map(|(name, part)| (name, part(&options)))
        .collect();
    println!("{}", report::render(&sections, options.json));
    if sections.iter().all(|(_, section)| section.holds()) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
