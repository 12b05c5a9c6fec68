//! The audit log: who changed what, and who was refused, in a chain of hashes
//! ([`tread_api::audit`]).

use tread_api::audit::AuditChain;
use tread_api::identity::AuditEntry;
pub use tread_store::audit::{AuditFilter, AuditRetention};

use super::{DbError, Tx, forward};

forward! {
    audit;
    fn list(filter: &AuditFilter, limit: u32) -> Vec<AuditEntry>;
    fn chain() -> Option<AuditChain>;
    fn append(entries: &[AuditEntry]) -> Vec<AuditEntry>;
    fn prune(kept: AuditRetention, limit: u32) -> ();
}
