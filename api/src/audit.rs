//! Hash chain of the audit log: each entry carries the hash of the entry before it, so that a later
//! change, removal or insertion of an entry is detected by [`Verifier`].
//!
//! ```text
//! hash(n) = SHA-256( hash(n − 1) in hexadecimal digits ‖ canonical form of entry n )
//! ```
//!
//! The **canonical form** is the entry as JSON without the fields `previous_hash` and `hash`: the
//! names of each object are sorted by their bytes, there is no white space, unknown values are
//! `null`, and a number with a fraction or an exponent has the fewest digits that parse to the same
//! value, such as `5e-1`, `2e0` or `1.25e2`. Entries are numbered without gaps. Retention removes
//! the oldest entries; the number and hash of the last removed entry are kept in [`AuditChain`], so
//! the rest stays verifiable.
//!
//! Somebody who can write the database and knows this scheme can compute another valid chain. Only
//! a number and hash that were recorded elsewhere before reveal it: by `tread audit verify`, in an
//! export, or in the machine's journal.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest as _, Sha256};
use utoipa::ToSchema;

use crate::identity::AuditEntry;

/// `previous_hash` of the first entry of a log.
pub const FIRST_PREVIOUS_HASH: &str =
    "0000000000000000000000000000000000000000000000000000000000000000";

/// Numbers and hashes at both ends of the stored entries, from which the chain is verified.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AuditChain {
    /// Number of the last entry that was removed, or that an earlier version wrote without a hash.
    pub before_id: u64,
    /// Hash of entry `before_id`; the first stored entry has it as `previous_hash`.
    pub before_hash: String,
    /// Number of the newest entry.
    pub last_id: u64,
    /// Hash of the newest entry.
    pub last_hash: String,
}

/// Returns the hash of `entry`, in hexadecimal digits, given the hash of the entry before it.
pub fn hash_after(previous_hash: &str, entry: &AuditEntry) -> String {
    let mut hash = Sha256::new();
    hash.update(previous_hash);
    hash.update(canonical(entry));
    let digest: [u8; 32] = hash.finalize().into();
    let digit = |value: u8| char::from_digit(value.into(), 16).unwrap_or('0');
    let digits = digest
        .iter()
        .flat_map(|byte| [digit(byte >> 4), digit(byte & 0xf)]);
    digits.collect()
}

/// Returns the canonical form of an entry, as the [module](self) defines it.
pub fn canonical(entry: &AuditEntry) -> String {
    let mut value = serde_json::to_value(entry).unwrap_or_default();
    if let Value::Object(fields) = &mut value {
        fields.remove("previous_hash");
        fields.remove("hash");
    }
    let mut text = String::new();
    write_canonical(&value, &mut text);
    text
}

fn write_canonical(value: &Value, text: &mut String) {
    match value {
        Value::Array(items) => {
            text.push('[');
            for (index, item) in items.iter().enumerate() {
                if index > 0 {
                    text.push(',');
                }
                write_canonical(item, text);
            }
            text.push(']');
        }
        Value::Object(fields) => {
            let mut names: Vec<&String> = fields.keys().collect();
            names.sort_unstable();
            text.push('{');
            for (index, name) in names.into_iter().enumerate() {
                if index > 0 {
                    text.push(',');
                }
                text.push_str(&Value::from(name.as_str()).to_string());
                text.push(':');
                write_canonical(&fields[name], text);
            }
            text.push('}');
        }
        Value::Number(number) => match number.as_f64() {
            Some(value) if number.is_f64() => {
                // Writing to a `String` cannot fail.
                let _ = write!(text, "{value:e}");
            }
            Some(_) | None => text.push_str(&number.to_string()),
        },
        Value::Null | Value::Bool(_) | Value::String(_) => text.push_str(&value.to_string()),
    }
}

/// Place and kind of the first violation in a hash chain.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Broken {
    /// Entries are missing, or out of order.
    #[error("entry {next} follows entry {last}: those between are missing")]
    Missing {
        /// Number of the last entry before the gap.
        last: u64,
        /// Number of the first entry after the gap.
        next: u64,
    },
    /// An entry without a hash follows entries that have one.
    #[error("entry {0} has no hash")]
    Unhashed(u64),
    /// `previous_hash` of an entry differs from the hash of the entry before it.
    #[error("entry {0} does not follow the entry before it: one of the two was replaced")]
    Unlinked(u64),
    /// The hash of an entry does not match its content.
    #[error("entry {0} was changed after it was written")]
    Changed(u64),
    /// The newest entries are missing, or there are more entries than the server recorded.
    #[error("the log ends with entry {found}, but by the server's record with entry {expected}")]
    Ends {
        /// Number of the newest entry in the log.
        found: u64,
        /// Number of the newest entry by the server's record.
        expected: u64,
    },
    /// The hash of the newest entry differs from the server's record.
    #[error("the hash of entry {0} differs from the server's record")]
    LastReplaced(u64),
}

/// Verifies a hash chain entry by entry, the oldest first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verifier {
    id: u64,
    hash: String,
    count: u64,
}

impl Verifier {
    /// Creates a verifier whose next entry must follow the entry with this number and hash.
    pub fn after(id: u64, hash: &str) -> Self {
        let hash = hash.to_owned();
        Self { id, hash, count: 0 }
    }

