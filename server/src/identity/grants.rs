//! Effective rights of a token or a person: a list of grants, each with rights and a scope.
//!
//! A person may be in several groups, each of which gives rights for some sites and robots. A right
//! of one group never applies in the scope of another: only rights with equal scopes are united,
//! and a request needs one grant that has both its right and its site. Where several grants have to
//! be summarised as one, the summary has the rights that all of them share: [`Grants::for_right`].

use tread_api::identity::Role;
use tread_api::ids::{RobotId, SiteId};
use tread_api::rights::{Grant, Right, Rights, Scope};

/// Effective grants of a token or a person; at least one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grants {
    role: Option<Role>,
    grants: Vec<Grant>,
}

impl Grants {
    /// Returns the single grant of a token.
    pub fn of_token(role: Option<Role>, rights: Rights, sites: Scope) -> Self {
        let grants = vec![Grant { rights, sites }];
        Self { role, grants }
    }

    /// Combines the grants of a person's groups; `None` if there are none.
    ///
    /// Rights with equal scopes are united; a grant that another one includes is left out.
    pub fn of_groups<'group>(given: impl IntoIterator<Item = &'group Grant>) -> Option<Self> {
        let mut united: Vec<Grant> = Vec::new();
        for grant in given {
            match united.iter_mut().find(|other| other.sites == grant.sites) {
                Some(other) => other.rights = other.rights.union(grant.rights),
                None => united.push(grant.clone()),
            }
        }
        // All scopes differ, so no two grants include each other.
        let covers = |other: &Grant, grant: &Grant| {
            other != grant
                && other.rights.includes_all(grant.rights)
                && other.sites.includes(&grant.sites)
        };
        let is_covered = |grant: &Grant| united.iter().any(|other| covers(other, grant));
        let mut grants: Vec<Grant> = united
            .iter()
            .filter(|grant| !is_covered(grant))
            .cloned()
            .collect();
        // The result must not depend on the order of the groups.
        grants.sort_by_cached_key(|grant| grant.sites.to_string());
        let role = match grants.as_slice() {
            [] => return None,
            [only] => Role::ALL
                .into_iter()
                .find(|&role| Rights::from(role) == only.rights),
            [..] => None,
        };
        Some(Self { role, grants })
    }

    /// Returns the role with exactly these rights; `None` without one or with several grants.
    pub fn role(&self) -> Option<Role> {
        self.role
    }

    /// Returns the grants, those of groups sorted by scope.
    pub fn as_slice(&self) -> &[Grant] {
        &self.grants
    }

    /// Returns the union of the scopes of all grants.
    pub fn scope(&self) -> Scope {
        common(self.grants.iter()).map_or_else(Scope::default, |grant| grant.sites)
    }

    /// Returns whether any grant has `right`, for whatever site.
    pub fn includes(&self, right: Right) -> bool {
        self.grants.iter().any(|grant| grant.rights.includes(right))
    }

    /// Returns whether one grant has `right` and includes `robot` of `site` in its scope.
    pub fn includes_at(&self, right: Right, site: &SiteId, robot: &RobotId) -> bool {
        let mut grants = self.grants.iter();
        grants.any(|grant| grant.rights.includes(right) && grant.sites.includes_robot(site, robot))
    }

    /// Summarises the grants that have `right`: the union of their scopes, and the rights that all
    /// of them share. `None` if no grant has `right`.
    pub fn for_right(&self, right: Right) -> Option<Grant> {
        let having = self.grants.iter();
        common(having.filter(|grant| grant.rights.includes(right)))
    }

    /// Summarises all grants: the union of their scopes, and the rights that all of them share.
    pub fn in_common(&self) -> Grant {
        // A constructed value has at least one grant.
        common(self.grants.iter()).unwrap_or_else(|| Grant {
            rights: Rights::default(),
            sites: Scope::EVERYWHERE,
        })
    }

    /// Returns whether there is more than one grant.
    pub fn are_several(&self) -> bool {
        self.grants.len() > 1
    }
}

