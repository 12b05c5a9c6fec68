//! HTTP client for the OpenID provider: TLS with ring, bounded times and sizes, no redirects.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::pin::Pin;
use std::time::Duration;

use openidconnect::{AsyncHttpClient, HttpRequest, HttpResponse};
use reqwest::{Certificate, Url, redirect};

use super::ProviderError;
use crate::config::credentials;
use crate::file_owner::OF_OTHERS;
use crate::identity::claims::Claims;

/// Timeout of one request to the provider. A sign-in sends up to three, within
/// [`crate::http::REQUEST_TIMEOUT`].
pub(super) const ANSWER_MAX: Duration = Duration::from_secs(4);
/// Timeout of a connection to the provider.
const CONNECT_MAX: Duration = Duration::from_secs(3);
/// Maximum size of an answer, in bytes; a larger one is an error.
pub(super) const BODY_MAX: usize = 1024 * 1024;
/// Maximum number of idle connections kept open to a host.
const IDLE_MAX: usize = 4;

/// Error of a request to the provider.
#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// The provider cannot be reached, or the request timed out.
    #[error("the request failed")]
    Failed(#[from] reqwest::Error),
    /// The answer is larger than [`BODY_MAX`].
    #[error("the answer has more than {BODY_MAX} bytes")]
    TooLarge,
    /// The status of the answer, the value, is not a success.
    #[error("it answered with status {0}")]
    Status(u16),
    /// The body of the answer is no JSON object.
    #[error("the answer is no object of JSON")]
    NoObject,
    /// The answer cannot be converted.
    #[error("the answer is none")]
    NoAnswer,
}

/// HTTP client for requests to the provider.
#[derive(Debug, Clone)]
pub(super) struct HttpClient(reqwest::Client);

impl HttpClient {
    /// Creates a client that trusts the CA certificates in the file `authorities`, or the machine's
    /// if `None`. Without TLS the provider runs on this machine, so no proxy is used.
    pub(super) fn new(authorities: Option<&Path>, is_tls: bool) -> Result<Self, ProviderError> {
        // Fails if a provider is installed already, which is then the same one.
        let _first = rustls::crypto::ring::default_provider().install_default();
        let mut builder = reqwest::Client::builder()
            .connect_timeout(CONNECT_MAX)
            .timeout(ANSWER_MAX)
            .pool_max_idle_per_host(IDLE_MAX)
            // A redirect would send the client secret or the code to another host.
            .redirect(redirect::Policy::none())
            .user_agent(concat!("tread-server/", env!("CARGO_PKG_VERSION")));
        if !is_tls {
            builder = builder.no_proxy();
        }
        if let Some(file) = authorities {
            let text = std::fs::read(file).map_err(|cause| ProviderError::Unreadable {
                path: file.to_owned(),
                cause,
            })?;
            let found = Certificate::from_pem_bundle(&text);
            let found = found.map_err(|cause| ProviderError::Authority {
                path: file.to_owned(),
                cause,
            })?;
            builder = builder.tls_certs_only(found);
        }
        builder.build().map(Self).map_err(ProviderError::Client)
    }

    async fn answer(&self, request: reqwest::Request) -> Result<HttpResponse, HttpError> {
        let mut response = self.0.execute(request).await?;
        let mut body = Vec::new();
        while let Some(chunk) = response.chunk().await? {
            if body.len() + chunk.len() > BODY_MAX {
                return Err(HttpError::TooLarge);
            }
            body.extend_from_slice(&chunk);
        }
        let mut answer = HttpResponse::new(body);
        *answer.status_mut() = response.status();
        *answer.headers_mut() = std::mem::take(response.headers_mut());
        Ok(answer)
    }

    /// Fetches the claims of a person from the provider's user info endpoint.
    pub(super) async fn claims(&self, url: &Url, access_token: &str) -> Result<Claims, HttpError> {
        let request = self.0.get(url.clone()).bearer_auth(access_token);
        let request = request.header("accept", "application/json").build()?;
        let answer = self.answer(request).await?;
        if !answer.status().is_success() {
            return Err(HttpError::Status(answer.status().as_u16()));
        }
        serde_json::from_slice(answer.body()).map_err(|_error| HttpError::NoObject)
    }
}

impl<'client> AsyncHttpClient<'client> for HttpClient {
    type Error = HttpError;
    type Future = Pin<Box<dyn Future<Output = Result<HttpResponse, HttpError>> + Send + 'client>>;

    fn call(&'client self, request: HttpRequest) -> Self::Future {
        Box::pin(async move {
            let request = reqwest::Request::try_from(request)?;
            self.answer(request).await
        })
    }
}

/// Reads the client secret from the first line of a file, which only its owner may access.
pub(super) fn read_secret(file: &Path) -> Result<String, ProviderError> {
    let unreadable = |cause| ProviderError::Unreadable {
        path: file.to_owned(),
        cause,
    };
    let mode = std::fs::metadata(file).map_err(unreadable)?.permissions();
    if mode.mode() & OF_OTHERS != 0 && !credentials::is_passed(file) {
        return Err(ProviderError::Open(file.to_owned()));
    }
    let text = std::fs::read_to_string(file).map_err(unreadable)?;
    let secret = text.lines().next().unwrap_or_default().trim();
    if secret.is_empty() {
        return Err(ProviderError::NoSecret(file.to_owned()));
    }
    Ok(secret.to_owned())
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;

    use super::*;

    #[test]
    fn the_client_secret_is_the_first_line_of_a_file_that_only_its_owner_can_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("secret");
        let error = read_secret(&file).unwrap_err();
        assert!(matches!(error, ProviderError::Unreadable { .. }));
        std::fs::write(&file, " geheim \nrest").unwrap();
        std::fs::set_permissions(&file, Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(read_secret(&file), Err(ProviderError::Open(_))));
        std::fs::set_permissions(&file, Permissions::from_mode(0o600)).unwrap();
        assert_eq!(read_secret(&file).unwrap(), "geheim");
        std::fs::write(&file, "\n").unwrap();
        assert!(matches!(
            read_secret(&file),
            Err(ProviderError::NoSecret(_))
        ));
    }
}
