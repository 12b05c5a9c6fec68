//! Sessions of browsers, each belonging to a token or to a person who signed in at an OpenID
//! provider.

use jiff::Timestamp;
use tread_api::ids::{PersonId, SessionId, TokenId};
use tread_store::Fingerprint;
pub use tread_store::sessions::{NewSession, Owner, PeopleSessionFilter, SessionRow, SignedIn};

use super::{DbError, Tx, forward};

forward! {
    sessions;
    fn insert(session: &NewSession) -> ();
    fn by_lookup(fingerprint: &Fingerprint) -> Option<SessionRow>;
    fn find(id: SessionId) -> Option<SessionRow>;
    fn list(filter: &PeopleSessionFilter<'_>, limit: u32) -> Vec<SessionRow>;
    fn count_of_people(at: Timestamp) -> i64;
    fn all_valid(at: Timestamp) -> Vec<SessionId>;
    fn touch(id: SessionId, at: Timestamp) -> ();
    fn delete(id: SessionId) -> ();
    fn delete_expired(at: Timestamp) -> ();
    fn surplus(owner: (Option<TokenId>, Option<PersonId>), kept: u32) -> Vec<SessionId>;
}
