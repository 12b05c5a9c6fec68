//! `[oidc]`: sign-in of people at an OpenID provider, and the rights of their groups.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::PathBuf;

use serde::Deserialize;
use tread_api::identity::Role;
use tread_api::rights::{Grant, InvalidScope, Right, Rights, Scope};

use super::ConfigError;
use crate::identity::origin::{Names, Origin};

/// Maximum number of configured groups; more prevent the start.
pub const GROUPS_MAX: usize = 200;
/// Maximum number of requested scopes; more prevent the start.
const SCOPES_MAX: usize = 30;
/// Maximum length of the name of a group, scope or claim, in characters.
const TEXT_MAX: usize = 255;
/// Maximum length of the label, in characters.
const LABEL_MAX: usize = 60;
/// Range of the maximum duration of a session, in hours.
pub const SESSION_HOURS_RANGE: RangeInclusive<u32> = 1..=12;
/// Route to which the provider redirects browsers after the sign-in.
pub const CALLBACK: &str = "/v1/sign-in/oidc/callback";
/// Scope that OpenID Connect requires.
const OPENID: &str = "openid";

/// `[oidc]`: sign-in of people at an OpenID provider.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OidcConfig {
    /// Issuer identifier of the provider, a URL: `https`, or `http` with a loopback host.
    pub issuer: String,
    /// Client identifier of this server at the provider.
    pub client_id: String,
    /// File with the client secret, readable by the server's user only; `None` for a public client,
    /// which uses PKCE alone.
    pub client_secret_file: Option<PathBuf>,
    /// Origin under which browsers reach this server. The provider redirects them to
    /// `<public_url>/v1/sign-in/oidc/callback`.
    pub public_url: Origin,
    /// Requested scopes, which must include `openid`.
    #[serde(default = "scopes")]
    pub scopes: Vec<String>,
    /// Claim with a person's groups: its name, or a dotted path such as `realm_access.roles`.
    #[serde(default = "groups_claim")]
    pub groups_claim: String,
    /// Claim with a person's display name; when absent, `preferred_username`, then `email`, then
    /// `sub`.
    pub name_claim: Option<String>,
    /// Name of the provider on the sign-in page: `Sign in with <label>`.
    #[serde(default = "label")]
    pub label: String,
    /// File with the CA certificates to trust for the provider, PEM; the machine's when absent.
    pub ca: Option<PathBuf>,
    /// Maximum duration of a session in hours, within [`SESSION_HOURS_RANGE`].
    #[serde(default = "session_hours")]
    pub session_hours: u32,
    /// Rights by group. A person in none of these groups is refused.
    pub groups: BTreeMap<String, GroupConfig>,
}

/// `[oidc.groups.NAME]`: rights of a group; needs either `role` or `rights`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroupConfig {
    /// Role of the group's members.
    pub role: Option<Role>,
    /// Rights of the group's members, instead of a role.
    pub rights: Option<Vec<Right>>,
    /// Scope of the rights, a list of `SITE` or `SITE/ROBOT`; everywhere when absent.
    pub sites: Option<Vec<String>>,
}

fn scopes() -> Vec<String> {
    [OPENID, "profile", "email", "groups"]
        .map(str::to_owned)
        .into()
}

fn groups_claim() -> String {
    "groups".to_owned()
}

fn label() -> String {
    "OpenID Connect".to_owned()
}

const fn session_hours() -> u32 {
    *SESSION_HOURS_RANGE.end()
}

/// Error of the section `[oidc]`.
#[derive(Debug, thiserror::Error)]
pub enum OidcConfigError {
    /// A value is empty, too long, or has characters that are not allowed.
    #[error("`oidc.{key}` cannot be {value:?}: {cause}")]
    Text {
        /// Key within `[oidc]`.
        key: &'static str,
        /// Configured value.
        value: String,
        /// Requirement that is not met.
        cause: String,
    },
    /// A URL would send secrets over the network without TLS.
    #[error(
        "`oidc.{key}` is `{value}`: it must be `https`, or `http` with a name of this machine's own"
    )]
    ClearText {
        /// Key within `[oidc]`.
        key: &'static str,
        /// Configured value.
        value: String,
    },
    /// `public_url` is `https`, but this server is reached by `http`, for which it sets its
    /// cookies.
    #[error(
        "`oidc.public_url` is `{0}`, and this server has neither `[tls]` nor `web.behind_https`"
    )]
    NoTls(Origin),
    /// `public_url` is `http`, but this server is reached by `https`, for which it sets its
    /// cookies.
    #[error("`oidc.public_url` is `{0}`, and this server is reached by `https`")]
    NotTls(Origin),
    /// The host of `public_url` is not among the names of this server.
    #[error("`oidc.public_url` is `{0}`, and its name is not one of `web.hosts`")]
    UnknownHost(Origin),
    /// The scope `openid` is missing.
    #[error("`oidc.scopes` must have `openid`")]
    NoOpenid,
    /// No group is configured, or more than [`GROUPS_MAX`].
    #[error(
        "`oidc.groups` must give rights to 1 to {GROUPS_MAX} groups, as in `[oidc.groups.NAME]`"
    )]
    Groups,
    /// A group, the value, has neither role nor rights, or both.
    #[error("`oidc.groups.{0}` needs either a `role` or `rights`, at least one")]
    Rights(String),
    /// The `sites` of a group are invalid.
    #[error("`oidc.groups.{group}.sites` cannot be taken: {cause}")]
    Sites {
        /// Name of the group.
        group: String,
        /// Cause of the failure.
        cause: InvalidScope,
    },
}

