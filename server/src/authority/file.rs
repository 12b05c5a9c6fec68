//! Stores the certificate authorities on the disk, with certificates and keys in a folder of their
//! own.
//!
//! Each step of a rotation writes, renames or removes one file atomically. After a crash between
//! two steps [`Folder::recover`] completes or undoes the change:
//!
//! ```text
//!  start   next.key, next.json ── next.pem ◄─ from here on the next authority signs
//!  finish  ca.pem → retired-….pem ◄─ from here on the former is retired
//!          next.key → ca.key (deletes the former key), next.pem → ca.pem, next.json removed
//!  replace replacing.key ── replacing.pem ◄─ from here on all others are retired
//!          ca.pem and next.pem → retired-….pem, next.key and next.json removed,
//!          replacing.key → ca.key, replacing.pem → ca.pem
//! ```
//!
//! A step is *done* when the file system shows it, and *durable* when `fsync` of the folder has
//! succeeded. The retirement of an authority takes effect when its step is done, because trusting
//! the authority again would be worse. A new authority takes effect only when its step is durable,
//! because a power failure must not delete an authority that has signed certificates.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use jiff::Timestamp;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject as _;
use serde::{Deserialize, Serialize};
use tracing::{error, warn};

use super::{Authority, fingerprint};
use crate::file_owner::OF_OTHERS;

/// File with the authority's certificate.
pub const CERTIFICATE_FILE: &str = "ca.pem";
/// File with the authority's private key.
pub const KEY_FILE: &str = "ca.key";
/// File with the certificate of the new authority during a rotation.
pub const NEXT_CERTIFICATE_FILE: &str = "next.pem";
/// File with the private key of the new authority during a rotation.
const NEXT_KEY_FILE: &str = "next.key";
/// File with [`Started`]: the time of the rotation's start and who started it.
const ROTATION_FILE: &str = "next.json";
/// Files with certificate and private key of an authority that replaces all others.
const REPLACING_CERTIFICATE_FILE: &str = "replacing.pem";
const REPLACING_KEY_FILE: &str = "replacing.key";
/// File modes: all users may read a certificate, and only the owner a key.
const CERTIFICATE_MODE: u32 = 0o644;
const KEY_MODE: u32 = 0o600;
/// Prefix and suffix of the file name of a retired authority's certificate, around its fingerprint.
const RETIRED_PREFIX: &str = "retired-";
const RETIRED_SUFFIX: &str = ".pem";
/// Number of leading digits of the fingerprint in the file name of a retired authority.
const RETIRED_DIGITS: usize = 16;
/// Maximum number of retired authorities that are read, those retired last; older ones are ignored.
const RETIRED_MAX: usize = 8;
/// Files of a rotation that was interrupted before it took effect.
const INCOMPLETE_ROTATION: [&str; 5] = [
    NEXT_KEY_FILE,
    ROTATION_FILE,
    "next.key.new",
    "next.json.new",
    "next.pem.new",
];
/// Files of a replacement that was interrupted before it took effect.
const INCOMPLETE_REPLACEMENT: [&str; 3] =
    [REPLACING_KEY_FILE, "replacing.key.new", "replacing.pem.new"];

/// Error of the authority's files.
#[derive(Debug, thiserror::Error)]
pub enum AuthorityError {
    /// The folder already contains an authority.
    #[error("there is a fleet's authority in `{}` already; robots trust it, so it stays", .0.display())]
    Exists(PathBuf),
    /// A file cannot be read.
    #[error(
        "cannot read `{}`: `tread-server init` makes the fleet's authority, and the user that the \
         server runs as must be able to read it", path.display()
    )]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write `{}`", path.display())]
    Unwritable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: io::Error,
    },
    /// A file was written, `fsync` failed, and its removal is not confirmed either.
    #[error(
        "cannot write `{}`, nor take it back for certain",
        path.display()
    )]
    NotTakenBack {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: io::Error,
    },
    /// Other users than the owner can read the private key.
    #[error("others can read `{}`: make it `chmod 600`, and a new authority if they may have", .0.display())]
    Open(PathBuf),
    /// Certificate or key is invalid, or they do not belong together.
    #[error("certificate and key in `{}` cannot be used", folder.display())]
    Unusable {
        /// Folder of the files.
        folder: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: rcgen::Error,
    },
}

