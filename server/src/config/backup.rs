//! `[backup]`: backups that the server makes by itself.

use std::path::PathBuf;
use std::time::Duration;

use serde::Deserialize;

use super::ConfigError;

/// Range of the interval between two backups, hours.
pub const EVERY_HOURS_RANGE: std::ops::RangeInclusive<u32> = 1..=8_760;
/// Range of the number of backups that are kept.
pub const KEEP_RANGE: std::ops::RangeInclusive<u32> = 1..=10_000;

/// `[backup]`: backups that the server makes by itself.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BackupConfig {
    /// Folder of the backups, created if missing; on another disk than the database, if possible.
    pub folder: PathBuf,
    /// Interval between two backups, hours.
    #[serde(default = "every_hours")]
    pub every_hours: u32,
    /// Number of backups that are kept; older ones are removed after a new one is complete.
    #[serde(default = "keep")]
    pub keep: u32,
    /// Shell command that encrypts its standard input to its standard output; without one backups
    /// are in clear text.
    pub encrypt: Option<String>,
}

const fn every_hours() -> u32 {
    24
}

const fn keep() -> u32 {
    7
}

impl BackupConfig {
    /// Returns the interval between two backups.
    pub const fn every(&self) -> Duration {
        Duration::from_hours(self.every_hours as u64)
    }

    pub(super) fn check(&self) -> Result<(), ConfigError> {
        for (key, value, (range, bounds)) in [
            (
                "backup.every_hours",
                self.every_hours,
                ("1 to 8760", EVERY_HOURS_RANGE),
            ),
            ("backup.keep", self.keep, ("1 to 10000", KEEP_RANGE)),
        ] {
            if !bounds.contains(&value) {
                let value = f64::from(value);
                return Err(ConfigError::OutOfRange { key, range, value });
            }
        }
        Ok(())
    }
}
