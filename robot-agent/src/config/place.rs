//! A robot's place in the fleet: who it is, where its folder is, and what it shows where.

use std::net::IpAddr;
use std::path::PathBuf;

use tread_api::ids::{RobotId, SiteId};

use super::{ConfigError, Flags, read_file};
use crate::membership::Membership;

/// What a robot must know to join the fleet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Place {
    /// The robot, if it is named.
    pub(crate) robot: Option<RobotId>,
    /// Where what outlives the process is.
    pub(crate) data_dir: PathBuf,
}

/// Reads who the robot is and where its folder is; flags go before the file.
///
/// # Errors
/// [`ConfigError`]: the file does not read, or nobody names the folder.
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

/// What the robot shows at an endpoint: its certificate where TLS is spoken, nothing on its own
/// machine, and elsewhere it does not go.
pub(super) fn place_at(
    server: &str,
    site: &SiteId,
    robot: &RobotId,
    membership: Option<Membership>,
) -> Result<Option<Membership>, ConfigError> {
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

/// Whether an endpoint in the clear is on this machine. What is no endpoint at all is for zenoh
/// to refuse.
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
