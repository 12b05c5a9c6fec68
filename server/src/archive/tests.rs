//! What was written is read to the bit, and a damaged file never reads as another one.

pub(super) mod samples;

use std::cell::Cell;
use std::fs;
use std::ops::Deref;
use std::os::unix::fs::PermissionsExt as _;

use proptest::prelude::*;
use tread_api::friction::{Information, ThetaErrors};

use self::samples::{numbered, rows, stored};
use super::*;

/// An archive with its mark, as a database has it.
struct Marked {
    files: SegmentArchive,
    mark: Cell<Option<KeyRange>>,
}

impl Deref for Marked {
    type Target = SegmentArchive;

    fn deref(&self) -> &SegmentArchive {
        &self.files
    }
}

impl Marked {
    fn folder(&self) -> PathBuf {
        self.shown()
    }

    fn read(
        &self,
        selection: &Selection,
        limit: usize,
    ) -> Result<SearchResult, SegmentArchiveError> {
        self.files.read(selection, self.mark.get(), limit)
    }

    fn check_writable(&self) -> Result<(), SegmentArchiveError> {
        self.check_present(self.mark.get())?;
        self.files.check_writable()
    }
}

fn in_folder(folder: &Path) -> Marked {
    let database = folder.with_file_name("tread.db");
    Marked {
        files: SegmentArchive::new(folder.to_owned().into(), Some(&database)).unwrap(),
        mark: Cell::new(None),
    }
}

fn archive(folder: &Path) -> Marked {
    in_folder(&folder.join("archive"))
}

fn write(archive: &Marked, rows: &[ArchivedSegment]) -> KeyRange {
    let (first, last) = (rows[0].stored.id, rows[rows.len() - 1].stored.id);
    let mut writer = archive.begin(KeyRange { first, last }).unwrap();
    for part in rows.chunks(1_000) {
        writer.add(part.to_vec()).unwrap();
    }
    let finished = writer.finish().unwrap();
    let keys = finished.keys();
    assert_eq!(archive.publish(&finished).unwrap(), Vec::<PathBuf>::new());
    archive.mark.set(Some(keys.joined_to(archive.mark.get())));
    keys
}

pub(super) fn everything(after: i64, before: i64) -> Selection {
    Selection {
        site: None,
        robot: None,
        terrain: None,
        robots: None,
        after,
        before,
    }
}

/// Every field with the bits of its numbers.
fn bits(rows: &[ArchivedSegment]) -> Vec<(String, Vec<u64>)> {
    let of = |row: &ArchivedSegment| {
        let segment = &row.stored.segment;
        let pair = |pair: Option<Information>| {
            let pair = pair.map(|pair| [pair.information, pair.weighted]);
            pair.map_or(vec![], Vec::from)
        };
        let errors = segment.theta_errors.map(|errors| {
            let ThetaErrors {
                independent_information,
                robot_ratio,
                tyre_ratio,
            } = errors;
            vec![independent_information, robot_ratio, tyre_ratio]
        });
        let numbers = [
            pair(Some(segment.theta)),
            errors.unwrap_or_default(),
            pair(segment.effective_track_ratio),
            pair(segment.rolling_resistance),
            segment.mu_peak_lower_bound.into_iter().collect(),
            vec![segment.distance_m, segment.saturation_ratio],
        ];
        let numbers = numbers.concat().into_iter().map(f64::to_bits).collect();
        (format!("{row:?}"), numbers)
    };
    rows.iter().map(of).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn measurements_are_read_as_they_were_written_to_the_bit(
        first in prop_oneof![1_i64..10, 1_i64..i64::MAX - 1_000],
        written in prop::collection::vec(stored(), 1..200),
        limit in 1_usize..300,
    ) {
        let folder = tempfile::tempdir().unwrap();
        let archive = archive(folder.path());
        let written = numbered(first, written);
        let keys = write(&archive, &written);
        let mut found = Vec::new();
        let mut after = 0;
        loop {
            let more = archive.read(&everything(after, keys.last + 1), limit).unwrap();
            found.extend(more.segments);
            after = more.searched_to;
            if after >= keys.last {
                break;
            }
        }
        prop_assert_eq!(bits(&found), bits(&written));
        prop_assert_eq!(archive.read_file(keys, 0, usize::MAX).unwrap(), written);
    }
}