    /// Verifies the next entry.
    ///
    /// # Errors
    /// [`Broken`] if the entry does not continue the chain.
    pub fn take(&mut self, entry: &AuditEntry) -> Result<(), Broken> {
        if self.id.checked_add(1) != Some(entry.id) {
            return Err(Broken::Missing {
                last: self.id,
                next: entry.id,
            });
        }
        let (Some(previous_hash), Some(hash)) = (&entry.previous_hash, &entry.hash) else {
            return Err(Broken::Unhashed(entry.id));
        };
        if hash_after(previous_hash, entry) != *hash {
            return Err(Broken::Changed(entry.id));
        }
        if *previous_hash != self.hash {
            return Err(Broken::Unlinked(entry.id));
        }
        self.id = entry.id;
        self.hash.clone_from(hash);
        self.count += 1;
        Ok(())
    }

    /// Compares the last verified entry with the server's record of the newest entry.
    ///
    /// # Errors
    /// [`Broken::Ends`] if the numbers differ, [`Broken::LastReplaced`] if the hashes differ.
    pub fn end(&self, chain: &AuditChain) -> Result<(), Broken> {
        if self.id != chain.last_id {
            return Err(Broken::Ends {
                found: self.id,
                expected: chain.last_id,
            });
        }
        if self.hash != chain.last_hash {
            return Err(Broken::LastReplaced(self.id));
        }
        Ok(())
    }

    /// Returns the number and hash of the last verified entry.
    pub fn last(&self) -> (u64, &str) {
        (self.id, &self.hash)
    }

    /// Returns the number of verified entries.
    pub fn count(&self) -> u64 {
        self.count
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn entry(id: u64) -> AuditEntry {
        serde_json::from_value(json!({
            "id": id, "at": "2026-11-22T09:00:00.000001Z", "since": null, "count": 1,
            "who": "desk", "token": null, "role": "admin", "address": "192.0.2.1",
            "method": "POST", "route": "/v1/sites", "path": "/v1/sites", "status": 201,
            "request_id": "", "what": {"id": "yard", "cell_m": 2.0, "b": [1e300, "ü\n"], "a": -0.5},
            "previous_hash": null, "hash": null,
        }))
        .unwrap()
    }

    fn chain(count: u64) -> Vec<AuditEntry> {
        let mut previous_hash = FIRST_PREVIOUS_HASH.to_owned();
        let chained = (1..=count).map(|id| {
            let mut entry = entry(id);
            let hash = hash_after(&previous_hash, &entry);
            entry.previous_hash = Some(std::mem::replace(&mut previous_hash, hash.clone()));
            entry.hash = Some(hash);
            entry
        });
        chained.collect()
    }

    fn verified(entries: &[AuditEntry]) -> Result<u64, Broken> {
        let mut verifier = Verifier::after(0, FIRST_PREVIOUS_HASH);
        entries.iter().try_for_each(|entry| verifier.take(entry))?;
        Ok(verifier.count())
    }

    #[test]
    fn the_canonical_form_is_sorted_and_has_no_hashes() {
        let text = canonical(&entry(7));
        assert_eq!(
            text,
            "{\"address\":\"192.0.2.1\",\"at\":\"2026-11-22T09:00:00.000001Z\",\"count\":1,\"id\":7,\
             \"method\":\"POST\",\"path\":\"/v1/sites\",\"request_id\":\"\",\"role\":\"admin\",\
             \"route\":\"/v1/sites\",\"since\":null,\"status\":201,\"token\":null,\
             \"what\":{\"a\":-5e-1,\"b\":[1e300,\"ü\\n\"],\"cell_m\":2e0,\"id\":\"yard\"},\
             \"who\":\"desk\"}"
        );
    }

    #[test]
    fn whatever_is_changed_removed_swapped_or_put_in_between_is_named() {
        let whole = chain(5);
        assert_eq!(verified(&whole), Ok(5));
        let broken = |change: fn(&mut Vec<AuditEntry>)| {
            let mut entries = whole.clone();
            change(&mut entries);
            verified(&entries).unwrap_err()
        };
        assert_eq!(
            broken(|entries| entries[2].status = 200),
            Broken::Changed(3)
        );
        assert_eq!(broken(|entries| entries[2].what = None), Broken::Changed(3));
        let missing = Broken::Missing { last: 2, next: 4 };
        assert_eq!(broken(|entries| drop(entries.remove(2))), missing);
        assert_eq!(
            broken(|entries| entries[2].hash = None),
            Broken::Unhashed(3)
        );
        // An entry whose hash was computed anew does not match the `previous_hash` of the next
        // entry.
        let renewed = broken(|entries| {
            entries[2].status = 200;
            let previous = entries[2].previous_hash.clone().unwrap();
            entries[2].hash = Some(hash_after(&previous, &entries[2]));
        });
        assert_eq!(renewed, Broken::Unlinked(4));
    }

    #[test]
    fn a_log_that_was_cut_off_at_its_end_is_not_what_the_record_says() {
        let whole = chain(3);
        let last_hash = whole[2].hash.clone().unwrap();
        let record = AuditChain {
            before_id: 0,
            before_hash: FIRST_PREVIOUS_HASH.to_owned(),
            last_id: 3,
            last_hash,
        };
        let mut verifier = Verifier::after(0, FIRST_PREVIOUS_HASH);
        verifier.take(&whole[0]).unwrap();
        verifier.take(&whole[1]).unwrap();
        let short = Broken::Ends {
            found: 2,
            expected: 3,
        };
        assert_eq!(verifier.end(&record), Err(short));
        verifier.take(&whole[2]).unwrap();
        assert_eq!(verifier.end(&record), Ok(()));
    }
}
