//! What the outbox promises, held against a simple model of it.

use std::collections::VecDeque;
use std::fs::{self, OpenOptions};
use std::io::Write as _;
use std::path::Path;

use proptest::prelude::*;
use tempfile::TempDir;
use tread_api::ids::MissionId;
use tread_api::wire::ingest::RefusedRecord;
use uuid::Uuid;

use super::frame::Head;
use super::recovery::Recovery;
use super::store::{Settled, Store};
use super::*;
use crate::missions::tests::succeeded;

#[derive(Debug, Clone)]
enum Step {
    Append {
        bytes: usize,
    },
    Settle {
        share: f64,
    },
    Sync,
    /// The machine dies: of what was not synced only a share of the bytes survives.
    Crash {
        share: f64,
    },
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        8 => (1..200_usize).prop_map(|bytes| Step::Append { bytes }),
        3 => (0.0..=1.0_f64).prop_map(|share| Step::Settle { share }),
        2 => Just(Step::Sync),
        1 => (0.0..=1.0_f64).prop_map(|share| Step::Crash { share }),
    ];
    prop::collection::vec(step, 1..120)
}

pub(super) fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

pub(super) fn log_files(folder: &Path) -> Vec<(PathBuf, u64)> {
    let mut files: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "log"))
        .map(|path| (path.clone(), fs::metadata(&path).unwrap().len()))
        .collect();
    files.sort();
    files
}

/// Cuts everything after `keep_bytes` of what was written since the files had `synced` bytes.
fn lose_unsynced(folder: &Path, synced: &[(PathBuf, u64)], share: f64) {
    let unsynced: Vec<(PathBuf, u64, u64)> = log_files(folder)
        .into_iter()
        .map(|(path, length)| {
            let safe = synced
                .iter()
                .find(|(known, _)| *known == path)
                .map_or(0, |known| known.1);
            (path, safe, length - safe)
        })
        .collect();
    let total: u64 = unsynced.iter().map(|(_, _, more)| more).sum();
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a few kilobytes"
    )]
    let mut left = (total as f64 * share) as u64;
    for (path, safe, more) in unsynced {
        let keep = more.min(left);
        left -= keep;
        let file = OpenOptions::new().write(true).open(&path).unwrap();
        file.set_len(safe + keep).unwrap();
    }
}

/// What the model knows: contents by ordinal, and where the store stood at the last sync.
#[derive(Debug, Default)]
struct Model {
    pending: VecDeque<(u64, Vec<u8>)>,
    next: u64,
    dropped: u64,
    synced_first: u64,
    synced_next: u64,
    synced_files: Vec<(PathBuf, u64)>,
    everything: Vec<Vec<u8>>,
}

impl Model {
    fn first(&self) -> u64 {
        self.pending
            .front()
            .map_or(self.next, |(ordinal, _)| *ordinal)
    }

    fn record_synced(&mut self, folder: &Path) {
        self.synced_first = self.first();
        self.synced_next = self.next;
        self.synced_files = log_files(folder);
    }
}

pub(super) const SMALL: Limits = Limits {
    pending_bytes_max: 3_000,
    pending_records_max: 25,
    file_bytes: 700,
};

pub(super) fn sync(store: &mut Store) {
    let ticket = store.begin_sync().unwrap();
    ticket.run().unwrap();
    store.finish_sync(&ticket).unwrap();
}

pub(super) fn contents(store: &Store) -> Vec<(u64, Vec<u8>)> {
    // Records of one run come at a time, so all of them are read by settling a copy's head.
    store
        .every_pending()
        .unwrap()
        .into_iter()
        .map(|(name, content)| (name.ordinal, content))
        .collect()
}

