//! Examines the folder of the database, its disk, and the modes and owners of the files.

use std::fs::{self, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use nix::sys::statvfs::{FsFlags, statvfs};
use nix::unistd::Uid;
use tread_api::diagnosis::{Finding, NextStep};

use super::DoctorInput;
use crate::config::credentials::is_passed;
use crate::config::{BYTES_PER_MIB, TlsSource};
use crate::file_owner::OF_OTHERS;
use crate::paths::folder_of;

/// Number of bytes written to test the disk.
const TRIED_BYTES: usize = 16 * 1_024;
/// Permissions of others.
const OF_ALL: u32 = 0o007;

pub(super) fn findings(examined: &DoctorInput) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(database) = examined.config.database.file() {
        let folder = folder_of(database);
        findings.push(folder_finding(folder));
        if folder.is_dir() {
            findings.push(disk(examined, folder));
        }
    }
    findings.extend(secrets(examined));
    findings.push(owners(examined));
    findings
}

/// Examines whether files can be created in the folder of the database.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "of all other errors the kernel log says more"
)]
fn folder_finding(folder: &Path) -> Finding {
    let shown = folder.display();
    if !folder.is_dir() {
        return Finding::on("folder").problem(
            format!("the folder `{shown}` of the database does not exist"),
            NextStep(format!(
                "`mkdir -p {shown}`, and give it to the user that the server runs as; or name \
                 another one by `database`"
            )),
        );
    }
    let is_read_only =
        statvfs(folder).is_ok_and(|found| found.flags().contains(FsFlags::ST_RDONLY));
    if is_read_only {
        return Finding::on("folder").problem(
            format!("the disk of `{shown}` is mounted read-only"),
            NextStep(
                "see `dmesg` for why; repair the file system, then mount it for writing \
                 (`mount -o remount,rw …`)",
            ),
        );
    }
    match try_to_write(folder) {
        Ok(()) => Finding::on("folder").ok(format!("files can be created in `{shown}`")),
        Err(error) => {
            let step = match error.kind() {
                io::ErrorKind::PermissionDenied => format!(
                    "run this as the user that the server runs as, or give that user the folder: \
                     `chown USER {shown}`"
                ),
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                    "make room on that disk; `df -h` and `df -i` show what is free".to_owned()
                }
                _ => "see `dmesg` for errors of the disk".to_owned(),
            };
            Finding::on("folder").problem(
                format!("nothing can be written in `{shown}`: {error}"),
                NextStep(step),
            )
        }
    }
}

/// Writes a file as large as a few pages, syncs it and removes it.
pub(super) fn try_to_write(folder: &Path) -> io::Result<()> {
    let file = folder.join(format!(".tread-doctor.{}", std::process::id()));
    let written = || {
        let mut options = OpenOptions::new();
        options.write(true).create_new(true).mode(0o600);
        let mut handle = options.open(&file)?;
        handle.write_all(&[0; TRIED_BYTES])?;
        handle.sync_all()
    };
    let written = written();
    // The error of the write matters more; the removal fails if the file was never made.
    let _ = fs::remove_file(&file);
    written
}

fn disk(examined: &DoctorInput, folder: &Path) -> Finding {
    let found = match statvfs(folder) {
        Ok(found) => found,
        Err(error) => {
            return Finding::on("disk").skipped(format!("its free space is not known: {error}"));
        }
    };
    let free_bytes = found
        .blocks_available()
        .saturating_mul(found.fragment_size());
    let limit_bytes = examined.config.storage.disk_free_min_bytes();
    let (free, limit) = (free_bytes / BYTES_PER_MIB, limit_bytes / BYTES_PER_MIB);
    let shown = folder.display();
    if found.files() > 0 && found.files_available() == 0 {
        return Finding::on("disk").problem(
            format!("the disk of `{shown}` has no inodes left, so no file can be made"),
            NextStep("remove files there; `df -i` shows who has them"),
        );
    }
    if free == 0 {
        return Finding::on("disk").problem(format!("the disk of `{shown}` is full"),
            NextStep(
                "make room on the disk; robots keep their measurements, and the server continues by itself",
            ),
        );
    }
    if free_bytes < limit_bytes {
        return Finding::on("disk").warning(
            format!(
                "{free} MiB are free for `{shown}`, less than storage.disk_free_min_mib, {limit}"
            ),
            NextStep(
                "make room, keep raw measurements for a shorter time ([retention]), or lower \
                 storage.disk_free_min_mib",
            ),
        );
    }
    Finding::on("disk").ok(format!("{free} MiB are free for `{shown}`"))
}

