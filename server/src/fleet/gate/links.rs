//! Links of each robot, limited to the newest few.
//!
//! A robot has one session, and for a moment a second. Without a limit one robot's certificate
//! could open all available links and lock the others out. A robot that overloads the router by
//! messages that cannot be refused there is cut off for a while. All links of a robot share one
//! byte rate.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::throttle::{BYTE_RATE, ByteRate};
use crate::app::presence::RobotKey;
use crate::rate_limit::RateLimit;

/// Maximum number of links of one robot. It admits two agents under one name, so that they are
/// detected and shown.
pub(in crate::fleet) const LINKS_PER_ROBOT_MAX: usize = 4;

/// Time for which a robot stays cut off: its session and its declarations end meanwhile.
pub(in crate::fleet) const CUT_OFF: Duration = Duration::from_secs(10);

/// The SHA-256 of a certificate.
pub(super) type CertificateHash = [u8; 32];

type LinksByRobot = HashMap<RobotKey, VecDeque<LinkEntry>>;

/// All robots' links.
#[derive(Debug, Clone)]
pub(in crate::fleet) struct Links(Arc<Mutex<Table>>);

#[derive(Debug)]
struct Table {
    next: u64,
    byte_limit: RateLimit,
    /// Byte rates by robot; a new link continues the rate of the earlier ones. Only robots that
    /// have joined are in it, so its size is bounded.
    byte_rates: HashMap<RobotKey, Arc<ByteRate>>,
    of_robots: LinksByRobot,
    /// Robots that are cut off, with the time at which that ends.
    cut_off: HashMap<RobotKey, Duration>,
}

impl Default for Links {
    fn default() -> Self {
        Self::new(BYTE_RATE)
    }
}

#[derive(Debug)]
struct LinkEntry {
    number: u64,
    certificate: CertificateHash,
    /// The zenoh session on this link; `None` until it begins to open.
    session_id: Option<u128>,
    displaced: CancellationToken,
    cut_off: CancellationToken,
    ended: CancellationToken,
}

/// Registration of a link; dropping it removes the link.
#[derive(Debug)]
pub(super) struct Entry {
    links: Links,
    robot: RobotKey,
    number: u64,
    byte_rate: Arc<ByteRate>,
    displaced: CancellationToken,
    cut_off: CancellationToken,
    ended: CancellationToken,
}

impl Links {
    /// Creates an empty table; all links of a robot together are read at `byte_limit`.
    pub(in crate::fleet) fn new(byte_limit: RateLimit) -> Self {
        Self(Arc::new(Mutex::new(Table {
            next: 0,
            byte_limit,
            byte_rates: HashMap::new(),
            of_robots: HashMap::new(),
            cut_off: HashMap::new(),
        })))
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Cuts a robot's links, and refuses new ones for [`CUT_OFF`]. Returns false if it was cut off
    /// already.
    pub(in crate::fleet) fn cut_off(&self, robot: &RobotKey, now: Duration) -> bool {
        let mut table = self.lock();
        table.cut_off.retain(|_, until| *until > now);
        let is_news = table.cut_off.insert(robot.clone(), now + CUT_OFF).is_none();
        for link in table.of_robots.get(robot).into_iter().flatten() {
            link.cut_off.cancel();
        }
        is_news
    }

    /// Adds a link of a robot; its oldest one is closed if it has too many.
    pub(super) fn enter(
        &self,
        robot: RobotKey,
        certificate: CertificateHash,
        now: Duration,
    ) -> Entry {
        let [displaced, cut_off, ended] = std::array::from_fn(|_| CancellationToken::new());
        let mut table = self.lock();
        if table.cut_off.get(&robot).is_some_and(|until| *until > now) {
            cut_off.cancel();
        }
        table.next += 1;
        let (number, byte_limit) = (table.next, table.byte_limit);
        let own = table.of_robots.entry(robot.clone()).or_default();
        own.push_back(LinkEntry {
            number,
            certificate,
            session_id: None,
            displaced: displaced.clone(),
            cut_off: cut_off.clone(),
            ended: ended.clone(),
        });
        let staying = |link: &&LinkEntry| !link.displaced.is_cancelled();
        if own.iter().filter(staying).count() > LINKS_PER_ROBOT_MAX
            && let Some(oldest) = own.iter().find(staying)
        {
            oldest.displaced.cancel();
        }
        let new_rate = || Arc::new(ByteRate::new(byte_limit));
        let byte_rate = Arc::clone(
            table
                .byte_rates
                .entry(robot.clone())
                .or_insert_with(new_rate),
        );
        drop(table);
        let links = self.clone();
        Entry {
            links,
            robot,
            number,
            byte_rate,
            displaced,
            cut_off,
            ended,
        }
    }
}

impl Entry {
    /// Waits until the robot is cut off.
    pub(super) async fn cut_off(&self) {
        self.cut_off.cancelled().await;
    }

