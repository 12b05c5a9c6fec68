//! Writes and reads archives in pieces, so that memory does not grow with the database.

mod extraction;

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::thread;

use jiff::Timestamp;
use nix::fcntl::{PosixFadviseAdvice, posix_fadvise};
use ring::digest::{Context, SHA256};
use tar::{Builder, EntryType, Header};

pub use self::extraction::{Extracted, Extraction, extract, manifest, verify};
use super::encryption::{EncryptionError, Filter};
use super::manifest::{ArchivedFile, FORMAT, Manifest};
use crate::file_error::FileError;
use crate::paths::folder_of;

/// Name of the manifest's entry, the first of an archive.
const MANIFEST_NAME: &str = "manifest.json";
/// Name of the last entry: the checksum of the manifest.
const MANIFEST_SUM_NAME: &str = "manifest.sha256";
/// Name of the database's entry.
pub const DATABASE_NAME: &str = "tread.db";
/// Folder of the authority's entries.
const AUTHORITY_FOLDER: &str = "authority/";
/// Mode of archives and of extracted files: they contain secrets.
const MODE: u32 = 0o600;
/// Size of the pieces in which files are read and written, bytes.
const PIECE_BYTES: usize = 1024 * 1024;
/// Bytes of an archive that are written before each sync.
const SYNC_EVERY_BYTES: u64 = 4 * 1024 * 1024;
/// Maximum size of a manifest, bytes.
const MANIFEST_BYTES_MAX: u64 = 1024 * 1024;
/// Maximum size of a file of the authority, bytes.
pub const AUTHORITY_FILE_BYTES_MAX: u64 = 256 * 1024;
/// Maximum number of files of the authority.
pub const AUTHORITY_FILES_MAX: usize = 64;

/// Reason why an archive cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    /// A file operation failed.
    #[error(transparent)]
    File(#[from] FileError),
    /// Encryption or decryption failed.
    #[error(transparent)]
    Encryption(#[from] EncryptionError),
    /// The file is no backup.
    #[error(
        "`{}` is no backup of tread-server, or is encrypted and needs `--decrypt COMMAND`: {detail}",
        path.display()
    )]
    NoBackup {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// A newer program wrote the format.
    #[error(
        "the backup has format {found}, made by version {version}; this program reads format {FORMAT} \
         and older: install version {version} or newer"
    )]
    Newer {
        /// Format of the archive.
        found: u32,
        /// Version of the server that made it.
        version: String,
    },
    /// A checksum does not match.
    #[error(
        "`{name}` in the backup is damaged: its checksum is {found} instead of {expected}; take \
         another backup"
    )]
    Damaged {
        /// The entry.
        name: String,
        /// Checksum in the manifest.
        expected: String,
        /// Checksum of the content that was read.
        found: String,
    },
    /// The archive ends before its last entry.
    #[error("the backup ends too early: `{0}` is missing; take another backup")]
    Incomplete(String),
    /// The file on the disk differs from the written data.
    #[error("the backup `{}` does not read back as it was written: the disk is unreliable", .0.display())]
    NotReadBack(PathBuf),
}

/// Content of an archive.
#[derive(Debug)]
pub struct Source<'source> {
    /// The manifest, with the checksums of everything else.
    pub manifest: &'source Manifest,
    /// The copy of the database.
    pub database: &'source Path,
    /// Names and contents of the authority's files.
    pub authority: &'source [(String, Vec<u8>)],
}

/// A complete archive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Archived {
    /// Its size, bytes.
    pub bytes: u64,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
}

/// File that is synced every [`SYNC_EVERY_BYTES`]. Otherwise the kernel writes everything at the end
/// at once, which delays the commits of the server.
struct PeriodicallySynced {
    file: File,
    unsynced_bytes: u64,
}

impl PeriodicallySynced {
    fn new(file: File) -> Self {
        Self {
            file,
            unsynced_bytes: 0,
        }
    }

    fn finish(self) -> io::Result<()> {
        self.file.sync_all()
    }
}

