//! A robot's membership in the fleet: its certificate and key, and their renewal.
//!
//! ```text
//!  none ──enroll, with a join token──► member ──two thirds of the certificate's time──► renews
//!                                         ▲                                               │
//!                                         └───────────────────────────────────────────────┘
//! ```
//!
//! When the server states that robots shall trust other authorities than this one does, it renews
//! at once: the answer contains them, and a certificate of the present authority.
//!
//! A membership is one file, readable by its owner only and replaced as a whole, so key and
//! certificate always belong together.

mod client;
mod renewal;
mod trust;

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde::{Deserialize, Serialize};
use tread_api::enrolment::TrustId;
use tread_api::ids::{RobotId, SiteId};

pub use self::client::{Enrolment, MembershipError, enrol};
pub(crate) use self::renewal::{Renewal, ServerTrust};
pub use self::trust::{Fingerprint, InvalidFingerprint, Trust};
use crate::durable;

/// Name of the file in the robot's folder.
pub const FILE: &str = "membership.json";
/// Fraction of a certificate's lifetime after which it is renewed.
const RENEW_AFTER: f64 = 2.0 / 3.0;

/// A robot's place in the fleet.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Membership {
    /// The site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// Number of the robot's enrolments.
    pub enrolment: u32,
    /// Its certificate, PEM.
    pub certificate: String,
    /// Its key, PEM; it never leaves the robot.
    pub(crate) key: String,
    /// Authorities that the robots' port is verified against, PEM; two during a rotation.
    pub authority: String,
    /// Address of the REST API, for renewals.
    pub server: String,
    /// How the REST API is authenticated.
    pub trust: Trust,
    /// Endpoint of the robots' port in zenoh's notation.
    pub endpoint: String,
    /// Time of receipt of the certificate, by the robot's clock.
    pub issued_at: Timestamp,
    /// Lifetime of the certificate from `issued_at`, seconds.
    pub lifetime_s: u64,
}

impl std::fmt::Debug for Membership {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("Membership")
            .field("site", &self.site)
            .field("robot", &self.robot)
            .field("enrolment", &self.enrolment)
            .field("endpoint", &self.endpoint)
            .finish_non_exhaustive()
    }
}

/// Why the file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MembershipFileError {
    /// It cannot be read.
    #[error("`{}` cannot be read", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        #[source]
        source: io::Error,
    },
    /// Its checksum does not match.
    #[error("`{}` is damaged; join the fleet again", path.display())]
    Damaged {
        /// Which file.
        path: PathBuf,
    },
    /// It is not valid JSON of a [`Membership`].
    #[error("`{}` does not read; join the fleet again", path.display())]
    Malformed {
        /// Which file.
        path: PathBuf,
        /// Why.
        #[source]
        source: serde_json::Error,
    },
    /// It cannot be written.
    #[error("`{}` cannot be written", path.display())]
    Unwritable {
        /// Which file.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
}

impl Membership {
    /// Reads the file in a robot's folder; `None` if it does not exist. Blocks.
    ///
    /// # Errors
    /// [`MembershipFileError`] if the file cannot be read, is damaged or does not parse.
    pub fn load(folder: &Path) -> Result<Option<Self>, MembershipFileError> {
        let path = folder.join(FILE);
        let file = match std::fs::read(&path) {
            Ok(file) => file,
            Err(cause) if cause.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(MembershipFileError::Unreadable { path, source }),
        };
        let Ok(text) = durable::unsealed(&file) else {
            return Err(MembershipFileError::Damaged { path });
        };
        serde_json::from_slice(text)
            .map(Some)
            .map_err(|source| MembershipFileError::Malformed { path, source })
    }

    /// Replaces the file in a robot's folder, which is created if missing. Blocks.
    ///
    /// # Errors
    /// [`MembershipFileError::Unwritable`]; the former file is kept.
    pub fn save(&self, folder: &Path) -> Result<(), MembershipFileError> {
        let path = folder.join(FILE);
        let written = serde_json::to_vec_pretty(self)
            .map_err(io::Error::other)
            .and_then(|text| {
                std::fs::create_dir_all(folder)?;
                durable::replace_private(folder, FILE, &durable::sealed(&text))
            });
        written.map_err(|source| MembershipFileError::Unwritable { path, source })
    }