    /// Returns the byte rate of the robot.
    pub(super) fn byte_rate(&self) -> &ByteRate {
        &self.byte_rate
    }

    /// Waits until newer links of the robot have displaced this one.
    pub(super) async fn displaced(&self) {
        self.displaced.cancelled().await;
    }

    /// Takes a session over from older links, and returns whether there was one. A robot whose
    /// network failed reconnects before the server notices, and the router would refuse a second
    /// link of the same session, so the older ones are ended and awaited. Only links with the very
    /// same certificate count: a client with another one is another agent.
    pub(super) async fn take_over(&self, session_id: u128) -> bool {
        let mut older = Vec::new();
        {
            let mut table = self.links.lock();
            let Some(own) = table.of_robots.get_mut(&self.robot) else {
                return false;
            };
            let Some(this) = own.iter_mut().find(|link| link.number == self.number) else {
                return false;
            };
            this.session_id = Some(session_id);
            let certificate = this.certificate;
            for link in own.iter().filter(|link| link.number < self.number) {
                if link.session_id == Some(session_id) && link.certificate == certificate {
                    link.displaced.cancel();
                    older.push(link.ended.clone());
                }
            }
        }
        for ended in &older {
            ended.cancelled().await;
        }
        !older.is_empty()
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        self.ended.cancel();
        let mut table = self.links.lock();
        let Some(own) = table.of_robots.get_mut(&self.robot) else {
            return;
        };
        own.retain(|link| link.number != self.number);
        if own.is_empty() {
            table.of_robots.remove(&self.robot);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot(name: &str) -> RobotKey {
        ("yard".parse().unwrap(), name.parse().unwrap())
    }

    #[test]
    fn of_a_robots_links_the_newest_stay_and_others_lose_none() {
        let links = Links::default();
        let other = links.enter(robot("rover-2"), [0; 32], Duration::ZERO);
        let all: Vec<Entry> = (0..100)
            .map(|_| links.enter(robot("rover-1"), [0; 32], Duration::ZERO))
            .collect();
        let stay = |entry: &&Entry| !entry.displaced.is_cancelled();
        assert_eq!(all.iter().filter(stay).count(), LINKS_PER_ROBOT_MAX);
        assert!(
            all[100 - LINKS_PER_ROBOT_MAX..]
                .iter()
                .all(|entry| stay(&entry))
        );
        assert!(stay(&&other));
        drop(all);
        assert_eq!(links.lock().of_robots.len(), 1);
        let again = links.enter(robot("rover-1"), [0; 32], Duration::ZERO);
        assert!(stay(&&again));
        drop((other, again));
        assert!(links.lock().of_robots.is_empty());
    }

    #[tokio::test]
    async fn a_session_goes_to_the_newest_link_of_the_same_certificate_alone() {
        let links = Links::default();
        let rover = || robot("rover-1");
        let (older, others) = (
            links.enter(rover(), [1; 32], Duration::ZERO),
            [
                links.enter(rover(), [2; 32], Duration::ZERO),
                links.enter(rover(), [1; 32], Duration::ZERO),
            ],
        );
        assert!(!older.take_over(7).await);
        for (other, session_id) in others.iter().zip([7, 8]) {
            assert!(!other.take_over(session_id).await);
        }
        let newest = links.enter(rover(), [1; 32], Duration::ZERO);
        let mut taking = Box::pin(newest.take_over(7));
        let waiting = tokio::time::timeout(std::time::Duration::from_millis(1), &mut taking).await;
        assert!(waiting.is_err(), "the older one has not ended");
        assert!(older.displaced.is_cancelled());
        drop(older);
        assert!(taking.await);
        assert!(others.iter().all(|other| !other.displaced.is_cancelled()));
    }

    #[test]
    fn a_robot_that_is_cut_off_loses_all_links_and_gets_none_for_a_while_and_others_keep_theirs() {
        let links = Links::default();
        let at = Duration::from_secs;
        let enter = |name, now| links.enter(robot(name), [0; 32], now);
        let (own, other) = (enter("rover-1", at(0)), enter("rover-2", at(0)));
        assert!(links.cut_off(&robot("rover-1"), at(1)));
        assert!(
            !links.cut_off(&robot("rover-1"), at(2)),
            "it was out already"
        );
        assert!(own.cut_off.is_cancelled() && !other.cut_off.is_cancelled());
        let just_before = Duration::from_millis(1_999) + CUT_OFF;
        assert!(enter("rover-1", just_before).cut_off.is_cancelled());
        assert!(!enter("rover-1", at(2) + CUT_OFF).cut_off.is_cancelled());
        assert!(!enter("rover-2", at(2)).cut_off.is_cancelled());
    }
}