#[test]
fn a_file_with_one_wrong_bit_or_without_its_end_gives_an_error_or_what_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let keys = write(&archive, &rows(1, 60));
    let path = archive.path_of(keys);
    let selections = [0, 2, 9].map(|robot| Selection {
        robot: Some(format!("rover-{robot}").parse().unwrap()),
        ..everything(0, 61)
    });
    let read = |selection: &Selection| archive.read(selection, 100).map(|found| found.segments);
    let expected = selections
        .clone()
        .map(|selection| read(&selection).unwrap());
    let written = fs::read(&path).unwrap();
    let flipped = (0..written.len()).map(|at| {
        let mut bytes = written.clone();
        bytes[at] ^= 1 << (at % 8);
        bytes
    });
    let cut = (0..written.len())
        .step_by(13)
        .map(|length| written[..length].to_vec());
    let mut errors = 0;
    for bytes in flipped.chain(cut) {
        fs::write(&path, bytes).unwrap();
        for (selection, expected) in selections.iter().zip(&expected) {
            match read(selection) {
                Ok(found) => assert_eq!(found, *expected),
                Err(SegmentArchiveError::Damaged { path: named, .. }) => {
                    assert_eq!(named, path);
                    errors += 1;
                }
                Err(other) => panic!("{other}"),
            }
        }
    }
    assert!(
        errors > 2 * written.len(),
        "{errors} errors of {} bytes",
        written.len()
    );
}

#[test]
fn only_what_is_selected_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    // More than a row group, in three files.
    let group = i64::try_from(ROW_GROUP_ROWS).unwrap();
    let all = rows(1, 2 * group + 500);
    let (one, rest) = all.split_at(ROW_GROUP_ROWS + 300);
    let (two, three) = rest.split_at(100);
    for part in [one, two, three] {
        write(&archive, part);
    }
    let last = i64::try_from(all.len()).unwrap();
    let selections = [
        everything(0, last + 1),
        everything(group - 5, group + 320),
        Selection {
            site: Some("quarry".parse().unwrap()),
            robot: Some("rover-1".parse().unwrap()),
            ..everything(0, last + 1)
        },
        Selection {
            terrain: Some("mud".parse().unwrap()),
            robots: Some(
                ["rover-2", "rover-9"]
                    .map(|name| name.parse().unwrap())
                    .into(),
            ),
            ..everything(77, last - 50)
        },
        Selection {
            site: Some("nowhere".parse().unwrap()),
            ..everything(0, last + 1)
        },
        Selection {
            robots: Some(BTreeSet::new()),
            ..everything(0, last + 1)
        },
    ];
    for selection in selections {
        let is_selected = |row: &&ArchivedSegment| {
            let (stored, site) = (&row.stored, &row.site);
            let terrain = stored.segment.terrain.as_ref().map(|terrain| &terrain.id);
            stored.id > selection.after
                && stored.id < selection.before
                && selection.site.as_ref().is_none_or(|wanted| wanted == site)
                && selection
                    .robot
                    .as_ref()
                    .is_none_or(|wanted| *wanted == stored.robot)
                && selection
                    .terrain
                    .as_ref()
                    .is_none_or(|wanted| terrain == Some(wanted))
                && selection
                    .robots
                    .as_ref()
                    .is_none_or(|robots| robots.contains(&stored.robot))
        };
        let expected: Vec<ArchivedSegment> = all.iter().filter(is_selected).cloned().collect();
        for limit in [7_919, usize::MAX] {
            let mut selection = selection.clone();
            let mut found = Vec::new();
            while selection.after < selection.before - 1 {
                let more = archive.read(&selection, limit).unwrap();
                assert!(more.segments.len() <= limit);
                found.extend(more.segments);
                selection.after = more.searched_to;
            }
            assert!(found == expected, "{selection:?}: {}", found.len());
        }
    }
}

#[test]
fn the_owner_alone_can_use_the_files() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let keys = write(&archive, &rows(1, 3));
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&archive.folder()), 0o700);
    assert_eq!(mode(&archive.path_of(keys)), 0o600);
    let name = "segments-0000000000000000001-0000000000000000003.parquet";
    assert!(archive.folder().join(name).exists());
}

