//! Determines the client address of a request: the peer address of the connection, or the address
//! that a trusted proxy reports.
//!
//! A proxy appends the address of its client to `X-Forwarded-For`. Entries to the left of those
//! that trusted proxies appended come from the client itself and are ignored.
//! [`TrustedProxies::client`] therefore reads the list from its end; the first address that is no
//! trusted proxy is the client.

use std::fmt;
use std::net::{IpAddr, Ipv6Addr};
use std::str::FromStr;

use serde::Deserialize;

/// Maximum number of entries of `X-Forwarded-For` that are read, from its end; others are ignored.
pub const HOPS_MAX: usize = 16;
/// Prefix length of the IPv6 network that counts as one client, in bits.
const NETWORK_BITS: u32 = 64;

/// Returns the key by which limits count clients: the address itself for IPv4, the first address of
/// its /64 for IPv6, because one machine usually controls a whole /64.
pub fn network_of(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) if !address.is_loopback() => {
            let network = u128::from(address) >> NETWORK_BITS << NETWORK_BITS;
            IpAddr::V6(Ipv6Addr::from(network))
        }
        address @ (IpAddr::V4(_) | IpAddr::V6(_)) => address,
    }
}

/// Error of parsing a [`Network`]. Contains the first 80 characters of the text.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no address or network: write it like `192.0.2.7`, `10.0.0.0/8` or `fd00::/8`")]
pub struct InvalidNetwork(String);

/// An IP network in CIDR notation, or a single address (prefix length 32 or 128).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct Network {
    address: IpAddr,
    bits: u32,
}

impl Network {
    /// Returns whether `address` belongs to this network. An IPv4-mapped IPv6 address counts as
    /// IPv4.
    pub fn contains(&self, address: IpAddr) -> bool {
        let host_bits = |all: u32| all - self.bits;
        match (self.address, address.to_canonical()) {
            (IpAddr::V4(network), IpAddr::V4(address)) => {
                let differ = u32::from(network) ^ u32::from(address);
                differ.checked_shr(host_bits(u32::BITS)).unwrap_or(0) == 0
            }
            (IpAddr::V6(network), IpAddr::V6(address)) => {
                let differ = u128::from(network) ^ u128::from(address);
                differ.checked_shr(host_bits(u128::BITS)).unwrap_or(0) == 0
            }
            (IpAddr::V4(_), IpAddr::V6(_)) | (IpAddr::V6(_), IpAddr::V4(_)) => false,
        }
    }
}

impl fmt::Display for Network {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}/{}", self.address, self.bits)
    }
}

impl FromStr for Network {
    type Err = InvalidNetwork;

    fn from_str(text: &str) -> Result<Self, InvalidNetwork> {
        let invalid = || InvalidNetwork(text.chars().take(80).collect());
        let (address, bits) = match text.split_once('/') {
            Some((address, bits)) => (address, Some(bits)),
            None => (text, None),
        };
        let address: IpAddr = address.parse().map_err(|_error| invalid())?;
        let most = if address.is_ipv4() {
            u32::BITS
        } else {
            u128::BITS
        };
        let bits = bits.map_or(Ok(most), |bits| bits.parse().map_err(|_error| invalid()))?;
        if bits > most || address != address.to_canonical() {
            return Err(invalid());
        }
        Ok(Self { address, bits })
    }
}

impl TryFrom<String> for Network {
    type Error = InvalidNetwork;

    fn try_from(text: String) -> Result<Self, InvalidNetwork> {
        text.parse()
    }
}

/// Networks of the proxies whose `X-Forwarded-For` entries are trusted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TrustedProxies(Vec<Network>);

impl TrustedProxies {
    /// Creates the set of trusted proxies from their networks.
    pub fn new(networks: Vec<Network>) -> Self {
        Self(networks)
    }

    /// Returns whether `address` belongs to a trusted proxy.
    pub fn contains(&self, address: IpAddr) -> bool {
        self.0.iter().any(|network| network.contains(address))
    }

