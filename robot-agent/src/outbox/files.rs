//! Names and sizes of the store's files.

use std::fs;
use std::path::{Path, PathBuf};

use super::error::{StoreError, failure};

/// Extension of the files.
const FILE_ENDING: &str = "log";

pub(super) fn size(length: usize) -> u64 {
    u64::try_from(length).expect("no machine has longer pointers than 64 bits")
}

pub(super) fn file_path(folder: &Path, first_ordinal: u64) -> PathBuf {
    folder.join(format!("{first_ordinal:020}.{FILE_ENDING}"))
}

pub(super) fn file_names(folder: &Path) -> Result<Vec<u64>, StoreError> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(failure("list", folder))? {
        let path = entry.map_err(failure("list", folder))?.path();
        let is_ours = path.extension().is_some_and(|ending| ending == FILE_ENDING);
        let stem = path.file_stem().and_then(|stem| stem.to_str());
        if let Some(first_ordinal) = stem
            .filter(|_| is_ours)
            .and_then(|stem| stem.parse::<u64>().ok())
        {
            names.push(first_ordinal);
        }
    }
    names.sort_unstable();
    Ok(names)
}