impl OidcConfig {
    /// Returns the redirect URI, to which the provider redirects browsers.
    pub fn redirect_uri(&self) -> String {
        format!("{}{}", self.public_url, CALLBACK)
    }

    /// Returns the grant of each group.
    ///
    /// # Errors
    /// [`OidcConfigError::Rights`] if a group has no rights, [`OidcConfigError::Sites`] if its
    /// scope is invalid.
    pub fn grants(&self) -> Result<BTreeMap<String, Grant>, OidcConfigError> {
        let grants = self.groups.iter().map(|(name, group)| {
            let rights: Rights = match (group.role, &group.rights) {
                (Some(role), None) => role.into(),
                (None, Some(rights)) if !rights.is_empty() => rights.iter().copied().collect(),
                (Some(_) | None, _) => return Err(OidcConfigError::Rights(name.clone())),
            };
            let sites = match &group.sites {
                None => Ok(Scope::EVERYWHERE),
                Some(places) => Scope::from_names(places.iter().map(String::as_str)),
            };
            let sites = sites.map_err(|cause| OidcConfigError::Sites {
                group: name.clone(),
                cause,
            })?;
            Ok((name.clone(), Grant { rights, sites }))
        });
        grants.collect()
    }

    pub(super) fn check(&self, names: &Names) -> Result<(), ConfigError> {
        self.check_texts()?;
        self.check_addresses(names)?;
        if !self.scopes.iter().any(|scope| scope == OPENID) {
            return Err(OidcConfigError::NoOpenid.into());
        }
        if !(1..=GROUPS_MAX).contains(&self.groups.len()) {
            return Err(OidcConfigError::Groups.into());
        }
        self.grants()?;
        if !SESSION_HOURS_RANGE.contains(&self.session_hours) {
            return Err(ConfigError::OutOfRange {
                key: "oidc.session_hours",
                range: "1 to 12",
                value: self.session_hours.into(),
            });
        }
        Ok(())
    }

    fn check_texts(&self) -> Result<(), OidcConfigError> {
        let scopes = self.scopes.iter().take(SCOPES_MAX + 1);
        let scopes = scopes.map(|scope| ("scopes", scope, TEXT_MAX));
        let groups = self.groups.keys().map(|name| ("groups", name, TEXT_MAX));
        let others = [
            ("client_id", Some(&self.client_id), TEXT_MAX),
            ("groups_claim", Some(&self.groups_claim), TEXT_MAX),
            ("name_claim", self.name_claim.as_ref(), TEXT_MAX),
            ("label", Some(&self.label), LABEL_MAX),
        ];
        let others = others
            .into_iter()
            .filter_map(|(key, text, length_max)| Some((key, text?, length_max)));
        for (key, text, length_max) in scopes.chain(groups).chain(others) {
            let wrong = |cause: String| OidcConfigError::Text {
                key,
                value: text.chars().take(TEXT_MAX).collect(),
                cause,
            };
            tread_api::text::line(text, length_max).map_err(|cause| wrong(cause.to_string()))?;
            if key == "scopes" && !text.bytes().all(|byte| byte.is_ascii_graphic()) {
                return Err(wrong("a scope is one word of ASCII".to_owned()));
            }
        }
        if self.scopes.len() > SCOPES_MAX {
            return Err(OidcConfigError::Text {
                key: "scopes",
                value: self.scopes.len().to_string(),
                cause: format!("at most {SCOPES_MAX} scopes can be asked for"),
            });
        }
        Ok(())
    }

