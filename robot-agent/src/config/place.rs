//! Reads the robot's identity and folder, and chooses its credentials for an endpoint.

use std::net::IpAddr;
use std::path::PathBuf;

use tread_api::ids::{RobotId, SiteId};

use super::{ConfigError, Flags, read_file};
use crate::membership::Membership;

/// Identity and folder of a robot that joins the fleet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Place {
    /// The robot, if it is named.
    pub(crate) robot: Option<RobotId>,
    /// Folder of the files that outlive the process.
    pub(crate) data_dir: PathBuf,
}

/// Reads the robot's identifier and its folder; flags override the file.
///
/// # Errors
/// [`ConfigError`]: the file cannot be read or parsed, or no folder is given.
pub(crate) fn place(flags: &Flags) -> Result<Place, ConfigError> {
    let file = read_file(flags)?;
    let data_dir = flags.data_dir.clone().or(file.data_dir);
    Ok(Place {
        robot: flags.robot.clone().or(file.robot),
        data_dir: data_dir.ok_or(ConfigError::Missing {
            key: "data_dir",
            flag: "data-dir",
        })?,
    })
}

/// Returns the credentials for an endpoint: the membership for TLS, none on this machine;
/// unencrypted endpoints on other machines are refused.
pub(super) fn place_at(
    server: &str,
    site: &SiteId,
    robot: &RobotId,
    membership: Option<Membership>,
) -> Result<Option<Membership>, ConfigError> {
    if server.starts_with("http://") || server.starts_with("https://") {
        return Err(ConfigError::RestAddress(server.to_owned()));
    }
    if !server.starts_with("tls/") {
        return if is_here(server) {
            Ok(None)
        } else {
            Err(ConfigError::ClearText(server.to_owned()))
        };
    }
    let joined = membership.ok_or_else(|| ConfigError::NotEnrolled(server.to_owned()))?;
    if (&joined.site, &joined.robot) != (site, robot) {
        let name = format!("{} of site {}", joined.robot, joined.site);
        return Err(ConfigError::OtherRobot(name));
    }
    Ok(Some(joined))
}

/// Whether an unencrypted endpoint is on this machine. True for a text that is no endpoint, which
/// zenoh refuses.
pub(super) fn is_here(endpoint: &str) -> bool {
    let Some((_protocol, rest)) = endpoint.split_once('/') else {
        return true;
    };
    let address = rest.split(['#', '?']).next().unwrap_or_default();
    let host = address
        .rsplit_once(':')
        .map_or(address, |(host, _port)| host);
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    bare == "localhost" || bare.parse().is_ok_and(|host: IpAddr| host.is_loopback())
}
