//! The authority on the disk: certificate and key, in a folder of their own.
//!
//! A rotation adds the next authority, and each of its steps replaces or renames one file, so that a
//! crash between any two of them leaves what [`Folder::recover`] completes or takes back:
//!
//! ```text
//!  start   next.key, next.json ── next.pem ◄─ from here on the next authority signs
//!  finish  ca.pem → retired-….pem ◄─ from here on the former is retired
//!          next.key → ca.key (its key is gone), next.pem → ca.pem, next.json removed
//!  replace replacing.key ── replacing.pem ◄─ from here on all others are retired
//!          ca.pem and next.pem → retired-….pem, next.key and next.json removed,
//!          replacing.key → ca.key, replacing.pem → ca.pem
//! ```
//!
//! A step is done when the folder shows it, and kept when the disk has confirmed it. What retires an
//! authority counts from when it is done: to trust it again would be worse. What makes one begins only
//! when it is kept: a power cut must not take an authority away that has signed.

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
/// The certificate and the key of the authority that replaces all others.
const REPLACING_CERTIFICATE_FILE: &str = "replacing.pem";
const REPLACING_KEY_FILE: &str = "replacing.key";
/// Others may read a certificate, and its owner alone a key.
const CERTIFICATE_MODE: u32 = 0o644;
const KEY_MODE: u32 = 0o600;
/// What the certificate of a retired authority is called, around the begin of its fingerprint.
const RETIRED_PREFIX: &str = "retired-";
const RETIRED_SUFFIX: &str = ".pem";
/// Digits of the fingerprint in that name.
const RETIRED_DIGITS: usize = 16;
/// Most retired authorities that are read, the newest by the time of their retirement.
const RETIRED_MAX: usize = 8;
/// The files of a rotation that was never complete.
const INCOMPLETE_ROTATION: [&str; 5] = [
    NEXT_KEY_FILE,
    ROTATION_FILE,
    "next.key.new",
    "next.json.new",
    "next.pem.new",
];
/// The files of a replacement that was never complete.
const INCOMPLETE_REPLACEMENT: [&str; 3] =
    [REPLACING_KEY_FILE, "replacing.key.new", "replacing.pem.new"];

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
    /// A file was written, the disk has not confirmed it, and it could not be removed for certain.
    #[error(
        "cannot write `{}`, nor take it back for certain",
        path.display()
    )]
    NotTakenBack {
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

impl AuthorityError {
    /// What became of a change that was asked for.
    pub fn what_became(&self) -> &'static str {
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
        write(&key, KEY_MODE, &key_pem).map_err(unwritable(&key))?;
        let written = write(&certificate, CERTIFICATE_MODE, &authority.certificate_pem);
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

/// Whether the disk has confirmed what the folder shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Settled {
    /// It has.
    Yes,
    /// It has not: a power cut may undo the last step. [`Folder::settle`] asks again.
    NotYet,
}

/// Makes sure that what was changed in a folder is on the disk.
type Sync = Arc<dyn Fn(&Path) -> io::Result<()> + Send + std::marker::Sync>;

/// The folder of the authority. Only the server that owns it may change it.
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

/// One change of the folder; each is there whole or not at all.
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

    /// Does it, so that the folder shows it; once more does no harm.
    fn take(&self, folder: &Path) -> io::Result<()> {
        match self {
            Self::Write(name, mode, text) => replace(folder, name, *mode, text),
            Self::Rename(name, to) => rename(&folder.join(name), &folder.join(to)),
            Self::Remove(name) => remove(&folder.join(name)),
        }
    }
}

/// What starts a rotation. With the last of the steps it has begun.
fn starting(next: &Authority, started: &Started) -> io::Result<Vec<Step>> {
    let started = serde_json::to_string_pretty(started)?;
    let (key, certificate) = (next.issuer.key().serialize_pem(), &next.certificate_pem);
    Ok(vec![
        Step::Write(NEXT_KEY_FILE, KEY_MODE, key),
        Step::Write(ROTATION_FILE, KEY_MODE, started),
        Step::Write(NEXT_CERTIFICATE_FILE, CERTIFICATE_MODE, certificate.clone()),
    ])
}

/// What finishes a rotation. With the first of the steps it is decided, and [`Folder::recover`] does
/// the others if the server does not come to it.
fn finishing(former: &Authority) -> Vec<Step> {
    vec![
        Step::Rename(CERTIFICATE_FILE, retired_name(&former.fingerprint)),
        Step::Rename(NEXT_KEY_FILE, KEY_FILE.to_owned()),
        Step::Rename(NEXT_CERTIFICATE_FILE, CERTIFICATE_FILE.to_owned()),
        Step::Remove(ROTATION_FILE),
    ]
}

/// What decides a replacement: with the last of the steps.
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

