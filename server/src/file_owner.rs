//! Owners of the files that root creates for the service's user, and the permissions of others.
//! `init`, `restore`, `copy` and `migrate` run as root on a machine with packages. The server runs as
//! another user.

use std::fs;
use std::os::unix::fs::{MetadataExt as _, lchown};
use std::path::Path;

use anyhow::Context as _;
use nix::unistd::Uid;

use crate::paths::folder_of;

/// Mask of the permissions of group and others in a file's mode.
pub(crate) const OF_OTHERS: u32 = 0o077;

/// Owner of a file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Owner {
    pub(crate) uid: u32,
    pub(crate) gid: u32,
}

/// Returns user and group of a folder that another user owns, if this process runs as root.
///
/// # Errors
/// The folder cannot be examined.
pub(crate) fn service_owner(folder: &Path) -> anyhow::Result<Option<Owner>> {
    if !Uid::effective().is_root() {
        return Ok(None);
    }
    let found =
        fs::metadata(folder).with_context(|| format!("cannot look at `{}`", folder.display()))?;
    Ok((found.uid() != 0).then(|| Owner {
        uid: found.uid(),
        gid: found.gid(),
    }))
}

/// Changes the owner of root's files: a file, or a folder with everything in it.
///
/// # Errors
/// A file cannot be examined, or its owner cannot be changed.
pub(crate) fn chown_recursively(path: &Path, owner: Owner) -> anyhow::Result<()> {
    let named = || format!("cannot change the owner of `{}`", path.display());
    let found = fs::symlink_metadata(path).with_context(named)?;
    if found.uid() == 0 {
        lchown(path, Some(owner.uid), Some(owner.gid)).with_context(named)?;
    }
    if found.is_dir() {
        for entry in fs::read_dir(path).with_context(named)? {
            chown_recursively(&entry.with_context(named)?.path(), owner)?;
        }
    }
    Ok(())
}

/// Makes the owner of the parent folder the owner of root's files in a folder.
///
/// # Errors
/// A file cannot be examined, or its owner cannot be changed.
pub(crate) fn chown_to_parents_owner(folder: &Path) -> anyhow::Result<()> {
    match service_owner(folder_of(folder))? {
        Some(owner) => chown_recursively(folder, owner),
        None => Ok(()),
    }
}

/// Makes the owner of the folder the owner of root's files of a database: those whose names begin
/// with its name.
///
/// # Errors
/// A file cannot be examined, or its owner cannot be changed.
pub(crate) fn chown_database(database: &Path) -> anyhow::Result<()> {
    let folder = folder_of(database);
    let Some((owner, name)) = service_owner(folder)?.zip(database.file_name()) else {
        return Ok(());
    };
    let named = || format!("cannot look at `{}`", folder.display());
    for entry in fs::read_dir(folder).with_context(named)? {
        let entry = entry.with_context(named)?;
        let found = entry.file_name();
        if found
            .as_encoded_bytes()
            .starts_with(name.as_encoded_bytes())
        {
            chown_recursively(&entry.path(), owner)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::chown;

    use super::*;

    /// A user that is not root.
    const OTHER: u32 = 12_345;

    #[test]
    fn what_root_makes_of_a_database_belongs_to_the_owner_of_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["tread.db", "tread.db-wal", "tread.db.lock", "notes"] {
            fs::write(at(name), "").unwrap();
        }
        fs::create_dir(at("authority")).unwrap();
        fs::write(at("authority/ca.key"), "").unwrap();
        let owner = |name: &str| fs::metadata(at(name)).unwrap().uid();
        if !Uid::effective().is_root() {
            // Nobody else can give files away; nothing is tried.
            chown_database(&at("tread.db")).unwrap();
            assert_eq!(owner("tread.db"), Uid::effective().as_raw());
            return;
        }
        chown(folder.path(), Some(OTHER), Some(OTHER)).unwrap();
        chown_database(&at("tread.db")).unwrap();
        for name in ["tread.db", "tread.db-wal", "tread.db.lock"] {
            assert_eq!(owner(name), OTHER, "{name}");
        }
        assert_eq!(owner("notes"), 0, "it is not of the database");
        assert_eq!(owner("authority/ca.key"), 0);
        chown_to_parents_owner(&at("authority")).unwrap();
        assert_eq!(owner("authority"), OTHER);
        assert_eq!(owner("authority/ca.key"), OTHER);
    }
}