impl Write for PeriodicallySynced {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.unsynced_bytes += written as u64;
        if self.unsynced_bytes >= SYNC_EVERY_BYTES {
            self.file.sync_data()?;
            self.unsynced_bytes = 0;
        }
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Writer that computes size and checksum.
struct Hashing<W> {
    inner: W,
    context: Context,
    bytes: u64,
}

impl<W> Hashing<W> {
    fn new(inner: W) -> Self {
        Self {
            inner,
            context: Context::new(&SHA256),
            bytes: 0,
        }
    }

    fn done(self) -> (W, Archived) {
        let archived = Archived {
            bytes: self.bytes,
            sha256: hex(self.context.finish().as_ref()),
        };
        (self.inner, archived)
    }
}

impl<W: Write> Write for Hashing<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.context.update(&bytes[..written]);
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

impl<R: Read> Read for Hashing<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.context.update(&buffer[..read]);
        self.bytes += read as u64;
        Ok(read)
    }
}

fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Returns size and checksum of a file.
///
/// # Errors
/// It cannot be read.
pub fn describe_file(path: &Path, name: &str) -> Result<ArchivedFile, ArchiveError> {
    let failed = || FileError::of("read", path);
    let mut file = Hashing::new(File::open(path).map_err(failed())?);
    let mut piece = vec![0; PIECE_BYTES];
    while file.read(&mut piece).map_err(failed())? > 0 {}
    let (_file, Archived { bytes, sha256 }) = file.done();
    Ok(ArchivedFile {
        name: name.to_owned(),
        bytes,
        sha256,
    })
}

/// Returns size and checksum of the content of a file of the authority.
pub fn describe_authority_file(name: &str, content: &[u8]) -> ArchivedFile {
    ArchivedFile {
        name: format!("{AUTHORITY_FOLDER}{name}"),
        bytes: content.len() as u64,
        sha256: hex(ring::digest::digest(&SHA256, content).as_ref()),
    }
}

/// Writes an archive to a new file beside `target`, reads it back, and renames it to `target`.
/// `progress` gets the number of bytes of the database that are written.
///
/// # Errors
/// [`ArchiveError`]; nothing is left behind.
pub fn write(
    target: &Path,
    source: &Source<'_>,
    encryption: Option<&Filter>,
    progress: &mut dyn FnMut(u64),
) -> Result<Archived, ArchiveError> {
    let partial = partial_name(target);
    // A killed process may have left it; the lock of backups excludes another writer.
    let _ = fs::remove_file(&partial);
    let written = write_new(&partial, source, encryption, progress).and_then(|archived| {
        read_back(&partial, &archived)?;
        fs::rename(&partial, target).map_err(FileError::of("rename to", target))?;
        sync_folder(target)?;
        Ok(archived)
    });
    if written.is_err() {
        let _ = fs::remove_file(&partial);
    }
    written
}

/// Returns the name of an incomplete archive.
pub fn partial_name(target: &Path) -> PathBuf {
    let mut name = target.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    target.with_file_name(name)
}

/// Makes the entries of the folder of a file durable.
///
/// # Errors
/// The folder cannot be synced.
pub fn sync_folder(file: &Path) -> Result<(), FileError> {
    let folder = folder_of(file);
    let synced = File::open(folder).and_then(|folder| folder.sync_all());
    synced.map_err(FileError::of("sync", folder))
}

fn write_new(
    partial: &Path,
    source: &Source<'_>,
    encryption: Option<&Filter>,
    progress: &mut dyn FnMut(u64),
) -> Result<Archived, ArchiveError> {
    let failed = || FileError::of("write", partial);
    let mut options = OpenOptions::new();
    let file = options.write(true).create_new(true).mode(MODE);
    let file = file.open(partial).map_err(failed())?;
    let file = PeriodicallySynced::new(file);
    let Some(filter) = encryption else {
        let output = BufWriter::with_capacity(PIECE_BYTES, Hashing::new(file));
        let output = pack(output, partial, source, progress)?;
        let hashing = output.into_inner().map_err(io::IntoInnerError::into_error);
        let (file, archived) = hashing.map_err(failed())?.done();
        file.finish().map_err(failed())?;
        return Ok(archived);
    };
    let mut child = filter.start(Stdio::piped())?;
    let (Some(input), Some(mut output)) = (child.stdin.take(), child.stdout.take()) else {
        return Err(ArchiveError::Incomplete(partial.display().to_string()));
    };
    let mut file = Hashing::new(file);
    let (packed, copied) = thread::scope(|scope| {
        let file = &mut file;
        // It owns the output, so that the command ends if the file cannot be written.
        let copying = scope.spawn(move || io::copy(&mut output, file));
        let input = BufWriter::with_capacity(PIECE_BYTES, input);
        let packed = pack(input, partial, source, progress);
        // This closes the command's input; otherwise the command would wait for more.
        let packed = packed.and_then(|mut input| Ok(input.flush().map_err(failed())?));
        (packed, copying.join())
    });
    let copied = copied.unwrap_or_else(|_panic| Err(io::Error::other("a thread panicked")));
    let status = child.wait().map_err(failed())?;
    copied.map_err(failed())?;
    // If the command failed, the broken pipe is only a consequence.
    filter.check(status)?;
    packed?;
    let (file, archived) = file.done();
    filter.check_size(archived.bytes, &source.manifest.database)?;
    file.finish().map_err(failed())?;
    Ok(archived)
}

