//! The audit log: filters, and which entries are kept.

use jiff::Timestamp;
use tread_api::identity::AuditOrder;

/// Filter and order of a list of entries.
#[derive(Debug, Clone, Default)]
pub struct AuditFilter {
    /// Only those of the token or person of this name.
    pub who: Option<String>,
    /// Only those of refused requests.
    pub refused: bool,
    /// Order of the list.
    pub order: AuditOrder,
    /// Only those after this one in that order (cursor).
    pub beyond: Option<u64>,
}

/// Which entries are kept.
#[derive(Debug, Clone, Copy)]
pub struct AuditRetention {
    /// Only those since this time.
    pub since: Timestamp,
    /// At most this many, the newest.
    pub newest_max: u32,
}
