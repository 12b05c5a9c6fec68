//! Sign-in of people at an OpenID provider, and the rights that their groups give.
//!
//! ```text
//!  browser ─► begin ─► provider ─► browser ─► finish ─► code for ID token ─► groups ─► session
//!               │ cookie                        ▲ cookie            │            │
//!               └──────── kept by the browser ──┘                   ▼            ▼ none is mapped
//!                                                             not believed    refused
//! ```
//!
//! No state of a pending sign-in is kept on the server ([`crate::identity::pending`]). Requests to
//! the provider are made only for browsers in which a sign-in began, and few at a time.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;
use tracing::info;
use tread_api::identity::{OidcSignIn, Person};
use tread_api::ids::{OidcSubject, PersonId};
use tread_api::rights::{Grant, Scope};
use tread_api::text::cleaned;

use super::Credential;
use super::id_tokens::IdTokens;
use crate::app::{App, AppError};
use crate::clock::Clock;
use crate::config::oidc::OidcConfig;
use crate::db;
use crate::db::sessions::{Owner, SessionRow, SignedIn};
use crate::identity::address::network_of;
use crate::identity::claims::{NAME_MAX, groups, shown_name};
use crate::identity::grants::Grants;
use crate::identity::origin::{Origin, Provenance};
use crate::identity::pending::{Pending, PendingKey, Presented, SIGN_IN_RANDOM_BYTES};
use crate::identity::secret::Secret;
use crate::identity::subject::name_of_person;
use crate::oidc::{AuthenticatedPerson, ExchangeError, Provider};

/// Path at which a browser begins a sign-in.
pub const BEGIN: &str = "/v1/sign-in/oidc";
/// Maximum number of codes exchanged with the provider at once.
const EXCHANGES_MAX: usize = 16;
/// Maximum number of codes exchanged at once for one address (a whole /64 of IPv6).
const EXCHANGES_PER_NETWORK_MAX: usize = 4;
/// Maximum time that a code waits for its exchange.
const EXCHANGE_WAIT_MAX: Duration = Duration::from_secs(2);
/// Maximum length of a code, bytes.
const CODE_MAX: usize = 2_048;
/// Maximum length of a host name in the log, characters.
const HOST_SHOWN_MAX: usize = 80;
/// Number of completed sign-ins that are remembered, so that none can be used twice. A provider
/// should accept a code once; this covers one that does not.
const USED_MAX: usize = 4_096;
/// First wait between attempts to reach the provider; it doubles up to a maximum.
const FIND_AGAIN_MIN: Duration = Duration::from_secs(1);
const FIND_AGAIN_MAX: Duration = Duration::from_secs(30);
/// Interval at which the metadata of a known provider are read again.
const METADATA_REFRESH: Duration = Duration::from_hours(1);

/// Reason why a person is not signed in.
#[derive(Debug, thiserror::Error)]
pub enum PersonError {
    /// No provider is configured.
    #[error("people sign in with tokens here: the configuration has no `[oidc]`")]
    NotConfigured,
    /// The provider cannot be reached.
    #[error("the provider cannot be asked now; try again later, or sign in with a token")]
    Unavailable,
    /// Too many people are being signed in at once.
    #[error("too many people are being signed in; try again")]
    Busy,
    /// The sign-in did not begin in this browser, is too old, or was used.
    #[error(
        "this sign-in did not begin in this browser, or began more than 10 minutes ago, or has been \
         used; begin it again"
    )]
    NotBegun,
    /// The provider declined the sign-in.
    #[error("the provider has not signed you in: {0}")]
    Declined(String),
    /// The provider's answer is malformed or failed verification; the reason is only in the log.
    #[error("the provider's answer cannot be used; the server's log says why")]
    NotBelieved,
    /// None of the person's groups has a grant.
    #[error(
        "`{name}` is signed in at the provider, but is in no group that may do anything here; ask \
         whoever runs this server"
    )]
    NoGroup {
        /// The person's name.
        name: String,
        /// The person's identity at the provider.
        person: Box<Person>,
    },
    /// An error of this server.
    #[error(transparent)]
    Failed(#[from] AppError),
}

/// A browser begins a sign-in at a host name other than that of `public_url`.
#[derive(Debug, thiserror::Error)]
#[error(
    "a browser asks for it at `{host}`, and is sent to `public_url`, {home}; if it asked for that, a proxy \
     does not pass the `Host` header on"
)]
struct OtherHost {
    host: String,
    home: Origin,
}

