//! Files of the archive in a folder.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use crate::file_error::FileError;

/// Present and new name of a file or an object.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rename<'name> {
    pub(super) from: &'name str,
    pub(super) to: &'name str,
}

/// A folder, which is created with its first file.
#[derive(Debug, Clone)]
pub(super) struct Folder {
    path: PathBuf,
}

impl Folder {
    pub(super) fn new(path: PathBuf) -> Self {
        Self { path }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn path_of(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    pub(super) fn create(&self) -> Result<(), FileError> {
        let mut builder = DirBuilder::new();
        let created = builder.recursive(true).mode(0o700).create(&self.path);
        created.map_err(FileError::of("create", &self.path))
    }

    /// Returns the names in the folder; none if it does not exist.
    pub(super) fn names(&self) -> Result<Vec<String>, FileError> {
        let failed = || FileError::of("read the folder", &self.path);
        let entries = match fs::read_dir(&self.path) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(failed()(error)),
        };
        let mut names = Vec::new();
        for entry in entries {
            names.extend(entry.map_err(failed())?.file_name().into_string());
        }
        Ok(names)
    }

    /// Creates a file with a name and removes it.
    pub(super) fn probe(&self, name: &str) -> Result<(), FileError> {
        self.create()?;
        let path = self.path_of(name);
        let mut options = OpenOptions::new();
        let created = options.write(true).create(true).mode(0o600).open(&path);
        created.map_err(FileError::of("create", &path))?;
        self.remove(name)
    }

    pub(super) fn remove(&self, name: &str) -> Result<(), FileError> {
        let path = self.path_of(name);
        fs::remove_file(&path).map_err(FileError::of("remove", &path))
    }

    pub(super) fn open(&self, name: &str) -> Result<File, FileError> {
        let path = self.path_of(name);
        File::open(&path).map_err(FileError::of("open", &path))
    }

    pub(super) fn rename(&self, names: Rename<'_>) -> Result<(), FileError> {
        let path = self.path_of(names.from);
        fs::rename(&path, self.path_of(names.to)).map_err(FileError::of("rename", &path))
    }

    /// Makes renamed files survive a power cut.
    pub(super) fn sync(&self) -> Result<(), FileError> {
        let synced = File::open(&self.path).and_then(|folder| folder.sync_all());
        synced.map_err(FileError::of("sync", &self.path))
    }
}
