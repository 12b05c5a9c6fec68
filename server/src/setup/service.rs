//! The service of the package, which `init --start` enables and starts.

use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, bail, ensure};

use super::choices::Choices;
use super::config_default;

/// Name of the service.
const NAME: &str = "tread-server";
/// Folders in which systemd looks for units.
const UNIT_FOLDERS: [&str; 3] = [
    "/etc/systemd/system",
    "/usr/lib/systemd/system",
    "/lib/systemd/system",
];

/// Checks that the service is installed and reads the configuration of these choices.
///
/// # Errors
/// The service is not installed, or it reads another configuration.
pub(crate) fn check_service(choices: &Choices) -> anyhow::Result<()> {
    let file = format!("{NAME}.service");
    ensure!(
        UNIT_FOLDERS
            .iter()
            .any(|folder| Path::new(folder).join(&file).exists()),
        "--start needs the service `{NAME}`, which the Debian package installs: omit --start, and \
         start the server with `tread-server --config {}`",
        choices.config.display()
    );
    let config = config_default(true);
    ensure!(
        choices.config == config,
        "--start needs the configuration `{}`, which the service reads: omit --config",
        config.display()
    );
    Ok(())
}

/// Enables and starts the service. Returns when the server is ready.
///
/// # Errors
/// `systemctl` is missing, or the service does not start.
pub(crate) fn start_service() -> anyhow::Result<()> {
    let status = Command::new("systemctl")
        .args(["enable", "--now", NAME])
        .status()
        .context("cannot run systemctl, which --start needs: start the server yourself")?;
    if !status.success() {
        bail!(
            "the configuration is written, but the server does not start: `tread-server doctor` \
             and `journalctl -u {NAME}` give the reason; then run `systemctl enable --now {NAME}`"
        );
    }
    Ok(())
}