/// Response to a browser that begins a sign-in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignInRedirect {
    /// URL to which the browser is redirected.
    pub location: String,
    /// Cookie of the pending sign-in; `None` if the browser is redirected to the page first.
    pub cookie: Option<String>,
}

/// Query parameters with which the provider redirects a browser back.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Answer {
    /// State of the sign-in.
    pub state: String,
    /// Authorisation code, if the sign-in succeeded.
    pub code: Option<String>,
    /// Error, if it did not.
    pub error: Option<String>,
    /// Issuer (RFC 9207), if the provider sends it.
    pub issuer: Option<String>,
}

/// Sign-in at a provider, as configured.
#[derive(Debug)]
pub struct People {
    provider: Provider,
    /// Public URL of this server, to which the provider redirects browsers.
    home: Origin,
    grants: BTreeMap<String, Grant>,
    groups_claim: String,
    name_claim: Option<String>,
    label: String,
    session_lasts: SignedDuration,
    key: PendingKey,
    turns: Arc<Semaphore>,
    networks: Mutex<HashMap<IpAddr, Arc<Semaphore>>>,
    used: Mutex<CompletedSignIns>,
    pub(super) id_tokens: IdTokens,
    /// Notified when somebody wants to sign in while the provider is not known.
    sign_in_waiting: Notify,
}

/// States of completed sign-ins, with the oldest first in `order`.
#[derive(Debug, Default)]
struct CompletedSignIns {
    states: HashSet<String>,
    order: VecDeque<String>,
}

impl People {
    /// Creates the sign-in at the configured provider, which need not be reachable yet.
    ///
    /// # Errors
    /// A file that the configuration names cannot be used.
    pub fn new(config: &OidcConfig, clock: Clock) -> anyhow::Result<Self> {
        let mut random = [0; SIGN_IN_RANDOM_BYTES];
        getrandom::fill(&mut random).map_err(|error| AppError::NoRandomness(error.to_string()))?;
        Ok(Self {
            provider: Provider::new(config, clock)?,
            home: config.public_url.clone(),
            grants: config.grants()?,
            groups_claim: config.groups_claim.clone(),
            name_claim: config.name_claim.clone(),
            label: config.label.trim().to_owned(),
            session_lasts: SignedDuration::from_hours(config.session_hours.into()),
            key: PendingKey::from_random(&random),
            turns: Arc::new(Semaphore::new(EXCHANGES_MAX)),
            networks: Mutex::default(),
            used: Mutex::default(),
            id_tokens: IdTokens::default(),
            sign_in_waiting: Notify::new(),
        })
    }

    /// Returns the provider's issuer identifier.
    pub(super) fn issuer(&self) -> &str {
        self.provider.issuer()
    }

    /// Returns two lists of groups: those whose grants are within a scope, and all others.
    pub(super) fn groups_by_scope(&self, within: &Scope) -> (Vec<&str>, Vec<&str>) {
        let is_within = |name: &&str| {
            let grant = self
                .grants
                .iter()
                .find(|(known, _)| known.as_str() == *name);
            grant.is_some_and(|(_, grant)| within.includes(&grant.sites))
        };
        let names = self.grants.keys().map(String::as_str);
        names.partition(is_within)
    }

    /// Returns the grants of a person's groups by the present configuration; `None` if there are
    /// none, or if the person signed in at another provider.
    pub(super) fn grants_of(&self, signed_in: &SignedIn) -> Option<Grants> {
        if signed_in.person.issuer != self.issuer() {
            return None;
        }
        let groups = signed_in.groups.iter();
        Grants::of_groups(groups.filter_map(|group| self.grants.get(group)))
    }

    /// Waits for permission to exchange a code; `None` after [`EXCHANGE_WAIT_MAX`]. The number is
    /// limited in all and per address.
    async fn turn(&self, address: IpAddr) -> Option<[OwnedSemaphorePermit; 2]> {
        let own = {
            let mut networks = self.networks.lock().unwrap_or_else(PoisonError::into_inner);
            // Semaphores that nobody holds or awaits are removed.
            networks.retain(|_, turns| Arc::strong_count(turns) > 1);
            let own = networks.entry(network_of(address));
            let new = || Arc::new(Semaphore::new(EXCHANGES_PER_NETWORK_MAX));
            Arc::clone(own.or_insert_with(new))
        };
        let turns = async {
            let own = own.acquire_owned().await.ok()?;
            let all = Arc::clone(&self.turns).acquire_owned().await.ok()?;
            Some([own, all])
        };
        let turns = tokio::time::timeout(EXCHANGE_WAIT_MAX, turns).await;
        turns.ok().flatten()
    }

