//! Which URLs and addresses a webhook may have.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use reqwest::Url;
use tread_api::webhook::WEBHOOK_URL_MAX;

use crate::config::webhooks::WebhooksConfig;
use crate::identity::origin::Origin;

/// Networks of IPv4 that are not public, with the length of their prefix: this network, private,
/// shared (CGNAT), loopback, link-local (with the metadata services of clouds), special purposes,
/// documentation, 6to4 relays, benchmarks, multicast and reserved.
const NOT_PUBLIC_V4: [(Ipv4Addr, u32); 15] = [
    (Ipv4Addr::UNSPECIFIED, 8),
    (Ipv4Addr::new(10, 0, 0, 0), 8),
    (Ipv4Addr::new(100, 64, 0, 0), 10),
    (Ipv4Addr::new(127, 0, 0, 0), 8),
    (Ipv4Addr::new(169, 254, 0, 0), 16),
    (Ipv4Addr::new(172, 16, 0, 0), 12),
    (Ipv4Addr::new(192, 0, 0, 0), 24),
    (Ipv4Addr::new(192, 0, 2, 0), 24),
    (Ipv4Addr::new(192, 88, 99, 0), 24),
    (Ipv4Addr::new(192, 168, 0, 0), 16),
    (Ipv4Addr::new(198, 18, 0, 0), 15),
    (Ipv4Addr::new(198, 51, 100, 0), 24),
    (Ipv4Addr::new(203, 0, 113, 0), 24),
    (Ipv4Addr::new(224, 0, 0, 0), 4),
    (Ipv4Addr::new(240, 0, 0, 0), 4),
];
/// Address of a cloud's metadata service within a public network.
const METADATA_V4: Ipv4Addr = Ipv4Addr::new(168, 63, 129, 16);
/// Network of IPv6 that holds all public addresses.
const GLOBAL_V6: (Ipv6Addr, u32) = (Ipv6Addr::new(0x2000, 0, 0, 0, 0, 0, 0, 0), 3);
/// Networks within [`GLOBAL_V6`] that are not public: special purposes (with Teredo),
/// documentation, and 6to4, which contains addresses of IPv4.
const NOT_PUBLIC_V6: [(Ipv6Addr, u32); 4] = [
    (Ipv6Addr::new(0x2001, 0, 0, 0, 0, 0, 0, 0), 23),
    (Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 0), 32),
    (Ipv6Addr::new(0x2002, 0, 0, 0, 0, 0, 0, 0), 16),
    (Ipv6Addr::new(0x3fff, 0, 0, 0, 0, 0, 0, 0), 20),
];

/// Returns whether an address is a public one: neither of this machine, nor of a private network,
/// nor of a special purpose. An IPv4-mapped address counts as IPv4.
pub fn is_public(address: IpAddr) -> bool {
    match address.to_canonical() {
        IpAddr::V4(address) => {
            let is_in = |&(network, bits): &(Ipv4Addr, u32)| {
                let differ = u32::from(network) ^ u32::from(address);
                differ >> (u32::BITS - bits) == 0
            };
            address != METADATA_V4 && !NOT_PUBLIC_V4.iter().any(is_in)
        }
        IpAddr::V6(address) => {
            let is_in = |&(network, bits): &(Ipv6Addr, u32)| {
                let differ = u128::from(network) ^ u128::from(address);
                differ >> (u128::BITS - bits) == 0
            };
            is_in(&GLOBAL_V6) && !NOT_PUBLIC_V6.iter().any(is_in)
        }
    }
}

/// Reason why a webhook cannot have a URL.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidUrl {
    /// It is no URL, or has no host.
    #[error("the URL cannot be read: write it like `https://alerts.example.org/tread`")]
    NotUrl,
    /// It is too long.
    #[error("the URL has more than {WEBHOOK_URL_MAX} bytes")]
    TooLong,
    /// Its scheme is `http`, which the configuration does not allow.
    #[error(
        "the URL must be `https`: with `http` everybody on the path reads the alerts; \
         `allow_http = true` under `[webhooks]` in the server's configuration allows it"
    )]
    NotHttps,
    /// It contains a user name or password.
    #[error("the URL must have no user name or password; deliveries are signed instead")]
    UserInfo,
    /// It has a fragment, which is never sent.
    #[error("the URL must have no fragment (`#…`), which is never sent")]
    Fragment,
    /// It names an address that may not be called.
    #[error(
        "the address {0} is not public; `allowed_networks` under `[webhooks]` in the server's \
         configuration allows others"
    )]
    Address(IpAddr),
}