    /// Returns the identifier of the trusted authorities; `None` if they cannot be parsed.
    pub(crate) fn trust_id(&self) -> Option<TrustId> {
        let trusted = trust::certificates(&self.authority).ok()?;
        Some(TrustId::of(trusted.iter().map(AsRef::as_ref)))
    }

    /// Returns the time until the renewal is due, zero if it is due now, computed from the
    /// certificate's age by the robot's clock, which may be wrong.
    pub(crate) fn renewal_due_in(&self, now: Timestamp) -> Duration {
        let after = Duration::from_secs(self.lifetime_s).mul_f64(RENEW_AFTER);
        let age = now.duration_since(self.issued_at);
        if age < SignedDuration::ZERO {
            // The clock was set back, so the certificate's age is unknown.
            return Duration::ZERO;
        }
        after.saturating_sub(age.unsigned_abs())
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn membership() -> Membership {
        Membership {
            site: "yard".parse().unwrap(),
            robot: "rover-1".parse().unwrap(),
            enrolment: 1,
            certificate: "certificate".to_owned(),
            key: "very secret".to_owned(),
            authority: "authority".to_owned(),
            server: "https://tread.example".to_owned(),
            trust: Trust::Machine,
            endpoint: "tls/tread.example:7447".to_owned(),
            issued_at: "2026-11-02T10:00:00Z".parse().unwrap(),
            lifetime_s: 90,
        }
    }

    #[test]
    fn it_comes_back_from_a_file_that_only_its_owner_can_read() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("robot");
        assert_eq!(Membership::load(&folder).unwrap(), None);
        for enrolment in [1, 2] {
            let saved = Membership {
                enrolment,
                ..membership()
            };
            saved.save(&folder).unwrap();
            assert_eq!(Membership::load(&folder).unwrap(), Some(saved));
            let mode = std::fs::metadata(folder.join(FILE)).unwrap().permissions();
            assert_eq!(mode.mode() & 0o777, 0o600);
        }
        std::fs::write(folder.join(FILE), "{}").unwrap();
        assert!(Membership::load(&folder).is_err());
    }

    #[test]
    fn a_file_with_any_bit_flipped_is_refused_and_never_another_membership() {
        let folder = tempfile::tempdir().unwrap();
        membership().save(folder.path()).unwrap();
        let path = folder.path().join(FILE);
        let intact = std::fs::read(&path).unwrap();
        for bit in 0..intact.len() * 8 {
            let mut damaged = intact.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            std::fs::write(&path, damaged).unwrap();
            match Membership::load(folder.path()) {
                // In the checksum's own name.
                Ok(read) => assert_eq!(read, Some(membership()), "bit {bit}"),
                Err(refused) => {
                    let refused = refused.to_string();
                    assert!(
                        refused.contains("join the fleet again"),
                        "bit {bit}: {refused}"
                    );
                }
            }
        }
        let earlier = serde_json::to_vec_pretty(&membership()).unwrap();
        std::fs::write(&path, earlier).unwrap();
        let read = Membership::load(folder.path()).unwrap();
        assert_eq!(read, Some(membership()), "of an earlier agent");
    }

    #[test]
    fn the_key_is_not_shown_by_accident() {
        assert!(!format!("{:?}", membership()).contains("secret"));
    }

    #[test]
    fn it_renews_after_two_thirds_of_its_time_and_at_once_when_the_clock_was_set_back() {
        let membership = membership();
        let at = |seconds| membership.issued_at + SignedDuration::from_secs(seconds);
        for (now_s, left_s) in [(0, 60), (20, 40), (60, 0), (1_000, 0), (-1, 0)] {
            let left = membership.renewal_due_in(at(now_s));
            assert_eq!(left, Duration::from_secs(left_s), "at {now_s} s");
        }
    }
}