/// A folder in memory where there is one: thousands of syncs on a real disk take minutes.
pub(super) fn fast_folder() -> TempDir {
    TempDir::new_in("/dev/shm")
        .or_else(|_| TempDir::new())
        .unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn nothing_synced_is_lost_and_nothing_settled_and_synced_comes_back(steps in steps()) {
        let folder = fast_folder();
        let path = folder.path();
        let mut boots = 1;
        let (mut store, _) = Store::open(path, SMALL, boot(boots)).unwrap();
        let mut model = Model::default();
        model.record_synced(path);
        for step in steps {
            match step {
                Step::Append { bytes } => {
                    #[expect(clippy::cast_possible_truncation, reason = "only has to vary")]
                    let content = vec![model.next as u8; bytes];
                    let name = store.append(&content).unwrap();
                    prop_assert_eq!(name.ordinal, model.next);
                    prop_assert_eq!(name.boot, boot(boots));
                    model.everything.truncate(usize::try_from(model.next).unwrap());
                    model.everything.push(content.clone());
                    model.pending.push_back((model.next, content));
                    model.next += 1;
                    let waiting =
                        |model: &Model| model.pending.iter().map(|(_, c)| c.len()).sum::<usize>();
                    while model.pending.len() > SMALL.pending_records_max
                        || waiting(&model) as u64 > SMALL.pending_bytes_max
                    {
                        model.pending.pop_front();
                        model.dropped += 1;
                    }
                }
                Step::Settle { share } => {
                    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most 25")]
                    let count = (model.pending.len() as f64 * share) as usize;
                    if let Some(last) = count.checked_sub(1) {
                        let through_ordinal = model.pending[last].0;
                        store.settle(Settled { through_ordinal, refused: 0 });
                        model.pending.drain(..count);
                    }
                }
                Step::Sync => {
                    sync(&mut store);
                    model.record_synced(path);
                }
                Step::Crash { share } => {
                    drop(store);
                    lose_unsynced(path, &model.synced_files, share);
                    boots += 1;
                    let (opened, recovery) = Store::open(path, SMALL, boot(boots)).unwrap();
                    store = opened;
                    prop_assert_eq!(recovery.lost_records, 0);
                    let found = contents(&store);
                    let first = found.first().map_or(model.synced_next, |(ordinal, _)| *ordinal);
                    prop_assert!(first >= model.synced_first, "something settled came back");
                    // Whatever was synced and not settled since must be there, and nothing but a
                    // prefix of what was appended since may be.
                    let next = found.last().map_or(first, |(ordinal, _)| ordinal + 1);
                    prop_assert!(next >= model.synced_next || model.first() >= model.synced_next);
                    prop_assert!(next <= model.next);
                    prop_assert!(first <= model.first().max(model.synced_next));
                    for (offset, (ordinal, content)) in found.iter().enumerate() {
                        prop_assert_eq!(*ordinal, first + offset as u64, "order or a gap");
                        let appended = &model.everything[usize::try_from(*ordinal).unwrap()];
                        prop_assert_eq!(content, appended);
                    }
                    model.dropped = store.head().dropped;
                    model.pending = found.into();
                    model.next = store.next_ordinal();
                    sync(&mut store);
                    model.record_synced(path);
                }
            }
            let expected: Vec<_> = model.pending.iter().cloned().collect();
            prop_assert_eq!(contents(&store), expected);
            prop_assert_eq!(store.head().dropped, model.dropped);
            prop_assert!(store.pending_bytes() <= SMALL.pending_bytes_max);
            prop_assert!(store.pending_records() <= SMALL.pending_records_max);
        }
        sync(&mut store);
        let on_disk: u64 = log_files(path).iter().map(|(_, bytes)| bytes).sum();
        // Frames and heads cost something, and up to two files wait for their last record.
        let bound = SMALL.pending_bytes_max + 25 * 41 + 3 * (SMALL.file_bytes + 300);
        prop_assert!(on_disk <= bound, "{on_disk} bytes on the disk");
    }
}

/// What an agent of an earlier version does that runs in between: it settles records, removes the
/// files that hold no others, and knows nothing of the head's own file.
fn settle_as_an_earlier_agent(folder: &Path, first_pending: u64) {
    let files = log_files(folder);
    let first_ordinal = |path: &Path| -> u64 {
        let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap();
        stem.parse().unwrap()
    };
    let mut head = Vec::new();
    let settled = Head {
        first_pending,
        ..Head::default()
    };
    frame::write_earlier_head(settled, &mut head);
    let newest = OpenOptions::new()
        .append(true)
        .open(&files.last().unwrap().0);
    newest.unwrap().write_all(&head).unwrap();
    for pair in files.windows(2) {
        if first_ordinal(&pair[1].0) <= first_pending {
            fs::remove_file(&pair[0].0).unwrap();
        }
    }
}

