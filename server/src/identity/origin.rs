//! Checks the `Host`, `Origin` and `Sec-Fetch-Site` headers against this server's own names.
//!
//! * The **`Host`** of a request must be a name of this server. This prevents DNS rebinding: a
//!   foreign page whose domain resolves to this server sends its own name and is refused.
//! * Browsers attach the session **cookie** automatically, so a change that is authenticated by
//!   cookie is accepted only from this server's own page (protection against CSRF): by
//!   `Sec-Fetch-Site`, or by `Origin` if that is missing.
//! * Browsers do not apply the same-origin policy to **`WebSocket`s**: their `Origin` must be this
//!   server's own or one of the configured origins.

use std::fmt;
use std::net::IpAddr;
use std::str::FromStr;

use serde::Deserialize;

/// Error of parsing an [`Origin`]. Contains the first 80 characters of the text.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no origin: write it like `https://dashboard.example.org` or with `:8443`")]
pub struct InvalidOrigin(String);

/// Origin of a web page (RFC 6454): scheme, host and port, in lower case, without a default port.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Deserialize)]
#[serde(try_from = "String")]
pub struct Origin(String);

impl Origin {
    /// Returns the origin in the form that browsers send in the `Origin` header.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Returns its host: a name, or an address, IPv6 in brackets.
    pub fn host(&self) -> &str {
        let (_, authority) = self.0.split_once("://").unwrap_or_default();
        split_host(authority).map_or(authority, |(host, _)| host)
    }

    /// Returns whether the connection to this origin cannot be read by others: it uses TLS or the
    /// loopback.
    pub fn is_safe(&self) -> bool {
        let is_here = match address_of(self.host()) {
            Some(address) => address.is_loopback(),
            None => self.host() == "localhost",
        };
        self.0.starts_with("https://") || is_here
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

impl FromStr for Origin {
    type Err = InvalidOrigin;

    fn from_str(text: &str) -> Result<Self, InvalidOrigin> {
        let invalid = || InvalidOrigin(text.chars().take(80).collect());
        let lower = text.to_ascii_lowercase();
        let (scheme, authority) = lower.split_once("://").ok_or_else(invalid)?;
        if !matches!(scheme, "http" | "https") {
            return Err(invalid());
        }
        let (name, port) = split_host(authority).ok_or_else(invalid)?;
        let default = if scheme == "https" { "443" } else { "80" };
        Ok(Self(match port {
            Some(port) if port != default => format!("{scheme}://{name}:{port}"),
            _ => format!("{scheme}://{name}"),
        }))
    }
}

impl TryFrom<String> for Origin {
    type Error = InvalidOrigin;

    fn try_from(text: String) -> Result<Self, InvalidOrigin> {
        text.parse()
    }
}

/// Splits a `Host` header into host and optional port; `None` if it is malformed. An IPv6 address
/// keeps its brackets.
fn split_host(authority: &str) -> Option<(&str, Option<&str>)> {
    let port_at = match authority.rfind(']') {
        Some(end) => authority[end..].find(':').map(|at| end + at),
        None => authority.find(':'),
    };
    let (name, port) = match port_at {
        Some(at) => (&authority[..at], Some(&authority[at + 1..])),
        None => (authority, None),
    };
    let is_name = |name: &str| {
        let allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-');
        !name.is_empty() && name.len() <= 253 && name.bytes().all(allowed)
    };
    let is_port =
        |port: &str| port.bytes().all(|byte| byte.is_ascii_digit()) && port.parse::<u16>().is_ok();
    let named = address_of(name).is_some() || is_name(name);
    (named && port.is_none_or(is_port)).then_some((name, port))
}

/// Parses a host as an IP address, IPv6 in brackets; `None` if it is a domain name.
fn address_of(name: &str) -> Option<IpAddr> {
    match name.strip_prefix('[') {
        Some(rest) => rest.strip_suffix(']')?.parse().ok().map(IpAddr::V6),
        None => name.parse().ok().map(IpAddr::V4),
    }
}

/// Host names of this server, and the foreign origins that it accepts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Names {
    /// Accepted host names in addition to `localhost` and all IP addresses.
    pub hosts: Vec<String>,
    /// Origins of foreign pages that may send requests with a token (CORS, `WebSocket`).
    pub allowed_origins: Vec<Origin>,
    /// Whether browsers reach this server by `https`, directly or through a proxy.
    pub is_tls: bool,
}

/// Headers of a request from which its origin is determined; `None` for a missing header.
#[derive(Debug, Clone, Copy, Default)]
pub struct Provenance<'request> {
    /// The `Host` header.
    pub host: Option<&'request str>,
    /// The `Origin` header.
    pub origin: Option<&'request str>,
    /// The `Sec-Fetch-Site` header.
    pub fetch_site: Option<&'request str>,
}