/// Rules of the configuration for URLs and addresses.
#[derive(Debug, Clone, Default)]
pub struct Rules(WebhooksConfig);

impl Rules {
    /// Creates the rules of a configuration.
    pub fn new(config: WebhooksConfig) -> Self {
        Self(config)
    }

    /// Returns the configuration.
    pub(super) fn config(&self) -> &WebhooksConfig {
        &self.0
    }

    /// Returns the absolute link to a path of this server, or the path if its own address is not
    /// configured.
    pub fn link(&self, path: &str) -> String {
        let origin = self.0.public_url.as_ref();
        format!("{}{path}", origin.map_or("", Origin::as_str))
    }

    /// Returns whether an address may be called.
    pub fn allows(&self, address: IpAddr) -> bool {
        let mut networks = self.0.allowed_networks.iter();
        is_public(address) || networks.any(|network| network.contains(address))
    }

    /// Reads the URL of a webhook.
    ///
    /// # Errors
    /// [`InvalidUrl`] if it may not be called, whatever its host name resolves to.
    pub fn read(&self, text: &str) -> Result<Url, InvalidUrl> {
        if text.len() > WEBHOOK_URL_MAX {
            return Err(InvalidUrl::TooLong);
        }
        let url = Url::parse(text).map_err(|_error| InvalidUrl::NotUrl)?;
        match url.scheme() {
            "https" => {}
            "http" if self.0.allow_http => {}
            "http" => return Err(InvalidUrl::NotHttps),
            _ => return Err(InvalidUrl::NotUrl),
        }
        if !url.username().is_empty() || url.password().is_some() {
            return Err(InvalidUrl::UserInfo);
        }
        if url.fragment().is_some() {
            return Err(InvalidUrl::Fragment);
        }
        let host = url.host_str().filter(|host| !host.is_empty());
        match literal(host.ok_or(InvalidUrl::NotUrl)?) {
            Some(address) if !self.allows(address) => Err(InvalidUrl::Address(address)),
            Some(_) | None => Ok(url),
        }
    }
}

