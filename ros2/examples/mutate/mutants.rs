//! Messages that were tampered with: what an enemy, or a bug, may put on a robot's bus.

use std::panic::{AssertUnwindSafe, catch_unwind};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tread_ros2::cdr::{CdrError, Field, decode};
use tread_ros2::messages::{
    BatteryState, DiagnosticArray, Float64MultiArray, Imu, JointState, Odometry, Path,
    PoseWithCovarianceStamped, Text, Twist, TwistStamped,
};

/// Counts that claim much.
const HOSTILE: [u32; 6] = [u32::MAX, u32::MAX - 3, 1 << 31, 1 << 29, 1 << 16, 255];
/// Most changes to one message.
const CHANGES_MAX: usize = 6;
/// Most bytes that are put behind a message.
const GROWTH_MAX: usize = 64;

/// Reads a message, and every field of its sequences; the count of fields.
type Read = fn(&[u8]) -> Result<usize, CdrError>;

fn all<'a, T: Field<'a>, R>(bytes: &'a [u8], fields: impl Fn(T) -> R) -> Result<R, CdrError> {
    decode(bytes).map(fields)
}

/// The types, each by a word of its messages' names in `golden.json`; the first that fits counts.
const TYPES: [(&str, Read); 11] = [
    ("odometry", |bytes| {
        all(bytes, |read: Odometry<'_>| read.child_frame_id.len())
    }),
    ("imu", |bytes| {
        all(bytes, |read: Imu<'_>| read.header.frame_id.len())
    }),
    ("joints", |bytes| {
        all(bytes, |read: JointState<'_>| {
            let names: usize = read.name.iter().map(str::len).sum();
            let lists = [read.position, read.velocity, read.effort];
            names + lists.iter().map(|list| list.iter().count()).sum::<usize>()
        })
    }),
    ("pose", |bytes| {
        all(bytes, |read: PoseWithCovarianceStamped<'_>| {
            read.header.frame_id.len()
        })
    }),
    ("battery", |bytes| {
        all(bytes, |read: BatteryState<'_>| {
            read.cell_voltage.iter().count() + read.cell_temperature.iter().count()
        })
    }),
    ("stamped_twist", |bytes| {
        all(bytes, |read: TwistStamped<'_>| read.header.frame_id.len())
    }),
    ("twist", |bytes| all(bytes, |_: Twist| 1)),
    ("array", |bytes| {
        all(bytes, |read: Float64MultiArray<'_>| {
            read.layout.dim.iter().count() + read.data.iter().count()
        })
    }),
    ("path", |bytes| {
        let length = |read: Path<'_>| {
            read.poses
                .iter()
                .map(|pose| pose.header.frame_id.len())
                .sum()
        };
        all(bytes, length)
    }),
    ("diagnostics", |bytes| {
        all(bytes, |read: DiagnosticArray<'_>| {
            read.status
                .iter()
                .map(|status| status.values.iter().count())
                .sum()
        })
    }),
    ("text", |bytes| all(bytes, |read: Text<'_>| read.data.len())),
];

/// What became of the mutants.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Outcome {
    /// Mutants that were read.
    pub(crate) inputs: u64,
    /// Readings that gave a message all the same.
    pub(crate) accepted: u64,
    /// Readings that panicked.
    pub(crate) panics: u64,
    /// Readings that allocated more than their message is long.
    pub(crate) allocated_above_size: u64,
    /// The most that one reading allocated, bytes.
    pub(crate) allocated_max_bytes: usize,
}

/// Reads so many mutants of the messages, each as its own type and as another; `allocated` says how
/// many bytes the process has allocated so far.
pub(crate) fn run(seed: u64, inputs: u64, allocated: impl Fn() -> usize) -> Outcome {
    let golden: serde_json::Value = serde_json::from_str(include_str!("../../tests/golden.json"))
        .expect("the file is the repository's own");
    let messages = golden["messages"]
        .as_object()
        .expect("as the script writes it");
    let sources: Vec<(Read, Vec<u8>)> = messages
        .iter()
        .map(|(name, hex)| {
            let (_, read) = TYPES
                .iter()
                .find(|(word, _)| name.contains(word))
                .expect("every message has a type");
            (*read, bytes_of(hex.as_str().expect("a string")))
        })
        .collect();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut mutant = Vec::with_capacity(64 * 1024);
    let mut outcome = Outcome::default();
    for _ in 0..inputs {
        let (own, source) = &sources[random.random_range(0..sources.len())];
        mutant.clear();
        mutant.extend_from_slice(source);
        for _ in 0..random.random_range(1..=CHANGES_MAX) {
            change(&mut random, &mut mutant);
        }
        let (_, other) = TYPES[random.random_range(0..TYPES.len())];
        for read in [*own, other] {
            let before = allocated();
            let result = catch_unwind(AssertUnwindSafe(|| read(&mutant)));
            let taken = allocated() - before;
            outcome.allocated_max_bytes = outcome.allocated_max_bytes.max(taken);
            outcome.allocated_above_size += u64::from(taken > mutant.len());
            outcome.panics += u64::from(result.is_err());
            outcome.accepted += u64::from(matches!(result, Ok(Ok(_))));
        }
        outcome.inputs += 1;
    }
    outcome
}

fn bytes_of(hex: &str) -> Vec<u8> {
    let digits = hex.as_bytes().chunks(2);
    let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    digits
        .map(byte)
        .collect::<Option<_>>()
        .expect("hexadecimal digits")
}

fn change(random: &mut ChaCha8Rng, mutant: &mut Vec<u8>) {
    if mutant.is_empty() {
        mutant.push(random.random());
        return;
    }
    let at = random.random_range(0..mutant.len());
    match random.random_range(0..7) {
        0 => mutant[at] ^= 1 << random.random_range(0..8),
        1 => mutant[at] = random.random(),
        2 | 3 => {
            // Counts are where four bytes are aligned.
            let claim = HOSTILE[random.random_range(0..HOSTILE.len())].to_le_bytes();
            if let Some(place) = mutant.get_mut(at / 4 * 4..at / 4 * 4 + 4) {
                place.copy_from_slice(&claim);
            }
        }
        4 => mutant.truncate(at),
        5 => {
            let more = random.random_range(1..=GROWTH_MAX);
            mutant.extend((0..more).map(|_| random.random::<u8>()));
        }
        _ => {
            let to = random.random_range(0..mutant.len());
            let count = random.random_range(0..=16).min(mutant.len() - at.max(to));
            mutant.copy_within(at..at + count, to);
        }
    }
}
