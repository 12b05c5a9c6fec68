//! Small files that are replaced as a whole and outlive a crash, with a checksum where a changed
//! byte must not pass for another content.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

use crate::checksum::crc32;

/// What stands in front of the checksum, on a line of its own behind the content.
const SEAL: &str = "\ncrc32 ";
/// Length of that line: eight hexadecimal digits and the line's end follow.
const SEAL_BYTES: usize = SEAL.len() + 8 + 1;

/// The content of a file is not what was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("its checksum does not fit")]
pub(crate) struct Damaged;

/// A content with its checksum.
pub(crate) fn sealed(content: &[u8]) -> Vec<u8> {
    let mut sealed = content.to_vec();
    sealed.extend_from_slice(format!("{SEAL}{:08x}\n", crc32(content)).as_bytes());
    sealed
}

/// The content of a file that was written with its checksum. What an earlier agent wrote has none
/// and is given whole: a damaged seal stays in it, and does not parse.
///
/// # Errors
/// [`Damaged`].
pub(crate) fn unsealed(file: &[u8]) -> Result<&[u8], Damaged> {
    let Some((content, seal)) = file.split_last_chunk::<SEAL_BYTES>() else {
        return Ok(file);
    };
    if !seal.starts_with(SEAL.as_bytes()) {
        return Ok(file);
    }
    if sealed(content) == file {
        Ok(content)
    } else {
        Err(Damaged)
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sealed_file_of_which_any_bit_is_flipped_or_any_end_is_missing_gives_no_other_content() {
        let content = br#"{"latch":null,"seen":["a"]}"#;
        let file = sealed(content);
        assert_eq!(unsealed(&file), Ok(&content[..]));
        assert_eq!(unsealed(content), Ok(&content[..]), "of an earlier agent");
        let is_harmless = |read: Result<&[u8], Damaged>| {
            read.is_err()
                || read == Ok(content)
                || read.is_ok_and(|read| serde_json::from_slice::<serde_json::Value>(read).is_err())
        };
        for bit in 0..file.len() * 8 {
            let mut damaged = file.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(is_harmless(unsealed(&damaged)), "bit {bit}");
        }
        for length in 0..file.len() {
            let read = unsealed(&file[..length]);
            let without_seal = read.map(<[u8]>::trim_ascii_end);
            assert!(is_harmless(without_seal), "{length} bytes");
        }
    }
}
