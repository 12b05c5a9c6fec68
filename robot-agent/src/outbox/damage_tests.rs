//! What one damaged place in the store's files costs: the records that it hits, all of them counted,
//! and nothing else.

use std::fs;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::Path;

use proptest::prelude::*;
use tempfile::TempDir;

use super::OutboxDamage;
use super::frame::{self, Frame};
use super::store::{Settled, Store};
use super::tests::{SMALL, boot, contents, fast_folder, log_files, open, report, sync};

/// What happens to the bytes of one file; places are shares of its length.
#[derive(Debug, Clone)]
enum Damage {
    FlipBit { at: f64, bit: u8 },
    Cut { at: f64 },
    Zero { from: f64, to: f64 },
}

fn damage() -> impl Strategy<Value = Damage> {
    let share = || 0.0..1.0_f64;
    prop_oneof![
        3 => (share(), 0..8_u8).prop_map(|(at, bit)| Damage::FlipBit { at, bit }),
        1 => share().prop_map(|at| Damage::Cut { at }),
        2 => (share(), share()).prop_map(|(from, to)| Damage::Zero { from, to }),
    ]
}

fn place(share: f64, length: usize) -> usize {
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a few kilobytes"
    )]
    let place = (length as f64 * share) as usize;
    place.min(length.saturating_sub(1))
}

impl Damage {
    fn apply(&self, bytes: &mut Vec<u8>) {
        match *self {
            Self::FlipBit { at, bit } => {
                let at = place(at, bytes.len());
                bytes[at] ^= 1 << bit;
            }
            Self::Cut { at } => bytes.truncate(place(at, bytes.len())),
            Self::Zero { from, to } => {
                let (from, to) = (place(from, bytes.len()), place(to, bytes.len()));
                bytes[from.min(to)..=from.max(to)].fill(0);
            }
        }
    }
}

/// Where the records are in the bytes of an undamaged file.
fn records_of(bytes: &[u8]) -> Vec<(u64, Range<usize>)> {
    let (mut records, mut at) = (Vec::new(), 0);
    while let Some((frame, length)) = frame::read(&bytes[at..]) {
        if let Frame::Record(name, _) = frame {
            records.push((name.ordinal, at..at + length));
        }
        at += length;
    }
    assert_eq!(at, bytes.len());
    records
}

/// A store with these records, of which so many are settled, synced in between and closed.
fn filled(folder: &Path, sizes: &[usize], settled: f64) -> Vec<(u64, Vec<u8>)> {
    let (mut store, _) = Store::open(folder, SMALL, boot(1)).unwrap();
    for (number, size) in (0_u8..).zip(sizes) {
        store.append(&vec![number; *size]).unwrap();
        if number % 7 == 0 {
            sync(&mut store);
        }
    }
    let waiting = contents(&store);
    if let Some(last) = place(settled, waiting.len()).checked_sub(1) {
        store.settle(Settled {
            through_ordinal: waiting[last].0,
            refused: 0,
        });
    }
    sync(&mut store);
    contents(&store)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn damage_costs_the_records_that_it_hits_all_counted_and_no_others(
        sizes in prop::collection::vec(1..200_usize, 1..60),
        settled in 0.0..1.0_f64,
        file in any::<prop::sample::Index>(),
        damage in damage(),
    ) {
        let folder = fast_folder();
        let path = folder.path();
        let waiting = filled(path, &sizes, settled);
        let dropped = Store::open(path, SMALL, boot(2)).unwrap().0.head().dropped;
        let mut files: Vec<_> = log_files(path).into_iter().map(|(path, _)| path).collect();
        files.push(path.join("head"));
        let hit = file.get(&files);
        let before = fs::read(hit).unwrap();
        if before.is_empty() {
            return Ok(());
        }
        let mut after = before.clone();
        damage.apply(&mut after);
        fs::write(hit, &after).unwrap();
        let mut expected = waiting.clone();
        if hit.extension().is_some() {
            let intact = |range: &Range<usize>| after.get(range.clone()) == before.get(range.clone());
            for (ordinal, range) in records_of(&before) {
                if !intact(&range) {
                    expected.retain(|(waiting, _)| *waiting != ordinal);
                }
            }
        }
        let lost = (waiting.len() - expected.len()) as u64;
        for boots in 3..6 {
            let (mut store, _) = Store::open(path, SMALL, boot(boots)).unwrap();
            prop_assert_eq!(contents(&store), expected.clone(), "start {}", boots);
            prop_assert_eq!(store.head().dropped, dropped + lost, "start {}", boots);
            // It goes on: a record that comes now is there after the next start, and of its own name.
            let name = store.append(b"one more").unwrap();
            expected.push((name.ordinal, b"one more".to_vec()));
            let full = expected.len() > SMALL.pending_records_max;
            let bytes: usize = expected.iter().map(|(_, content)| content.len()).sum();
            if full || bytes as u64 > SMALL.pending_bytes_max {
                return Ok(());
            }
            sync(&mut store);
        }
    }
}

