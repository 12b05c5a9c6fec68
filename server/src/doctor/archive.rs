//! Examines the folder of the archive of old measurements. Creates nothing that remains.

use std::path::Path;

use nix::errno::Errno;
use nix::unistd::{AccessFlags, access};
use tread_api::diagnosis::Finding;

use super::Examined;
use super::files::try_to_write;
use crate::archive::mark_of;

const NAME: &str = "archive";

/// Returns the finding; `None` without an archive.
pub(super) fn finding(examined: &Examined) -> Option<Finding> {
    let folder = examined.config.retention.archive.as_deref()?;
    Some(examine(
        folder,
        &mark_of(folder, examined.config.database.file()),
    ))
}

fn examine(folder: &Path, mark: &Path) -> Finding {
    let shown = folder.display();
    let keeps = "until then old measurements stay in the database";
    if folder.is_dir() {
        return match try_to_write(folder) {
            Ok(()) => Finding::ok(NAME, format!("files can be created in `{shown}`")),
            Err(error) => Finding::problem(
                NAME,
                format!("nothing can be written in `{shown}`: {error}"),
                format!(
                    "make room there, mount it for writing, or give it to the user that the server \
                     runs as; {keeps}"
                ),
            ),
        };
    }
    if mark.exists() {
        return Finding::problem(
            NAME,
            format!("measurements were archived, and the folder `{shown}` does not exist"),
            format!(
                "mount the disk of the archive, or name its folder by [retention] archive; {keeps}"
            ),
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
        Ok(()) => Finding::ok(
            NAME,
            format!("`{shown}` does not exist yet; the server makes it"),
        ),
        Err(error) => Finding::problem(
            NAME,
            format!(
                "`{shown}` does not exist, and cannot be made in `{}`: {}",
                present.display(),
                error.desc()
            ),
            format!("make it, and give it to the user that the server runs as; {keeps}"),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_is_missing_or_cannot_be_made_is_said_and_nothing_is_made() {
        let home = tempfile::tempdir().unwrap();
        let (folder, mark) = (
            home.path().join("a/b"),
            home.path().join("tread.db.archived"),
        );
        assert!(examine(&folder, &mark).holds());
        assert!(!home.path().join("a").exists());
        std::fs::write(&mark, "").unwrap();
        let missing = examine(&folder, &mark);
        assert!(!missing.holds(), "{missing:?}");
        std::fs::create_dir_all(&folder).unwrap();
        assert!(examine(&folder, &mark).holds());
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
        let below_file = examine(&mark.join("archive"), Path::new("/none"));
        assert!(!below_file.holds(), "{below_file:?}");
    }
}
