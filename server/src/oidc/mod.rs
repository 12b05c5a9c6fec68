//! Client of the OpenID provider: discovery, authorisation code flow, keys. No other module sends
//! requests to the provider.
//!
//! ```text
//!  start ─► unknown ──discovery──► known ──every hour, or unknown signing key──► refreshed
//!              └── failure: retried after 1 s, 2 s, … at most 30 s ──┘ (earlier metadata stay)
//! ```
//!
//! Implements the authorisation code flow with PKCE (RFC 7636). The crate `openidconnect` builds
//! the protocol's messages and checks signatures; [`verify`] validates ID tokens.

mod http;
#[cfg(test)]
mod rollover_tests;
pub mod verify;

use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use openidconnect::core::{
    CoreAuthenticationFlow, CoreClient, CoreClientAuthMethod, CoreErrorResponseType, CoreJsonWebKey,
};
use openidconnect::{
    AuthType, AuthorizationCode, ClientId, ClientSecret, CsrfToken, DiscoveryError, EndSessionUrl,
    EndpointMaybeSet, EndpointNotSet, EndpointSet, IssuerUrl, JsonWebKeySet, LogoutRequest, Nonce,
    OAuth2TokenResponse as _, PkceCodeChallenge, PkceCodeVerifier, PostLogoutRedirectUrl,
    ProviderMetadataWithLogout, RedirectUrl, RequestTokenError, Scope, StandardErrorResponse,
    TokenResponse as _, UserInfoUrl,
};

use self::http::{HttpClient, HttpError};
use self::verify::{ExpectedClaims, InvalidIdToken};
use crate::clock::Clock;
use crate::config::oidc::OidcConfig;
use crate::identity::claims::{Claims, claim};
use crate::identity::pending::Pending;

/// Minimum interval between requests for the provider's keys, however many ID tokens are signed by
/// an unknown key.
pub const KEYS_REFRESH_INTERVAL: Duration = Duration::from_secs(10);
/// Minimum interval before the next request for the provider's keys, after one that failed.
const KEYS_RETRY_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum number of key sets by which the signature of one ID token is checked: the known set, one
/// that another sign-in fetched meanwhile, and one fetched for this token.
const KEYS_TRIED_MAX: usize = 3;
/// Maximum size of an ID token that is kept for the sign-out, in bytes; a larger one is not kept.
const ID_TOKEN_MAX: usize = 16 * 1_024;

/// Error of [`Provider::new`].
#[derive(Debug, thiserror::Error)]
pub enum ProviderError {
    /// A file cannot be read.
    #[error("cannot read `{}` of `[oidc]`", path.display())]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: std::io::Error,
    },
    /// Other users can read the file with the client secret.
    #[error("others can read `{}`: give the client secret the mode 0600", .0.display())]
    Open(PathBuf),
    /// The first line of the file with the client secret is empty.
    #[error("`{}` has no client secret in its first line", .0.display())]
    NoSecret(PathBuf),
    /// The file with trusted CA certificates contains no usable ones.
    #[error("`{}` has no certificates that can be used", path.display())]
    Authority {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: reqwest::Error,
    },
    /// A URL of the configuration, the value, is invalid.
    #[error("`{0}` of `[oidc]` is no address")]
    Address(String),
    /// The HTTP client cannot be created.
    #[error("cannot prepare for asking the OpenID provider")]
    Client(#[source] reqwest::Error),
}

