//! Keys of the measurements of a file, which its name has.

/// Beginning of the name of a file.
pub(super) const PREFIX: &str = "segments-";
/// End of the name of a file.
pub(super) const ENDING: &str = ".parquet";
/// Number of digits of a key in a name, enough for every key.
const KEY_DIGITS: usize = 19;

/// Keys of measurements, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct KeyRange {
    /// The first key.
    pub first: i64,
    /// The last key.
    pub last: i64,
}

impl KeyRange {
    /// Returns whether a key is one of these.
    pub fn contains(self, key: i64) -> bool {
        (self.first..=self.last).contains(&key)
    }

    /// Returns the number of keys.
    pub fn count(self) -> i64 {
        self.last - self.first + 1
    }

    /// Returns the mark after a file with these keys was added to what a mark names.
    #[must_use]
    pub fn joined_to(self, mark: Option<Self>) -> Self {
        match mark {
            Some(mark) if mark.first <= self.first && self.first <= mark.last.saturating_add(1) => {
                Self {
                    first: mark.first,
                    last: self.last,
                }
            }
            Some(_) | None => self,
        }
    }

    pub(super) fn overlaps(self, other: Self) -> bool {
        self.first <= other.last && other.first <= self.last
    }

    /// Returns the name of the file with these keys.
    pub(super) fn name(self) -> String {
        let Self { first, last } = self;
        format!("{PREFIX}{first:0KEY_DIGITS$}-{last:0KEY_DIGITS$}{ENDING}")
    }

    /// Returns the keys in the name of a file; `None` for other names.
    pub(super) fn of_name(name: &str) -> Option<Self> {
        let keys = name.strip_prefix(PREFIX)?.strip_suffix(ENDING)?;
        let (first, last) = keys.split_once('-')?;
        let is_key = |key: &str| key.len() == KEY_DIGITS && key.bytes().all(|c| c.is_ascii_digit());
        if !(is_key(first) && is_key(last)) {
            return None;
        }
        let (first, last) = (first.parse().ok()?, last.parse().ok()?);
        (1 <= first && first <= last).then_some(Self { first, last })
    }
}

/// What the folder contains.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Listing {
    /// Keys of the files, in their order.
    pub files: Vec<KeyRange>,
    /// Keys of the files that a person has given up.
    pub lost: Vec<KeyRange>,
}

impl Listing {
    pub(super) fn all(&self) -> impl Iterator<Item = KeyRange> {
        self.files.iter().chain(&self.lost).copied()
    }

    /// Returns the last archived key that precedes `keys`; `None` if there is none.
    pub(super) fn preceding(&self, keys: KeyRange) -> Option<i64> {
        let all = self.all().map(|found| found.last);
        all.filter(|last| *last < keys.first).max()
    }
}
