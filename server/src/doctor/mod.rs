//! `tread-server doctor` examines configuration, files, database, archive, certificates, ports, clock
//! and limits of a server. It works before the first start, beside a running server and after a
//! failure.
//!
//! It changes nothing: it removes its test file, and opens the database for reading only. Each
//! finding states the fault and the remedy.

mod archive;
mod certificates;
mod clock;
mod database;
mod files;
mod limits;
mod ports;
mod probe;

use std::io::Write as _;
use std::path::PathBuf;

use clap::Args;
use tread_api::diagnosis::{Finding, NextStep};

use crate::clock::Clock;
use crate::config::{Config, ServerArgs};
use crate::db::lock;
use crate::error_text::chain;

/// Arguments of `tread-server doctor`.
#[derive(Debug, Clone, Args)]
pub(crate) struct DoctorArgs {
    /// Configuration file of the server, TOML
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Database: a file, or the address `postgres://…` of a PostgreSQL database
    #[arg(long, value_name = "FILE")]
    database: Option<PathBuf>,
    /// Read the whole database and the whole archive, which takes seconds for each gigabyte
    #[arg(long)]
    deep: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Input of every check.
struct DoctorInput {
    config: Config,
    config_file: Option<PathBuf>,
    clock: Clock,
    /// Process that holds the database, if a server runs.
    server_process: Option<u32>,
    is_deep: bool,
}

/// Examines a server and prints the findings. Returns whether no problem was found.
///
/// # Errors
/// Standard output cannot be written.
pub(crate) async fn run(args: DoctorArgs) -> anyhow::Result<bool> {
    let is_json = args.json;
    let findings = examine(args).await;
    let mut out = std::io::stdout().lock();
    let is_well = findings.iter().all(Finding::holds);
    if is_json {
        let report = serde_json::json!({ "ok": is_well, "checks": findings });
        serde_json::to_writer(&mut out, &report)?;
        writeln!(out)?;
    } else {
        for finding in &findings {
            writeln!(out, "{} {}: {}", finding.mark(), finding.name, finding.text)?;
            if let Some(next_step) = &finding.next_step {
                writeln!(out, "      do: {next_step}")?;
            }
        }
    }
    Ok(is_well)
}

async fn examine(args: DoctorArgs) -> Vec<Finding> {
    let loaded = Config::load(&ServerArgs {
        config: args.config.clone(),
        database: args.database,
        ..ServerArgs::default()
    });
    let resolved = loaded.and_then(|mut config| config.find_credentials().map(|()| config));
    let config = match resolved {
        Ok(config) => config,
        Err(error) => {
            return vec![Finding::on("configuration").problem(
                chain(&error),
                NextStep(configuration_step(args.config.as_deref())),
            )];
        }
    };
    let source = match &args.config {
        Some(file) => format!("`{}` can be used", file.display()),
        None => "the built-in values are used, since no --config is given".to_owned(),
    };
    let examined = DoctorInput {
        server_process: lock::holder_of(&config.database),
        config,
        config_file: args.config,
        clock: Clock::system(),
        is_deep: args.deep,
    };
    let mut findings = vec![Finding::on("configuration").ok(source)];
    findings.push(match examined.server_process {
        Some(process) => Finding::on("server").ok(format!("it runs, as process {process}")),
        None => Finding::on("server").skipped("it does not run on this database"),
    });
    findings.extend(files::findings(&examined));
    let (of_database, inspection) = database::findings(&examined).await;
    findings.extend(of_database);
    let archived = inspection.as_ref().and_then(|found| found.archived);
    findings.extend(archive::finding(&examined, archived).await);
    let newest = inspection.and_then(|found| found.newest);
    findings.extend(clock::findings(&examined, newest));
    findings.extend(certificates::findings(&examined));
    findings.extend(ports::findings(&examined).await);
    findings.extend(limits::findings());
    findings
}

fn configuration_step(file: Option<&std::path::Path>) -> String {
    match file {
        Some(file) if !file.exists() => format!(
            "write one: `tread-server init --config {} --yes`, or without --yes in a terminal",
            file.display()
        ),
        Some(_) | None => {
            "correct it; docs/deployment.md has every setting with its default".to_owned()
        }
    }
}