impl Provenance<'_> {
    /// Returns whether no foreign page caused this request: `Sec-Fetch-Site` is `same-origin` or
    /// `none` (address typed by the user), or missing, as in requests of programs that are no
    /// browsers.
    pub fn is_not_cross_site(&self) -> bool {
        matches!(self.fetch_site, None | Some("same-origin" | "none"))
    }

    /// Returns whether the `Host` header names the host and port of `origin`. The scheme is not
    /// compared, because a proxy may terminate TLS.
    pub fn is_at(&self, origin: &Origin) -> bool {
        let scheme = origin.0.split_once("://").map_or("", |(scheme, _)| scheme);
        let named = self.host.map(|host| format!("{scheme}://{host}").parse());
        named.is_some_and(|named| named.as_ref() == Ok(origin))
    }
}

impl Names {
    /// Returns whether a `Host` header names this server: an IP address, `localhost` or a
    /// configured name. Any IP address is accepted, because DNS rebinding needs a domain name.
    pub fn knows(&self, host: &str) -> bool {
        let Some((name, _port)) = split_host(host) else {
            return false;
        };
        let is_configured = |known: &String| {
            known
                .trim_end_matches('.')
                .eq_ignore_ascii_case(name.trim_end_matches('.'))
        };
        address_of(name).is_some()
            || name.eq_ignore_ascii_case("localhost")
            || self.hosts.iter().any(is_configured)
    }

    /// Returns whether the headers show that this server's own page sent the request.
    ///
    /// A request without `Origin` and `Sec-Fetch-Site` gives `false`: browsers send `Origin` with
    /// every request that changes something.
    pub fn is_own_page(&self, request: &Provenance<'_>) -> bool {
        match request.fetch_site {
            Some("same-origin") => request.origin.is_none_or(|_| self.is_own_origin(request)),
            Some(_) => false,
            None => request.origin.is_some() && self.is_own_origin(request),
        }
    }

    fn is_own_origin(&self, request: &Provenance<'_>) -> bool {
        let (Some(origin), Some(host)) = (request.origin, request.host) else {
            return false;
        };
        let scheme = if self.is_tls { "https" } else { "http" };
        let own = format!("{scheme}://{host}").parse::<Origin>();
        let own_by_proxy = format!("https://{host}").parse::<Origin>();
        let origin = origin.parse::<Origin>();
        // Behind a proxy that terminates TLS the page is `https` while this server serves `http`.
        origin.is_ok() && (origin == own || origin == own_by_proxy)
    }

