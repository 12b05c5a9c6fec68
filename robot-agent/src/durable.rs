//! Replaces small files as a whole and crash-safely, with a checksum where damage must be detected.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

use crate::checksum::crc32;

/// Text before the checksum, which is the last field of a file's JSON object.
const SEAL: &str = ",\"crc32\":\"";
/// Text after the checksum.
const SEAL_END: &str = "\"}";
/// Length of the checksum field, bytes: its eight hexadecimal digits are between the two texts.
const SEAL_BYTES: usize = SEAL.len() + 8 + SEAL_END.len();

/// The checksum of a file does not match its content.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("its checksum does not fit")]
pub(crate) struct Damaged;

/// Returns a JSON object with its checksum as an additional field, which other readers ignore.
pub(crate) fn sealed(object: &[u8]) -> Vec<u8> {
    let open = object.strip_suffix(b"}").unwrap_or(object);
    let mut sealed = open.to_vec();
    sealed.extend_from_slice(format!("{SEAL}{:08x}{SEAL_END}", crc32(open)).as_bytes());
    sealed
}

/// Returns the JSON object of a file after verifying its checksum. A file of an earlier agent
/// without a checksum is returned unverified.
///
/// # Errors
/// [`Damaged`] if the checksum does not match.
pub(crate) fn unsealed(file: &[u8]) -> Result<&[u8], Damaged> {
    let Some((open, seal)) = file.split_last_chunk::<SEAL_BYTES>() else {
        return Ok(file);
    };
    let is_sealed = seal.starts_with(SEAL.as_bytes()) && seal.ends_with(SEAL_END.as_bytes());
    if is_sealed && !seal[SEAL.len()..].starts_with(format!("{:08x}", crc32(open)).as_bytes()) {
        return Err(Damaged);
    }
    Ok(file)
}

/// Replaces a file in a folder and waits until it is on disk. Blocks.
///
/// # Errors
/// The operating system's error; the former content is kept.
pub(crate) fn replace(folder: &Path, name: &str, content: &[u8]) -> io::Result<()> {
    let file = File::create(new_path(folder, name))?;
    put_in_place(folder, name, file, content)
}

/// Replaces a file as [`replace`] does, readable by its owner only.
///
/// # Errors
/// The operating system's error; the former content is kept.
pub(crate) fn replace_private(folder: &Path, name: &str, content: &[u8]) -> io::Result<()> {
    let new_path = new_path(folder, name);
    // A file left by a crash may have other permissions.
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
    let written = file.write_all(content).and_then(|()| file.sync_data());
    if written.is_err() {
        // A part of a file would take the last space of a full disk. Another error counts more.
        let _ = fs::remove_file(new_path(folder, name));
    }
    written?;
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
        let value = |bytes: &[u8]| serde_json::from_slice::<serde_json::Value>(bytes).ok();
        let fields = |bytes: &[u8]| {
            let mut object = value(bytes)?;
            let fields = object.as_object_mut()?;
            // The checksum itself is no content, whatever it is called.
            fields.retain(|name, _| name == "latch" || name == "seen");
            Some(object)
        };
        let expected = value(content);
        assert_eq!(fields(unsealed(&file).unwrap()), expected);
        assert_eq!(unsealed(content), Ok(&content[..]), "of an earlier agent");
        let is_harmless = |damaged: &[u8]| {
            let Ok(read) = unsealed(damaged) else {
                return true;
            };
            let read = fields(read);
            read.is_none() || read == expected
        };
        for bit in 0..file.len() * 8 {
            let mut damaged = file.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(is_harmless(&damaged), "bit {bit}");
        }
        for length in 0..file.len() {
            assert!(is_harmless(&file[..length]), "{length} bytes");
        }
    }
}
