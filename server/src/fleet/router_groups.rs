//! Decides which robots a new router is for, and which routers are superseded. Pure.
//!
//! The rules of a router cannot be changed, and take time and memory in proportion to its robots, of
//! which zenoh does not return the memory when the router closes. So a router for robots that have
//! joined is not for the whole fleet: it also takes over the newer routers with less than twice as many
//! robots, and leaves the larger ones alone.
//!
//! ```text
//!  robots of the routers, oldest first     one joins
//!  1000                                ─►  1000 1
//!  1000 1                              ─►  1000 2      the router with 1 is superseded
//!  1000 2                              ─►  1000 2 1
//!  1000 2 1                            ─►  1000 4      those with 2 and 1 are superseded
//! ```
//!
//! Each router thus has at least twice as many robots as the next newer one, so `n` robots have at most
//! `log2(n) + 1` routers. A router that supersedes another has more than 1.5 times its robots, so a robot
//! moves at most `log1.5(n)` times however many join.

use std::collections::{BTreeSet, HashSet};

use crate::app::presence::RobotKey;

/// What counts of an open router.
#[derive(Debug, Clone, Copy)]
pub(super) struct Group<'router> {
    /// Robots that its rules include.
    pub(super) robots: &'router HashSet<RobotKey>,
    /// Whether its passwords derive from the authority that signs now.
    pub(super) is_of_signing: bool,
}

/// Returns the robots of the router that is to be opened for robots of the fleet that no router
/// includes; `None` if there is none and a router of the signing authority is open. `open` are the
/// routers, oldest first.
pub(super) fn to_open(open: &[Group<'_>], fleet: &[RobotKey]) -> Option<BTreeSet<RobotKey>> {
    let current: Vec<&Group<'_>> = open.iter().filter(|group| group.is_of_signing).collect();
    let is_known = |robot: &RobotKey| current.iter().any(|group| group.robots.contains(robot));
    let mut robots: BTreeSet<RobotKey> = fleet
        .iter()
        .filter(|robot| !is_known(robot))
        .cloned()
        .collect();
    if robots.is_empty() && !current.is_empty() {
        return None;
    }
    for group in current.iter().rev() {
        if group.robots.len() >= 2 * robots.len().max(1) {
            break;
        }
        robots.extend(group.robots.iter().cloned());
    }
    Some(robots)
}

/// Returns for each router whether it is superseded: newer routers of the signing authority include
/// all its robots, so that no robot connects to it any more.
pub(super) fn superseded(open: &[Group<'_>]) -> Vec<bool> {
    let mut covered: HashSet<&RobotKey> = HashSet::new();
    let mut has_newer = false;
    let mut found: Vec<bool> = open
        .iter()
        .rev()
        .map(|group| {
            let is_covered = group.robots.iter().all(|robot| covered.contains(robot));
            let is_superseded = has_newer && is_covered;
            if group.is_of_signing {
                covered.extend(group.robots);
                has_newer = true;
            }
            is_superseded
        })
        .collect();
    found.reverse();
    found
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn robot(number: usize) -> RobotKey {
        (
            "yard".parse().unwrap(),
            format!("rover-{number}").parse().unwrap(),
        )
    }

    /// A router with its robots, and the number of the authority that signed when it opened.
    type Open = (HashSet<RobotKey>, u32);

    fn groups(open: &[Open], signing: u32) -> Vec<Group<'_>> {
        let of = open.iter().map(|(robots, authority)| Group {
            robots,
            is_of_signing: *authority == signing,
        });
        of.collect()
    }

    /// Opens a router if one is needed, and closes those that are superseded. Returns its robots.
    fn change(open: &mut Vec<Open>, fleet: &[RobotKey], signing: u32) -> BTreeSet<RobotKey> {
        let opened = to_open(&groups(open, signing), fleet);
        if let Some(robots) = &opened {
            open.push((robots.iter().cloned().collect(), signing));
        }
        let mut superseded = superseded(&groups(open, signing)).into_iter();
        open.retain(|_router| !superseded.next().unwrap());
        opened.unwrap_or_default()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn every_robot_has_a_router_and_routers_and_moves_grow_with_the_logarithm(
            batches in prop::collection::vec((1_usize..40, prop::bool::weighted(0.05)), 1..60),
        ) {
            let (mut open, mut fleet, mut signing) = (Vec::new(), Vec::new(), 0);
            let mut moves = std::collections::BTreeMap::new();
            change(&mut open, &fleet, signing);
            prop_assert_eq!(open.len(), 1, "a router for nobody, until somebody joins");
            for (count, rotates) in batches {
                if rotates {
                    signing += 1;
                    moves.clear();
                }
                fleet.extend((fleet.len()..fleet.len() + count).map(robot));
                for moved in change(&mut open, &fleet, signing) {
                    *moves.entry(moved).or_insert(0_u32) += 1;
                }
                for robot in &fleet {
                    let is_in = |(robots, of): &Open| *of == signing && robots.contains(robot);
                    prop_assert_eq!(open.iter().filter(|open| is_in(open)).count(), 1);
                }
                let sizes: Vec<usize> = open.iter().map(|(robots, _)| robots.len()).collect();
                prop_assert!(sizes.windows(2).all(|two| two[0] >= 2 * two[1]), "{:?}", sizes);
                prop_assert!(open.len() <= 1 + fleet.len().ilog2() as usize, "{:?}", sizes);
                let count = f64::from(u32::try_from(fleet.len()).unwrap());
                let most = count.log(1.5) + 1.0;
                prop_assert!(moves.values().all(|&moves| f64::from(moves) <= most));
                prop_assert_eq!(to_open(&groups(&open, signing), &fleet), None);
            }
        }
    }

    #[test]
    fn a_router_of_a_former_authority_is_superseded_by_the_one_for_all_robots() {
        let fleet: Vec<RobotKey> = (0..3).map(robot).collect();
        let mut open = vec![(fleet.iter().cloned().collect(), 0)];
        assert_eq!(
            superseded(&groups(&open, 1)),
            [false],
            "nobody else takes its robots yet"
        );
        let opened = to_open(&groups(&open, 1), &fleet).unwrap();
        assert_eq!(opened.len(), 3);
        open.push((opened.into_iter().collect(), 1));
        assert_eq!(superseded(&groups(&open, 1)), [true, false]);
    }
}
