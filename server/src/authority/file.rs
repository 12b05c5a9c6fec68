//! The authority on the disk: certificate and key, in a folder of their own.
//!
//! A rotation adds the next authority, and each of its steps replaces or renames one file, so that a
//! crash between any two of them leaves what [`recover`] completes or takes back:
//!
//! ```text
//!  start   next.key, next.json ── next.pem ◄─ from here on the next authority signs
//!  finish  ca.pem → retired-….pem ◄─ from here on the former is retired
//!          next.key → ca.key (its key is gone), next.pem → ca.pem, next.json removed
//! ```

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject as _;
use serde::{Deserialize, Serialize};
use tracing::{error, warn};

use super::Authority;

/// The authority's certificate, in its folder.
pub const CERTIFICATE_FILE: &str = "ca.pem";
/// The authority's key, in its folder.
pub const KEY_FILE: &str = "ca.key";
/// During a rotation the certificate of the authority that signs by now, beside the former one's.
pub const NEXT_CERTIFICATE_FILE: &str = "next.pem";
/// Its key.
const NEXT_KEY_FILE: &str = "next.key";
/// Who started the rotation, and when.
const ROTATION_FILE: &str = "next.json";
/// What the certificate of a retired authority is called, around the begin of its fingerprint.
const RETIRED_PREFIX: &str = "retired-";
const RETIRED_SUFFIX: &str = ".pem";
/// Digits of the fingerprint in that name.
const RETIRED_DIGITS: usize = 16;
/// Most retired authorities that are read, the newest by the time of their retirement.
const RETIRED_MAX: usize = 8;
/// The files of a rotation that was never complete.
const INCOMPLETE: [&str; 4] = [
    NEXT_KEY_FILE,
    ROTATION_FILE,
    "next.key.new",
    "next.json.new",
];

/// Why the authority cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AuthorityError {
    /// There is one already.
    #[error("there is a fleet's authority in `{}` already; robots trust it, so it stays", .0.display())]
    Exists(PathBuf),
    /// A file cannot be read.
    #[error("cannot read `{}`; `tread-server init` makes the fleet's authority", path.display())]
    Unreadable {
        /// Which file.
        path: PathBuf,
        /// Why.
        #[source]
        cause: io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write `{}`", path.display())]
    Unwritable {
        /// Which file.
        path: PathBuf,
        /// Why.
        #[source]
        cause: io::Error,
    },
    /// Others than the owner can read the key.
    #[error("others can read `{}`: make it `chmod 600`, and a new authority if they may have", .0.display())]
    Open(PathBuf),
    /// Certificate and key are none, or not of each other.
    #[error("certificate and key in `{}` cannot be used", folder.display())]
    Unusable {
        /// Where they are.
        folder: PathBuf,
        /// Why.
        #[source]
        cause: rcgen::Error,
    },
}

impl Authority {
    /// Makes a new authority in a folder, which is made if it is missing.
    ///
    /// # Errors
    /// There is one, or the folder cannot be written.
    pub fn create(folder: &Path, now: Timestamp) -> Result<Self, AuthorityError> {
        let (certificate, key) = (folder.join(CERTIFICATE_FILE), folder.join(KEY_FILE));
        let next = folder.join(NEXT_CERTIFICATE_FILE);
        if certificate.exists() || key.exists() || next.exists() {
            return Err(AuthorityError::Exists(folder.to_owned()));
        }
        let mut builder = DirBuilder::new();
        let made = builder.recursive(true).mode(0o700).create(folder);
        made.map_err(unwritable(folder))?;
        let authority =
            Self::generate("Tread fleet", now).map_err(|cause| AuthorityError::Unusable {
                folder: folder.to_owned(),
                cause,
            })?;
        let key_pem = authority.issuer.key().serialize_pem();
        write(&key, 0o600, &key_pem).map_err(unwritable(&key))?;
        let written = write(&certificate, 0o644, &authority.certificate_pem);
        written.map_err(unwritable(&certificate))?;
        Ok(authority)
    }

    /// Reads the authority in a folder.
    ///
    /// # Errors
    /// There is none, others can read its key, or it cannot be used.
    pub fn load(folder: &Path) -> Result<Self, AuthorityError> {
        load(folder, CERTIFICATE_FILE, KEY_FILE)
    }
}

