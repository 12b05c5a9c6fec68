//! Reads the manifest and the content of archives, and checks every checksum.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, Read as _, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
use std::process::Stdio;

use ring::digest::SHA256;
use tar::Archive;

use super::{
    AUTHORITY_FILE_BYTES_MAX, AUTHORITY_FILES_MAX, AUTHORITY_FOLDER, ArchiveError, Archived,
    Hashing, MANIFEST_BYTES_MAX, MANIFEST_NAME, MANIFEST_SUM_NAME, MODE, PIECE_BYTES, hex,
};
use crate::backup::encryption::{Filter, Filtered, Opening};
use crate::backup::manifest::{ArchivedFile, FORMAT, Manifest};
use crate::file_error::FileError;

/// Extracted content of an archive.
#[derive(Debug)]
pub struct Extracted {
    /// The manifest.
    pub manifest: Manifest,
    /// Names and contents of the authority's files.
    pub authority: Vec<(String, Vec<u8>)>,
}

/// An archive that is to be extracted.
#[derive(Debug, Clone, Copy)]
pub struct Extraction<'paths> {
    /// The archive.
    pub archive: &'paths Path,
    /// Command that decrypts it, if it is encrypted.
    pub key: Option<&'paths Filter>,
    /// New file for its database.
    pub database: &'paths Path,
}

/// Reads the manifest of an archive.
///
/// # Errors
/// [`ArchiveError`].
pub fn manifest(path: &Path, key: Option<&Filter>) -> Result<Manifest, ArchiveError> {
    let mut archive = open(path, key)?;
    let mut entries = archive.entries().map_err(FileError::of("read", path))?;
    Ok(next_manifest(path, &mut entries)?.0)
}

type Entries<'archive> = tar::Entries<'archive, Opening<BufReader<File>>>;

fn open(
    path: &Path,
    key: Option<&Filter>,
) -> Result<Archive<Opening<BufReader<File>>>, ArchiveError> {
    let file = File::open(path).map_err(FileError::of("read", path))?;
    let Some(filter) = key else {
        let input = BufReader::with_capacity(PIECE_BYTES, file);
        return Ok(Archive::new(Opening::Plain(input)));
    };
    let filtered = Filtered::new(filter.start(Stdio::from(file))?);
    let missing = || ArchiveError::Incomplete("the output of the command".to_owned());
    Ok(Archive::new(Opening::Filtered(
        filtered.ok_or_else(missing)?,
    )))
}

/// Fields that manifests of all formats have.
#[derive(serde::Deserialize)]
struct Head {
    format: u32,
    version: String,
}

/// Returns the manifest and its checksum.
fn next_manifest(
    path: &Path,
    entries: &mut Entries<'_>,
) -> Result<(Manifest, ArchivedFile), ArchiveError> {
    let no_backup = |detail: String| ArchiveError::NoBackup {
        path: path.to_owned(),
        detail,
    };
    let entry = match entries.next() {
        Some(Ok(entry)) => entry,
        // The operating system's error; otherwise the text would quote bytes of the file.
        Some(Err(cause)) if cause.raw_os_error().is_some() => {
            return Err(FileError::of("read", path)(cause).into());
        }
        Some(Err(_not_tar)) => return Err(no_backup("it is no tar archive".to_owned())),
        None => return Err(no_backup("it is empty".to_owned())),
    };
    if &*entry.path_bytes() != MANIFEST_NAME.as_bytes() {
        return Err(no_backup(format!(
            "it does not begin with `{MANIFEST_NAME}`"
        )));
    }
    let mut text = Vec::new();
    let read = entry.take(MANIFEST_BYTES_MAX).read_to_end(&mut text);
    read.map_err(FileError::of("read", path))?;
    let head: Head = serde_json::from_slice(&text).map_err(|cause| no_backup(cause.to_string()))?;
    if head.format > FORMAT {
        return Err(ArchiveError::Newer {
            found: head.format,
            version: head.version,
        });
    }
    let manifest = serde_json::from_slice(&text).map_err(|cause| no_backup(cause.to_string()))?;
    let described = ArchivedFile {
        name: MANIFEST_NAME.to_owned(),
        bytes: text.len() as u64,
        sha256: hex(ring::digest::digest(&SHA256, &text).as_ref()),
    };
    Ok((manifest, described))
}

/// Extracts an archive: the database into a new file, and the authority into memory. Compares every
/// checksum. `progress` gets the number of database bytes that were read.
///
/// # Errors
/// [`ArchiveError`]; the file of the database is removed.
pub fn extract(
    extraction: &Extraction<'_>,
    progress: &mut dyn FnMut(u64),
) -> Result<Extracted, ArchiveError> {
    let Extraction {
        archive,
        key,
        database,
    } = *extraction;
    let mut options = OpenOptions::new();
    let file = options.write(true).create_new(true).mode(MODE);
    let mut file = file
        .open(database)
        .map_err(FileError::of("create", database))?;
    let extracted = extract_into(archive, key, (&mut file, database), progress).and_then(|found| {
        file.sync_all().map_err(FileError::of("write", database))?;
        Ok(found)
    });
    if extracted.is_err() {
        let _ = fs::remove_file(database);
    }
    extracted
}

