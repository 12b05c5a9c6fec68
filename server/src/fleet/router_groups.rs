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
//! A router has a maximum number of robots, `robots_max`: zenoh copies the configuration of a router,
//! with all of its rules, for each session that it accepts. One that would have more takes over as many
//! small routers as fit, and then as many new robots as there is room for.
//!
//! So a router that is left behind a full one has about half of the maximum or more: `n` robots have at
//! most `2 n / robots_max + log2(robots_max) + 1` routers. A router that supersedes another has more
//! than 1.5 times its robots or is full, so a robot moves at most `log1.5(robots_max) + 1` times however
//! many join, the last time to a full one.

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

/// Returns the robots, at most `robots_max`, of the next router that is to be opened for robots of the
/// fleet that no router includes; `None` if there is none and a router of the signing authority is open.
/// `open` are the routers, oldest first.
pub(super) fn to_open(
    open: &[Group<'_>],
    fleet: &[RobotKey],
    robots_max: usize,
) -> Option<BTreeSet<RobotKey>> {
    let current: Vec<&Group<'_>> = open.iter().filter(|group| group.is_of_signing).collect();
    let known: HashSet<&RobotKey> = current.iter().flat_map(|group| group.robots).collect();
    let unknown: BTreeSet<&RobotKey> = fleet
        .iter()
        .filter(|robot| !known.contains(robot))
        .collect();
    if unknown.is_empty() && !current.is_empty() {
        return None;
    }
    let wanted = unknown.len().clamp(1, robots_max);
    let mut robots = BTreeSet::new();
    for group in current.iter().rev() {
        let is_large = group.robots.len() >= 2 * (wanted + robots.len());
        // There must be room for one robot at least that no router includes.
        if is_large || group.robots.len() + robots.len() >= robots_max {
            break;
        }
        robots.extend(group.robots.iter().cloned());
    }
    let room = robots_max - robots.len();
    robots.extend(unknown.into_iter().take(room).cloned());
    Some(robots)
}

/// Returns the robots of the router that replaces `former`: its own, and those of newer routers as far as
/// they fit, newest first, so that the sizes stay in their order. `newer` are oldest first.
pub(super) fn to_reopen(
    former: &HashSet<RobotKey>,
    newer: &[&HashSet<RobotKey>],
    robots_max: usize,
) -> BTreeSet<RobotKey> {
    let mut robots: BTreeSet<RobotKey> = former.iter().cloned().collect();
    for group in newer.iter().rev() {
        if group.len() + robots.len() > robots_max {
            break;
        }
        robots.extend(group.iter().cloned());
    }
    robots
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

    const ROBOTS_MAX: usize = 256;

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

    /// Opens routers while they are needed, and closes those that are superseded. Returns the robots of
    /// the new ones.
    fn change(open: &mut Vec<Open>, fleet: &[RobotKey], signing: u32) -> Vec<RobotKey> {
        let mut moved = Vec::new();
        while let Some(robots) = to_open(&groups(open, signing), fleet, ROBOTS_MAX) {
            open.push((robots.iter().cloned().collect(), signing));
            moved.extend(robots);
            let mut superseded = superseded(&groups(open, signing)).into_iter();
            open.retain(|_router| !superseded.next().unwrap());
        }
        moved
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn every_robot_has_one_router_and_routers_and_moves_are_bounded(
            batches in prop::collection::vec(
                (prop_oneof![9 => 1_usize..40, 1 => 200..700_usize], prop::bool::weighted(0.05)),
                1..60,
            ),
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
                prop_assert!(sizes.iter().all(|&size| size <= ROBOTS_MAX), "{:?}", sizes);
                let most = 2 * fleet.len() / ROBOTS_MAX + ROBOTS_MAX.ilog2() as usize + 1;
                prop_assert!(open.len() <= most, "{:?}", sizes);
                let most = f64::from(u32::try_from(ROBOTS_MAX).unwrap()).log(1.5) + 2.0;
                prop_assert!(moves.values().all(|&moves| f64::from(moves) <= most));
                prop_assert_eq!(to_open(&groups(&open, signing), &fleet, ROBOTS_MAX), None);
            }
        }
    }

    #[test]
    fn few_routers_are_for_a_fleet_that_grows_one_by_one_and_in_batches() {
        let (mut open, mut fleet) = (Vec::new(), Vec::new());
        for (singles, batch) in [(255, 256), (255, 256), (100, 300), (255, 1), (63, 200)] {
            for count in std::iter::repeat_n(1, singles).chain([batch]) {
                fleet.extend((fleet.len()..fleet.len() + count).map(robot));
                change(&mut open, &fleet, 0);
            }
        }
        let most = 2 * fleet.len() / ROBOTS_MAX + ROBOTS_MAX.ilog2() as usize + 1;
        let sizes: Vec<usize> = open.iter().map(|(robots, _)| robots.len()).collect();
        assert!(sizes.len() <= most, "{sizes:?}");
        assert_eq!(sizes.iter().sum::<usize>(), fleet.len());
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
        let opened = to_open(&groups(&open, 1), &fleet, ROBOTS_MAX).unwrap();
        assert_eq!(opened.len(), 3);
        open.push((opened.into_iter().collect(), 1));
        assert_eq!(superseded(&groups(&open, 1)), [true, false]);
    }

    #[test]
    fn a_router_that_replaces_another_one_takes_over_newer_ones_as_far_as_they_fit() {
        let of = |numbers: std::ops::Range<usize>| numbers.map(robot).collect::<HashSet<_>>();
        let (former, large, small) = (of(0..100), of(100..250), of(250..300));
        let robots = to_reopen(&former, &[&large, &small], ROBOTS_MAX);
        assert_eq!(robots.len(), 150);
        assert!(small.iter().all(|robot| robots.contains(robot)));
        assert_eq!(to_reopen(&former, &[&large], ROBOTS_MAX).len(), 250);
    }
}