    /// Returns whether the provider is known; if not, triggers the next attempt to reach it.
    fn is_found(&self) -> bool {
        let is_known = self.provider.is_known();
        if !is_known {
            self.sign_in_waiting.notify_one();
        }
        is_known
    }

    fn is_used(&self, state: &str) -> bool {
        let used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        used.states.contains(state)
    }

    /// Records a completed sign-in; returns false if its state was used before.
    fn consume_state(&self, state: &str) -> bool {
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        if !used.states.insert(state.to_owned()) {
            return false;
        }
        used.order.push_back(state.to_owned());
        while used.order.len() > USED_MAX {
            if let Some(oldest) = used.order.pop_front() {
                used.states.remove(&oldest);
            }
        }
        true
    }

    fn signed_in(&self, authenticated: &AuthenticatedPerson) -> Result<SignedIn, PersonError> {
        let (subject, claims) = (&authenticated.subject, &authenticated.claims);
        let issuer = self.issuer().to_owned();
        let person = Person {
            id: PersonId::of(OidcSubject {
                issuer: &issuer,
                subject,
            }),
            issuer,
            subject: subject.clone(),
        };
        let name = shown_name(claims, self.name_claim.as_deref(), subject);
        let named: HashSet<&str> = groups(claims, &self.groups_claim).into_iter().collect();
        let mapped = self.grants.keys();
        let mapped = mapped.filter(|group| named.contains(group.as_str()));
        let mapped: Vec<String> = mapped.cloned().collect();
        if mapped.is_empty() {
            let person = Box::new(person);
            return Err(PersonError::NoGroup { name, person });
        }
        Ok(SignedIn {
            person,
            name,
            groups: mapped,
        })
    }
}

impl App {
    pub(super) fn people(&self) -> Option<&People> {
        self.identity().people.as_ref()
    }

    /// Returns how people sign in at a provider; `None` if no provider is configured.
    pub fn oidc_sign_in(&self) -> Option<OidcSignIn> {
        let people = self.people()?;
        Some(OidcSignIn {
            label: people.label.clone(),
            path: BEGIN.to_owned(),
            available: people.is_found(),
        })
    }

    /// Returns the credential of a person's session; `None` if its groups have no grant.
    pub(super) fn person_of(&self, kept: SessionRow, checked_at: Duration) -> Option<Credential> {
        let Owner::Person(signed_in) = kept.owner else {
            return None;
        };
        let grants = self.people()?.grants_of(&signed_in)?;
        let session = (kept.id, kept.expires_at);
        let times = (kept.last_used_at, checked_at);
        Some(Credential::of_person(signed_in, grants, session, times))
    }

    /// Begins a sign-in at the provider. The browser is redirected to the page instead, where the
    /// person begins the sign-in:
    ///
    /// * if it uses a host name other than that of `public_url`, since cookies belong to one host
    ///   name;
    /// * if the request comes from a foreign page, which could otherwise replace the present
    ///   session by one of whoever is signed in at the provider.
    ///
    /// # Errors
    /// No provider is configured, or it is not known yet.
    pub fn begin_sign_in(
        &self,
        provenance: &Provenance<'_>,
    ) -> Result<SignInRedirect, PersonError> {
        let people = self.people().ok_or(PersonError::NotConfigured)?;
        let is_at_home = provenance.is_at(&people.home);
        if !is_at_home {
            let error = OtherHost {
                host: cleaned(provenance.host.unwrap_or_default(), HOST_SHOWN_MAX),
                home: people.home.clone(),
            };
            self.log_failure("begin a sign-in", &error);
        }
        if !is_at_home || !provenance.is_not_cross_site() {
            return Ok(SignInRedirect {
                location: format!("{}/", people.home),
                cookie: None,
            });
        }
        let mut random = [0; SIGN_IN_RANDOM_BYTES];
        getrandom::fill(&mut random).map_err(|error| AppError::NoRandomness(error.to_string()))?;
        let pending = Pending::begin(&people.key, &random, self.clock().now());
        let Some(location) = people.provider.sign_in_url(&pending) else {
            people.sign_in_waiting.notify_one();
            self.log_failure("sign people in", &ExchangeError::Unknown);
            return Err(PersonError::Unavailable);
        };
        let cookie = Some(pending.cookie().to_owned());
        Ok(SignInRedirect { location, cookie })
    }