impl AuthorityError {
    /// Returns a clause for messages that states whether the failed change had an effect.
    pub fn effect_clause(&self) -> &'static str {
        match self {
            Self::NotTakenBack { .. } => {
                "nothing has changed, but it could not be taken back for certain, and the next start \
                 of the server may find it done"
            }
            Self::Exists(_)
            | Self::Unreadable { .. }
            | Self::Unwritable { .. }
            | Self::Open(_)
            | Self::Unusable { .. } => "nothing has changed",
        }
    }
}

impl Authority {
    /// Generates a new authority in a folder, which is created if missing.
    ///
    /// # Errors
    /// [`AuthorityError::Exists`] if the folder has an authority, [`AuthorityError::Unwritable`] if
    /// it cannot be written.
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
        write(&key, KEY_MODE, &key_pem).map_err(unwritable(&key))?;
        let written = write(&certificate, CERTIFICATE_MODE, &authority.certificate_pem);
        written.map_err(unwritable(&certificate))?;
        Ok(authority)
    }

    /// Reads the authority in a folder.
    ///
    /// # Errors
    /// [`AuthorityError::Unreadable`] if there is none, [`AuthorityError::Open`] if other users can
    /// read its key, [`AuthorityError::Unusable`] if certificate and key do not fit.
    pub fn load(folder: &Path) -> Result<Self, AuthorityError> {
        let names = FileNames {
            certificate: CERTIFICATE_FILE,
            key: KEY_FILE,
        };
        load(folder, names)
    }
}

/// Names of the files of an authority.
#[derive(Clone, Copy)]
struct FileNames {
    certificate: &'static str,
    key: &'static str,
}

fn load(folder: &Path, names: FileNames) -> Result<Authority, AuthorityError> {
    let (certificate, key) = (folder.join(names.certificate), folder.join(names.key));
    let mode = fs::metadata(&key).map_err(unreadable(&key))?.permissions();
    if mode.mode() & OF_OTHERS != 0 {
        return Err(AuthorityError::Open(key));
    }
    let key_pem = fs::read_to_string(&key).map_err(unreadable(&key))?;
    let certificate_pem = fs::read_to_string(&certificate).map_err(unreadable(&certificate))?;
    Authority::from_pem(certificate_pem, &key_pem).map_err(|cause| AuthorityError::Unusable {
        folder: folder.to_owned(),
        cause,
    })
}

/// Start of a rotation: its time, and the name of the caller.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Started {
    pub(super) at: Timestamp,
    pub(super) by: String,
}

/// Contents of the authority's folder.
pub(super) struct AuthorityFiles {
    pub(super) present: Authority,
    /// New authority, during a rotation.
    pub(super) next: Option<(Authority, Started)>,
    pub(super) retired: Vec<CertificateDer<'static>>,
}

/// Whether the last step is durable on the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Durability {
    /// The step is durable.
    Durable,
    /// A power failure may undo the step; [`Folder::retry_sync`] retries.
    Pending,
}

/// Function that makes the changes of a folder durable (`fsync`).
type Sync = Arc<dyn Fn(&Path) -> io::Result<()> + Send + std::marker::Sync>;

/// The folder of the authorities. Only the server that holds the lock of the database changes it.
#[derive(Clone)]
pub(super) struct Folder {
    path: PathBuf,
    sync: Sync,
}

impl std::fmt::Debug for Folder {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_tuple("Folder").field(&self.path).finish()
    }
}

