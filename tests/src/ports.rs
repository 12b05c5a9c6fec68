//! Ports of the loopback for processes that are started, killed, and started again on them.
//!
//! They lie below those that Linux gives to outgoing connections. A port that the kernel gave for 0
//! may belong to somebody's connection by the time that it is listened on, and a client that calls a
//! dead server again and again can even be connected to itself there.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::sync::atomic::{AtomicU32, Ordering};

/// The lowest port.
const FIRST: u16 = 10_000;
/// How many there are; outgoing connections begin at 32768.
const COUNT: u16 = 22_000;
/// How far apart two processes begin that were started one after the other.
const APART: u32 = 41;
/// Ports that are looked at before none is found.
const LOOKS_MAX: u32 = 1_000;

/// An address of the loopback that nobody listens on, and no two callers of this process get.
///
/// # Panics
/// If a thousand ports one after the other are taken.
#[must_use]
pub fn free_address() -> SocketAddr {
    static GIVEN: AtomicU32 = AtomicU32::new(0);
    // Tests run as processes of their own, many at once.
    let begin = std::process::id().wrapping_mul(APART);
    let numbers = || begin.wrapping_add(GIVEN.fetch_add(1, Ordering::Relaxed));
    first_free((0..LOOKS_MAX).map(|_| numbers())).expect("one port of a thousand is free")
}

fn first_free(mut numbers: impl Iterator<Item = u32>) -> Option<SocketAddr> {
    numbers.find_map(|number| {
        let address = address(number);
        TcpListener::bind(address).is_ok().then_some(address)
    })
}

fn address(number: u32) -> SocketAddr {
    let place = u16::try_from(number % u32::from(COUNT)).unwrap_or(0);
    SocketAddr::from((Ipv4Addr::LOCALHOST, FIRST + place))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_port_is_one_of_outgoing_connections_or_given_twice() {
        let mut ports: Vec<u16> = (0..50).map(|_| free_address().port()).collect();
        let is_low = |port: &u16| (FIRST..FIRST + COUNT).contains(port);
        assert!(ports.iter().all(is_low), "{ports:?}");
        ports.sort_unstable();
        ports.dedup();
        assert_eq!(ports.len(), 50);
        assert_eq!(address(u32::from(COUNT) * 3 + 1).port(), FIRST + 1);
    }

    #[test]
    fn a_port_that_somebody_listens_on_is_passed_over() {
        let (number, held) = (0..u32::from(COUNT))
            .find_map(|number| Some((number, TcpListener::bind(address(number)).ok()?)))
            .unwrap();
        let found = first_free(number..number + LOOKS_MAX).unwrap();
        assert_ne!(found, held.local_addr().unwrap());
        assert_eq!(first_free(std::iter::once(number)), None);
    }
}