/// Error of [`Provider::discover`].
#[derive(Debug, thiserror::Error)]
pub enum DiscoverError {
    /// The discovery document cannot be fetched or is invalid.
    #[error("the provider does not say how to sign in")]
    Discovery(#[source] Box<DiscoveryError<HttpError>>),
    /// The discovery document names an endpoint, the value, without TLS.
    #[error("the provider names the endpoint `{0}`, which is not `https`")]
    ClearText(String),
    /// The discovery document names no token endpoint.
    #[error("the provider names no token endpoint")]
    NoTokenEndpoint,
}

/// Error of [`Provider::exchange`].
#[derive(Debug, thiserror::Error)]
pub enum ExchangeError {
    /// No discovery has succeeded yet.
    #[error("the OpenID provider is not known yet")]
    Unknown,
    /// The provider cannot be reached, takes too long, or answers with the status of a failure.
    #[error("the OpenID provider does not answer")]
    Unanswered(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The answer of the token endpoint or the user info endpoint is not what OpenID Connect defines.
    #[error("the OpenID provider's answer is malformed")]
    Malformed(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The provider's keys could not be fetched, now or within the retry interval.
    #[error("the OpenID provider does not say which keys it has")]
    KeysUnknown,
    /// The provider refused the authorisation code; the value is its error code.
    #[error("the OpenID provider refuses the code: {0}")]
    Refused(String),
    /// The ID token is invalid.
    #[error("the OpenID provider's answer cannot be believed")]
    Invalid(#[source] InvalidIdToken),
    /// The user info has another subject than the ID token, or none.
    #[error("the OpenID provider's word on the person cannot be used: {0}")]
    UserInfo(String),
}

/// A person whom the provider has authenticated.
#[derive(Clone, PartialEq)]
pub struct AuthenticatedPerson {
    /// Subject (`sub`): the person's identifier at the provider.
    pub subject: String,
    /// Claims of the ID token, with those of the user info if it was fetched.
    pub claims: Claims,
    /// Encoded ID token, for the sign-out at the provider; `None` if larger than `ID_TOKEN_MAX`.
    pub id_token: Option<String>,
}

type Client = CoreClient<
    EndpointSet,
    EndpointNotSet,
    EndpointNotSet,
    EndpointNotSet,
    EndpointMaybeSet,
    EndpointMaybeSet,
>;

/// Client of the configured OpenID provider.
pub struct Provider {
    issuer: IssuerUrl,
    client_id: ClientId,
    secret: Option<ClientSecret>,
    redirect: RedirectUrl,
    signed_out: PostLogoutRedirectUrl,
    scopes: Vec<Scope>,
    groups_claim: String,
    http: HttpClient,
    clock: Clock,
    known: RwLock<Option<Arc<ProviderMetadataWithLogout>>>,
    /// Held during a request for the provider's keys. It orders these requests, so the latest keys
    /// win, and other sign-ins wait for the new keys instead of failing.
    key_request: tokio::sync::Mutex<LastKeyRequest>,
}

/// Monotonic time of the last request for the provider's keys, and whether it succeeded; `None`
/// before the first.
#[derive(Debug, Default)]
struct LastKeyRequest(Option<(Duration, bool)>);

impl LastKeyRequest {
    /// Returns whether the last request succeeded if it is too early for another; `None` if a new
    /// one is allowed.
    fn recently(&self, now: Duration) -> Option<bool> {
        let (at, is_answered) = self.0?;
        let interval = if is_answered {
            KEYS_REFRESH_INTERVAL
        } else {
            KEYS_RETRY_INTERVAL
        };
        (now.saturating_sub(at) < interval).then_some(is_answered)
    }
}

impl std::fmt::Debug for Provider {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let issuer = self.issuer.as_str();
        formatter
            .debug_struct("Provider")
            .field("issuer", &issuer)
            .finish_non_exhaustive()
    }
}

impl Provider {
    /// Creates a client from the configuration, without sending a request.
    ///
    /// # Errors
    /// A file or URL in the configuration is unusable, or the HTTP client cannot be created.
    pub fn new(config: &OidcConfig, clock: Clock) -> Result<Self, ProviderError> {
        let address = |text: String| move |_error| ProviderError::Address(text);
        let issuer = config.issuer.clone();
        let (redirect, public) = (config.redirect_uri(), format!("{}/", config.public_url));
        let secret = config.client_secret_file.as_deref();
        let secret = secret.map(http::read_secret).transpose()?;
        // The scope `openid` is added by the crate.
        let scopes = config.scopes.iter().filter(|scope| *scope != "openid");
        Ok(Self {
            issuer: IssuerUrl::new(issuer.clone()).map_err(address(issuer))?,
            client_id: ClientId::new(config.client_id.clone()),
            secret: secret.map(ClientSecret::new),
            redirect: RedirectUrl::new(redirect.clone()).map_err(address(redirect))?,
            signed_out: PostLogoutRedirectUrl::new(public.clone()).map_err(address(public))?,
            scopes: scopes.cloned().map(Scope::new).collect(),
            groups_claim: config.groups_claim.clone(),
            http: HttpClient::new(config.ca.as_deref(), config.issuer.starts_with("https:"))?,
            clock,
            known: RwLock::default(),
            key_request: tokio::sync::Mutex::default(),
        })
    }

    /// Returns the issuer identifier of the provider, a URL.
    pub fn issuer(&self) -> &str {
        self.issuer.as_str()
    }

    /// Fetches the provider's discovery document and keys.
    ///
    /// # Errors
    /// [`DiscoverError`]; metadata of an earlier discovery stay in use.
    pub async fn discover(&self) -> Result<(), DiscoverError> {
        let _turn = self.key_request.lock().await;
        let found = ProviderMetadataWithLogout::discover_async(self.issuer.clone(), &self.http);
        let found = found
            .await
            .map_err(|error| DiscoverError::Discovery(Box::new(error)))?;
        let sign_out = &found.additional_metadata().end_session_endpoint;
        let token = found.token_endpoint();
        let token = token.ok_or(DiscoverError::NoTokenEndpoint)?;
        let endpoints = [
            Some(found.authorization_endpoint().url()),
            Some(token.url()),
            Some(found.jwks_uri().url()),
            found.userinfo_endpoint().map(UserInfoUrl::url),
            sign_out.as_ref().map(EndSessionUrl::url),
        ];
        let is_tls = self.issuer.url().scheme() == "https";
        let host = self.issuer.url().host_str();
        // A provider without TLS runs on this machine, and its endpoints must be on this machine
        // too.
        let is_safe =
            |url: &reqwest::Url| url.scheme() == "https" || !is_tls && url.host_str() == host;
        let in_the_clear = |url: &&reqwest::Url| !is_safe(url);
        if let Some(url) = endpoints.into_iter().flatten().find(in_the_clear) {
            return Err(DiscoverError::ClearText(url.to_string()));
        }
        self.set_metadata(found);
        Ok(())
    }

    fn set_metadata(&self, found: ProviderMetadataWithLogout) {
        let mut known = self.known.write().unwrap_or_else(PoisonError::into_inner);
        *known = Some(Arc::new(found));
    }

    fn metadata(&self) -> Option<Arc<ProviderMetadataWithLogout>> {
        let known = self.known.read().unwrap_or_else(PoisonError::into_inner);
        known.clone()
    }

    /// Returns whether a discovery has succeeded, so that people can sign in.
    pub fn is_known(&self) -> bool {
        self.metadata().is_some()
    }

    fn client(&self, metadata: &ProviderMetadataWithLogout) -> Client {
        let methods = metadata.token_endpoint_auth_methods_supported();
        let takes = |method| methods.is_some_and(|methods| methods.contains(&method));
        let (basic, post) = (
            takes(CoreClientAuthMethod::ClientSecretBasic),
            takes(CoreClientAuthMethod::ClientSecretPost),
        );
        let client = CoreClient::from_provider_metadata(
            metadata.clone(),
            self.client_id.clone(),
            self.secret.clone(),
        );
        let how = if post && !basic {
            AuthType::RequestBody
        } else {
            AuthType::BasicAuth
        };
        client
            .set_auth_type(how)
            .set_redirect_uri(self.redirect.clone())
    }

    /// Returns the URL to which a browser is redirected to sign in; `None` before a successful
    /// discovery.
    pub fn sign_in_url(&self, pending: &Pending) -> Option<String> {
        let client = self.client(&*self.metadata()?);
        let (state, nonce) = (pending.state.clone(), pending.nonce.clone());
        let verifier = PkceCodeVerifier::new(pending.verifier.clone());
        let request = client
            .authorize_url(
                CoreAuthenticationFlow::AuthorizationCode,
                || CsrfToken::new(state),
                || Nonce::new(nonce),
            )
            .set_pkce_challenge(PkceCodeChallenge::from_code_verifier_sha256(&verifier))
            .add_scopes(self.scopes.iter().cloned());
        Some(request.url().0.into())
    }

    /// Returns the URL to which a browser is redirected to sign out at the provider; `None` if the
    /// provider has no such endpoint, or before a successful discovery.
    pub fn sign_out_url(&self, id_token: Option<&str>) -> Option<String> {
        let metadata = self.metadata()?;
        let endpoint = metadata.additional_metadata().end_session_endpoint.clone();
        let request = LogoutRequest::from(endpoint?)
            .set_client_id(self.client_id.clone())
            .set_post_logout_redirect_uri(self.signed_out.clone());
        let id_token = id_token.and_then(|text| text.parse::<verify::IdToken>().ok());
        let request = match &id_token {
            Some(id_token) => request.set_id_token_hint(id_token),
            None => request,
        };
        Some(request.http_get_url().into())
    }

    /// Exchanges an authorisation code for an ID token, validates it, and returns the person.
    ///
    /// Fetches the provider's keys if an unknown one signed the token, and the user info if the
    /// token lacks the claim of groups.
    ///
    /// # Errors
    /// [`ExchangeError`] if the provider does not answer or refuses the code, or if its answer is
    /// invalid.
    pub async fn exchange(
        &self,
        code: &str,
        pending: &Pending,
    ) -> Result<AuthenticatedPerson, ExchangeError> {
        let metadata = self.metadata().ok_or(ExchangeError::Unknown)?;
        let client = self.client(&metadata);
        let request = client
            .exchange_code(AuthorizationCode::new(code.to_owned()))
            .map_err(|error| ExchangeError::Unanswered(Box::new(error)))?
            .set_pkce_verifier(PkceCodeVerifier::new(pending.verifier.clone()));
        let answer = request.request_async(&self.http).await.map_err(refused)?;
        let id_token = answer
            .id_token()
            .ok_or(ExchangeError::Invalid(InvalidIdToken::Missing))?;
        let access_token = answer.access_token();
        let verified_with = |keys: &JsonWebKeySet<CoreJsonWebKey>| {
            let expected = ExpectedClaims {
                issuer: &self.issuer,
                client_id: &self.client_id,
                nonce: &pending.nonce,
                access_token,
                now: self.clock.now(),
                keys,
            };
            verify::claims(id_token, &expected)
        };
        let mut metadata_used = Arc::clone(&metadata);
        let mut verified = verified_with(metadata_used.jwks());
        for _ in 1..KEYS_TRIED_MAX {
            let Err(InvalidIdToken::Signature(_)) = &verified else {
                break;
            };
            let fetching = tokio::time::timeout(http::ANSWER_MAX, self.newer_than(&metadata_used));
            let fetched = fetching.await.unwrap_or(Err(ExchangeError::KeysUnknown));
            let Some(newer) = fetched? else {
                break;
            };
            metadata_used = newer;
            verified = verified_with(metadata_used.jwks());
        }
        let (subject, mut claims) = verified.map_err(ExchangeError::Invalid)?;
        if claim(&claims, &self.groups_claim).is_none()
            && let Some(endpoint) = metadata.userinfo_endpoint()
        {
            let user_info = self.http.claims(endpoint.url(), access_token.secret());
            let user_info = user_info.await;
            let user_info = user_info.map_err(|error| match error {
                HttpError::NoObject => ExchangeError::Malformed(Box::new(error)),
                error @ (HttpError::Failed(_)
                | HttpError::TooLarge
                | HttpError::Status(_)
                | HttpError::NoAnswer) => ExchangeError::Unanswered(Box::new(error)),
            })?;
            merge(&mut claims, user_info, &self.groups_claim)?;
        }
        let id_token = id_token.to_string();
        Ok(AuthenticatedPerson {
            subject,
            claims,
            id_token: (id_token.len() <= ID_TOKEN_MAX).then_some(id_token),
        })
    }

    /// Returns metadata with newer keys than `known`: those that another sign-in fetched meanwhile,
    /// or else those fetched now. `None` if keys were fetched less than [`KEYS_REFRESH_INTERVAL`]
    /// ago.
    ///
    /// # Errors
    /// [`ExchangeError::KeysUnknown`] if the keys cannot be fetched.
    async fn newer_than(
        &self,
        known: &Arc<ProviderMetadataWithLogout>,
    ) -> Result<Option<Arc<ProviderMetadataWithLogout>>, ExchangeError> {
        let mut last_request = self.key_request.lock().await;
        let present = self.metadata().ok_or(ExchangeError::Unknown)?;
        if !Arc::ptr_eq(&present, known) {
            return Ok(Some(present));
        }
        let now = self.clock.elapsed();
        match last_request.recently(now) {
            Some(true) => return Ok(None),
            Some(false) => return Err(ExchangeError::KeysUnknown),
            None => {}
        }
        *last_request = LastKeyRequest(Some((now, false)));
        let keys = JsonWebKeySet::fetch_async(present.jwks_uri(), &self.http);
        let keys = keys.await.map_err(|error| {
            tracing::warn!("cannot ask the OpenID provider for its keys: {error}");
            ExchangeError::KeysUnknown
        })?;
        *last_request = LastKeyRequest(Some((now, true)));
        self.set_metadata((*present).clone().set_jwks(keys));
        Ok(self.metadata())
    }
}

/// Merges the claims of the user info into those of the ID token, which have precedence except for
/// the claim of groups.
///
/// # Errors
/// [`ExchangeError::UserInfo`] if the user info is not about the subject of the ID token.
fn merge(claims: &mut Claims, user_info: Claims, groups_claim: &str) -> Result<(), ExchangeError> {
    let subject = |of: &Claims| of.get("sub")?.as_str().map(str::to_owned);
    if subject(&user_info).is_none_or(|user_info| subject(claims) != Some(user_info)) {
        let detail = "its user info is about somebody else".to_owned();
        return Err(ExchangeError::UserInfo(detail));
    }
    // The ID token may have an object of this name without the groups, which has to be replaced.
    let leads_to_groups = |name: &str| {
        let rest = groups_claim.strip_prefix(name);
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    for (name, value) in user_info {
        if leads_to_groups(&name) {
            claims.insert(name, value);
        } else {
            claims.entry(name).or_insert(value);
        }
    }
    Ok(())
}

type TokenError = RequestTokenError<HttpError, StandardErrorResponse<CoreErrorResponseType>>;

/// Distinguishes a refused code, a malformed answer and a failed request.
fn refused(error: TokenError) -> ExchangeError {
    match error {
        RequestTokenError::ServerResponse(response) => {
            let response = serde_json::to_value(response.error()).unwrap_or_default();
            let response = response.as_str().unwrap_or_default();
            ExchangeError::Refused(tread_api::text::cleaned(response, 80))
        }
        error @ RequestTokenError::Parse(..) => ExchangeError::Malformed(Box::new(error)),
        error @ (RequestTokenError::Request(_) | RequestTokenError::Other(_)) => {
            ExchangeError::Unanswered(Box::new(error))
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn groups_of_the_user_info_count_where_the_id_token_has_none() {
        let claims = |value| serde_json::from_value::<Claims>(value).unwrap();
        let own = || claims(json!({"sub": "7", "name": "Anna", "realm_access": {"other": 1}}));
        let said = |subject: &str| {
            claims(json!({
                "sub": subject, "name": "Bert", "realm_access": {"roles": ["night"]}, "realm": 3,
            }))
        };
        let mut both = own();
        merge(&mut both, said("7"), "realm_access.roles").unwrap();
        let groups = claim(&both, "realm_access.roles");
        assert_eq!(groups, Some(&json!(["night"])));
        assert_eq!(both["name"], "Anna", "the signed one counts");
        assert!(merge(&mut own(), said("8"), "realm_access.roles").is_err());
    }
}
