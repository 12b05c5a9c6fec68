//! A zenoh router without a server, to compare with: it takes robots' sessions and reads their states,
//! and does nothing with them. Its settings are those of the server's router.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Parser;
use tokio::signal::unix::{SignalKind, signal};
use tread_api::keys;
use tread_api::wire::{BATCH_BYTES, SESSION_LEASE_MS};
use zenoh::Wait as _;

/// Maximum number of sessions, and of those that are being opened.
const SESSIONS_MAX: u32 = 10_000;

/// A zenoh router that reads robots' states.
#[derive(Debug, Parser)]
#[command(name = "router")]
struct Arguments {
    /// Where it listens, as tcp/address:port
    #[arg(long)]
    listen: String,
}

/// Runs until SIGTERM; failures go to the standard error.
pub fn run_from_args(arguments: Vec<OsString>) -> ExitCode {
    match run(&Arguments::parse_from(arguments)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let failed = |error: zenoh::Error| anyhow::anyhow!("zenoh: {error}");
    let session = zenoh::open(config(&arguments.listen).map_err(failed)?)
        .wait()
        .map_err(failed)?;
    session
        .declare_subscriber(keys::ALL_STATES)
        .callback(|sample| {
            std::hint::black_box(sample.payload().len());
        })
        .background()
        .wait()
        .map_err(failed)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    runtime.block_on(async {
        let mut stop = signal(SignalKind::terminate())?;
        stop.recv().await;
        anyhow::Ok(())
    })?;
    session.close().wait().map_err(failed)
}

fn config(listen: &str) -> zenoh::Result<zenoh::Config> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"router\"".to_owned()),
        ("listen/endpoints", format!("[\"{listen}\"]")),
        ("transport/link/tx/batch_size", BATCH_BYTES.to_string()),
        ("transport/link/tx/lease", SESSION_LEASE_MS.to_string()),
        ("transport/unicast/max_sessions", SESSIONS_MAX.to_string()),
        ("transport/unicast/accept_pending", SESSIONS_MAX.to_string()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("scouting/delay", "0".to_owned()),
        ("timestamping/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value)?;
    }
    Ok(config)
}