#[test]
fn an_unfinished_file_is_no_file_and_is_removed() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    assert_eq!(archive.remove_unfinished().unwrap(), 0);
    assert_eq!(archive.list().unwrap(), Listing::default());
    let keys = write(&archive, &rows(1, 3));
    let left = "segments-0000000000000000004-0000000000000000005.parquet.partial";
    fs::write(archive.folder().join(left), "half").unwrap();
    fs::write(archive.folder().join("notes.parquet"), "other").unwrap();
    assert_eq!(archive.list().unwrap().files, [keys]);
    assert_eq!(archive.remove_unfinished().unwrap(), 1);
    assert_eq!(fs::read_dir(archive.folder()).unwrap().count(), 2);
    // One that ends early removes its file.
    drop(archive.begin(KeyRange { first: 4, last: 5 }).unwrap());
    assert_eq!(fs::read_dir(archive.folder()).unwrap().count(), 2);
}

#[test]
fn a_missing_file_is_an_error_but_for_the_oldest() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let files: Vec<KeyRange> = [(1, 3), (4, 2), (6, 4)]
        .map(|(first, count)| write(&archive, &rows(first, count)))
        .into();
    let read = |before: i64| {
        let found = archive.read(&everything(0, before), 100);
        found.map(|found| found.segments.len())
    };
    assert_eq!(read(10).unwrap(), 9);
    let missing = |found: Result<usize, SegmentArchiveError>| match found {
        Err(SegmentArchiveError::Missing { key, .. }) => key,
        other => panic!("{other:?}"),
    };
    fs::remove_file(archive.path_of(files[1])).unwrap();
    assert_eq!(missing(read(10)), 5);
    // Who has an older database again, with keys 5 and later, needs that one too.
    assert_eq!(missing(read(5)), 4);
    assert_eq!(read(4).unwrap(), 3);
    fs::remove_file(archive.path_of(files[0])).unwrap();
    assert_eq!(read(10).unwrap(), 4, "people may remove the oldest files");
    fs::remove_file(archive.path_of(files[2])).unwrap();
    assert_eq!(missing(read(10)), 9, "the disk is not there");
    assert_eq!(missing(read(8)), 7);
}

#[test]
fn a_file_that_a_person_gives_up_is_no_longer_missed() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let files: Vec<KeyRange> = [(1, 3), (4, 2), (6, 4)]
        .map(|(first, count)| write(&archive, &rows(first, count)))
        .into();
    for lost in [files[1], files[2]] {
        let path = archive.path_of(lost);
        fs::rename(&path, path.with_extension("parquet.lost")).unwrap();
        let found = archive.read(&everything(0, 10), 100).unwrap().segments;
        assert!(
            !found.iter().any(|row| lost.contains(row.stored.id)),
            "{lost:?}"
        );
        assert!(found.len() >= 3 && found[0].stored.id == 1);
    }
    // Rows that were still in the database are written again.
    write(&archive, &rows(7, 3));
    write(&archive, &rows(10, 1));
    assert_eq!(
        archive
            .read(&everything(0, 11), 100)
            .unwrap()
            .segments
            .len(),
        7
    );
}

#[test]
fn a_file_with_the_same_keys_is_superseded_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let old = [write(&archive, &rows(1, 3)), write(&archive, &rows(4, 3))];
    for round in 0..2 {
        let new = rows(4, 2);
        let mut writer = archive.begin(KeyRange { first: 4, last: 5 }).unwrap();
        writer.add(new).unwrap();
        let superseded = archive.publish(&writer.finish().unwrap()).unwrap();
        assert_eq!(superseded.len(), 1, "{round}");
        assert!(superseded[0].exists() && superseded[0].to_string_lossy().ends_with(".superseded"));
        let present = KeyRange { first: 4, last: 5 };
        assert_eq!(archive.list().unwrap().files, [old[0], present]);
    }
    let names = archive.names().unwrap();
    assert_eq!(names.len(), 4, "{names:?}");
}

