//! Checks `[recording]` of `robot.toml`.

use std::path::{Path, PathBuf};

use super::ConfigError;
use super::file::RecordingFile;

/// Permitted size of a file, MiB.
pub const FILE_MIB_RANGE: std::ops::RangeInclusive<u64> = 1..=4_096;
/// Permitted number of files.
pub const FILES_RANGE: std::ops::RangeInclusive<usize> = 2..=1_000;
/// Default size of a file, MiB.
const FILE_MIB_DEFAULT: u64 = 64;
/// Default number of files.
const FILES_DEFAULT: usize = 16;

/// Destination and size of records.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingConfig {
    /// Folder of the files.
    pub folder: PathBuf,
    /// Size at which a file is closed and the next one begun, bytes.
    pub file_bytes: u64,
    /// Number of files that are kept, of all runs together.
    pub files: usize,
}

/// Returns the destination of records; `None` if recording is off.
///
/// # Errors
/// [`ConfigError::OutOfRange`] for a value that is not permitted, even if recording is off.
pub(super) fn checked(
    file: RecordingFile,
    data_dir: &Path,
) -> Result<Option<RecordingConfig>, ConfigError> {
    let file_mib = file.file_mib.unwrap_or(FILE_MIB_DEFAULT);
    let files = file.files.unwrap_or(FILES_DEFAULT);
    let outside = |key, problem| ConfigError::OutOfRange { key, problem };
    if !FILE_MIB_RANGE.contains(&file_mib) {
        let (least, most) = (FILE_MIB_RANGE.start(), FILE_MIB_RANGE.end());
        let problem = format!("{file_mib} is not within {least} to {most} MiB");
        return Err(outside("recording.file_mib", problem));
    }
    if !FILES_RANGE.contains(&files) {
        let (least, most) = (FILES_RANGE.start(), FILES_RANGE.end());
        let problem = format!("{files} is not within {least} to {most} files");
        return Err(outside("recording.files", problem));
    }
    let folder = file.folder.unwrap_or_else(|| data_dir.join("recordings"));
    let is_enabled = file.enabled.unwrap_or(false);
    Ok(is_enabled.then_some(RecordingConfig {
        folder,
        file_bytes: file_mib * 1024 * 1024,
        files,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_recorded_unless_it_is_wanted_and_bounds_are_checked() {
        let folder = Path::new("/data");
        assert_eq!(checked(RecordingFile::default(), folder).unwrap(), None);
        let on = RecordingFile {
            enabled: Some(true),
            ..RecordingFile::default()
        };
        let config = checked(on.clone(), folder).unwrap().unwrap();
        assert_eq!(config.folder, Path::new("/data/recordings"));
        assert_eq!((config.file_bytes, config.files), (64 << 20, 16));
        for (file_mib, files, key) in [(0, 2, "file_mib"), (5_000, 2, "file_mib"), (1, 1, "files")]
        {
            let file = RecordingFile {
                file_mib: Some(file_mib),
                files: Some(files),
                ..on.clone()
            };
            let refused = checked(file, folder).unwrap_err().to_string();
            assert!(refused.contains(key), "{refused}");
        }
    }
}
