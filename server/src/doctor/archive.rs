//! Examines the archive of old measurements: whether files can be written, and whether those that were
//! written are there. Creates nothing that remains.

use std::path::Path;

use nix::errno::Errno;
use nix::unistd::{AccessFlags, access};
use tread_api::diagnosis::{Finding, NextStep};

use super::DoctorInput;
use super::files::try_to_write;
use crate::archive::{ArchiveLocation, KeyRange, SegmentArchive, SegmentArchiveError};
use crate::error_text::chain;

const NAME: &str = "archive";
const CONTENT: &str = "archive content";
/// What happens until a fault is corrected.
const KEEPS: &str = "until then old measurements stay in the database";

/// Returns the findings; none without an archive. `archived` has the first and the last key of the
/// measurements that were archived by the database.
pub(super) async fn finding(examined: &DoctorInput, archived: Option<(i64, i64)>) -> Vec<Finding> {
    let Some(location) = examined.config.retention.archive.clone() else {
        return Vec::new();
    };
    let database = examined.config.database.file().map(Path::to_owned);
    let is_deep = examined.is_deep;
    // Files and requests to a bucket wait.
    let examining = move || examine(location, database.as_deref(), archived, is_deep);
    let examined = tokio::task::spawn_blocking(examining).await;
    examined.unwrap_or_else(|_panic| {
        vec![Finding::on(CONTENT).problem(
            "its examination broke off",
            NextStep("report this with what `doctor` printed"),
        )]
    })
}

fn examine(
    location: ArchiveLocation,
    database: Option<&Path>,
    archived: Option<(i64, i64)>,
    is_deep: bool,
) -> Vec<Finding> {
    let folder = match &location {
        ArchiveLocation::Folder(folder) => Some(folder.clone()),
        ArchiveLocation::Bucket(_) => None,
    };
    let archive = match SegmentArchive::new(location, database) {
        Ok(archive) => archive,
        Err(error) => return vec![unreachable(&error)],
    };
    let archived = archived.map(|(first, last)| KeyRange { first, last });
    let mark = match archived.map_or_else(|| archive.former_mark(), |mark| Ok(Some(mark))) {
        Ok(mark) => mark,
        Err(error) => return vec![damaged(&error)],
    };
    let writable = match &folder {
        Some(folder) => of_folder(folder, mark.is_some()),
        None => match archive.list().and_then(|_| archive.check_writable()) {
            Ok(()) => {
                let shown = archive.shown();
                Finding::on(NAME).ok(format!("objects can be written to `{}`", shown.display()))
            }
            Err(error) => unreachable(&error),
        },
    };
    if !writable.holds() || folder.as_ref().is_some_and(|folder| !folder.exists()) {
        return vec![writable];
    }
    let content = match archive.examine(mark, is_deep) {
        Ok(0) => Finding::on(CONTENT).ok("nothing is archived yet"),
        Ok(count) if is_deep => Finding::on(CONTENT).ok(format!("all files can be read ({count})")),
        Ok(count) => {
            Finding::on(CONTENT).ok(format!("all files are there ({count}); --deep reads them"))
        }
        Err(error @ SegmentArchiveError::Bucket { .. }) => unreachable(&error),
        Err(error) => damaged(&error),
    };
    vec![writable, content]
}

fn unreachable(error: &SegmentArchiveError) -> Finding {
    Finding::on(NAME).problem(chain(error),
        NextStep(format!(
            "see whether the storage can be reached; set AWS_ENDPOINT_URL, AWS_REGION and the credentials \
             in the environment of the server, and \
             permit it to list, read, write and delete objects; {KEEPS}"
        )),
    )
}

fn damaged(error: &SegmentArchiveError) -> Finding {
    Finding::on(CONTENT).problem(chain(error),
        NextStep(
            "mount the right disk, name the right folder or bucket, or restore the file from its copy; \
             docs/runbook.md says what to do without one",
        ),
    )
}

fn of_folder(folder: &Path, is_used: bool) -> Finding {
    let shown = folder.display();
    if folder.is_dir() {
        return match try_to_write(folder) {
            Ok(()) => Finding::on(NAME).ok(format!("files can be created in `{shown}`")),
            Err(error) => Finding::on(NAME).problem(
                format!("nothing can be written in `{shown}`: {error}"),
                NextStep(format!(
                    "make room there, mount it for writing, or give it to the user that the server \
                     runs as; {KEEPS}"
                )),
            ),
        };
    }
    if is_used {
        return Finding::on(NAME).problem(
            format!("measurements were archived, and the folder `{shown}` does not exist"),
            NextStep(format!(
                "mount the disk of the archive, or name its folder by [retention] archive; {KEEPS}"
            )),
        );
    }
    let mut ancestors = folder.ancestors().skip(1);
    let present = ancestors.find(|ancestor| ancestor.exists());
    let present = present.unwrap_or_else(|| Path::new("."));
    let permitted = if present.is_dir() {
        access(present, AccessFlags::W_OK | AccessFlags::X_OK)
    } else {
        Err(Errno::ENOTDIR)
    };
    match permitted {
        Ok(()) => {
            Finding::on(NAME).ok(format!("`{shown}` does not exist yet; the server makes it"))
        }
        Err(error) => Finding::on(NAME).problem(
            format!(
                "`{shown}` does not exist, and cannot be made in `{}`: {}",
                present.display(),
                error.desc()
            ),
            NextStep(format!(
                "make it, and give it to the user that the server runs as; {KEEPS}"
            )),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn examined(folder: &Path, archived: Option<(i64, i64)>) -> Vec<Finding> {
        examine(folder.to_owned().into(), None, archived, true)
    }

    #[test]
    fn a_folder_that_is_missing_or_cannot_be_made_is_said_and_nothing_is_made() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("a/b");
        let not_yet = examined(&folder, None);
        assert!(not_yet.iter().all(Finding::holds), "{not_yet:?}");
        assert!(!home.path().join("a").exists());
        let missing = examined(&folder, Some((1, 9)));
        assert!(missing[0].text.contains("does not exist"), "{missing:?}");
        std::fs::create_dir_all(&folder).unwrap();
        let empty = examined(&folder, None);
        assert!(
            empty.len() == 2 && empty.iter().all(Finding::holds),
            "{empty:?}"
        );
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
        let file = home.path().join("file");
        std::fs::write(&file, "").unwrap();
        let below_file = examined(&file.join("archive"), None);
        assert!(!below_file[0].holds(), "{below_file:?}");
    }

    #[test]
    fn missing_and_damaged_files_are_found() {
        let home = tempfile::tempdir().unwrap();
        let missing = examined(home.path(), Some((1, 9)));
        assert!(
            missing[0].holds() && missing[1].text.contains("lacks the measurement 9"),
            "{missing:?}"
        );
        let name = format!("segments-{:019}-{:019}.parquet", 1, 9);
        std::fs::write(home.path().join(name), "PAR1").unwrap();
        let damaged = examined(home.path(), Some((1, 9)));
        assert!(damaged[1].text.contains("is damaged"), "{damaged:?}");
    }
}