/// One atomic change of the folder.
#[derive(Debug)]
enum Step {
    Write(&'static str, u32, String),
    Rename(&'static str, String),
    Remove(&'static str),
}

impl Step {
    fn name(&self) -> &'static str {
        match self {
            Self::Write(name, ..) | Self::Rename(name, _) | Self::Remove(name) => name,
        }
    }

    /// Applies the step without `fsync` of the folder; idempotent.
    fn take(&self, folder: &Path) -> io::Result<()> {
        match self {
            Self::Write(name, mode, text) => replace(&folder.join(name), *mode, text),
            Self::Rename(name, to) => match fs::rename(folder.join(name), folder.join(to)) {
                // It was renamed before.
                Err(cause)
                    if cause.kind() == io::ErrorKind::NotFound && folder.join(to).exists() =>
                {
                    Ok(())
                }
                renamed => renamed,
            },
            Self::Remove(name) => remove(&folder.join(name)),
        }
    }
}

/// Returns the steps that start a rotation; the last one makes it effective.
fn starting(next: &Authority, started: &Started) -> io::Result<Vec<Step>> {
    let started = serde_json::to_string_pretty(started)?;
    let (key, certificate) = (next.issuer.key().serialize_pem(), &next.certificate_pem);
    Ok(vec![
        Step::Write(NEXT_KEY_FILE, KEY_MODE, key),
        Step::Write(ROTATION_FILE, KEY_MODE, started),
        Step::Write(NEXT_CERTIFICATE_FILE, CERTIFICATE_MODE, certificate.clone()),
    ])
}

/// Returns the steps that finish a rotation. The first one makes it effective; [`Folder::recover`]
/// applies the others after an interruption.
fn finishing(former: &Authority) -> Vec<Step> {
    vec![
        Step::Rename(CERTIFICATE_FILE, retired_name(&former.fingerprint)),
        Step::Rename(NEXT_KEY_FILE, KEY_FILE.to_owned()),
        Step::Rename(NEXT_CERTIFICATE_FILE, CERTIFICATE_FILE.to_owned()),
        Step::Remove(ROTATION_FILE),
    ]
}

/// Returns the first steps of a replacement; the last of them makes it effective.
fn replacing(next: &Authority) -> Vec<Step> {
    let (key, certificate) = (next.issuer.key().serialize_pem(), &next.certificate_pem);
    vec![
        Step::Write(REPLACING_KEY_FILE, KEY_MODE, key),
        Step::Write(
            REPLACING_CERTIFICATE_FILE,
            CERTIFICATE_MODE,
            certificate.clone(),
        ),
    ]
}

/// Fingerprints of the authorities that a replacement retires.
struct Replaced {
    present: Option<String>,
    /// New authority, during a rotation.
    next: Option<String>,
}

/// Returns the steps that complete a replacement.
fn completing_replacement(replaced: &Replaced) -> Vec<Step> {
    let Replaced { present, next } = replaced;
    let retire =
        |file: &'static str, fingerprint: &str| Step::Rename(file, retired_name(fingerprint));
    let mut steps = Vec::new();
    steps.extend(next.iter().map(|it| retire(NEXT_CERTIFICATE_FILE, it)));
    steps.extend([Step::Remove(NEXT_KEY_FILE), Step::Remove(ROTATION_FILE)]);
    steps.extend(present.iter().map(|it| retire(CERTIFICATE_FILE, it)));
    steps.extend([
        Step::Rename(REPLACING_KEY_FILE, KEY_FILE.to_owned()),
        Step::Rename(REPLACING_CERTIFICATE_FILE, CERTIFICATE_FILE.to_owned()),
    ]);
    steps
}

fn retired_name(fingerprint: &str) -> String {
    let digits = fingerprint.get(..RETIRED_DIGITS).unwrap_or(fingerprint);
    format!("{RETIRED_PREFIX}{digits}{RETIRED_SUFFIX}")
}

impl Folder {
    pub(super) fn new(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            sync: Arc::new(|path| File::open(path)?.sync_all()),
        }
    }

    fn unwritable(&self, name: &str) -> impl FnOnce(io::Error) -> AuthorityError + use<> {
        unwritable(&self.path.join(name))
    }

    fn has(&self, name: &str) -> bool {
        self.path.join(name).exists()
    }

    /// Returns the fingerprint of the certificate in a file; `None` if it has none.
    fn fingerprint_in(&self, name: &str) -> Option<String> {
        let certificate = CertificateDer::from_pem_file(self.path.join(name)).ok()?;
        Some(fingerprint(&certificate))
    }

    /// Applies a step and makes it durable.
    fn apply(&self, step: &Step) -> Result<(), AuthorityError> {
        let done = step.take(&self.path).and_then(|()| (self.sync)(&self.path));
        done.map_err(self.unwritable(step.name()))
    }

    /// Applies steps of which the last makes a change effective. Undoes that step if it does not
    /// become durable, because a power failure could undo it later.
    fn begin(&self, steps: &[Step]) -> Result<(), AuthorityError> {
        let Some((deciding, preparing)) = steps.split_last() else {
            return Ok(());
        };
        for step in preparing {
            self.apply(step)?;
        }
        let Err(failed) = self.apply(deciding) else {
            return Ok(());
        };
        match self.undo_step(deciding.name()) {
            Ok(()) => Err(failed),
            Err(cause) => {
                let path = self.path.join(deciding.name());
                Err(AuthorityError::NotTakenBack { path, cause })
            }
        }
    }

    fn undo_step(&self, name: &str) -> io::Result<()> {
        // Either the rename failed, so there is nothing to remove, or the `fsync` did.
        remove(&self.path.join(name))?;
        (self.sync)(&self.path)
    }

    /// Applies the remaining steps of an effective change. A failure is logged; the next start of
    /// the server completes them.
    fn complete(&self, steps: &[Step]) {
        for step in steps {
            if let Err(failed) = self.apply(step) {
                error!(
                    error = &failed as &dyn std::error::Error,
                    "the files of the authorities are not all in their places; the next start of \
                     the server completes it"
                );
                break;
            }
        }
    }

    /// Completes earlier changes whose last steps failed, and removes new authorities that are not
    /// in the trusted set because their start failed.
    fn clean_up(&self, is_trusted: impl Fn(&str) -> bool) -> Result<(), AuthorityError> {
        for name in [REPLACING_CERTIFICATE_FILE, NEXT_CERTIFICATE_FILE] {
            let known = self.fingerprint_in(name).is_some_and(|it| is_trusted(&it));
            if self.has(name) && !known {
                self.apply(&Step::Remove(name))?;
            }
        }
        self.recover()
    }

    /// Starts a rotation to `next`.
    ///
    /// # Errors
    /// The folder cannot be written; the change is undone, or the error is
    /// [`AuthorityError::NotTakenBack`].
    pub(super) fn start(
        &self,
        next: &Authority,
        started: &Started,
        is_trusted: impl Fn(&str) -> bool,
    ) -> Result<(), AuthorityError> {
        self.clean_up(is_trusted)?;
        let steps = starting(next, started).map_err(self.unwritable(ROTATION_FILE))?;
        self.begin(&steps)
    }

    /// Finishes a rotation by retiring `former`. The finish is effective as soon as its first step
    /// is done; the result tells whether it is durable.
    ///
    /// # Errors
    /// The first step failed; the folder is unchanged.
    pub(super) fn finish(&self, former: &Authority) -> Result<Durability, AuthorityError> {
        let steps = finishing(former);
        let Some((deciding, rest)) = steps.split_first() else {
            return Ok(Durability::Durable);
        };
        let decided = deciding.take(&self.path);
        decided.map_err(self.unwritable(deciding.name()))?;
        if let Err(cause) = (self.sync)(&self.path) {
            // The other steps must not become durable before this one: after a power failure key
            // and certificate would not belong together.
            error!("the disk has not confirmed that the former authority is retired: {cause}");
            return Ok(Durability::Pending);
        }
        self.complete(rest);
        Ok(Durability::Durable)
    }

    /// Replaces all authorities by `next`.
    ///
    /// # Errors
    /// The folder cannot be written; the change is undone, or the error is
    /// [`AuthorityError::NotTakenBack`].
    pub(super) fn replace(
        &self,
        next: &Authority,
        is_trusted: impl Fn(&str) -> bool,
    ) -> Result<(), AuthorityError> {
        self.clean_up(is_trusted)?;
        self.begin(&replacing(next))?;
        self.complete(&self.rest_of_replacement());
        Ok(())
    }

    fn rest_of_replacement(&self) -> Vec<Step> {
        completing_replacement(&Replaced {
            present: self.fingerprint_in(CERTIFICATE_FILE),
            next: self.fingerprint_in(NEXT_CERTIFICATE_FILE),
        })
    }

    /// Retries to make the last step durable, and applies the steps that follow it.
    ///
    /// # Errors
    /// The step does not become durable, or another one fails.
    pub(super) fn retry_sync(&self) -> Result<(), AuthorityError> {
        (self.sync)(&self.path).map_err(unwritable(&self.path))?;
        self.recover()
    }

    /// Completes interrupted changes that were effective, and undoes those that were not.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub(super) fn recover(&self) -> Result<(), AuthorityError> {
        if self.has(REPLACING_CERTIFICATE_FILE) {
            for step in self.rest_of_replacement() {
                self.apply(&step)?;
            }
        }
        self.remove_all(&INCOMPLETE_REPLACEMENT)?;
        if self.has(NEXT_CERTIFICATE_FILE) && !self.has(CERTIFICATE_FILE) {
            if self.has(NEXT_KEY_FILE) {
                self.apply(&Step::Rename(NEXT_KEY_FILE, KEY_FILE.to_owned()))?;
            }
            let certificate = CERTIFICATE_FILE.to_owned();
            self.apply(&Step::Rename(NEXT_CERTIFICATE_FILE, certificate))?;
        }
        if !self.has(NEXT_CERTIFICATE_FILE) {
            self.remove_all(&INCOMPLETE_ROTATION)?;
        }
        Ok(())
    }

