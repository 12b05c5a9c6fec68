//! Small files that are replaced as a whole and outlive a crash.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

/// Replaces a file in a folder and waits until the disk has it; the former content stays when it
/// refuses. Blocks.
///
/// # Errors
/// What the operating system said.
pub(crate) fn replace(folder: &Path, name: &str, content: &[u8]) -> io::Result<()> {
    let file = File::create(new_path(folder, name))?;
    put_in_place(folder, name, file, content)
}

/// The same for a file that only its owner can read.
///
/// # Errors
/// What the operating system said.
pub(crate) fn replace_private(folder: &Path, name: &str, content: &[u8]) -> io::Result<()> {
    let new_path = new_path(folder, name);
    // One that was left behind may have other permissions.
    match fs::remove_file(&new_path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        Ok(()) | Err(_) => {}
    }
    let mut options = OpenOptions::new();
    let file = options
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(new_path)?;
    put_in_place(folder, name, file, content)
}

fn new_path(folder: &Path, name: &str) -> std::path::PathBuf {
    folder.join(format!("{name}.new"))
}

fn put_in_place(folder: &Path, name: &str, mut file: File, content: &[u8]) -> io::Result<()> {
    file.write_all(content)?;
    file.sync_data()?;
    fs::rename(new_path(folder, name), folder.join(name))?;
    File::open(folder).and_then(|folder| folder.sync_all())
}
