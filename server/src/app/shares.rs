//! Limited numbers of connections, with a maximum per identity, so that nobody uses them all.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tread_api::rights::Rights;

use super::AppError;
use super::identity::Credential;
use crate::identity::subject::SubjectId;

/// Limits on places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Maximum in all.
    pub all: usize,
    /// Maximum for viewers, who may only watch and stop, all together: the rest is for operators
    /// and admins.
    pub viewers: usize,
    /// Maximum for one token or person, with their sessions.
    pub each: usize,
}

#[derive(Debug, Default)]
struct Usage {
    all: usize,
    viewers: usize,
    by_subject: HashMap<SubjectId, usize>,
}

/// Places taken, by identity.
#[derive(Debug, Clone)]
pub struct Shares {
    bounds: Bounds,
    taken: Arc<Mutex<Usage>>,
}

impl Shares {
    /// Creates shares of which none is taken.
    pub fn new(bounds: Bounds) -> Self {
        let taken = Arc::default();
        Self { bounds, taken }
    }

    fn lock(&self) -> MutexGuard<'_, Usage> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the number of places taken.
    pub fn taken(&self) -> usize {
        self.lock().all
    }

    /// Takes a place until the result is dropped.
    ///
    /// # Errors
    /// [`AppError::TooMany`] if all places are taken, or those of viewers, or those of this token
    /// or person.
    pub fn take(&self, of: &Credential, what: &'static str) -> Result<Place, AppError> {
        self.place(of.subject, of.rights, what)
    }

    fn place(&self, of: SubjectId, rights: Rights, what: &'static str) -> Result<Place, AppError> {
        let Bounds { all, viewers, each } = self.bounds;
        let is_viewer = rights.only_watches();
        let mut taken = self.lock();
        let own = taken.by_subject.get(&of).copied().unwrap_or(0);
        let too_many = |count| Err(AppError::TooMany { what, count });
        if taken.all >= all {
            return too_many(all);
        }
        if is_viewer && taken.viewers >= viewers {
            return too_many(viewers);
        }
        if own >= each {
            return too_many(each);
        }
        taken.all += 1;
        taken.viewers += usize::from(is_viewer);
        taken.by_subject.insert(of, own + 1);
        drop(taken);
        let shares = self.clone();
        Ok(Place {
            shares,
            subject: of,
            is_viewer,
        })
    }
}

/// One place; dropping it frees the place.
#[derive(Debug)]
pub struct Place {
    shares: Shares,
    subject: SubjectId,
    is_viewer: bool,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.shares.lock();
        taken.all -= 1;
        taken.viewers -= usize::from(self.is_viewer);
        if let Some(own) = taken.by_subject.get_mut(&self.subject) {
            *own -= 1;
            if *own == 0 {
                taken.by_subject.remove(&self.subject);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tread_api::identity::Role;

    use super::*;

    #[test]
    fn nobody_takes_more_than_a_share_and_viewers_leave_room_for_operators() {
        let shares = Shares::new(Bounds {
            all: 10,
            viewers: 6,
            each: 4,
        });
        let token = |number| {
            let id = tread_api::ids::TokenId::from_uuid(uuid::Uuid::from_u128(number));
            SubjectId::Token(id)
        };
        let place = |number, role| shares.place(token(number), Rights::from(role), "places");
        let mut held: Vec<_> = (0..20)
            .filter_map(|_| place(1, Role::Viewer).ok())
            .collect();
        assert_eq!(held.len(), 4);
        held.extend((0..20).filter_map(|number| place(2 + number % 4, Role::Viewer).ok()));
        assert_eq!(held.len(), 6);
        held.extend((0..20).filter_map(|number| place(9 + number % 4, Role::Operator).ok()));
        assert_eq!((held.len(), shares.taken()), (10, 10));
        held.clear();
        assert_eq!(shares.taken(), 0);
        assert!(shares.lock().by_subject.is_empty());
    }
}
