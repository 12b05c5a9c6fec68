//! `tread-server health`: whether the server on this machine answers, for health checks of
//! containers and of other service managers.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context as _, bail};
use clap::Args;

use crate::config::{Config, ServerArgs};

/// Maximum time for the answer.
const ANSWER_MAX: Duration = Duration::from_secs(3);

/// Arguments of `tread-server health`.
#[derive(Debug, Clone, Args)]
pub(crate) struct HealthArgs {
    /// Configuration file of the server, TOML
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Address of the REST API
    #[arg(long, value_name = "ADDRESS")]
    http: Option<SocketAddr>,
    /// Also check that the server is ready: that its database accepts a write. A restart does not
    /// fix what this check finds
    #[arg(long)]
    ready: bool,
}

/// Requests `/healthz`, or `/readyz`, from the server on this machine.
///
/// # Errors
/// The configuration is invalid, no answer arrives in time, or the answer is not that of a healthy
/// server.
pub(crate) async fn run(args: HealthArgs) -> anyhow::Result<()> {
    let config = Config::load(&ServerArgs {
        config: args.config,
        http: args.http,
        ..ServerArgs::default()
    })?;
    let scheme = if config.tls.is_some() {
        "https"
    } else {
        "http"
    };
    let path = if args.ready { "readyz" } else { "healthz" };
    let url = format!("{scheme}://{}/{path}", reachable(config.http));
    // Fails if a provider is installed already, which is then the same one.
    let _first = rustls::crypto::ring::default_provider().install_default();
    let client = reqwest::Client::builder()
        .timeout(ANSWER_MAX)
        .no_proxy()
        // The certificate is for the names by which others know this machine, and nothing secret
        // is sent.
        .tls_danger_accept_invalid_certs(true)
        .build()
        .context("no HTTP client")?;
    let answer = client.get(&url).send().await;
    let status = answer
        .with_context(|| format!("no answer from {url}: is the server running?"))?
        .status();
    if !status.is_success() {
        bail!("{url} answered with status {status}: see the server's log");
    }
    Ok(())
}

/// Returns an address by which this machine reaches what listens on `address`.
pub(crate) fn reachable(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip @ (IpAddr::V4(_) | IpAddr::V6(_)) => ip,
    };
    SocketAddr::new(ip, address.port())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_that_listens_everywhere_is_asked_on_the_loopback() {
        for (listens, expected) in [
            ("0.0.0.0:8420", "127.0.0.1:8420"),
            ("[::]:8420", "[::1]:8420"),
            ("192.0.2.7:80", "192.0.2.7:80"),
        ] {
            assert_eq!(
                reachable(listens.parse().unwrap()),
                expected.parse().unwrap(),
                "{listens}"
            );
        }
    }
}