#[test]
fn what_an_earlier_agent_settled_in_between_is_neither_lost_nor_sent_again() {
    for settled in [3, 12, 19, 20] {
        let folder = fast_folder();
        let path = folder.path();
        let (mut store, _) = Store::open(path, SMALL, boot(1)).unwrap();
        for number in 0..20_u8 {
            store.append(&[number; 100]).unwrap();
        }
        sync(&mut store);
        let mut expected = contents(&store);
        assert!(log_files(path).len() > 2);
        drop(store);
        settle_as_an_earlier_agent(path, settled);
        expected.retain(|(ordinal, _)| *ordinal >= settled);
        for start in 2..5 {
            let (mut store, recovery) = Store::open(path, SMALL, boot(start)).unwrap();
            assert_eq!(recovery, Recovery::default(), "{settled} settled");
            assert_eq!(contents(&store), expected, "{settled} settled");
            assert_eq!((store.head().dropped, store.head().damaged), (0, 0));
            let name = store.append(b"one more").unwrap();
            expected.push((name.ordinal, b"one more".to_vec()));
            sync(&mut store);
        }
    }
}

pub(super) fn report(number: u128) -> RecordContent {
    RecordContent::Mission(succeeded(MissionId::from_uuid(Uuid::from_u128(number))))
}

pub(super) fn open(folder: &Path, number: u128) -> Result<Outbox, OutboxError> {
    Outbox::open(
        folder,
        Limits::default(),
        "rover-1".parse().unwrap(),
        boot(number),
    )
}

pub(super) fn receipt(refused: &[u64]) -> Receipt {
    let refused = refused
        .iter()
        .map(|&seq| RefusedRecord {
            seq,
            reason: "on purpose".to_owned(),
        })
        .collect();
    Receipt {
        committed: 0,
        duplicates: 0,
        refused,
    }
}

#[test]
fn a_batch_holds_the_records_of_one_run_only() {
    let folder = TempDir::new().unwrap();
    let outbox = open(folder.path(), 1).unwrap();
    for number in 0..3 {
        assert_eq!(
            outbox.append(&report(number)).unwrap(),
            u64::try_from(number).unwrap()
        );
    }
    outbox.sync().unwrap();
    drop(outbox);
    let outbox = open(folder.path(), 2).unwrap();
    assert_eq!(
        outbox.append(&report(9)).unwrap(),
        0,
        "each run counts from 0"
    );
    let first = outbox.pending(1_000).unwrap().unwrap();
    assert_eq!((first.batch.boot, first.batch.records.len()), (boot(1), 3));
    outbox.settle(&first, &receipt(&[])).unwrap();
    let second = outbox.pending(1_000).unwrap().unwrap();
    assert_eq!(
        (second.batch.boot, second.batch.records.len()),
        (boot(2), 1)
    );
    outbox.settle(&second, &receipt(&[])).unwrap();
    assert!(outbox.pending(1_000).unwrap().is_none());
}

#[test]
fn a_refused_record_goes_to_the_dead_letters_and_does_not_block() {
    let folder = TempDir::new().unwrap();
    let outbox = open(folder.path(), 1).unwrap();
    for number in 0..3 {
        outbox.append(&report(number)).unwrap();
    }
    let batch = outbox.pending(1_000).unwrap().unwrap();
    outbox.settle(&batch, &receipt(&[1])).unwrap();
    assert_eq!(
        outbox.status(),
        OutboxStatus {
            pending: 0,
            dropped: 0,
            refused: 1
        }
    );
    outbox.sync().unwrap();
    drop(outbox);
    assert_eq!(
        open(folder.path(), 2).unwrap().status().refused,
        1,
        "counted for ever"
    );
    let letters = fs::read_to_string(folder.path().join("dead-letters.jsonl")).unwrap();
    let letter: serde_json::Value = serde_json::from_str(letters.trim_end()).unwrap();
    assert_eq!(
        (&letter["seq"], &letter["reason"]),
        (&1.into(), &"on purpose".into())
    );
}