/// What completes a replacement, out of the fingerprints of those that it retires.
fn completing_replacement(present: Option<&str>, next: Option<&str>) -> Vec<Step> {
    let retire =
        |file: &'static str, fingerprint: &str| Step::Rename(file, retired_name(fingerprint));
    let mut steps = Vec::new();
    steps.extend(next.map(|next| retire(NEXT_CERTIFICATE_FILE, next)));
    steps.extend([Step::Remove(NEXT_KEY_FILE), Step::Remove(ROTATION_FILE)]);
    steps.extend(present.map(|present| retire(CERTIFICATE_FILE, present)));
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

    /// The fingerprint of the certificate in a file; `None` without one.
    fn fingerprint_in(&self, name: &str) -> Option<String> {
        let certificate = CertificateDer::from_pem_file(self.path.join(name)).ok()?;
        Some(fingerprint(&certificate))
    }

    /// Does a step and waits until the disk has it.
    fn apply(&self, step: &Step) -> Result<(), AuthorityError> {
        let done = step.take(&self.path).and_then(|()| (self.sync)(&self.path));
        done.map_err(self.unwritable(step.name()))
    }

    /// Does what begins something. If the last step is not known to be kept it is taken back: nothing
    /// must be done by what a power cut may undo.
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
        match self.take_back(deciding.name()) {
            Ok(()) => Err(failed),
            Err(cause) => {
                let path = self.path.join(deciding.name());
                Err(AuthorityError::NotTakenBack { path, cause })
            }
        }
    }

    fn take_back(&self, name: &str) -> io::Result<()> {
        // Either the rename has failed, and there is nothing, or the disk has not confirmed it.
        remove(&self.path.join(name))?;
        (self.sync)(&self.path)
    }

    /// Does what is left of something that is decided; the next start of the server does it otherwise.
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

    /// Completes what the disk refused to complete, and removes what was taken back in vain: whatever
    /// signs here and is none of those that are trusted.
    fn tidy(&self, is_trusted: impl Fn(&str) -> bool) -> Result<(), AuthorityError> {
        for name in [REPLACING_CERTIFICATE_FILE, NEXT_CERTIFICATE_FILE] {
            let known = self.fingerprint_in(name).is_some_and(|it| is_trusted(&it));
            if self.has(name) && !known {
                self.apply(&Step::Remove(name))?;
            }
        }
        self.recover()
    }

    /// Starts a rotation.
    ///
    /// # Errors
    /// It cannot be written; as far as that is possible, it is as before.
    pub(super) fn start(
        &self,
        next: &Authority,
        started: &Started,
        is_trusted: impl Fn(&str) -> bool,
    ) -> Result<(), AuthorityError> {
        self.tidy(is_trusted)?;
        let steps = starting(next, started).map_err(self.unwritable(ROTATION_FILE))?;
        self.begin(&steps)
    }

    /// Finishes a rotation. It is decided as soon as the folder shows it, kept by the disk or not.
    ///
    /// # Errors
    /// The folder is as it was.
    pub(super) fn finish(&self, former: &Authority) -> Result<Settled, AuthorityError> {
        let steps = finishing(former);
        let Some((deciding, rest)) = steps.split_first() else {
            return Ok(Settled::Yes);
        };
        let decided = deciding.take(&self.path);
        decided.map_err(self.unwritable(deciding.name()))?;
        if let Err(cause) = (self.sync)(&self.path) {
            // The others must not come to the disk before it: key and certificate would not be of
            // each other.
            error!("the disk has not confirmed that the former authority is retired: {cause}");
            return Ok(Settled::NotYet);
        }
        self.complete(rest);
        Ok(Settled::Yes)
    }

    /// Puts an authority in the place of all others.
    ///
    /// # Errors
    /// It cannot be written; as far as that is possible, it is as before.
    pub(super) fn replace(
        &self,
        next: &Authority,
        is_trusted: impl Fn(&str) -> bool,
    ) -> Result<(), AuthorityError> {
        self.tidy(is_trusted)?;
        self.begin(&replacing(next))?;
        self.complete(&self.rest_of_replacement());
        Ok(())
    }

    fn rest_of_replacement(&self) -> Vec<Step> {
        let present = self.fingerprint_in(CERTIFICATE_FILE);
        let next = self.fingerprint_in(NEXT_CERTIFICATE_FILE);
        completing_replacement(present.as_deref(), next.as_deref())
    }

    /// Asks the disk again for what it has not confirmed, and completes what waits for it.
    ///
    /// # Errors
    /// It still does not confirm it.
    pub(super) fn settle(&self) -> Result<(), AuthorityError> {
        (self.sync)(&self.path).map_err(unwritable(&self.path))?;
        self.recover()
    }

    /// Completes what an earlier run of the server had decided, and takes back what it had not.
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
        let mut there = names.iter().filter(|name| self.has(name));
        there.try_for_each(|name| self.apply(&Step::Remove(name)))
    }

    /// Reads it, after [`Self::recover`].
    ///
    /// # Errors
    /// There is no authority, others can read a key, or it cannot be used.
    pub(super) fn read(&self) -> Result<Kept, AuthorityError> {
        read(&self.path)
    }
}

fn read(folder: &Path) -> Result<Kept, AuthorityError> {
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

fn unwritable(path: &Path) -> impl FnOnce(io::Error) -> AuthorityError + use<> {
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

/// Replaces a file.
fn replace(folder: &Path, name: &str, mode: u32, text: &str) -> io::Result<()> {
    let new = folder.join(format!("{name}.new"));
    remove(&new)?;
    write(&new, mode, text)?;
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
mod tests;