    fn check_addresses(&self, names: &Names) -> Result<(), OidcConfigError> {
        let url = |key, text: &str| {
            let wrong = |cause: String| OidcConfigError::Text {
                key,
                value: text.chars().take(TEXT_MAX).collect(),
                cause,
            };
            let url = reqwest::Url::parse(text).map_err(|error| wrong(error.to_string()))?;
            if url.query().is_some() || url.fragment().is_some() || url.host().is_none() {
                return Err(wrong(
                    "write it like `https://login.example.org/realm`".to_owned(),
                ));
            }
            let name = url.host_str().unwrap_or_default();
            let address = name.trim_matches(['[', ']']).parse::<std::net::IpAddr>();
            let is_here = name == "localhost" || address.is_ok_and(|address| address.is_loopback());
            if url.scheme() == "https" || (url.scheme() == "http" && is_here) {
                return Ok(url);
            }
            let value = text.to_owned();
            Err(OidcConfigError::ClearText { key, value })
        };
        url("issuer", &self.issuer)?;
        let public = url("public_url", self.public_url.as_str())?;
        match (public.scheme(), names.is_tls) {
            ("https", false) => return Err(OidcConfigError::NoTls(self.public_url.clone())),
            ("http", true) => return Err(OidcConfigError::NotTls(self.public_url.clone())),
            (_, _) => {}
        }
        if !names.knows(public.host_str().unwrap_or_default()) {
            return Err(OidcConfigError::UnknownHost(self.public_url.clone()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::load;
    use super::*;

    const LEAST: &str = "[oidc]\nissuer = \"https://login.test/realms/main\"\nclient_id = \"tread\"\n\
        public_url = \"http://127.0.0.1:8420\"\n";
    const GROUP: &str = "[oidc.groups.all]\nrole = \"viewer\"\n";

    fn oidc(text: &str) -> OidcConfig {
        load(text).unwrap().oidc.unwrap()
    }

    #[test]
    fn the_least_configuration_has_what_most_providers_want() {
        let oidc = oidc(&format!("{LEAST}{GROUP}"));
        assert_eq!(oidc.scopes, ["openid", "profile", "email", "groups"]);
        assert_eq!(
            (oidc.groups_claim.as_str(), oidc.session_hours),
            ("groups", 12)
        );
        assert_eq!(
            oidc.redirect_uri(),
            "http://127.0.0.1:8420/v1/sign-in/oidc/callback"
        );
        let viewer = &oidc.grants().unwrap()["all"];
        assert!(viewer.sites.is_everywhere() && viewer.rights.only_watches());
    }

    #[test]
    fn a_group_gives_a_role_or_rights_everywhere_or_for_some_places() {
        let text = "[oidc.groups.\"night shift\"]\nrights = [\"drive\", \"clear_stop\"]\n\
            sites = [\"yard\", \"park/rover-1\"]\n";
        let grants = oidc(&format!("{LEAST}{text}")).grants().unwrap();
        let grant = &grants["night shift"];
        assert_eq!(grant.rights.to_string(), "stop, read, drive, clear_stop");
        assert_eq!(grant.sites.to_string(), "park/rover-1, yard");
    }

    #[test]
    fn what_cannot_be_is_said_at_the_start() {
        let tls = "[tls]\ncertificate = \"c.pem\"\nkey = \"k.pem\"\n";
        let with = |old: &str, new: &str| {
            let text = format!("{LEAST}{GROUP}").replacen(old, new, 1);
            assert!(text.contains(new), "{new}");
            text
        };
        let more = |line: &str| format!("{LEAST}{line}\n{GROUP}");
        for (text, said) in [
            (LEAST.to_owned(), "groups"),
            (format!("{LEAST}[oidc.groups]\n"), "1 to 200 groups"),
            (with("role = \"viewer\"", ""), "either a `role` or `rights`"),
            (with("role = \"viewer\"", "rights = []"), "either a `role`"),
            (
                with(
                    "role = \"viewer\"",
                    "role = \"viewer\"\nrights = [\"read\"]",
                ),
                "either a `role`",
            ),
            (with("\"viewer\"", "\"boss\""), "boss"),
            (with("role", "sites = []\nrole"), "name at least one site"),
            (with("role", "sites = [\"Y\"]\nrole"), "`SITE/ROBOT`"),
            (with("https://login", "http://login"), "must be `https`"),
            (with("https://login", "login"), "oidc.issuer"),
            (with("/realms/main", "?a=b"), "oidc.issuer"),
            (with("127.0.0.1:8420\"", "tread.test\""), "must be `https`"),
            (
                with("http://127.0.0.1", "https://127.0.0.1"),
                "behind_https",
            ),
            (format!("{LEAST}{GROUP}{tls}"), "reached by `https`"),
            (
                format!(
                    "{}{tls}",
                    with("http://127.0.0.1:8420", "https://foreign.test")
                ),
                "web.hosts",
            ),
            (with("\"tread\"", "\"\""), "oidc.client_id"),
            (more("label = \"a\\u202eb\""), "U+202E"),
            (more("scopes = [\"profile\"]"), "must have `openid`"),
            (more("scopes = [\"openid\", \"a b\"]"), "one word"),
            (more("session_hours = 13"), "oidc.session_hours"),
            (more("session_hours = 0"), "oidc.session_hours"),
            (more("secret = \"s\""), "line"),
        ] {
            let error = load(&text).map(|_| ()).unwrap_err().to_string();
            assert!(error.contains(said), "{text}: {error}");
        }
    }
}