#[test]
fn the_dead_letters_are_bounded() {
    let folder = TempDir::new().unwrap();
    let mut letters = DeadLetters::new(folder.path());
    let content = "x".repeat(300_000);
    for seq in 0..12 {
        let letter = DeadLetter {
            boot: boot(1),
            seq,
            reason: "too long",
            content: &content,
        };
        letters.write(&letter).unwrap();
    }
    let bytes: u64 = fs::read_dir(folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().metadata().unwrap().len())
        .sum();
    assert!(bytes <= 2 * bounded_file::FILE_BYTES_MAX, "{bytes}");
}

#[test]
fn a_dead_letter_that_a_crash_left_half_written_does_not_spoil_the_next() {
    let folder = TempDir::new().unwrap();
    let mut letters = DeadLetters::new(folder.path());
    let letter = |seq| DeadLetter {
        boot: boot(1),
        seq,
        reason: "refused",
        content: "{}",
    };
    letters.write(&letter(1)).unwrap();
    let path = folder.path().join("dead-letters.jsonl");
    let torn = fs::read(&path).unwrap();
    fs::write(&path, &torn[..torn.len() - 9]).unwrap();
    letters.write(&letter(2)).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    let last: serde_json::Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    assert_eq!(last["seq"], 2);
}

#[test]
fn a_folder_serves_one_agent_at_a_time() {
    let folder = TempDir::new().unwrap();
    let outbox = open(folder.path(), 1).unwrap();
    assert!(matches!(open(folder.path(), 2), Err(OutboxError::InUse(_))));
    drop(outbox);
    assert!(open(folder.path(), 2).is_ok());
}

#[test]
fn damage_in_the_middle_loses_only_the_record_that_it_hits_and_counts_it() {
    let folder = TempDir::new().unwrap();
    let (mut store, _) = Store::open(folder.path(), SMALL, boot(1)).unwrap();
    for _ in 0..20 {
        store.append(&[7; 100]).unwrap();
    }
    sync(&mut store);
    drop(store);
    let files = log_files(folder.path());
    assert!(files.len() >= 3);
    let mut bytes = fs::read(&files[1].0).unwrap();
    bytes[10] ^= 1;
    fs::write(&files[1].0, bytes).unwrap();
    let (store, recovery) = Store::open(folder.path(), SMALL, boot(2)).unwrap();
    let expected = Recovery {
        torn_bytes: 0,
        damaged_bytes: 141,
        lost_records: 1,
    };
    assert_eq!(recovery, expected);
    assert_eq!((store.head().dropped, store.pending_records()), (1, 19));
}

#[test]
fn a_torn_end_is_cut_off_and_counts_as_no_damage() {
    let folder = TempDir::new().unwrap();
    let (mut store, _) = Store::open(folder.path(), SMALL, boot(1)).unwrap();
    for _ in 0..3 {
        store.append(&[7; 100]).unwrap();
    }
    sync(&mut store);
    // Of this one the machine's death lets a part survive.
    store.append(&[8; 100]).unwrap();
    drop(store);
    let (path, length) = log_files(folder.path()).remove(0);
    let file = OpenOptions::new().write(true).open(&path).unwrap();
    file.set_len(length - 50).unwrap();
    let (store, recovery) = Store::open(folder.path(), SMALL, boot(2)).unwrap();
    assert_eq!((recovery.torn_bytes, recovery.damaged_bytes), (91, 0));
    assert_eq!((store.head().dropped, store.damage()), (0, None));
    assert_eq!(store.pending_records(), 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_appended_is_soon_safe() {
    let folder = TempDir::new().unwrap();
    let outbox = open(folder.path(), 1).unwrap();
    let stop = CancellationToken::new();
    let tracker = tokio_util::task::TaskTracker::new();
    let syncing = tracker.spawn(outbox.clone().keep_synced(stop.clone()));
    outbox.append(&report(1)).unwrap();
    let is_synced = async {
        while locked(&outbox.shared.store).has_unsynced() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(20 * SYNC_DELAY, is_synced)
        .await
        .expect("synced in time");
    stop.cancel();
    syncing.await.unwrap();
}
