//! Initialises structured logging to standard error.

use std::io::IsTerminal as _;

use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;

use crate::config::{LogFormat, ServerArgs};

/// Default log filter, without `--log` and `RUST_LOG`.
const FILTER_DEFAULT: &str = "info,sqlx=warn,zenoh=warn,zenoh_transport=warn";

/// Starts logging for the whole process; a second call has no effect.
///
/// # Errors
/// The filter of `--log` or `RUST_LOG` cannot be parsed.
pub(crate) fn start(args: &ServerArgs) -> anyhow::Result<()> {
    let filter = match &args.log {
        Some(filter) => EnvFilter::try_new(filter)?,
        None if std::env::var_os(EnvFilter::DEFAULT_ENV).is_some() => {
            EnvFilter::try_from_default_env()?
        }
        None => EnvFilter::try_new(FILTER_DEFAULT)?,
    };
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        // A line that cannot be written is lost; the library would say so by `eprintln`, which panics then.
        .log_internal_errors(false)
        .with_ansi(std::io::stderr().is_terminal());
    let registry = tracing_subscriber::registry().with(filter);
    // The only possible error is that an embedding program started logging before.
    let _ = match args.log_format {
        LogFormat::Human => registry.with(lines).try_init(),
        LogFormat::Json => registry.with(lines.json()).try_init(),
    };
    Ok(())
}