    /// Returns whether a request may open a `WebSocket`: it has this server's own origin, a
    /// configured one, or no `Origin` header, as in requests of programs that are no browsers.
    pub fn may_open_socket(&self, request: &Provenance<'_>) -> bool {
        let Some(origin) = request.origin else {
            return true;
        };
        self.is_own_origin(request)
            || origin
                .parse()
                .is_ok_and(|origin| self.allowed_origins.contains(&origin))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Names {
        Names {
            hosts: vec!["Tread.Example.org".to_owned()],
            allowed_origins: vec!["https://dash.example.org".parse().unwrap()],
            is_tls: false,
        }
    }

    fn request<'text>(
        host: &'text str,
        origin: Option<&'text str>,
        fetch_site: Option<&'text str>,
    ) -> Provenance<'text> {
        Provenance {
            host: Some(host),
            origin,
            fetch_site,
        }
    }

    #[test]
    fn addresses_localhost_and_configured_names_are_known_and_no_others() {
        for known in [
            "127.0.0.1:8420",
            "192.0.2.7",
            "[::1]:8420",
            "[2001:db8::1]",
            "localhost:1",
            "LOCALHOST",
            "tread.example.org",
            "tread.example.org.:443",
        ] {
            assert!(names().knows(known), "{known}");
        }
        for foreign in [
            "",
            "evil.example",
            "tread.example.org.evil.example",
            "127.0.0.1.evil.example",
            "localhost.evil.example:8420",
            "127.0.0.1:8420:1",
            "127.0.0.1:99999",
            "a@127.0.0.1",
            "[::1",
            "::1",
            "127.0.0.1/x",
        ] {
            assert!(!names().knows(foreign), "{foreign}");
        }
    }

    #[test]
    fn only_the_servers_own_page_may_change_something_by_cookie() {
        let own = |origin, site| names().is_own_page(&request("127.0.0.1:8420", origin, site));
        let (ours, theirs) = (Some("http://127.0.0.1:8420"), Some("http://127.0.0.1:9000"));
        assert!(own(ours, Some("same-origin")));
        assert!(own(None, Some("same-origin")));
        assert!(own(ours, None));
        assert!(own(Some("https://127.0.0.1:8420"), None), "behind a proxy");
        for site in ["cross-site", "same-site", "none", "Same-Origin", ""] {
            assert!(!own(ours, Some(site)), "{site}");
        }
        assert!(!own(None, None));
        for site in [None, Some("same-origin")] {
            assert!(!own(theirs, site));
            assert!(!own(Some("null"), site));
            assert!(!own(Some("http://127.0.0.1:8420.evil.example"), site));
        }
    }

    #[test]
    fn a_socket_is_for_own_and_allowed_pages_and_for_programs() {
        let may = |origin| names().may_open_socket(&request("tread.example.org", origin, None));
        assert!(may(None));
        assert!(may(Some("http://tread.example.org")));
        assert!(may(Some("https://dash.example.org")));
        assert!(may(Some("https://dash.example.org:443")));
        for foreign in [
            "null",
            "https://evil.example",
            "http://dash.example.org",
            "",
        ] {
            assert!(!may(Some(foreign)), "{foreign}");
        }
    }

    #[test]
    fn a_request_is_at_the_host_and_port_that_it_names() {
        let is_at = |host, origin: &str| {
            let request = Provenance {
                host,
                ..Provenance::default()
            };
            request.is_at(&origin.parse().unwrap())
        };
        for own in ["tread.example.org", "Tread.Example.org:443"] {
            assert!(is_at(Some(own), "https://tread.example.org"), "{own}");
        }
        assert!(is_at(Some("[::1]:8420"), "http://[::1]:8420"));
        for other in [
            "tread.example.org:8420",
            "example.org",
            "127.0.0.1",
            "",
            "a b",
        ] {
            assert!(!is_at(Some(other), "https://tread.example.org"), "{other}");
        }
        assert!(!is_at(None, "https://tread.example.org"));
    }

    #[test]
    fn an_origin_has_one_spelling_and_no_path() {
        let origin = |text: &str| text.parse::<Origin>().map(|origin| origin.to_string());
        assert_eq!(
            origin("HTTPS://A.example:443"),
            Ok("https://a.example".to_owned())
        );
        assert_eq!(
            origin("http://[::1]:8420"),
            Ok("http://[::1]:8420".to_owned())
        );
        for wrong in [
            "*",
            "a.example",
            "https://a.example/",
            "ftp://a",
            "https://",
            "https://a b",
        ] {
            assert!(origin(wrong).is_err(), "{wrong}");
        }
    }
}
