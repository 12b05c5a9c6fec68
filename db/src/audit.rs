//! The audit log: who changed what, and who was refused, in a chain of hashes
//! ([`tread_api::audit`]).

use jiff::Timestamp;
use tread_api::audit::AuditChain;
use tread_api::identity::AuditEntry;
pub use tread_store::audit::AuditFilter;

use super::{DbError, Tx, forward};

forward! {
    audit;
    fn list(filter: &AuditFilter, limit: u32) -> Vec<AuditEntry>;
    fn chain() -> Option<AuditChain>;
    fn append(entries: &[AuditEntry]) -> Vec<AuditEntry>;
    fn forget(before: Timestamp, kept: u32, limit: u32) -> ();
}
