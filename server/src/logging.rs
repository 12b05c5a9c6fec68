//! Initialises structured logging to standard error.

use std::io::IsTerminal as _;

use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;

use tread_telemetry::{LOG_FILTER_DEFAULT, log_filter};

use crate::config::{LogFormat, ServerArgs};

/// Starts logging for the whole process; a second call has no effect.
///
/// # Errors
/// The filter of `--log` or `RUST_LOG` cannot be parsed.
pub(crate) fn start(args: &ServerArgs) -> anyhow::Result<()> {
    let given = match &args.log {
        Some(filter) => filter.clone(),
        None if std::env::var_os(EnvFilter::DEFAULT_ENV).is_some() => {
            std::env::var(EnvFilter::DEFAULT_ENV)?
        }
        None => LOG_FILTER_DEFAULT.to_owned(),
    };
    let filter = EnvFilter::try_new(log_filter(&given))?;
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

#[cfg(test)]
mod tests {
    use tracing::{Level, enabled};

    use super::*;

    #[test]
    fn of_zenoh_only_errors_and_of_sqlx_only_warnings_are_logged_unless_the_filter_names_them() {
        let logged = |given: &str| {
            let filter = EnvFilter::try_new(log_filter(given)).unwrap();
            let subscriber = tracing_subscriber::registry().with(filter);
            tracing::subscriber::with_default(subscriber, || {
                [
                    enabled!(target: "zenoh_link_commons::unicast", Level::WARN),
                    enabled!(target: "sqlx::query", Level::INFO),
                    enabled!(target: "sqlx::query", Level::WARN),
                    enabled!(target: "tread_audit", Level::INFO),
                ]
            })
        };
        assert_eq!(logged(LOG_FILTER_DEFAULT), [false, false, true, true]);
        let own_detail = "info,tread_server=debug";
        assert_eq!(logged(own_detail), [false, false, true, true]);
        let all = "info,zenoh=warn,sqlx=info";
        assert_eq!(logged(all), [true, true, true, true]);
    }
}