    fn remove_all(&self, names: &[&'static str]) -> Result<(), AuthorityError> {
        let mut existing = names.iter().filter(|name| self.has(name));
        existing.try_for_each(|name| self.apply(&Step::Remove(name)))
    }

    /// Reads the authorities; call [`Self::recover`] first.
    ///
    /// # Errors
    /// As [`Authority::load`].
    pub(super) fn read(&self) -> Result<AuthorityFiles, AuthorityError> {
        read(&self.path)
    }
}

fn read(folder: &Path) -> Result<AuthorityFiles, AuthorityError> {
    let present = Authority::load(folder)?;
    let next = if folder.join(NEXT_CERTIFICATE_FILE).exists() {
        let names = FileNames {
            certificate: NEXT_CERTIFICATE_FILE,
            key: NEXT_KEY_FILE,
        };
        Some((load(folder, names)?, read_started(folder)?))
    } else {
        None
    };
    let retired = read_retired(folder).map_err(unreadable(folder))?;
    Ok(AuthorityFiles {
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
        // A retired certificate only explains why a robot is refused, so an unreadable one is
        // skipped.
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

fn unwritable(path: &Path) -> impl FnOnce(io::Error) -> AuthorityError + use<> {
    let path = path.to_owned();
    move |cause| AuthorityError::Unwritable { path, cause }
}

/// Creates a file, which must not exist, and syncs it to the disk.
fn write(path: &Path, mode: u32, text: &str) -> io::Result<()> {
    let mut options = OpenOptions::new();
    let mut file = options.write(true).create_new(true).mode(mode).open(path)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}

/// Replaces a file atomically, by way of a temporary file.
fn replace(path: &Path, mode: u32, text: &str) -> io::Result<()> {
    let new = path.with_added_extension("new");
    remove(&new)?;
    write(&new, mode, text)?;
    fs::rename(new, path)
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(cause),
        Ok(()) | Err(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests;
