//! Tokens of people and programs. Only the hash of a secret is stored.

use jiff::Timestamp;
use tread_api::identity::Token;
use tread_api::ids::TokenId;
use tread_api::rights::Scope;
use tread_store::Fingerprint;

use tread_store::secrets::TokenRow;

use super::{DbError, Tx, forward};

forward! {
    tokens;
    fn find(id: TokenId) -> Option<Token>;
    fn by_lookup(fingerprint: &Fingerprint) -> Option<TokenRow<Token>>;
    fn list(within: &Scope, before: Option<TokenId>, limit: u32) -> Vec<Token>;
    fn valid_by_name(name: &str, at: Timestamp) -> Option<Token>;
    fn valid_counts(at: Timestamp) -> (i64, i64);
    fn valid_count_within(within: &Scope, at: Timestamp) -> i64;
    fn insert(token: &Token, fingerprint: &Fingerprint) -> ();
    fn revoke(id: TokenId, at: Timestamp) -> ();
    fn touch(id: TokenId, at: Timestamp) -> ();
    fn delete_ended(before: Timestamp, limit: u32) -> ();
    fn all_valid(at: Timestamp) -> Vec<TokenRow<Token>>;
}