    /// Completes a sign-in when the provider redirects the browser back with its cookie.
    ///
    /// # Errors
    /// [`PersonError`].
    pub async fn finish_sign_in(
        &self,
        address: IpAddr,
        cookie: Option<&str>,
        answer: &Answer,
    ) -> Result<(Arc<Credential>, Secret), PersonError> {
        let people = self.people().ok_or(PersonError::NotConfigured)?;
        let now = self.clock().now();
        let pending = cookie
            .and_then(|cookie| {
                let state = &answer.state;
                Pending::resume(&people.key, Presented { cookie, state }, now)
            })
            .filter(|pending| !people.is_used(&pending.state))
            .ok_or(PersonError::NotBegun)?;
        if let Some(issuer) = &answer.issuer
            && issuer != people.issuer()
        {
            return Err(PersonError::NotBegun);
        }
        let code = match (&answer.code, &answer.error) {
            (Some(code), None) if code.len() <= CODE_MAX => code,
            (_, Some(error)) => return Err(PersonError::Declined(cleaned(error, NAME_MAX))),
            (_, None) => return Err(PersonError::NotBegun),
        };
        let turn = people.turn(address).await.ok_or(PersonError::Busy)?;
        let authenticated = people.provider.exchange(code, &pending).await;
        drop(turn);
        let authenticated = authenticated.map_err(|error| match error {
            ExchangeError::Unknown | ExchangeError::Unanswered(_) | ExchangeError::KeysUnknown => {
                self.log_failure("sign people in", &error);
                PersonError::Unavailable
            }
            ExchangeError::Malformed(_)
            | ExchangeError::Refused(_)
            | ExchangeError::Invalid(_)
            | ExchangeError::UserInfo(_) => {
                self.log_failure("believe the OpenID provider", &error);
                PersonError::NotBelieved
            }
        })?;
        if !people.consume_state(&pending.state) {
            return Err(PersonError::NotBegun);
        }
        let mut signed_in = people.signed_in(&authenticated)?;
        signed_in.name = self
            .distinct_from_tokens(signed_in.name, &authenticated.subject)
            .await?;
        let expires_at = now.checked_add(people.session_lasts);
        let expires_at = expires_at.unwrap_or(Timestamp::MAX);
        let opened = self.open_session_of(Owner::Person(signed_in), expires_at);
        let (credential, secret) = opened.await?.ok_or(PersonError::NotBelieved)?;
        if let (Some(session), Some(id_token)) = (credential.session, authenticated.id_token) {
            people.id_tokens.insert(session, id_token);
        }
        Ok((credential, secret))
    }

    /// Returns a name for the person that differs from the name of every valid token. New tokens
    /// cannot have such a name, but those of earlier versions may.
    async fn distinct_from_tokens(&self, name: String, subject: &str) -> Result<String, AppError> {
        let mut tx = self.db().read("identity").await?;
        let called = name_of_person(&name);
        let taken = db::tokens::valid_by_name(&mut tx, &called, self.clock().now()).await?;
        Ok(match taken {
            None => name,
            Some(_) => format!("{name} ({})", cleaned(subject, NAME_MAX)),
        })
    }

    /// Returns the URL for signing out at the provider, for a person's session that is about to
    /// end.
    pub fn sign_out_at_provider(&self, who: &Credential) -> Option<String> {
        let (people, session) = (self.people()?, who.session?);
        who.person.as_ref()?;
        let id_token = people.id_tokens.of(session);
        people.provider.sign_out_url(id_token.as_deref())
    }
}

/// Reads the provider's metadata, and reads them again at intervals, until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let Some(people) = app.people() else {
        return stop.cancelled().await;
    };
    let mut rest = FIND_AGAIN_MIN;
    loop {
        let was_known = people.provider.is_known();
        let found = tokio::select! {
            found = people.provider.discover() => found,
            () = stop.cancelled() => return,
        };
        let wait = match found {
            Ok(()) => {
                if !was_known {
                    info!("people can sign in at {}", people.issuer());
                }
                rest = FIND_AGAIN_MIN;
                METADATA_REFRESH
            }
            Err(error) => {
                app.log_failure("find the OpenID provider", &error);
                let wait = rest;
                rest = (2 * rest).min(FIND_AGAIN_MAX);
                wait
            }
        };
        let sign_in_waits = async {
            // Waits at least this long, however many people want to sign in.
            tokio::time::sleep(FIND_AGAIN_MIN).await;
            people.sign_in_waiting.notified().await;
        };
        tokio::select! {
            () = tokio::time::sleep(wait) => {}
            () = sign_in_waits => {}
            () = stop.cancelled() => return,
        }
    }
}

#[cfg(test)]
mod tests;
