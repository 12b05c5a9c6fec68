//! Small files that are replaced as a whole and outlive a crash.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

/// Replaces a file in a folder and waits until the disk has it; the former content stays when it
/// refuses. Blocks.
///
/// # Errors
/// What the operating system said.
pub(crate) fn replace(folder: &Path, name: &str, content: &[u8]) -> io::Result<()> {
    let new_path = folder.join(format!("{name}.new"));
    let mut file = File::create(&new_path)?;
    file.write_all(content)?;
    file.sync_data()?;
    fs::rename(&new_path, folder.join(name))?;
    File::open(folder).and_then(|folder| folder.sync_all())
}
