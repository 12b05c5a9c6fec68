//! ID tokens of people's sessions, needed for signing out at the provider; in memory only, bounded
//! in number.

use std::collections::{HashMap, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tread_api::ids::SessionId;

/// Maximum number of ID tokens kept.
const ID_TOKENS_MAX: usize = 1_000;

/// ID tokens by session.
#[derive(Debug, Default)]
pub(super) struct IdTokens(Mutex<TokenTable>);

#[derive(Debug, Default)]
struct TokenTable {
    of: HashMap<SessionId, String>,
    /// Sessions, oldest first.
    order: VecDeque<SessionId>,
}

impl IdTokens {
    fn lock(&self) -> MutexGuard<'_, TokenTable> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps a session's ID token; beyond the maximum the oldest is dropped.
    pub(super) fn insert(&self, session: SessionId, id_token: String) {
        let mut kept = self.lock();
        kept.of.insert(session, id_token);
        kept.order.push_back(session);
        while kept.order.len() > ID_TOKENS_MAX {
            if let Some(oldest) = kept.order.pop_front() {
                kept.of.remove(&oldest);
            }
        }
    }

    /// Forgets the ID tokens of sessions that have ended.
    pub(super) fn remove(&self, sessions: &[SessionId]) {
        let mut kept = self.lock();
        for session in sessions {
            kept.of.remove(session);
        }
        kept.order.retain(|session| !sessions.contains(session));
    }

    /// Returns a session's ID token, if it is kept.
    pub(super) fn of(&self, session: SessionId) -> Option<String> {
        self.lock().of.get(&session).cloned()
    }
}