#[test]
fn a_flipped_bit_costs_one_record_of_sixty_eight_which_is_counted_kept_and_said() {
    for hit in [0, 34, 67] {
        let folder = TempDir::new().unwrap();
        let outbox = open(folder.path(), 1).unwrap();
        for number in 0..68 {
            outbox.append(&report(number)).unwrap();
        }
        outbox.sync().unwrap();
        assert_eq!(outbox.damage(), OutboxDamage::default());
        drop(outbox);
        let (path, _) = log_files(folder.path()).remove(0);
        let mut bytes = fs::read(&path).unwrap();
        let (_, range) = records_of(&bytes).remove(hit);
        bytes[range.start + 60] ^= 4;
        fs::write(&path, &bytes).unwrap();

        let outbox = open(folder.path(), 2).unwrap();
        let status = outbox.status();
        assert_eq!((status.pending, status.dropped), (67, 1), "record {hit}");
        let found = outbox.damage();
        assert_eq!(found.lost_records, 1);
        let kept_in = found.kept_in.clone().expect("it is said");
        let kept = fs::read(&kept_in).unwrap();
        let is_kept = kept
            .windows(range.len())
            .any(|kept| *kept == bytes[range.clone()]);
        assert!(is_kept, "record {hit}");
        drop(outbox);
        // It stands over a restart, until somebody has removed what was kept.
        let outbox = open(folder.path(), 3).unwrap();
        assert_eq!(outbox.damage(), found);
        drop(outbox);
        fs::remove_file(&kept_in).unwrap();
        let outbox = open(folder.path(), 4).unwrap();
        assert_eq!(outbox.damage().kept_in, None);
        assert_eq!(
            (outbox.damage().lost_records, outbox.status().dropped),
            (1, 1)
        );
    }
}

#[test]
fn a_record_that_is_damaged_while_the_agent_runs_is_not_sent_but_counted() {
    let folder = TempDir::new().unwrap();
    let outbox = open(folder.path(), 1).unwrap();
    for number in 0..5 {
        outbox.append(&report(number)).unwrap();
    }
    outbox.sync().unwrap();
    let (path, _) = log_files(folder.path()).remove(0);
    let (_, range) = records_of(&fs::read(&path).unwrap()).remove(2);
    let file = fs::File::options().write(true).open(&path).unwrap();
    // A digit of a number within the content: still JSON, and another record.
    file.write_all_at(b"2", size_of_place(&path, &range))
        .unwrap();

    let seqs = |batch: &super::PendingBatch| {
        let records = batch.batch.records.iter();
        records.map(|record| record.seq).collect::<Vec<_>>()
    };
    let first = outbox.pending(10).unwrap().unwrap();
    assert_eq!(seqs(&first), [0, 1]);
    outbox.settle(&first, &super::tests::receipt(&[])).unwrap();
    let second = outbox.pending(10).unwrap().unwrap();
    assert_eq!(seqs(&second), [3, 4]);
    assert_eq!(outbox.status().dropped, 1);
    assert_eq!(outbox.damage().lost_records, 1);
    outbox.settle(&second, &super::tests::receipt(&[])).unwrap();
    outbox.sync().unwrap();
    drop(outbox);
    let status = open(folder.path(), 2).unwrap().status();
    assert_eq!((status.pending, status.dropped), (0, 1), "counted once");
}

/// Where the revision of a report stands in the file.
fn size_of_place(path: &Path, range: &Range<usize>) -> u64 {
    let bytes = fs::read(path).unwrap();
    let needle = b"\"revision\":";
    let within = bytes[range.clone()]
        .windows(needle.len())
        .position(|bytes| bytes == needle)
        .unwrap();
    (range.start + within + needle.len()) as u64
}