/// Writes all entries, and returns the writer.
fn pack<W: Write>(
    output: W,
    partial: &Path,
    source: &Source<'_>,
    progress: &mut dyn FnMut(u64),
) -> Result<W, ArchiveError> {
    let failed = || FileError::of("write", partial);
    let mut tar = Builder::new(output);
    let manifest = source.manifest;
    let taken_at = manifest.taken_at;
    let text = serde_json::to_vec_pretty(manifest).map_err(io::Error::from);
    let text = text.map_err(failed())?;
    append(&mut tar, MANIFEST_NAME, text.len() as u64, taken_at, &*text).map_err(failed())?;
    for (name, content) in source.authority {
        let (name, bytes) = (format!("{AUTHORITY_FOLDER}{name}"), content.len() as u64);
        append(&mut tar, &name, bytes, taken_at, &**content).map_err(failed())?;
    }
    let copy = source.database;
    let opened = File::open(copy).map_err(FileError::of("read", copy))?;
    let counting = ProgressReader {
        inner: BufReader::with_capacity(PIECE_BYTES, opened),
        bytes: 0,
        progress,
    };
    let bytes = manifest.database.bytes;
    append(&mut tar, DATABASE_NAME, bytes, taken_at, counting).map_err(failed())?;
    let sum = hex(ring::digest::digest(&SHA256, &text).as_ref());
    let bytes = sum.len() as u64;
    append(&mut tar, MANIFEST_SUM_NAME, bytes, taken_at, sum.as_bytes()).map_err(failed())?;
    Ok(tar.into_inner().map_err(failed())?)
}

/// Reader that reports its progress.
struct ProgressReader<'progress, R> {
    inner: R,
    bytes: u64,
    progress: &'progress mut dyn FnMut(u64),
}

impl<R: Read> Read for ProgressReader<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.bytes += read as u64;
        (self.progress)(self.bytes);
        Ok(read)
    }
}

fn append<W: Write>(
    tar: &mut Builder<W>,
    name: &str,
    bytes: u64,
    changed_at: Timestamp,
    content: impl Read,
) -> io::Result<()> {
    let mut header = Header::new_gnu();
    header.set_entry_type(EntryType::Regular);
    header.set_size(bytes);
    header.set_mode(MODE);
    header.set_mtime(u64::try_from(changed_at.as_second()).unwrap_or_default());
    tar.append_data(&mut header, name, content.take(bytes))
}

/// Reads a file from the disk and compares it with the written data.
fn read_back(partial: &Path, written: &Archived) -> Result<(), ArchiveError> {
    let file = File::open(partial).map_err(FileError::of("read", partial))?;
    // Otherwise the check would only read the cache of the operating system. If the call fails, the
    // check is weaker, but the backup is the same.
    let _ = posix_fadvise(&file, 0, 0, PosixFadviseAdvice::POSIX_FADV_DONTNEED);
    drop(file);
    let found = describe_file(partial, "")?;
    if (found.bytes, &found.sha256) != (written.bytes, &written.sha256) {
        return Err(ArchiveError::NotReadBack(partial.to_owned()));
    }
    Ok(())
}

#[cfg(test)]
mod tests;
