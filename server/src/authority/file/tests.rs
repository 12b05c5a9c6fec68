use std::os::unix::fs::PermissionsExt as _;
use std::sync::atomic::{AtomicUsize, Ordering};

use proptest::prelude::*;

use super::super::{Authorities, RotationError};
use super::*;

fn now() -> Timestamp {
    "2026-11-02T10:00:00Z".parse().unwrap()
}

fn started() -> Started {
    Started {
        at: now(),
        by: "admin".to_owned(),
    }
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let name = |entry: io::Result<fs::DirEntry>| entry.unwrap().file_name().into_string();
    let mut names: Vec<String> = entries.map(|entry| name(entry).unwrap()).collect();
    names.sort();
    names
}

fn apply_all(folder: &Path, steps: &[Step]) {
    let folder = Folder::new(folder);
    for step in steps {
        folder.apply(step).unwrap();
    }
}

fn mode(folder: &Path, name: &str) -> u32 {
    let metadata = fs::metadata(folder.join(name)).unwrap();
    metadata.permissions().mode() & 0o777
}

#[test]
fn a_crash_between_any_two_steps_leaves_the_rotation_started_or_not_and_finished_or_not() {
    for steps_done in 0..=7 {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("authority");
        let former = Authority::create(&folder, now()).unwrap();
        let next = Authority::generate("next", now()).unwrap();
        let mut steps = starting(&next, &started()).unwrap();
        steps.extend(finishing(&former));
        assert_eq!(steps.len(), 7);
        apply_all(&folder, &steps[..steps_done]);
        // A half-written file of the interrupted step.
        fs::write(folder.join("next.key.new"), "half").unwrap();
        // Twice, because the recovery itself may be interrupted and repeated.
        for _ in 0..2 {
            let trusted = Authorities::load(&folder).unwrap().present();
            let all: Vec<&str> = trusted.all().map(|one| one.fingerprint()).collect();
            let expected = match steps_done {
                0..=2 => vec![former.fingerprint()],
                3 => vec![next.fingerprint(), former.fingerprint()],
                _ => vec![next.fingerprint()],
            };
            assert_eq!(all, expected, "after {steps_done} steps");
        }
        assert_eq!(mode(&folder, KEY_FILE), 0o600);
        assert_eq!(mode(&folder, CERTIFICATE_FILE), 0o644);
        if steps_done == 3 {
            assert_eq!(mode(&folder, NEXT_KEY_FILE), 0o600);
            continue;
        }
        // Only the files in use are left, above all no other key.
        let mut expected = vec![KEY_FILE.to_owned(), CERTIFICATE_FILE.to_owned()];
        if steps_done > 3 {
            expected.push(retired_name(&former.fingerprint));
            let key = fs::read_to_string(folder.join(KEY_FILE)).unwrap();
            assert_eq!(key, next.issuer.key().serialize_pem());
        }
        assert_eq!(names(&folder), expected, "after {steps_done} steps");
    }
}

#[test]
fn a_crash_between_any_two_steps_leaves_the_authority_replaced_or_not_in_a_rotation_too() {
    for (is_rotating, steps_done) in (0..=8).flat_map(|done| [(false, done), (true, done)]) {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("authority");
        let former = Authority::create(&folder, now()).unwrap();
        let (next, last) = (
            Authority::generate("next", now()).unwrap(),
            Authority::generate("last", now()).unwrap(),
        );
        let mut trusted_before = vec![former.fingerprint()];
        if is_rotating {
            apply_all(&folder, &starting(&next, &started()).unwrap());
            trusted_before.insert(0, next.fingerprint());
        }
        let mut steps = replacing(&last);
        steps.extend(completing_replacement(&Replaced {
            present: Some(former.fingerprint.clone()),
            next: is_rotating.then(|| next.fingerprint.clone()),
        }));
        assert_eq!(steps.len(), 7 + usize::from(is_rotating));
        let steps_done = steps_done.min(steps.len());
        apply_all(&folder, &steps[..steps_done]);
        for _ in 0..2 {
            let trusted = Authorities::load(&folder).unwrap().present();
            let all: Vec<&str> = trusted.all().map(|one| one.fingerprint()).collect();
            let expected = match steps_done {
                0..=1 => trusted_before.clone(),
                _ => vec![last.fingerprint()],
            };
            assert_eq!(all, expected, "after {steps_done} steps");
        }
        if steps_done < 2 {
            assert!(!names(&folder).iter().any(|name| name.contains("replacing")));
            continue;
        }
        let mut expected = vec![KEY_FILE.to_owned(), CERTIFICATE_FILE.to_owned()];
        expected.extend(trusted_before.iter().map(|one| retired_name(one)));
        expected.sort();
        assert_eq!(names(&folder), expected, "after {steps_done} steps");
        let key = fs::read_to_string(folder.join(KEY_FILE)).unwrap();
        assert_eq!(key, last.issuer.key().serialize_pem());
        assert_eq!(mode(&folder, KEY_FILE), 0o600);
    }
}

/// Returns a folder whose `fsync` succeeds `confirmed` times, then fails `failures` times, then
/// succeeds.
fn failing(path: &Path, confirmed: usize, failures: usize) -> Folder {
    let asked = AtomicUsize::new(0);
    let sync = move |path: &Path| {
        let asked = asked.fetch_add(1, Ordering::Relaxed);
        if (confirmed..confirmed + failures).contains(&asked) {
            return Err(io::Error::from_raw_os_error(5));
        }
        File::open(path)?.sync_all()
    };
    Folder {
        path: path.to_owned(),
        sync: Arc::new(sync),
    }
}

