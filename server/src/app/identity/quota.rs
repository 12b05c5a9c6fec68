//! How many there may be of what admins make: in all, and of those who administer some sites alone each
//! a share, so that none of them uses up what the others need.
//!
//! The share goes by what a maker administers and not by his token: whoever may make tokens could make
//! more makers.

use tread_api::rights::Scope;

use crate::app::AppError;

/// How many there may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::app) struct Quota {
    /// What is counted.
    pub(in crate::app) what: &'static str,
    /// In all.
    pub(in crate::app) all: usize,
    /// Those of them that only admins of the whole server make.
    pub(in crate::app) reserved: usize,
    /// For what one admin of some sites administers, whoever has made them.
    pub(in crate::app) share: usize,
}

/// How many there are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::app) struct Count {
    /// In all.
    pub(in crate::app) all: i64,
    /// Of them those for what the maker administers.
    pub(in crate::app) within_scope: i64,
}

impl Quota {
    /// Refuses another one of a maker.
    ///
    /// # Errors
    /// [`AppError::TooMany`].
    pub(in crate::app) fn check(&self, maker: &Scope, count: Count) -> Result<(), AppError> {
        let is_limited = !maker.is_everywhere();
        let most = self.all - if is_limited { self.reserved } else { 0 };
        let over = if is_limited && is_reached(count.within_scope, self.share) {
            Some(self.share)
        } else if is_reached(count.all, most) {
            Some(most)
        } else {
            None
        };
        let what = self.what;
        over.map_or(Ok(()), |count| Err(AppError::TooMany { what, count }))
    }
}

fn is_reached(count: i64, most: usize) -> bool {
    usize::try_from(count).is_ok_and(|count| count >= most)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_admin_of_some_sites_has_a_share_and_leaves_a_rest_to_those_of_the_whole_server() {
        let quota = Quota {
            what: "things",
            all: 10,
            reserved: 2,
            share: 3,
        };
        let site = Scope::from_names(["yard"]).unwrap();
        let is_refused = |maker: &Scope, all, within_scope| {
            let count = Count { all, within_scope };
            quota.check(maker, count).is_err()
        };
        assert!(!is_refused(&site, 7, 2));
        assert!(is_refused(&site, 3, 3), "it has its share");
        assert!(is_refused(&site, 8, 0), "the rest is not for it");
        assert!(!is_refused(&Scope::EVERYWHERE, 9, 9));
        assert!(is_refused(&Scope::EVERYWHERE, 10, 10));
    }
}