/// Returns the address that a URL's host is, if it is one. The parser of URLs has brought every
/// spelling of an address (`0x7f.1`) to its usual form.
pub(super) fn literal(host: &str) -> Option<IpAddr> {
    let inner = host
        .strip_prefix('[')
        .and_then(|host| host.strip_suffix(']'));
    inner.unwrap_or(host).parse().ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn rules(allow_http: bool, networks: &[&str]) -> Rules {
        let networks = networks.iter().map(|network| network.parse().unwrap());
        Rules::new(WebhooksConfig {
            allow_http,
            allowed_networks: networks.collect(),
            ..WebhooksConfig::default()
        })
    }

    #[test]
    fn addresses_of_this_machine_of_private_networks_and_of_special_purposes_are_not_public() {
        for address in [
            "0.0.0.0",
            "10.1.2.3",
            "100.64.0.1",
            "100.127.255.255",
            "127.0.0.1",
            "127.255.0.1",
            "169.254.169.254",
            "172.16.0.1",
            "172.31.255.255",
            "192.0.0.192",
            "192.0.2.1",
            "192.168.1.1",
            "198.19.255.255",
            "198.51.100.7",
            "203.0.113.7",
            "224.0.0.1",
            "239.255.255.250",
            "255.255.255.255",
            "168.63.129.16",
            "::",
            "::1",
            "::ffff:127.0.0.1",
            "::ffff:10.0.0.1",
            "::127.0.0.1",
            "64:ff9b::7f00:1",
            "64:ff9b:1::1",
            "fe80::1",
            "fec0::1",
            "fc00::1",
            "fd00:ec2::254",
            "ff02::1",
            "2001::1",
            "2001:db8::1",
            "2002:7f00:1::1",
            "100::1",
            "3fff::1",
        ] {
            assert!(!is_public(address.parse().unwrap()), "{address}");
        }
        for address in [
            "1.1.1.1",
            "100.63.255.255",
            "100.128.0.0",
            "172.15.0.1",
            "172.32.0.1",
            "192.0.1.1",
            "168.63.129.17",
            "223.255.255.255",
            "::ffff:8.8.8.8",
            "2606:4700::1111",
            "2a00::1",
        ] {
            assert!(is_public(address.parse().unwrap()), "{address}");
        }
    }

    #[test]
    fn a_url_names_no_user_and_no_address_that_is_not_allowed_however_it_is_spelt() {
        let strict = rules(false, &[]);
        for (url, wrong) in [
            ("https://u@alerts.example.org/", InvalidUrl::UserInfo),
            ("https://:p@alerts.example.org/", InvalidUrl::UserInfo),
            ("https://alerts.example.org/#a", InvalidUrl::Fragment),
            ("http://alerts.example.org/", InvalidUrl::NotHttps),
            ("ftp://alerts.example.org/", InvalidUrl::NotUrl),
            ("file:///etc/passwd", InvalidUrl::NotUrl),
            ("alerts.example.org", InvalidUrl::NotUrl),
            ("https://", InvalidUrl::NotUrl),
        ] {
            assert_eq!(strict.read(url).unwrap_err(), wrong, "{url}");
        }
        for url in [
            "https://127.0.0.1/",
            "https://127.1/",
            "https://2130706433/",
            "https://0x7f.0.0.1/",
            "https://0177.0.0.1/",
            "https://[::1]/",
            "https://[::ffff:127.0.0.1]/",
            "https://[::ffff:7f00:1]/",
            "https://169.254.169.254/latest",
            "https://0/",
            "https://[fd00::1]:8443/",
            "https://%31%32%37.0.0.1/",
            "https://１２７.0.0.1/",
        ] {
            let wrong = strict.read(url).unwrap_err();
            assert!(matches!(wrong, InvalidUrl::Address(_)), "{url}: {wrong}");
        }
        let long = format!("https://alerts.example.org/{}", "a".repeat(WEBHOOK_URL_MAX));
        assert_eq!(strict.read(&long).unwrap_err(), InvalidUrl::TooLong);
        assert!(strict.read("https://alerts.example.org:8443/a?b=c").is_ok());
        assert!(strict.read("https://1.1.1.1/").is_ok());
        let loose = rules(true, &["127.0.0.0/8", "fd00::/8"]);
        for url in [
            "http://127.0.0.1:9/",
            "https://[fd00::1]/",
            "http://[::ffff:127.0.0.1]/",
        ] {
            assert!(loose.read(url).is_ok(), "{url}");
        }
        assert!(loose.read("http://10.0.0.1/").is_err());
    }

    #[test]
    fn a_link_is_absolute_where_the_address_of_this_server_is_configured() {
        assert_eq!(rules(false, &[]).link("/v1/alerts/7"), "/v1/alerts/7");
        let config = WebhooksConfig {
            public_url: Some("https://tread.example.org".parse().unwrap()),
            ..WebhooksConfig::default()
        };
        let link = Rules::new(config).link("/v1/alerts/7");
        assert_eq!(link, "https://tread.example.org/v1/alerts/7");
    }

    proptest! {
        #[test]
        fn whatever_a_url_is_a_literal_address_in_it_is_allowed(text in "https?://\\PC{0,60}") {
            if let Ok(url) = rules(true, &[]).read(&text) {
                let address = literal(url.host_str().unwrap());
                prop_assert!(address.is_none_or(is_public), "{url}");
            }
        }

        #[test]
        fn a_mapped_address_is_judged_as_what_it_maps(bits: u32) {
            let address = Ipv4Addr::from(bits);
            let mapped = IpAddr::V6(address.to_ipv6_mapped());
            prop_assert_eq!(is_public(mapped), is_public(IpAddr::V4(address)));
        }
    }
}
