//! Owners of files that root creates for the service's user: `init`, `restore` and `migrate` run as
//! root on a machine with packages, and the server does not.

use std::fs;
use std::os::unix::fs::{MetadataExt as _, lchown};
use std::path::Path;

use anyhow::Context as _;
use nix::unistd::Uid;

/// User and group of a folder, if this process is root and another user owns the folder.
///
/// # Errors
/// The folder cannot be examined.
pub(crate) fn other_owner(folder: &Path) -> anyhow::Result<Option<(u32, u32)>> {
    if !Uid::effective().is_root() {
        return Ok(None);
    }
    let found =
        fs::metadata(folder).with_context(|| format!("cannot look at `{}`", folder.display()))?;
    Ok((found.uid() != 0).then(|| (found.uid(), found.gid())))
}

/// Gives a file of root, or all files of root in a folder and its subfolders, to a user.
///
/// # Errors
/// A file cannot be examined or given away.
pub(crate) fn give(path: &Path, owner: (u32, u32)) -> anyhow::Result<()> {
    let named = || format!("cannot give `{}` to its owner", path.display());
    let found = fs::symlink_metadata(path).with_context(named)?;
    if found.uid() == 0 {
        lchown(path, Some(owner.0), Some(owner.1)).with_context(named)?;
    }
    if found.is_dir() {
        for entry in fs::read_dir(path).with_context(named)? {
            give(&entry.with_context(named)?.path(), owner)?;
        }
    }
    Ok(())
}

/// Gives root's files in a folder to the owner of the folder around it.
///
/// # Errors
/// A file cannot be examined or given away.
pub(crate) fn give_to_owner_around(folder: &Path) -> anyhow::Result<()> {
    match other_owner(parent_of(folder))? {
        Some(owner) => give(folder, owner),
        None => Ok(()),
    }
}

fn parent_of(path: &Path) -> &Path {
    let folder = path.parent().filter(|it| !it.as_os_str().is_empty());
    folder.unwrap_or(Path::new("."))
}

/// Gives root's files of a database (those whose names begin with its name) to the owner of their
/// folder.
///
/// # Errors
/// A file cannot be examined or given away.
pub(crate) fn give_database(database: &Path) -> anyhow::Result<()> {
    let folder = parent_of(database);
    let Some((owner, name)) = other_owner(folder)?.zip(database.file_name()) else {
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
            give(&entry.path(), owner)?;
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
            give_database(&at("tread.db")).unwrap();
            assert_eq!(owner("tread.db"), Uid::effective().as_raw());
            return;
        }
        chown(folder.path(), Some(OTHER), Some(OTHER)).unwrap();
        give_database(&at("tread.db")).unwrap();
        for name in ["tread.db", "tread.db-wal", "tread.db.lock"] {
            assert_eq!(owner(name), OTHER, "{name}");
        }
        assert_eq!(owner("notes"), 0, "it is not of the database");
        assert_eq!(owner("authority/ca.key"), 0);
        give_to_owner_around(&at("authority")).unwrap();
        assert_eq!(owner("authority"), OTHER);
        assert_eq!(owner("authority/ca.key"), OTHER);
    }
}
