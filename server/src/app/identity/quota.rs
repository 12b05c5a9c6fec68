//! Quotas on objects that admins create, such as tokens: a total, and for admins of some sites
//! alone a share, so that none uses up what others need.
//!
//! The share belongs to the scope that the creator administers and not to the creator's token: an
//! admin could otherwise create more admins to get more shares.

use tread_api::rights::Scope;

use crate::app::AppError;

/// Limits on the number of objects of one kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::app) struct Quota {
    /// Name of the objects.
    pub(in crate::app) what: &'static str,
    /// Maximum number in all.
    pub(in crate::app) all: usize,
    /// Number of these reserved for admins of the whole server.
    pub(in crate::app) reserved: usize,
    /// Maximum number within the scope of one admin of some sites, by any creator.
    pub(in crate::app) share: usize,
}

/// Present number of objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::app) struct Count {
    /// Number in all.
    pub(in crate::app) all: i64,
    /// Number within the scope that the creator administers.
    pub(in crate::app) within_scope: i64,
}

impl Quota {
    /// Checks that the quota allows `maker` one more object.
    ///
    /// # Errors
    /// [`AppError::TooMany`] at the limit.
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