    /// Returns the address of the client that sent a request. `peer` is the address of the
    /// connection, `forwarded` the values of the `X-Forwarded-For` headers in their order.
    ///
    /// Reading stops at an entry that is no address, because proxies append only addresses.
    pub fn client<'text>(
        &self,
        peer: IpAddr,
        forwarded: impl DoubleEndedIterator<Item = &'text str>,
    ) -> IpAddr {
        let mut client = peer.to_canonical();
        let entries = forwarded.rev().flat_map(|value| value.rsplit(','));
        for entry in entries.take(HOPS_MAX) {
            if !self.contains(client) {
                break;
            }
            match entry_address(entry.trim()) {
                Some(address) => client = address,
                None => break,
            }
        }
        client
    }
}

/// Parses an entry of `X-Forwarded-For`, with or without a port; `None` if it is no address.
fn entry_address(entry: &str) -> Option<IpAddr> {
    let address = entry.parse().ok();
    let with_port = || {
        let address: std::net::SocketAddr = entry.parse().ok()?;
        Some(address.ip())
    };
    let in_brackets = || entry.strip_prefix('[')?.strip_suffix(']')?.parse().ok();
    let address: IpAddr = address.or_else(with_port).or_else(in_brackets)?;
    Some(address.to_canonical())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn a_network_holds_what_begins_like_it() {
        for (network, inside, outside) in [
            ("10.0.0.0/8", "10.255.0.1", "11.0.0.1"),
            ("192.0.2.7", "192.0.2.7", "192.0.2.8"),
            ("192.0.2.7", "::ffff:192.0.2.7", "::1"),
            ("fd00::/8", "fdff::1", "fe00::1"),
            ("::1", "::1", "::2"),
        ] {
            let network: Network = network.parse().unwrap();
            assert!(network.contains(address(inside)), "{network} {inside}");
            assert!(!network.contains(address(outside)), "{network} {outside}");
        }
        let all: Network = "0.0.0.0/0".parse().unwrap();
        assert!(all.contains(address("203.0.113.9")) && !all.contains(address("::2")));
        for wrong in [
            "",
            "10.0.0.0/33",
            "10.0.0/8",
            "::/129",
            "a",
            "::ffff:1.2.3.4",
            "1.2.3.4/-1",
        ] {
            assert!(wrong.parse::<Network>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn only_what_a_trusted_proxy_appended_counts() {
        let networks = ["127.0.0.1", "10.0.0.0/8"].map(|text| text.parse().unwrap());
        let proxies = TrustedProxies::new(networks.into());
        let client = |peer: &str, forwarded: &[&str]| {
            proxies
                .client(address(peer), forwarded.iter().copied())
                .to_string()
        };
        assert_eq!(client("127.0.0.1", &[]), "127.0.0.1");
        assert_eq!(client("127.0.0.1", &["203.0.113.9"]), "203.0.113.9");
        // The client sent the first entry itself.
        assert_eq!(
            client("127.0.0.1", &["192.0.2.1, 203.0.113.9"]),
            "203.0.113.9"
        );
        assert_eq!(
            client("127.0.0.1", &["192.0.2.1", "203.0.113.9"]),
            "203.0.113.9"
        );
        assert_eq!(
            client("127.0.0.1", &["203.0.113.9, 10.0.0.2"]),
            "203.0.113.9"
        );
        assert_eq!(client("127.0.0.1", &["x, 10.0.0.2"]), "10.0.0.2");
        assert_eq!(client("127.0.0.1", &["[2001:db8::1]:443"]), "2001:db8::1");
        assert_eq!(client("127.0.0.1", &["203.0.113.9:5000"]), "203.0.113.9");
        // The header of a peer that is no trusted proxy is ignored.
        assert_eq!(client("203.0.113.9", &["192.0.2.1"]), "203.0.113.9");
        let many = vec!["10.0.0.2"; 100].join(",");
        assert_eq!(client("127.0.0.1", &[&many]), "10.0.0.2");
    }

    #[test]
    fn one_machine_has_a_whole_network_of_ipv6_and_one_address_of_ipv4() {
        let network = |text| network_of(address(text)).to_string();
        assert_eq!(network("2001:db8::1"), network("2001:db8::ffff:1"));
        assert_ne!(network("2001:db8::1"), network("2001:db8:0:1::1"));
        assert_eq!(network("::ffff:192.0.2.1"), "192.0.2.1");
        assert_eq!(network("::1"), "::1");
    }
}