#[test]
fn files_with_the_same_keys_or_of_another_program_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let keys = write(&archive, &rows(1, 3));
    let copy = KeyRange { first: 3, last: 5 };
    fs::copy(archive.path_of(keys), archive.path_of(copy)).unwrap();
    let refused = archive.read(&everything(0, 6), 9).unwrap_err();
    assert!(
        matches!(refused, SegmentArchiveError::Overlap { key: 3, .. }),
        "{refused}"
    );
    // The content of another file under a name.
    let renamed = KeyRange { first: 4, last: 6 };
    fs::rename(archive.path_of(copy), archive.path_of(renamed)).unwrap();
    let refused = archive.read(&everything(3, 7), 9).unwrap_err().to_string();
    assert!(
        refused.contains("damaged or no file of this archive"),
        "{refused}"
    );
    for content in ["", "PAR1PAR1", "something else that ends with PAR1"] {
        fs::write(archive.path_of(renamed), content).unwrap();
        let refused = archive.read(&everything(3, 7), 9).unwrap_err();
        assert!(
            matches!(refused, SegmentArchiveError::Damaged { .. }),
            "{refused}"
        );
        assert_eq!(
            archive.read(&everything(0, 4), 9).unwrap().segments.len(),
            3
        );
    }
}

#[test]
fn a_search_ends_after_so_many_files_and_goes_on_from_there() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let count = i64::try_from(SEARCHED_FILES_MAX).unwrap() + 3;
    for key in 1..=count {
        write(&archive, &rows(key, 1));
    }
    let selection = Selection {
        robot: Some("nobody".parse().unwrap()),
        ..everything(0, count + 1)
    };
    let found = archive.read(&selection, 100).unwrap();
    assert_eq!((found.segments.len(), found.searched_to), (0, count - 3));
    let rest = archive
        .read(&everything(found.searched_to, count + 1), 100)
        .unwrap();
    assert_eq!((rest.segments.len(), rest.searched_to), (3, count));
}

#[test]
fn a_folder_is_examined_before_anything_is_written_and_nothing_remains_of_that() {
    let folder = tempfile::tempdir().unwrap();
    let good = archive(folder.path());
    good.check_writable().unwrap();
    let entries = fs::read_dir(good.folder()).unwrap();
    assert_eq!(entries.count(), 0);
    // The kernel lets nobody make a folder there, not even root.
    let wrong = in_folder(Path::new("/proc/archive"));
    assert!(wrong.list().unwrap().files.is_empty());
    let refused = wrong.check_writable().unwrap_err().to_string();
    assert!(refused.contains("/proc/archive"), "{refused}");
    // Where the disk of the archive is not mounted, no folder is made in its place.
    write(&good, &rows(1, 3));
    fs::remove_dir_all(good.folder()).unwrap();
    assert!(matches!(
        good.check_writable(),
        Err(SegmentArchiveError::Missing { key: 3, .. })
    ));
    assert!(!good.folder().exists());
}

#[test]
fn the_mark_of_a_former_version_is_read_and_removed() {
    let folder = tempfile::tempdir().unwrap();
    let database = folder.path().join("tread.db");
    let archived = folder.path().join("archive");
    let beside = SegmentArchive::new(archived.clone().into(), Some(&database)).unwrap();
    let within = SegmentArchive::new(archived.clone().into(), None).unwrap();
    fs::create_dir(&archived).unwrap();
    for (archive, file) in [
        (beside, folder.path().join("tread.db.archived")),
        (within, archived.join("tread.archived")),
    ] {
        assert_eq!(archive.former_mark().unwrap(), None);
        fs::write(&file, "3 90\n").unwrap();
        let mark = KeyRange { first: 3, last: 90 };
        assert_eq!(archive.former_mark().unwrap(), Some(mark));
        archive.remove_former_mark().unwrap();
        assert_eq!(archive.former_mark().unwrap(), None);
        for damaged in ["", "3", "9 3", "a b"] {
            fs::write(&file, damaged).unwrap();
            assert!(archive.former_mark().is_err(), "{damaged}");
        }
    }
}

proptest! {
    #[test]
    fn a_mark_names_no_key_of_a_gap(
        files in prop::collection::vec((1_i64..20, 0_i64..5), 1..8),
    ) {
        let mut mark: Option<KeyRange> = None;
        for (first, more) in files {
            let keys = KeyRange { first, last: first + more };
            let joined = keys.joined_to(mark);
            prop_assert_eq!(joined.last, keys.last);
            // All its keys are those of the file or of the former mark.
            for key in joined.first..keys.first {
                prop_assert!(mark.is_some_and(|mark| mark.contains(key)));
            }
            mark = Some(joined);
        }
    }
}
