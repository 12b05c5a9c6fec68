//! The authority on the disk: certificate and key, in a folder of their own.

use std::fs::{self, DirBuilder, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use jiff::Timestamp;

use super::Authority;

/// The authority's certificate, in its folder.
pub const CERTIFICATE_FILE: &str = "ca.pem";
/// The authority's key, in its folder.
pub const KEY_FILE: &str = "ca.key";

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
        if certificate.exists() || key.exists() {
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
        let (certificate, key) = (folder.join(CERTIFICATE_FILE), folder.join(KEY_FILE));
        let mode = fs::metadata(&key).map_err(unreadable(&key))?.permissions();
        if mode.mode() & 0o077 != 0 {
            return Err(AuthorityError::Open(key));
        }
        let key_pem = fs::read_to_string(&key).map_err(unreadable(&key))?;
        let certificate_pem = fs::read_to_string(&certificate).map_err(unreadable(&certificate))?;
        Self::from_pem(certificate_pem, &key_pem).map_err(|cause| AuthorityError::Unusable {
            folder: folder.to_owned(),
            cause,
        })
    }
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
