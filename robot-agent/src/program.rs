//! The agent as a program: logging → configuration → start → wait → stop.

use std::ffi::OsString;
use std::io::IsTerminal as _;
use std::process::ExitCode;

use anyhow::Context;
use clap::{Parser, Subcommand};
use tracing::{error, info, warn};
use tracing_subscriber::EnvFilter;
use tread_api::startup::{apply_environment, ignores_hangup};
use tread_telemetry::log_filter;

use crate::agent::{Agent, RunningAgent};
use crate::config::{AgentConfig, Flags, LogFormat};
use crate::doctor::{self, DoctorArgs};
use crate::enroll::{self, EnrollArgs};
use crate::recording::report::{self, ReplayArgs};
use crate::recording::salvage::{self, RecoverArgs};

/// Exit code for invalid arguments.
const USAGE: u8 = 2;

/// Drives one robot and measures the friction of the ground.
#[derive(Debug, Parser)]
#[command(name = "tread-agent", version = tread_api::release::long_version(), args_conflicts_with_subcommands = true)]
struct Arguments {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    flags: Flags,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Join the fleet with a join token: get a certificate and store it in the robot's folder
    Enroll(EnrollArgs),
    /// Check the installation on a ROS 2 robot and print what is wrong
    Doctor(DoctorArgs),
    /// Run controller and estimator again on a record and print the differences
    Replay(ReplayArgs),
    /// Copy the readable part of a damaged or truncated record into a valid one
    Recover(RecoverArgs),
}

/// Returns the definition of the program's command line.
pub fn command_line() -> clap::Command {
    <Arguments as clap::CommandFactory>::command()
}

/// Runs an agent until SIGTERM or ctrl-c stops it; the first argument is the
/// program's name. Sets up logging, so it is for whole processes.
///
/// The code is 0 after an orderly stop, 1 when the agent could not start or a part of it failed,
/// and 2 for wrong flags.
pub fn run_from_args(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    // The first call counts; all install the same provider.
    let _first = rustls::crypto::ring::default_provider().install_default();
    let arguments = match Arguments::try_parse_from(arguments) {
        Ok(arguments) => arguments,
        Err(message) => {
            // Help and version are printed here too; a failure to print cannot be reported.
            let _ = message.print();
            return ExitCode::from(u8::try_from(message.exit_code()).unwrap_or(USAGE));
        }
    };
    if let Err(cause) = init_logging(&arguments.flags) {
        eprintln!("error: {cause:#}");
        return ExitCode::from(USAGE);
    }
    // Whether the result is good, where a command prints a result.
    let ended = match arguments.action {
        Some(Action::Enroll(args)) => run_enroll(args).map(|()| true),
        Some(Action::Doctor(args)) => doctor::run(&args),
        Some(Action::Replay(args)) => report::run(&args),
        Some(Action::Recover(args)) => salvage::run(&args),
        None => run(&arguments.flags).map(|()| true),
    };
    match ended {
        Ok(true) => ExitCode::SUCCESS,
        // What is wrong has been printed.
        Ok(false) => ExitCode::FAILURE,
        Err(cause) => {
            error!("{cause:#}");
            ExitCode::FAILURE
        }
    }
}

fn init_logging(flags: &Flags) -> anyhow::Result<()> {
    let log = &flags.log;
    let filter = EnvFilter::try_new(log_filter(log));
    let filter = filter.with_context(|| {
        format!(
            "the log filter `{log}` is invalid; give a level, such as `info`, or `info,zenoh=warn`"
        )
    })?;
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        // A line that cannot be written, as on a full disk or a closed pipe, is lost. Otherwise the library
        // says so by `eprintln`, which panics then.
        .log_internal_errors(false)
        .with_ansi(std::io::stderr().is_terminal());
    // A process with a subscriber keeps it.
    let _ = match flags.log_format {
        LogFormat::Human => subscriber.try_init(),
        LogFormat::Json => subscriber.json().try_init(),
    };
    Ok(())
}

fn run_enroll(args: EnrollArgs) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("no runtime")?;
    runtime.block_on(enroll::run(args))
}

fn run(flags: &Flags) -> anyhow::Result<()> {
    if let Err(cause) = apply_environment() {
        warn!(
            "zenoh has few threads, the robot may be silent for seconds after a loss of the \
             link: {cause}"
        );
    }
    let config = AgentConfig::load(flags)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("no runtime")?;
    let ended = runtime.block_on(async {
        let mut agent = Agent::start(config)?;
        agent.notify_service_manager()?;
        let ended = wait(&agent).await;
        agent.stop().await;
        ended
    });
    // A thread that waits for an absent server must not block the exit.
    runtime.shutdown_background();
    ended
}

/// Waits for a signal, or for a part that ends unexpectedly.
async fn wait(agent: &RunningAgent) -> anyhow::Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut terminate = signal(SignalKind::terminate()).context("no signal handler")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("no signal handler")?;
    // The terminal that the agent was started from may be closed: the robot must brake all the same.
    let ignores_hangup = ignores_hangup();
    let mut hangup = signal(SignalKind::hangup()).context("no signal handler")?;
    tokio::select! {
        _ = hangup.recv(), if !ignores_hangup => info!("stopping by SIGHUP"),
        _ = terminate.recv() => info!("stopping by SIGTERM"),
        _ = interrupt.recv() => info!("stopping by ctrl-c"),
        ended = agent.failed() => return Err(ended.into()),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use tracing::{Level, enabled};
    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;

    #[test]
    fn of_zenoh_only_errors_are_logged_unless_the_filter_names_it() {
        let logged = |given: &str| {
            let filter = EnvFilter::try_new(log_filter(given)).unwrap();
            let subscriber = tracing_subscriber::registry().with(filter);
            tracing::subscriber::with_default(subscriber, || {
                [
                    enabled!(target: "zenoh_transport::unicast", Level::ERROR),
                    enabled!(target: "zenoh_transport::unicast", Level::WARN),
                    enabled!(target: "tread_agent::online", Level::INFO),
                    enabled!(target: "tread_agent::online", Level::DEBUG),
                ]
            })
        };
        let default = tread_telemetry::LOG_FILTER_DEFAULT;
        assert_eq!(logged(default), [true, false, true, false]);
        let own_detail = "info,tread_agent=debug";
        assert_eq!(logged(own_detail), [true, false, true, true]);
        assert_eq!(logged("info,zenoh=warn"), [true, true, true, false]);
        let of_crate = "info,zenoh_transport=warn";
        assert_eq!(logged(of_crate), [true, true, true, false]);
        assert_eq!(logged(""), [true, false, false, false]);
    }
}
