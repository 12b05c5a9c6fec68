//! Structured logs on standard error.

use std::io::IsTerminal as _;

use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;

use crate::config::{LogFormat, ServerArgs};

/// What is logged when neither flag nor environment says otherwise.
const FILTER_DEFAULT: &str = "info,zenoh=warn,zenoh_transport=warn";

/// Starts logging for the whole process; a second call changes nothing.
///
/// # Errors
/// A filter that does not parse.
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
        .with_ansi(std::io::stderr().is_terminal());
    let registry = tracing_subscriber::registry().with(filter);
    // The only error is that logging was started before, by a program that embeds this one.
    let _ = match args.log_format {
        LogFormat::Human => registry.with(lines).try_init(),
        LogFormat::Json => registry.with(lines.json()).try_init(),
    };
    Ok(())
}
