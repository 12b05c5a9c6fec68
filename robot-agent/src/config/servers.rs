//! The servers that an agent may connect to, in the order of preference.

use serde::Deserialize;
use tread_api::ids::{RobotId, SiteId};

use super::ConfigError;
use super::place::place_at;
use crate::membership::Membership;

/// Maximum number of servers of one fleet that an agent may connect to.
pub const SERVERS_MAX: usize = 8;

/// `server` in `robot.toml`: one endpoint, or several.
#[derive(Debug, Clone, Deserialize)]
#[serde(
    untagged,
    expecting = "an endpoint such as \"tls/tread.example:7447\", or a list of them"
)]
pub(super) enum ServerFile {
    One(String),
    Several(Vec<String>),
}

impl From<ServerFile> for Vec<String> {
    fn from(file: ServerFile) -> Self {
        match file {
            ServerFile::One(endpoint) => vec![endpoint],
            ServerFile::Several(endpoints) => endpoints,
        }
    }
}

/// Endpoints of the servers of one fleet, from 1 to [`SERVERS_MAX`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Servers(Vec<String>);

impl Servers {
    /// Creates a list.
    ///
    /// # Errors
    /// [`ConfigError::OutOfRange`]: there are none or too many, or one is named twice.
    pub fn new(endpoints: Vec<String>) -> Result<Self, ConfigError> {
        let refused = |problem: String| {
            Err(ConfigError::OutOfRange {
                key: "server",
                problem,
            })
        };
        if endpoints.is_empty() || endpoints.len() > SERVERS_MAX {
            let count = endpoints.len();
            return refused(format!(
                "{count} servers are named, and it takes 1 to {SERVERS_MAX}"
            ));
        }
        for (at, endpoint) in endpoints.iter().enumerate() {
            if endpoints[..at].contains(endpoint) {
                return refused(format!("`{endpoint}` is named twice"));
            }
        }
        Ok(Self(endpoints))
    }

    /// Returns the endpoints, the preferred one first.
    pub fn endpoints(&self) -> &[String] {
        &self.0
    }

    /// Returns whether there is more than one.
    pub fn are_several(&self) -> bool {
        self.0.len() > 1
    }

    /// Returns the credentials for all of them, which are servers of one fleet: the membership for
    /// TLS, none on this machine.
    pub(super) fn credentials(
        &self,
        site: &SiteId,
        robot: &RobotId,
        membership: Option<Membership>,
    ) -> Result<Option<Membership>, ConfigError> {
        let is_tls = |endpoint: &&String| endpoint.starts_with("tls/");
        let tls = self.0.iter().filter(is_tls).count();
        if tls != 0 && tls != self.0.len() {
            return Err(ConfigError::OutOfRange {
                key: "server",
                problem: "servers of one fleet are reached all by `tls/` or all without".to_owned(),
            });
        }
        let (last, others) = self.0.split_last().ok_or(ConfigError::Missing {
            key: "server",
            flag: "server",
        })?;
        for endpoint in others {
            place_at(endpoint, site, robot, membership.clone())?;
        }
        place_at(last, site, robot, membership)
    }
}
