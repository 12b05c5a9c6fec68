use std::os::unix::fs::PermissionsExt as _;

use jiff::Timestamp;

use super::*;

struct TestArchive {
    folder: tempfile::TempDir,
    archive: PathBuf,
    database: Vec<u8>,
}

fn make(encryption: Option<&Filter>) -> TestArchive {
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy.db");
    let database: Vec<u8> = (0..300_000_u32).flat_map(u32::to_le_bytes).collect();
    fs::write(&copy, &database).unwrap();
    let authority = vec![
        ("ca.key".to_owned(), b"secret".to_vec()),
        ("ca.pem".to_owned(), b"certificate".to_vec()),
    ];
    let described = authority
        .iter()
        .map(|(name, content)| describe_authority_file(name, content));
    let manifest = Manifest {
        format: FORMAT,
        version: "0.1.0".to_owned(),
        commit: None,
        schema: 7,
        taken_at: Timestamp::UNIX_EPOCH,
        database: describe_file(&copy, DATABASE_NAME).unwrap(),
        rows: [("missions".to_owned(), 3)].into(),
        authority: described.collect(),
    };
    let source = Source {
        manifest: &manifest,
        database: &copy,
        authority: &authority,
    };
    let archive = folder.path().join("backup.tar");
    let mut shown = 0;
    let archived = write(&archive, &source, encryption, &mut |bytes| shown = bytes).unwrap();
    assert_eq!(shown, database.len() as u64);
    assert_eq!(archived.bytes, fs::metadata(&archive).unwrap().len());
    TestArchive {
        folder,
        archive,
        database,
    }
}

fn extracted(made: &TestArchive, key: Option<&Filter>) -> Result<Extracted, ArchiveError> {
    let target = made.folder.path().join("restored.db");
    let _ = fs::remove_file(&target);
    let extraction = Extraction {
        archive: &made.archive,
        key,
        database: &target,
    };
    let extracted = extract(&extraction, &mut |_bytes| {});
    match &extracted {
        Ok(_) => assert_eq!(fs::read(&target).unwrap(), made.database),
        Err(_) => assert!(!target.exists(), "nothing is left behind"),
    }
    extracted
}

#[test]
fn an_archive_gives_back_what_was_put_in_and_its_owner_alone_can_read_it() {
    let made = make(None);
    let found = extracted(&made, None).unwrap();
    assert_eq!(found.manifest.schema, 7);
    assert_eq!(
        found.authority[0],
        ("ca.key".to_owned(), b"secret".to_vec())
    );
    assert_eq!(manifest(&made.archive, None).unwrap(), found.manifest);
    let permissions = fs::metadata(&made.archive).unwrap().permissions();
    assert_eq!(permissions.mode() & 0o777, 0o600);
    assert!(!partial_name(&made.archive).exists());
}

fn filter(command: &str) -> Filter {
    Filter(command.to_owned())
}

#[test]
fn a_command_encrypts_and_another_decrypts() {
    // It is no cipher, but it changes every byte, and every machine has it.
    let (to, from) = (
        filter("LC_ALL=C tr '\\000-\\377' '\\001-\\377\\000'"),
        filter("LC_ALL=C tr '\\001-\\377\\000' '\\000-\\377'"),
    );
    let made = make(Some(&to));
    let bytes = fs::read(&made.archive).unwrap();
    assert!(!bytes.windows(6).any(|piece| piece == b"secret"));
    let found = extracted(&made, Some(&from)).unwrap();
    assert_eq!(found.authority[0].1, b"secret");
    assert_eq!(
        manifest(&made.archive, Some(&from)).unwrap(),
        found.manifest
    );
    let refused = extracted(&made, None).unwrap_err().to_string();
    assert!(refused.contains("--decrypt"), "{refused}");
    extracted(&made, Some(&filter("false"))).unwrap_err();
}