/// Examines who may read the secrets.
fn secrets(examined: &DoctorInput) -> Vec<Finding> {
    let config = &examined.config;
    let mut secret: Vec<PathBuf> = Vec::new();
    if let Some(database) = config.database.file() {
        for ending in ["", "-wal", "-shm"] {
            let mut name = database.as_os_str().to_owned();
            name.push(ending);
            secret.push(name.into());
        }
    }
    if let Some(TlsSource::Files(files)) = &config.tls {
        secret.push(files.key.clone());
    }
    if let Some(robots) = &config.robots {
        secret.push(robots.authority.join(crate::authority::KEY_FILE));
    }
    let mut findings = Vec::new();
    for file in secret {
        let Ok(found) = fs::metadata(&file) else {
            continue;
        };
        let mode = found.mode() & 0o777;
        let shown = file.display();
        if mode & OF_ALL != 0 {
            findings.push(Finding::on("file modes").problem(
                format!("others can use `{shown}`, which has the mode {mode:o}"),
                NextStep(format!(
                    "`chmod 600 {shown}`, and renew what is in it if others may have read it"
                )),
            ));
        } else if mode & OF_OTHERS != 0 {
            findings.push(Finding::on("file modes").warning(
                format!("the group of `{shown}` can use it, with the mode {mode:o}"),
                NextStep(format!(
                    "`chmod 600 {shown}`, unless you trust every member of that group"
                )),
            ));
        }
    }
    if findings.is_empty() {
        findings.push(Finding::on("file modes").ok("only their owner can use the secrets"));
    }
    findings
}

/// Examines whether the files belong to the user who runs the doctor, and are readable.
fn owners(examined: &DoctorInput) -> Finding {
    let config = &examined.config;
    let mut files: Vec<PathBuf> = examined.config_file.iter().cloned().collect();
    if let Some(database) = config.database.file() {
        files.push(database.to_owned());
        files.push(folder_of(database).to_owned());
    }
    if let Some(TlsSource::Files(tls)) = &config.tls {
        // Root owns credentials, and the service manager passes them.
        let files_of_user = [&tls.certificate, &tls.key].into_iter();
        files.extend(files_of_user.filter(|file| !is_passed(file)).cloned());
    }
    if let Some(robots) = &config.robots {
        files.push(robots.authority.clone());
    }
    let user = Uid::effective();
    let mut unreadable = Vec::new();
    let mut foreign = Vec::new();
    for file in files {
        let shown = file.display().to_string();
        match fs::metadata(&file) {
            Ok(found) if !found.is_dir() && fs::File::open(&file).is_err() => {
                unreadable.push(shown);
            }
            Ok(found) if found.uid() != user.as_raw() => foreign.push((shown, found.uid())),
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => unreadable.push(shown),
            Ok(_) | Err(_) => {}
        }
    }
    if !unreadable.is_empty() {
        return Finding::on("file owners").problem(format!("user {user} cannot read `{}`", unreadable.join("`, `")),
            NextStep(
                "give the files to the user that the server runs as (`chown`), and run this as that \
                 user",
            ),
        );
    }
    match foreign.first() {
        Some((file, owner)) if user.is_root() => Finding::on("file owners").warning(
            format!("this runs as root, and `{file}` is of user {owner}"),
            NextStep(format!(
                "run it as the user that the server runs as, to see what that one sees: \
                 `setpriv --reuid={owner} --clear-groups tread-server doctor …`"
            )),
        ),
        Some(_) | None => Finding::on("file owners").ok(format!("user {user} can read all files")),
    }
}