#[test]
fn a_finish_that_the_disk_does_not_confirm_counts_says_so_and_is_completed_later() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("authority");
    let former = Authority::create(&path, now()).unwrap();
    // Three syncs of the start succeed; that of the finish's first step and the next retry fail.
    let authorities = Authorities::load_from(failing(&path, 3, 2)).unwrap();
    let during = authorities.start("admin", now()).unwrap();
    let next = during.signing().fingerprint();
    let after = authorities.finish(during.id()).unwrap();
    assert!(!after.is_trusted(former.fingerprint()) && after.is_trusted(next));
    assert!(!authorities.is_durable());
    // After a power failure that undoes the rename, key and certificate must belong together.
    let undone = tempfile::tempdir().unwrap();
    for name in names(&path) {
        fs::copy(path.join(&name), undone.path().join(name)).unwrap();
    }
    let retired = undone.path().join(retired_name(former.fingerprint()));
    fs::rename(retired, undone.path().join(CERTIFICATE_FILE)).unwrap();
    let undone = Authorities::load(undone.path()).unwrap().present();
    assert_eq!(undone.id(), during.id());

    assert!(authorities.retry_sync().is_err());
    assert!(!authorities.is_durable());
    authorities.retry_sync().unwrap();
    assert!(authorities.is_durable());
    let mut expected = vec![KEY_FILE.to_owned(), CERTIFICATE_FILE.to_owned()];
    expected.push(retired_name(former.fingerprint()));
    assert_eq!(names(&path), expected);
    let again = Authorities::load(&path).unwrap().present();
    assert_eq!(again.id(), after.id());
}

#[test]
fn what_begins_and_is_not_confirmed_is_taken_back_and_can_be_asked_for_again() {
    for is_replacement in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("authority");
        let former = Authority::create(&path, now()).unwrap();
        let prepared = if is_replacement { 1 } else { 2 };
        for failures in [1, 2] {
            let authorities = Authorities::load_from(failing(&path, prepared, failures)).unwrap();
            let refused = if is_replacement {
                authorities.replace(former.fingerprint(), now())
            } else {
                authorities.start("admin", now())
            };
            let refused = refused.unwrap_err();
            let is_taken_back = !matches!(
                refused,
                RotationError::Files(AuthorityError::NotTakenBack { .. })
            );
            assert_eq!(is_taken_back, failures == 1, "{refused:?}");
            assert!(authorities.is_durable());
            let trusted = authorities.present();
            assert_eq!(trusted.signing().fingerprint(), former.fingerprint());
            // The folder contains the same authorities.
            let shown = Authorities::load(&path).unwrap().present();
            assert_eq!(shown.id(), trusted.id());
        }
        let authorities = Authorities::load(&path).unwrap();
        // A start that could not be undone is not mistaken for the new one.
        let stale = Authority::generate("stale", now()).unwrap();
        apply_all(&path, &starting(&stale, &started()).unwrap());
        apply_all(&path, &replacing(&stale));
        authorities.start("admin", now()).unwrap();
        let again = Authorities::load(&path).unwrap().present();
        assert_eq!(again.id(), authorities.present().id());
        assert!(!again.is_trusted(stale.fingerprint()));
    }
}

#[test]
fn a_folder_that_cannot_be_written_leaves_all_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("authority");
    Authority::create(&path, now()).unwrap();
    let authorities = Authorities::load(&path).unwrap();
    // A folder occupies the name of the file.
    fs::create_dir(path.join(NEXT_CERTIFICATE_FILE)).unwrap();
    fs::write(path.join(NEXT_CERTIFICATE_FILE).join("file"), "").unwrap();
    let before = authorities.present();
    assert!(authorities.start("admin", now()).is_err());
    assert_eq!(authorities.present().id(), before.id());
    fs::remove_dir_all(path.join(NEXT_CERTIFICATE_FILE)).unwrap();
    authorities.start("admin", now()).unwrap();
    let again = Authorities::load(&path).unwrap().present();
    assert_eq!(again.id(), authorities.present().id());
    let retiring = again.retiring().unwrap();
    assert_eq!(
        (retiring.started_at, &*retiring.started_by),
        (now(), "admin")
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Starts, finishes, replacements and restarts in any order.
    #[test]
    fn whatever_is_asked_for_one_authority_signs_at_most_two_are_trusted_and_the_disk_says_so(
        asked in prop::collection::vec(0_u8..4, 1..12),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("authority");
        Authority::create(&folder, now()).unwrap();
        let mut authorities = Authorities::load(&folder).unwrap();
        for asked in asked {
            let before = authorities.present();
            let was_under_way = before.retiring().is_some();
            match asked {
                0 => prop_assert_eq!(authorities.start("admin", now()).is_ok(), !was_under_way),
                1 => prop_assert_eq!(authorities.finish(before.id()).is_ok(), was_under_way),
                2 => {
                    let replaced = authorities.replace(before.signing().fingerprint(), now());
                    let replaced = replaced.unwrap();
                    prop_assert!(!before.all().any(|one| replaced.is_trusted(one.fingerprint())));
                }
                _ => authorities = Authorities::load(&folder).unwrap(),
            }
            let present = authorities.present();
            prop_assert_eq!(present.all().count(), 1 + usize::from(present.retiring().is_some()));
            prop_assert!(present.is_trusted(present.of_port().fingerprint()));
            // Except for a replacement, each change leaves a robot with the previous trust set and
            // the server with a common authority.
            if asked != 2 {
                prop_assert!(present.is_trusted(before.signing().fingerprint()));
                prop_assert!(before.is_trusted(present.of_port().fingerprint()));
            }
            prop_assert_eq!(Authorities::load(&folder).unwrap().present().id(), present.id());
        }
    }
}