#[test]
fn a_command_that_fails_leaves_no_archive() {
    let made = make(None);
    let found = manifest(&made.archive, None).unwrap();
    let copy = made.folder.path().join("copy.db");
    let source = Source {
        manifest: &found,
        database: &copy,
        authority: &[],
    };
    for command in [
        "false",
        "head -c 100; exit 3",
        "no-such-program-at-all 2>/dev/null",
    ] {
        let target = made.folder.path().join("encrypted.tar");
        let command = filter(command);
        let failed = write(&target, &source, Some(&command), &mut |_bytes| {}).unwrap_err();
        assert!(failed.to_string().contains("failed"), "{failed}");
        assert!(!target.exists() && !partial_name(&target).exists());
    }
}

#[test]
fn a_command_that_writes_elsewhere_or_nothing_leaves_no_archive() {
    let made = make(None);
    let found = manifest(&made.archive, None).unwrap();
    let copy = made.folder.path().join("copy.db");
    let source = Source {
        manifest: &found,
        database: &copy,
        authority: &[],
    };
    let elsewhere = format!("cat >{}", made.folder.path().join("mine").display());
    for command in ["cat >/dev/null", &elsewhere] {
        let target = made.folder.path().join("encrypted.tar");
        let failed = write(&target, &source, Some(&filter(command)), &mut |_bytes| {});
        let failed = failed.unwrap_err().to_string();
        assert!(failed.contains("wrote 0 bytes"), "{failed}");
        assert!(failed.contains("standard output"), "{failed}");
        assert!(!target.exists() && !partial_name(&target).exists());
    }
}

#[test]
fn damage_anywhere_is_found() {
    let made = make(None);
    let intact = extracted(&made, None).unwrap();
    let whole = fs::read(&made.archive).unwrap();
    let mut found = 0;
    for at in (0..whole.len()).step_by(499) {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x40;
        fs::write(&made.archive, damaged).unwrap();
        match extracted(&made, None) {
            Err(_refused) => found += 1,
            // The zeros between the entries of a tar file have no meaning.
            Ok(read) => {
                assert_eq!(read.manifest, intact.manifest, "byte {at}");
                assert_eq!(read.authority, intact.authority, "byte {at}");
            }
        }
    }
    assert!(found * 499 > made.database.len(), "{found}");
    let tail = 1_024 + 512;
    for length in [0, 100, 600, 2_000, whole.len() / 2, whole.len() - tail - 1] {
        fs::write(&made.archive, &whole[..length]).unwrap();
        extracted(&made, None).expect_err(&format!("{length} bytes"));
    }
}

#[test]
fn another_file_and_a_newer_format_are_refused_with_words() {
    let made = make(None);
    fs::write(&made.archive, vec![7; 5_000]).unwrap();
    let refused = extracted(&made, None).unwrap_err().to_string();
    assert!(refused.contains("no backup"), "{refused}");
    // As an encrypted archive is.
    let noise: Vec<u8> = (0..4_096_u32)
        .map(|place| (place.wrapping_mul(2_654_435_761) >> 11).to_le_bytes()[0] | 0x80)
        .collect();
    fs::write(&made.archive, noise).unwrap();
    let refused = extracted(&made, None).unwrap_err().to_string();
    assert!(
        refused.is_ascii() && refused.contains("`--decrypt COMMAND`"),
        "{refused}"
    );
    let mut tar = Builder::new(Vec::new());
    let text = br#"{"format": 2, "version": "9.9.9", "unknown": 1}"#;
    let bytes = text.len() as u64;
    append(
        &mut tar,
        MANIFEST_NAME,
        bytes,
        Timestamp::UNIX_EPOCH,
        &text[..],
    )
    .unwrap();
    fs::write(&made.archive, tar.into_inner().unwrap()).unwrap();
    let refused = extracted(&made, None).unwrap_err().to_string();
    assert!(refused.contains("9.9.9"), "{refused}");
}

#[test]
fn an_archive_that_cannot_be_written_leaves_nothing_behind() {
    let made = make(None);
    let copy = made.folder.path().join("copy.db");
    let mut manifest = manifest(&made.archive, None).unwrap();
    manifest.database.bytes += 1;
    let source = Source {
        manifest: &manifest,
        database: &copy,
        authority: &[],
    };
    let target = made.folder.path().join("nowhere/backup.tar");
    let failed = write(&target, &source, None, &mut |_bytes| {}).unwrap_err();
    assert!(failed.to_string().contains("nowhere"), "{failed}");
}
