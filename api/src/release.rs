//! The release of these programs, and which other releases they work with.
//!
//! Server and agents understand each other while they speak the same major version of the wire
//! ([`crate::wire::VERSION`]). Within it fields and commands are only added: a peer ignores fields
//! that it does not know, gives fields that it misses their default, and does not answer commands
//! that it does not know. A release therefore works with agents of the release before and of the
//! release after; a change of the wire's major version is announced one release before, in
//! which both are spoken. Releases are counted by [`minor_release`].

use std::fmt;
use std::sync::LazyLock;

use crate::wire;

/// Version of all programs, by semantic versioning.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Number of releases by which server and agent may differ.
pub const RELEASES_APART_MAX: u64 = 1;

/// Returns the commit that this program was built from: the environment variable `TREAD_COMMIT` of
/// the build. `None` without it, so that a build is the same with and without a repository.
pub fn commit() -> Option<&'static str> {
    option_env!("TREAD_COMMIT").filter(|commit| !commit.is_empty())
}

/// Returns what `--version` prints after the name of a program that stores no database.
pub fn long_version() -> &'static str {
    static TEXT: LazyLock<String> = LazyLock::new(|| describe(None));
    &TEXT
}

/// Returns a version with its commit, the major version of the wire, and the schema of the
/// database, if the program has one.
pub fn describe(schema: Option<i64>) -> String {
    let commit = commit().unwrap_or("unknown");
    let schema = schema.map(|schema| format!(", schema {schema}"));
    let schema = schema.unwrap_or_default();
    format!(
        "{VERSION} (commit {commit}, wire {}{schema})",
        wire::VERSION
    )
}

/// How the release of a peer relates to this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// It is at most [`RELEASES_APART_MAX`] releases away.
    Supported,
    /// It is older than that.
    TooOld,
    /// It is newer than that.
    TooNew,
    /// Its version is not one of a release.
    Unknown,
}

impl Peer {
    /// Judges the version that a peer states.
    pub fn of(version: &str) -> Self {
        minor_release(VERSION).map_or(Self::Unknown, |own| Self::seen_by(own, version))
    }

    /// Judges the version that a peer states to a program of the release `own`.
    fn seen_by(own: (u64, u64), version: &str) -> Self {
        let Some(other) = minor_release(version) else {
            return Self::Unknown;
        };
        if own.0 == other.0 && own.1.abs_diff(other.1) <= RELEASES_APART_MAX {
            Self::Supported
        } else if other < own {
            Self::TooOld
        } else {
            Self::TooNew
        }
    }
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Supported => "is supported",
            Self::TooOld => "is more than one release older: update it",
            Self::TooNew => "is more than one release newer: update the server first",
            Self::Unknown => "is not a release",
        })
    }
}

/// Returns the release that a version belongs to: its major and minor numbers. Patches of a release
/// change neither the wire nor the schema.
pub fn minor_release(version: &str) -> Option<(u64, u64)> {
    let core = version.split(['-', '+']).next()?;
    let mut numbers = core.split('.').map(|number| number.parse().ok());
    let release = (numbers.next()??, numbers.next()??);
    numbers.next()??;
    numbers.next().is_none().then_some(release)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_may_be_one_release_older_or_newer() {
        for (own, other, peer) in [
            ("0.2.0", "0.1.9", Peer::Supported),
            ("0.2.0", "0.2.7", Peer::Supported),
            ("0.2.0", "0.3.0-rc.1", Peer::Supported),
            ("0.3.0", "0.1.0", Peer::TooOld),
            ("0.1.0", "0.3.0", Peer::TooNew),
            ("1.0.0", "0.9.0", Peer::TooOld),
            ("1.0.0", "2.0.0", Peer::TooNew),
            ("0.1.0", "", Peer::Unknown),
            ("0.1.0", "0.1", Peer::Unknown),
            ("0.1.0", "0.1.0.0", Peer::Unknown),
        ] {
            let release = minor_release(own).unwrap();
            assert_eq!(Peer::seen_by(release, other), peer, "{own} {other}");
        }
        assert_eq!(Peer::of(VERSION), Peer::Supported);
    }

    #[test]
    fn a_description_names_version_wire_and_schema() {
        let text = describe(Some(7));
        assert!(text.starts_with(VERSION), "{text}");
        assert!(text.ends_with("wire 2, schema 7)"), "{text}");
        assert!(!long_version().contains("schema"));
    }
}
