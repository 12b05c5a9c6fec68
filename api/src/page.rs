//! The envelope of every list.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Entries of a page when the request does not say.
pub const PAGE_LIMIT_DEFAULT: u32 = 100;
/// Most entries of a page.
pub const PAGE_LIMIT_MAX: u32 = 1_000;

/// One page of a list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Page<T> {
    /// The entries.
    pub items: Vec<T>,
    /// Give this as `cursor` for the next page; `null` on the last one.
    pub next_cursor: Option<String>,
}

/// One page of the friction map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MapPage<T> {
    /// The entries.
    pub items: Vec<T>,
    /// Give this as `cursor` for the next page; `null` on the last one.
    pub next_cursor: Option<String>,
    /// As of when: nothing that was measured later counts. The end of the last epoch before
    /// the requested time; `null` when no time was, and all that has come counts.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
}

/// One page of how the friction map changed between two times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DifferencePage<T> {
    /// The entries.
    pub items: Vec<T>,
    /// Give this as `cursor` for the next page; `null` on the last one.
    pub next_cursor: Option<String>,
    /// The first time: the end of the last epoch before the requested one.
    #[serde(default)]
    pub from: Option<Timestamp>,
    /// The second time, as [`MapPage::as_of`].
    #[serde(default)]
    pub as_of: Option<Timestamp>,
}
