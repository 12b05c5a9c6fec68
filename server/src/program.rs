//! The program: its commands, and the server's run until a signal.

use std::ffi::OsString;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser as _;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use tokio::signal::unix::{SignalKind, signal};
use tracing::{info, warn};
use tread_api::startup::{apply_environment, ignores_hangup};

use crate::clock::Clock;
use crate::webhooks::SystemResolver;
use crate::{Config, Server, ServerArgs, build, doctor, health, init, logging, maintenance};

/// Nice value of the lowest priority.
const NICE_LOWEST: i32 = 19;
/// Maximum wait for blocking threads after all tasks have stopped; then they are abandoned.
const RUNTIME_STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// Server of Tread: sends missions to robots, maps the friction that they measure, has a REST API.
#[derive(Debug, clap::Parser)]
#[command(name = "tread-server", version = build::long_version(), args_conflicts_with_subcommands = true)]
struct Command {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    server: ServerArgs,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Exit with 0 if the server on this machine answers, for health checks of containers
    Health(health::HealthArgs),
    /// Write a configuration if there is none, and create the first admin's token
    Init(Box<init::InitArgs>),
    /// Check configuration, files, database, certificates, ports, clock and limits
    Doctor(doctor::DoctorArgs),
    /// Accept the next certificate that each robot presents, for use after restoring a backup of
    /// the database
    ForgetCertificates(init::ForgetArgs),
    /// Back up the database and the fleet's authority to one file, also while the server runs
    Backup(maintenance::backup::BackupArgs),
    /// Restore a backup; no server may run on the database
    Restore(maintenance::restore::RestoreArgs),
    /// Hold robots and list what to review, after the database was restored with its own tools;
    /// `restore` does this itself
    MarkRestored(maintenance::mark_restored::MarkRestoredArgs),
    /// Copy everything into a new database, from SQLite to PostgreSQL or back, and compare both; no
    /// server may run on either
    Copy(maintenance::copy::CopyArgs),
    /// Show or apply the changes of the database's schema that this version needs
    Migrate(maintenance::migrate::MigrateArgs),
}

/// Returns the definition of the command line, for documentation and tests.
pub fn command_line() -> clap::Command {
    <Command as clap::CommandFactory>::command()
}

/// Runs the whole program with these arguments, the first of which is the program's name.
///
/// Prints errors on standard error and returns the exit code: 0 after a requested stop, 1 after a
/// failure, 2 for invalid arguments.
pub fn run_from_args(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let command = match Command::try_parse_from(arguments) {
        Ok(command) => command,
        Err(error) => {
            // Help and version are printed here too. A failure to print has no other output.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    let ended = match command.action {
        Some(Action::Health(args)) => run_beside_server(health::run(args)),
        Some(Action::Init(args)) => run_beside_server(init::run(*args)),
        Some(Action::Doctor(args)) => match run_beside_server(doctor::run(args)) {
            Ok(true) => Ok(()),
            // The findings have been printed.
            Ok(false) => return ExitCode::FAILURE,
            Err(error) => Err(error),
        },
        Some(Action::ForgetCertificates(args)) => {
            run_beside_server(init::delete_certificate_records(args))
        }
        Some(Action::Backup(args)) => {
            lower_priority();
            run_beside_server(maintenance::backup::run(args))
        }
        Some(Action::Restore(args)) => run_beside_server(maintenance::restore::run(args)),
        Some(Action::MarkRestored(args)) => {
            run_beside_server(maintenance::mark_restored::run(args))
        }
        Some(Action::Copy(args)) => run_beside_server(maintenance::copy::run(args)),
        Some(Action::Migrate(args)) => {
            return maintenance::migrate::exit_code(run_beside_server(maintenance::migrate::run(
                args,
            )));
        }
        None => run(&command.server),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Raises the soft limit of open files to the hard limit, because the usual soft limit is below the
/// maximum number of connections.
fn raise_file_limit() {
    let raised = getrlimit(Resource::RLIMIT_NOFILE)
        .and_then(|(_, most)| setrlimit(Resource::RLIMIT_NOFILE, most, most));
    if let Err(error) = raised {
        warn!("cannot raise the limit of open files: {error}");
    }
}

/// Lowers the priority of this process, so that a server on the same machine runs first. Call it
/// before any thread starts: Linux lowers that of the calling thread and of those that it starts.
fn lower_priority() {
    if let Err(error) = rustix::process::nice(NICE_LOWEST) {
        eprintln!("cannot lower the priority: {error}");
    }
}

fn run_beside_server<T>(command: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    runtime.block_on(command)
}

/// Runs the server until SIGTERM, SIGINT or the failure of a vital task.
///
/// # Errors
/// The configuration is invalid, the server cannot start, or a vital task failed.
pub fn run(args: &ServerArgs) -> anyhow::Result<()> {
    let environment = apply_environment();
    logging::start(args)?;
    if let Err(cause) = environment {
        warn!(
            "zenoh has few threads and the allocator keeps memory, robots may be silent for \
             seconds after a loss of the link: {cause}"
        );
    }
    let config = Config::load(args)?;
    raise_file_limit();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let ended = runtime.block_on(async {
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let ignores_hangup = ignores_hangup();
        let mut hangup = signal(SignalKind::hangup())?;
        let mut stop_requested = async || {
            tokio::select! {
                _ = terminate.recv() => info!("asked to stop"),
                _ = interrupt.recv() => info!("asked to stop"),
                _ = hangup.recv(), if !ignores_hangup => info!("asked to stop: its terminal is closed"),
            }
        };
        // A standby may wait for long.
        let (clock, resolver) = (Clock::system(), Arc::new(SystemResolver));
        let started = Server::start_until(stop_requested(), config, clock, resolver).await?;
        let Some(server) = started else {
            return Ok(());
        };
        server.notify_service_manager();
        tokio::select! {
            () = stop_requested() => {}
            () = server.failed() => {}
        }
        server.stop().await
    });
    // A thread that blocks in a system call must not keep the process from ending.
    runtime.shutdown_timeout(RUNTIME_STOP_TIMEOUT);
    ended
}
