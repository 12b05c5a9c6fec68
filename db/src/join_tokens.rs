//! Join tokens of robots. Only the hash of a secret is stored.

use jiff::Timestamp;
use tread_api::enrolment::JoinToken;
use tread_api::ids::{JoinTokenId, RobotId};
use tread_api::rights::Scope;
use tread_store::Fingerprint;

use tread_store::secrets::TokenRow;

use super::{DbError, Tx, forward};

forward! {
    join_tokens;
    fn find(id: JoinTokenId) -> Option<JoinToken>;
    fn by_lookup(fingerprint: &Fingerprint) -> Option<TokenRow<JoinToken>>;
    fn list(within: &Scope, before: Option<JoinTokenId>, limit: u32) -> Vec<JoinToken>;
    fn valid_count(at: Timestamp) -> i64;
    fn valid_count_within(within: &Scope, at: Timestamp) -> i64;
    fn insert(token: &JoinToken, fingerprint: &Fingerprint) -> ();
    fn consume(id: JoinTokenId, by: &RobotId, at: Timestamp) -> bool;
    fn revoke(id: JoinTokenId, at: Timestamp) -> ();
    fn delete_ended(before: Timestamp, limit: u32) -> ();
}