/// Returns the union of the scopes of `grants` and the intersection of their rights; `None` if
/// `grants` is empty.
fn common<'grant>(mut grants: impl Iterator<Item = &'grant Grant>) -> Option<Grant> {
    let first = grants.next()?.clone();
    Some(grants.fold(first, |all, grant| Grant {
        rights: all.rights.intersection(grant.rights),
        sites: all.sites.union(&grant.sites),
    }))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SITES: [&str; 3] = ["yard", "park", "field"];
    const ROBOTS: [&str; 3] = ["rover-1", "rover-2", "rover-3"];

    fn grant(rights: &[Right], places: &[&str]) -> Grant {
        let sites = match places {
            [] => Scope::EVERYWHERE,
            places => Scope::from_names(places.iter().copied()).unwrap(),
        };
        let rights = rights.iter().copied().collect();
        Grant { rights, sites }
    }

    fn of(groups: &[Grant]) -> Grants {
        Grants::of_groups(groups).unwrap()
    }

    #[test]
    fn rights_are_united_where_the_places_are_the_same() {
        let grants = of(&[
            grant(&[Right::Drive], &["yard", "park"]),
            grant(&[Right::Dispatch], &["park", "yard"]),
        ]);
        let both = grant(&[Right::Drive, Right::Dispatch], &["yard", "park"]);
        assert_eq!(grants.as_slice(), [both]);
        assert!(!grants.are_several() && grants.role().is_none());
    }

    #[test]
    fn rights_of_one_place_are_not_taken_to_another() {
        let viewer = Grant {
            rights: Role::Viewer.into(),
            sites: Scope::EVERYWHERE,
        };
        let grants = of(&[viewer.clone(), grant(&[Right::Drive], &["yard"])]);
        let (yard, park) = ("yard".parse().unwrap(), "park".parse().unwrap());
        let rover = "rover-1".parse().unwrap();
        assert!(grants.includes_at(Right::Drive, &yard, &rover));
        assert!(grants.includes_at(Right::Read, &park, &rover));
        assert!(!grants.includes_at(Right::Drive, &park, &rover));
        let drive = grants.for_right(Right::Drive).unwrap();
        assert_eq!(drive.sites.to_string(), "yard");
        assert_eq!(grants.for_right(Right::Read), Some(viewer));
        assert_eq!(grants.for_right(Right::Administer), None);
    }

    #[test]
    fn what_another_group_covers_is_left_out_and_a_role_is_known_again() {
        let operator = Grant {
            rights: Role::Operator.into(),
            sites: Scope::EVERYWHERE,
        };
        let grants = of(&[
            grant(&[Right::Read], &["yard"]),
            operator.clone(),
            operator.clone(),
        ]);
        assert_eq!(grants.as_slice(), [operator]);
        assert_eq!(grants.role(), Some(Role::Operator));
        assert_eq!(Grants::of_groups(&[]), None);
    }

    fn some_grant() -> impl Strategy<Value = Grant> {
        let place = (0..SITES.len(), proptest::option::of(0..ROBOTS.len()));
        let places = proptest::collection::btree_map(0..SITES.len(), place, 0..3);
        let rights = proptest::sample::subsequence(Right::ALL.to_vec(), 1..4);
        (rights, places).prop_map(|(rights, places)| {
            let names = places.into_iter().map(|(site, (_, robot))| match robot {
                None => SITES[site].to_owned(),
                Some(robot) => format!("{}/{}", SITES[site], ROBOTS[robot]),
            });
            let names: Vec<String> = names.collect();
            grant(
                &rights,
                &names.iter().map(String::as_str).collect::<Vec<_>>(),
            )
        })
    }

    proptest! {
        /// A request is allowed exactly if one group alone gives its right in its place.
        #[test]
        fn nobody_may_do_somewhere_what_no_single_group_gives_there(
            groups in proptest::collection::vec(some_grant(), 1..6),
        ) {
            let grants = of(&groups);
            for site in SITES {
                let site: SiteId = site.parse().unwrap();
                for robot in ROBOTS {
                    let robot: RobotId = robot.parse().unwrap();
                    let given = |right| groups.iter().any(|group| {
                        group.rights.includes(right) && group.sites.includes_robot(&site, &robot)
                    });
                    for right in Right::ALL {
                        prop_assert_eq!(grants.includes_at(right, &site, &robot), given(right));
                        let view = grants.for_right(right);
                        let place = |view: &Grant| view.sites.includes_robot(&site, &robot);
                        prop_assert_eq!(view.as_ref().is_some_and(place), given(right));
                        // A further right that a handler checks in addition to the right of its
                        // route.
                        for view in view.iter().filter(|view| place(view)) {
                            for other in view.rights.iter() {
                                prop_assert!(given(other), "{other} at {site}/{robot}");
                            }
                        }
                    }
                    let common = grants.in_common();
                    if common.sites.includes_robot(&site, &robot) {
                        prop_assert!(common.rights.iter().all(given));
                    }
                }
                for right in Right::ALL {
                    let whole = |scope: &Scope| scope.includes_whole_site(&site);
                    let given = groups.iter().any(|group| {
                        group.rights.includes(right) && whole(&group.sites)
                    });
                    let view = grants.for_right(right);
                    prop_assert_eq!(view.is_some_and(|view| whole(&view.sites)), given);
                }
            }
        }

        /// The result does not depend on the order of the groups.
        #[test]
        fn the_order_of_groups_says_nothing(
            groups in proptest::collection::vec(some_grant(), 1..6),
        ) {
            let turned: Vec<Grant> = groups.iter().rev().cloned().collect();
            prop_assert_eq!(of(&groups), of(&turned));
        }
    }
}