/// Reads an archive to its end and compares every checksum.
///
/// # Errors
/// [`ArchiveError`].
pub fn verify(path: &Path, key: Option<&Filter>) -> Result<Manifest, ArchiveError> {
    let mut nowhere = io::sink();
    let output: (&mut dyn Write, _) = (&mut nowhere, Path::new("nowhere"));
    Ok(extract_into(path, key, output, &mut |_bytes| {})?.manifest)
}

fn extract_into(
    path: &Path,
    key: Option<&Filter>,
    (output, database): (&mut dyn Write, &Path),
    progress: &mut dyn FnMut(u64),
) -> Result<Extracted, ArchiveError> {
    let unreadable = || FileError::of("read", path);
    let mut archive = open(path, key)?;
    let mut entries = archive.entries().map_err(unreadable())?;
    let (manifest, read_manifest) = next_manifest(path, &mut entries)?;
    if manifest.authority.len() > AUTHORITY_FILES_MAX {
        let detail = format!("it names more than {AUTHORITY_FILES_MAX} files of an authority");
        let path = path.to_owned();
        return Err(ArchiveError::NoBackup { path, detail });
    }
    let mut authority = Vec::new();
    for expected in &manifest.authority {
        let mut content = Vec::new();
        let entry = next_entry(path, &mut entries, expected)?;
        let mut entry = Hashing::new(entry.take(AUTHORITY_FILE_BYTES_MAX));
        entry.read_to_end(&mut content).map_err(unreadable())?;
        compare(expected, &entry.done().1)?;
        let name = expected.name.strip_prefix(AUTHORITY_FOLDER);
        let name = name.filter(|name| is_plain(name)).ok_or_else(|| {
            let detail = format!("`{}` is no file of an authority", expected.name);
            let path = path.to_owned();
            ArchiveError::NoBackup { path, detail }
        })?;
        authority.push((name.to_owned(), content));
    }
    let mut entry = Hashing::new(next_entry(path, &mut entries, &manifest.database)?);
    let mut piece = vec![0; PIECE_BYTES];
    loop {
        let read = entry.read(&mut piece).map_err(unreadable())?;
        if read == 0 {
            break;
        }
        let written = output.write_all(&piece[..read]);
        written.map_err(FileError::of("write", database))?;
        progress(entry.bytes);
    }
    compare(&manifest.database, &entry.done().1)?;
    // It is the last entry, so an archive that has it is complete.
    let sum = ArchivedFile {
        name: MANIFEST_SUM_NAME.to_owned(),
        ..read_manifest.clone()
    };
    let mut expected = String::new();
    let entry = next_entry(path, &mut entries, &sum)?;
    let read = entry.take(MANIFEST_BYTES_MAX).read_to_string(&mut expected);
    read.map_err(unreadable())?;
    if expected != read_manifest.sha256 {
        return Err(ArchiveError::Damaged {
            name: read_manifest.name,
            expected,
            found: read_manifest.sha256,
        });
    }
    Ok(Extracted {
        manifest,
        authority,
    })
}

/// Returns whether a name cannot lead out of its folder.
fn is_plain(name: &str) -> bool {
    let is_allowed = |letter: char| letter.is_ascii_alphanumeric() || ".-_".contains(letter);
    !name.is_empty() && !name.starts_with('.') && name.chars().all(is_allowed)
}

fn next_entry<'entries>(
    path: &Path,
    entries: &mut Entries<'entries>,
    expected: &ArchivedFile,
) -> Result<tar::Entry<'entries, Opening<BufReader<File>>>, ArchiveError> {
    let missing = || ArchiveError::Incomplete(expected.name.clone());
    let entry = entries.next().ok_or_else(missing)?;
    let entry = entry.map_err(FileError::of("read", path))?;
    if &*entry.path_bytes() == expected.name.as_bytes() {
        Ok(entry)
    } else {
        Err(missing())
    }
}

fn compare(expected: &ArchivedFile, found: &Archived) -> Result<(), ArchiveError> {
    if found.bytes < expected.bytes {
        return Err(ArchiveError::Incomplete(expected.name.clone()));
    }
    if (found.bytes, &found.sha256) == (expected.bytes, &expected.sha256) {
        return Ok(());
    }
    Err(ArchiveError::Damaged {
        name: expected.name.clone(),
        expected: expected.sha256.clone(),
        found: found.sha256.clone(),
    })
}
