//! Copies of the authority's files, for backups.

use std::fs::{self, DirBuilder, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::Path;

use super::AuthorityError;

/// Maximum number of times that the files are read when they change meanwhile. A rotation takes
/// four steps.
const READS_MAX: u32 = 10;

/// Reads all files of the authority in a folder, as of one moment.
///
/// # Errors
/// [`AuthorityError::Unreadable`] if a file cannot be read, or the files never stood still.
pub fn read_files(folder: &Path) -> Result<Vec<(String, Vec<u8>)>, AuthorityError> {
    let unreadable = |cause| AuthorityError::Unreadable {
        path: folder.to_owned(),
        cause,
    };
    let mut before = read_once(folder).map_err(unreadable)?;
    for _ in 1..READS_MAX {
        let now = read_once(folder).map_err(unreadable)?;
        if now.is_some() && now == before {
            return Ok(now.unwrap_or_default());
        }
        before = now;
    }
    let cause = io::Error::other("its files change all the time");
    Err(unreadable(cause))
}

/// Files of an authority: names and contents.
type Files = Vec<(String, Vec<u8>)>;

/// Returns the files in the order of their names; `None` if one was renamed meanwhile.
fn read_once(folder: &Path) -> io::Result<Option<Files>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let Ok(name) = entry.file_name().into_string() else {
            continue;
        };
        // Files that end in `.new` are being written.
        if ![".pem", ".key", ".json"]
            .iter()
            .any(|end| name.ends_with(end))
        {
            continue;
        }
        match fs::read(entry.path()) {
            Ok(content) => files.push((name, content)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        }
    }
    files.sort();
    Ok(Some(files))
}

/// Writes the files of an authority into a new folder, with the modes that the server needs.
///
/// # Errors
/// [`AuthorityError::Exists`] if the folder contains anything; [`AuthorityError::Unwritable`].
pub fn write_files(folder: &Path, files: &[(String, Vec<u8>)]) -> Result<(), AuthorityError> {
    let unwritable = |path: &Path| {
        let path = path.to_owned();
        move |cause| AuthorityError::Unwritable { path, cause }
    };
    let mut builder = DirBuilder::new();
    let made = builder.recursive(true).mode(0o700).create(folder);
    made.map_err(unwritable(folder))?;
    let mut entries = fs::read_dir(folder).map_err(unwritable(folder))?;
    if entries.next().is_some() {
        return Err(AuthorityError::Exists(folder.to_owned()));
    }
    for (name, content) in files {
        let path = folder.join(name);
        let is_certificate = path.extension().is_some_and(|extension| extension == "pem");
        let permissions = if is_certificate { 0o644 } else { 0o600 };
        let mut options = OpenOptions::new();
        let opened = options
            .write(true)
            .create_new(true)
            .mode(permissions)
            .open(&path);
        let written = opened.and_then(|mut file| {
            file.write_all(content)?;
            file.sync_all()
        });
        written.map_err(unwritable(&path))?;
    }
    let synced = fs::File::open(folder).and_then(|folder| folder.sync_all());
    synced.map_err(unwritable(folder))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::authority::Authority;

    #[test]
    fn an_authority_works_after_it_was_copied() {
        let folder = tempfile::tempdir().unwrap();
        let (here, there) = (folder.path().join("here"), folder.path().join("there"));
        let made = Authority::create(&here, jiff::Timestamp::UNIX_EPOCH).unwrap();
        fs::write(here.join("next.key.new"), "half").unwrap();
        let files = read_files(&here).unwrap();
        let names: Vec<&str> = files.iter().map(|(name, _)| &**name).collect();
        assert_eq!(names, ["ca.key", "ca.pem"]);
        write_files(&there, &files).unwrap();
        let copied = Authority::load(&there).unwrap();
        assert_eq!(copied.fingerprint, made.fingerprint);
        assert!(matches!(
            write_files(&there, &files),
            Err(AuthorityError::Exists(_))
        ));
    }
}
