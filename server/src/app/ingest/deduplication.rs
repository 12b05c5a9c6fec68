//! Which segments are stored already, or were stored and removed at the end of their retention.

use std::collections::{BTreeMap, HashMap};
use std::ops::RangeInclusive;

use super::Candidate;
use super::keys::Keys;
use crate::app::retention::Removed;
use crate::db::{self, DbError, RecordKey, Tx};

/// Recognises segments of a group of uploads that are stored already, or twice in the group.
#[derive(Debug, Default)]
pub(super) struct Deduplication {
    boots: HashMap<i64, SeqSet>,
}

impl Deduplication {
    /// Reads which of the candidates' sequence numbers are known. A run whose numbers follow those of
    /// its former uploads costs no query.
    pub(super) async fn read(
        tx: &mut Tx,
        candidates: &[Candidate<'_>],
        removed: &Removed,
        keys: &mut Keys,
    ) -> Result<Self, DbError> {
        let mut spans: HashMap<i64, RangeInclusive<i64>> = HashMap::new();
        for candidate in candidates {
            let RecordKey { boot_pk, seq } = candidate.key;
            let span = spans.entry(boot_pk).or_insert(seq..=seq);
            *span = seq.min(*span.start())..=seq.max(*span.end());
        }
        let mut found = Self::default();
        for (boot_pk, span) in spans {
            let newest = keys.newest_seq(tx, boot_pk).await?;
            let seq = *span.end();
            keys.record_seq(RecordKey { boot_pk, seq });
            if newest.is_none_or(|newest| newest < *span.start()) {
                continue;
            }
            let mut ranges = db::segment_ranges::within(tx, boot_pk, span.clone()).await?;
            if removed.has(boot_pk) {
                ranges.extend(db::removed::within(tx, boot_pk, span).await?);
            }
            found
                .boots
                .insert(boot_pk, SeqSet(ranges.into_iter().collect()));
        }
        Ok(found)
    }

    /// Adds a segment. Returns whether it was unknown.
    pub(super) fn insert(&mut self, key: RecordKey) -> bool {
        self.boots.entry(key.boot_pk).or_default().insert(key.seq)
    }
}

/// A set of sequence numbers, as disjoint ranges from the first to the last number of each.
#[derive(Debug, Default)]
struct SeqSet(BTreeMap<i64, i64>);

impl SeqSet {
    /// Adds a number. Returns whether it was not in the set.
    fn insert(&mut self, seq: i64) -> bool {
        let Self(ranges) = self;
        match ranges.range_mut(..=seq).next_back() {
            Some((_, last)) if seq <= *last => return false,
            Some((_, last)) if seq - 1 == *last => *last = seq,
            _ => {
                ranges.insert(seq, seq);
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_number_is_new_once_whatever_the_ranges_and_the_order(
            stored in prop::collection::btree_set(0_i64..60, 0..30),
            inserted in prop::collection::vec(0_i64..70, 0..80),
        ) {
            let mut ranges: Vec<(i64, i64)> = Vec::new();
            for &seq in &stored {
                match ranges.last_mut() {
                    Some((_, last)) if *last + 1 == seq => *last = seq,
                    _ => ranges.push((seq, seq)),
                }
            }
            let mut seqs = SeqSet(ranges.into_iter().collect());
            let mut expected: BTreeSet<i64> = stored;
            for seq in inserted {
                prop_assert_eq!(seqs.insert(seq), expected.insert(seq), "{}", seq);
            }
        }
    }
}
