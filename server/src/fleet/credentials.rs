//! User names and passwords of the internal routers.
//!
//! TLS ends at the gate, so a router cannot see a robot's certificate; it identifies robots by user
//! name and password. Passwords derive from the key of the signing authority, so they are the same
//! after a restart of the server, and a robot's session recovers by itself. A rotation of the
//! authority opens another router, whose passwords derive from the new key. The gate sends a robot
//! that has shown its certificate the credentials of its router.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Write as _};
use std::os::fd::{AsRawFd as _, OwnedFd};

use nix::sys::memfd::{MFdFlags, memfd_create};
use ring::hmac;
use tread_api::tunnel::{RouterCredentials, SessionPrefix};

use crate::app::presence::RobotKey;
use crate::authority::Authority;

/// User name of the server's own probe of its router. It contains no dot, unlike those of robots.
pub(super) const PROBE_USER: &str = "tread-probe";
/// Purpose of the key from which passwords derive.
const PASSWORDS: &str = "zenoh router password";
/// Purpose of the key from which session prefixes derive.
const PREFIXES: &str = "zenoh session prefix";

/// Returns the user name of a robot.
pub(super) fn user_of((site, robot): &RobotKey) -> String {
    format!("{robot}.{site}")
}

/// Derives the credentials of all users.
#[derive(Debug)]
pub(super) struct CredentialDerivation {
    authority: String,
    passwords: hmac::Key,
    prefixes: hmac::Key,
}

impl CredentialDerivation {
    pub(super) fn new(authority: &Authority) -> Self {
        Self {
            authority: authority.fingerprint().to_owned(),
            passwords: authority.derive_key(PASSWORDS),
            prefixes: authority.derive_key(PREFIXES),
        }
    }

    /// Returns the fingerprint of the authority from whose key the credentials derive.
    pub(super) fn authority(&self) -> &str {
        &self.authority
    }

    /// Returns the credentials of a robot's session.
    pub(super) fn of_robot(&self, robot: &RobotKey) -> RouterCredentials {
        self.of_user(user_of(robot))
    }

    /// Returns the credentials of the server's own probe.
    pub(super) fn of_probe(&self) -> RouterCredentials {
        self.of_user(PROBE_USER.to_owned())
    }

    fn of_user(&self, user: String) -> RouterCredentials {
        let prefix = hmac::sign(&self.prefixes, user.as_bytes());
        let mut upper = [0; 8];
        upper.copy_from_slice(&prefix.as_ref()[..8]);
        RouterCredentials {
            password: self.password(&user),
            session_prefix: SessionPrefix::new(u64::from_be_bytes(upper)),
            user,
        }
    }

    fn password(&self, user: &str) -> String {
        let tag = hmac::sign(&self.passwords, user.as_bytes());
        let mut text = String::with_capacity(2 * tag.as_ref().len());
        for byte in tag.as_ref() {
            // Writing to a string cannot fail.
            let _ = write!(text, "{byte:02x}");
        }
        text
    }

    /// Returns all users and passwords of a router. The probe's user is always among them: without
    /// any user zenoh would not demand passwords.
    ///
    /// # Errors
    /// The operating system cannot allocate the file in memory.
    pub(super) fn dictionary(&self, robots: &[RobotKey]) -> io::Result<Dictionary> {
        let users = robots.iter().map(user_of);
        let mut text = String::new();
        for user in users.chain([PROBE_USER.to_owned()]) {
            let _ = writeln!(text, "{user}:{}", self.password(&user));
        }
        Dictionary::new(&text)
    }
}

/// File with the users and passwords for zenoh. It is in memory only, without a name by which
/// another process could open it.
#[derive(Debug)]
pub(super) struct Dictionary(OwnedFd);

impl Dictionary {
    fn new(text: &str) -> io::Result<Self> {
        let descriptor = memfd_create(c"tread-router-users", MFdFlags::MFD_CLOEXEC)?;
        let mut file = File::from(descriptor);
        file.write_all(text.as_bytes())?;
        Ok(Self(file.into()))
    }

    /// Returns the path by which this process reads it.
    pub(super) fn path(&self) -> String {
        format!("/proc/self/fd/{}", self.0.as_raw_fd())
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;

    fn robot(site: &str, robot: &str) -> RobotKey {
        (site.parse().unwrap(), robot.parse().unwrap())
    }

    #[test]
    fn every_robot_has_credentials_of_its_own_that_stay_with_the_authority() {
        let authority = Authority::generate("fleet", Timestamp::UNIX_EPOCH).unwrap();
        let another = Authority::generate("fleet", Timestamp::UNIX_EPOCH).unwrap();
        let derivation = CredentialDerivation::new(&authority);
        let rover = derivation.of_robot(&robot("yard", "rover-1"));
        let again = CredentialDerivation::new(&authority).of_robot(&robot("yard", "rover-1"));
        assert_eq!(rover, again);
        assert_eq!(rover.user, "rover-1.yard");
        for other in [
            derivation.of_robot(&robot("yard", "rover-2")),
            derivation.of_robot(&robot("farm", "rover-1")),
            derivation.of_probe(),
            CredentialDerivation::new(&another).of_robot(&robot("yard", "rover-1")),
        ] {
            assert_ne!(rover.password, other.password);
            assert_ne!(rover.session_prefix, other.session_prefix);
        }
    }

    #[test]
    fn the_dictionary_is_read_whole_each_time_and_is_never_empty() {
        let authority = Authority::generate("fleet", Timestamp::UNIX_EPOCH).unwrap();
        let derivation = CredentialDerivation::new(&authority);
        let nobody = derivation.dictionary(&[]).unwrap();
        let read = std::fs::read_to_string(nobody.path()).unwrap();
        assert_eq!(read.lines().count(), 1);
        let dictionary = derivation.dictionary(&[robot("yard", "rover-1")]).unwrap();
        for _ in 0..2 {
            let read = std::fs::read_to_string(dictionary.path()).unwrap();
            let password = derivation.of_robot(&robot("yard", "rover-1")).password;
            assert!(read.contains(&format!("rover-1.yard:{password}\n")));
            assert_eq!(read.lines().count(), 2);
        }
    }
}