fn load(folder: &Path, certificate: &str, key: &str) -> Result<Authority, AuthorityError> {
    let (certificate, key) = (folder.join(certificate), folder.join(key));
    let mode = fs::metadata(&key).map_err(unreadable(&key))?.permissions();
    if mode.mode() & 0o077 != 0 {
        return Err(AuthorityError::Open(key));
    }
    let key_pem = fs::read_to_string(&key).map_err(unreadable(&key))?;
    let certificate_pem = fs::read_to_string(&certificate).map_err(unreadable(&certificate))?;
    Authority::from_pem(certificate_pem, &key_pem).map_err(|cause| AuthorityError::Unusable {
        folder: folder.to_owned(),
        cause,
    })
}

/// Who started a rotation, and when.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Started {
    pub(super) at: Timestamp,
    pub(super) by: String,
}

/// What the folder of the authority holds.
pub(super) struct Kept {
    pub(super) present: Authority,
    /// The next authority during a rotation.
    pub(super) next: Option<(Authority, Started)>,
    pub(super) retired: Vec<CertificateDer<'static>>,
}

/// One change of the folder; each is there whole or not at all.
#[derive(Debug)]
enum Step {
    Write(&'static str, String),
    Rename(&'static str, String),
    Remove(&'static str),
}

impl Step {
    /// Does it; once more does no harm.
    fn apply(&self, folder: &Path) -> Result<(), AuthorityError> {
        let (name, done) = match self {
            Self::Write(name, text) => (name, replace(folder, name, text)),
            Self::Rename(name, to) => (name, rename(&folder.join(name), &folder.join(to))),
            Self::Remove(name) => (name, remove(&folder.join(name))),
        };
        done.and_then(|()| File::open(folder)?.sync_all())
            .map_err(unwritable(&folder.join(name)))
    }
}

/// What starts a rotation. With the last of the steps it has begun.
fn starting(next: &Authority, started: &Started) -> io::Result<Vec<Step>> {
    let started = serde_json::to_string_pretty(started)?;
    Ok(vec![
        Step::Write(NEXT_KEY_FILE, next.issuer.key().serialize_pem()),
        Step::Write(ROTATION_FILE, started),
        Step::Write(NEXT_CERTIFICATE_FILE, next.certificate_pem.clone()),
    ])
}

/// What finishes a rotation. With the first of the steps it is decided, and [`recover`] does the
/// others if the server does not come to it.
fn finishing(former: &Authority) -> Vec<Step> {
    let digits = &former.fingerprint[..RETIRED_DIGITS];
    let retired = format!("{RETIRED_PREFIX}{digits}{RETIRED_SUFFIX}");
    vec![
        Step::Rename(CERTIFICATE_FILE, retired),
        Step::Rename(NEXT_KEY_FILE, KEY_FILE.to_owned()),
        Step::Rename(NEXT_CERTIFICATE_FILE, CERTIFICATE_FILE.to_owned()),
        Step::Remove(ROTATION_FILE),
    ]
}

/// Starts a rotation in the folder.
///
/// # Errors
/// It cannot be written; as far as that is possible, it is as before.
pub(super) fn start(
    folder: &Path,
    next: &Authority,
    started: &Started,
) -> Result<(), AuthorityError> {
    // A finish may have been decided that the disk refused to complete.
    recover(folder)?;
    let steps = starting(next, started).map_err(unwritable(&folder.join(ROTATION_FILE)))?;
    for step in steps {
        if let Err(failed) = step.apply(folder) {
            let _ = Step::Remove(NEXT_CERTIFICATE_FILE).apply(folder);
            return Err(failed);
        }
    }
    Ok(())
}

/// Finishes a rotation in the folder.
///
/// # Errors
/// It cannot be written, and is not decided.
pub(super) fn finish(folder: &Path, former: &Authority) -> Result<(), AuthorityError> {
    let mut steps = finishing(former).into_iter();
    if let Some(decided) = steps.next() {
        decided.apply(folder)?;
    }
    for step in steps {
        if let Err(failed) = step.apply(folder) {
            error!(
                error = &failed as &dyn std::error::Error,
                "the files of the authorities are not all in their places; the next start of the \
                 server completes it"
            );
            break;
        }
    }
    Ok(())
}

/// Completes what an earlier run of the server had decided, and takes back what it had not. Only the
/// server that owns the folder may call it.
pub(super) fn recover(folder: &Path) -> Result<(), AuthorityError> {
    let is_there = |name: &str| folder.join(name).exists();
    if is_there(NEXT_CERTIFICATE_FILE) && !is_there(CERTIFICATE_FILE) {
        if is_there(NEXT_KEY_FILE) {
            Step::Rename(NEXT_KEY_FILE, KEY_FILE.to_owned()).apply(folder)?;
        }
        Step::Rename(NEXT_CERTIFICATE_FILE, CERTIFICATE_FILE.to_owned()).apply(folder)?;
    }
    if !is_there(NEXT_CERTIFICATE_FILE) {
        for name in INCOMPLETE.into_iter().filter(|name| is_there(name)) {
            Step::Remove(name).apply(folder)?;
        }
    }
    Ok(())
}

/// Reads the folder, after [`recover`].
pub(super) fn read(folder: &Path) -> Result<Kept, AuthorityError> {
    let present = Authority::load(folder)?;
    let next = if folder.join(NEXT_CERTIFICATE_FILE).exists() {
        let next = load(folder, NEXT_CERTIFICATE_FILE, NEXT_KEY_FILE)?;
        Some((next, read_started(folder)?))
    } else {
        None
    };
    let retired = read_retired(folder).map_err(unreadable(folder))?;
    Ok(Kept {
        present,
        next,
        retired,
    })
}

fn read_started(folder: &Path) -> Result<Started, AuthorityError> {
    let path = folder.join(ROTATION_FILE);
    let text = fs::read(&path).map_err(unreadable(&path))?;
    serde_json::from_slice(&text).map_err(|cause| unreadable(&path)(cause.into()))
}

fn read_retired(folder: &Path) -> io::Result<Vec<CertificateDer<'static>>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let is_retired = name
            .to_str()
            .is_some_and(|name| name.starts_with(RETIRED_PREFIX) && name.ends_with(RETIRED_SUFFIX));
        if !is_retired {
            continue;
        }
        // It only tells why a robot is refused; without it the robot is refused all the same.
        match CertificateDer::from_pem_file(entry.path()) {
            Ok(certificate) => found.push((entry.metadata()?.modified()?, certificate)),
            Err(cause) => warn!("`{}` does not read: {cause}", entry.path().display()),
        }
    }
    found.sort_by_key(|(retired_at, _)| std::cmp::Reverse(*retired_at));
    found.truncate(RETIRED_MAX);
    Ok(found
        .into_iter()
        .map(|(_, certificate)| certificate)
        .collect())
}

fn unreadable(path: &Path) -> impl FnOnce(io::Error) -> AuthorityError {
    let path = path.to_owned();
    move |cause| AuthorityError::Unreadable { path, cause }
}

fn unwritable(path: &Path) -> impl FnOnce(io::Error) -> AuthorityError {
    let path = path.to_owned();
    move |cause| AuthorityError::Unwritable { path, cause }
}

/// Writes a file that was not there, and waits until the disk has it.
fn write(path: &Path, mode: u32, text: &str) -> io::Result<()> {
    let mut options = OpenOptions::new();
    let mut file = options.write(true).create_new(true).mode(mode).open(path)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}

/// Replaces a file that only its owner can read.
fn replace(folder: &Path, name: &str, text: &str) -> io::Result<()> {
    let new = folder.join(format!("{name}.new"));
    remove(&new)?;
    write(&new, 0o600, text)?;
    fs::rename(new, folder.join(name))
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(cause),
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Renames a file, unless that was done before.
fn rename(from: &Path, to: &Path) -> io::Result<()> {
    match fs::rename(from, to) {
        Err(cause) if cause.kind() == io::ErrorKind::NotFound && to.exists() => Ok(()),
        renamed => renamed,
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use proptest::prelude::*;

    use super::super::Authorities;
    use super::*;

    fn now() -> Timestamp {
        "2026-11-02T10:00:00Z".parse().unwrap()
    }

    fn started() -> Started {
        Started {
            at: now(),
            by: "admin".to_owned(),
        }
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let name = |entry: io::Result<fs::DirEntry>| entry.unwrap().file_name().into_string();
        let mut names: Vec<String> = entries.map(|entry| name(entry).unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_crash_between_any_two_steps_leaves_the_rotation_started_or_not_and_finished_or_not() {
        for steps_done in 0..=7 {
            let folder = tempfile::tempdir().unwrap();
            let folder = folder.path().join("authority");
            let former = Authority::create(&folder, now()).unwrap();
            let next = Authority::generate("next", now()).unwrap();
            let mut steps = starting(&next, &started()).unwrap();
            steps.extend(finishing(&former));
            assert_eq!(steps.len(), 7);
            for step in &steps[..steps_done] {
                step.apply(&folder).unwrap();
            }
            // A half-written file of the step that did not come to its end.
            fs::write(folder.join("next.key.new"), "half").unwrap();
            // Twice: the recovery itself may be cut short and is done again.
            for _ in 0..2 {
                let trusted = Authorities::load(&folder).unwrap().present();
                let all: Vec<&str> = trusted.all().map(|one| one.fingerprint()).collect();
                let expected = match steps_done {
                    0..=2 => vec![former.fingerprint()],
                    3 => vec![next.fingerprint(), former.fingerprint()],
                    _ => vec![next.fingerprint()],
                };
                assert_eq!(all, expected, "after {steps_done} steps");
            }
            let private = |name: &str| {
                let mode = fs::metadata(folder.join(name))
                    .unwrap()
                    .permissions()
                    .mode();
                assert_eq!(mode & 0o077, 0, "{name} after {steps_done} steps");
            };
            private(KEY_FILE);
            if steps_done == 3 {
                private(NEXT_KEY_FILE);
                continue;
            }
            // Nothing is left beside what is in force, above all no other key.
            let mut expected = vec![KEY_FILE.to_owned(), CERTIFICATE_FILE.to_owned()];
            if steps_done > 3 {
                let digits = &former.fingerprint[..RETIRED_DIGITS];
                expected.push(format!("retired-{digits}.pem"));
                let key = fs::read_to_string(folder.join(KEY_FILE)).unwrap();
                assert_eq!(key, next.issuer.key().serialize_pem());
            }
            assert_eq!(names(&folder), expected, "after {steps_done} steps");
        }
    }

    #[test]
    fn a_folder_that_cannot_be_written_leaves_all_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("authority");
        Authority::create(&path, now()).unwrap();
        let authorities = Authorities::load(&path).unwrap();
        // A folder of that name stands where the file is to be.
        fs::create_dir(path.join(NEXT_CERTIFICATE_FILE)).unwrap();
        fs::write(path.join(NEXT_CERTIFICATE_FILE).join("file"), "").unwrap();
        let before = authorities.present();
        assert!(authorities.start("admin", now()).is_err());
        assert_eq!(authorities.present().id(), before.id());
        fs::remove_dir_all(path.join(NEXT_CERTIFICATE_FILE)).unwrap();
        authorities.start("admin", now()).unwrap();
        let again = Authorities::load(&path).unwrap().present();
        assert_eq!(again.id(), authorities.present().id());
        let retiring = again.retiring().unwrap();
        assert_eq!(
            (retiring.started_at, &*retiring.started_by),
            (now(), "admin")
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        /// Starts, finishes and restarts in any order.
        #[test]
        fn whatever_is_asked_for_one_authority_signs_at_most_two_are_trusted_and_the_disk_says_so(
            asked in prop::collection::vec(0_u8..3, 1..12),
        ) {
            let folder = tempfile::tempdir().unwrap();
            let folder = folder.path().join("authority");
            Authority::create(&folder, now()).unwrap();
            let mut authorities = Authorities::load(&folder).unwrap();
            for asked in asked {
                let before = authorities.present();
                let was_under_way = before.retiring().is_some();
                match asked {
                    0 => prop_assert_eq!(authorities.start("admin", now()).is_ok(), !was_under_way),
                    1 => prop_assert_eq!(authorities.finish().is_ok(), was_under_way),
                    _ => authorities = Authorities::load(&folder).unwrap(),
                }
                let present = authorities.present();
                prop_assert_eq!(present.all().count(), 1 + usize::from(present.retiring().is_some()));
                prop_assert!(present.is_trusted(present.of_port().fingerprint()));
                // No step leaves a robot that was brought over before without a common authority.
                prop_assert!(present.is_trusted(before.signing().fingerprint()));
                prop_assert!(before.is_trusted(present.of_port().fingerprint()));
                prop_assert_eq!(Authorities::load(&folder).unwrap().present().id(), present.id());
            }
        }
    }
}
