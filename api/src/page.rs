//! Envelopes of lists, which the API returns in pages.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Number of entries of a page when the request has no `limit`.
pub const PAGE_LIMIT_DEFAULT: u32 = 100;
/// Maximum number of entries of a page.
pub const PAGE_LIMIT_MAX: u32 = 1_000;

/// Page of a list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Page<T> {
    /// Entries of this page.
    pub items: Vec<T>,
    /// Value of `cursor` for the request of the next page; `null` on the last page.
    pub next_cursor: Option<String>,
}

/// Page of a list that was read from the friction map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MapPage<T> {
    /// Entries of this page.
    pub items: Vec<T>,
    /// Value of `cursor` for the request of the next page; `null` on the last page.
    pub next_cursor: Option<String>,
    /// Time up to which measurements are included: the requested time rounded down to a minute, or
    /// to the end of an epoch whose raw measurements are missing or too many. `null` if no time was
    /// requested; all measurements are included then.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
}

/// Page of the differences of the friction map between two times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DifferencePage<T> {
    /// Entries of this page.
    pub items: Vec<T>,
    /// Value of `cursor` for the request of the next page; `null` on the last page.
    pub next_cursor: Option<String>,
    /// Time up to which measurements are included in `before`: the requested first time rounded
    /// down to a minute, or to the end of an epoch whose raw measurements are missing or too many.
    #[serde(default)]
    pub from: Option<Timestamp>,
    /// Time up to which measurements are included in `after`: the requested second time, rounded
    /// down likewise; `null` if none was requested, and all measurements are included then.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
}
