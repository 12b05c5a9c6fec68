//! One attempt to send a delivery: resolve, check, connect to what was checked, read the status.

use std::fmt::Debug;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::{Certificate, Client, Response, StatusCode, Url, header, redirect};
use tread_api::text::cleaned;
use tread_api::webhook::{DELIVERY_HEADER, SIGNATURE_HEADER, TIMESTAMP_HEADER};

use super::address::{Rules, literal};
use super::outgoing::OutgoingDelivery;
use super::signature::signature;

/// Maximum time to resolve a host name.
pub const RESOLVE_MAX: Duration = Duration::from_secs(3);
/// Maximum time to connect, TLS included.
pub const CONNECT_MAX: Duration = Duration::from_secs(3);
/// Maximum time from the connection's begin to the end of the answer.
pub const ANSWER_MAX: Duration = Duration::from_secs(8);
/// Maximum number of bytes that are read of an answer's body, to say why an attempt failed.
pub const BODY_MAX: usize = 4 * 1024;
/// Maximum number of addresses of a host name; one with more is not called.
const ADDRESSES_MAX: usize = 32;
/// Maximum number of headers of an answer.
const HEADERS_MAX: usize = 64;
/// Maximum length of the reason why an attempt failed, characters.
const DETAIL_MAX: usize = 300;

/// Future of a resolver.
pub type Resolved<'resolver> =
    Pin<Box<dyn Future<Output = io::Result<Vec<IpAddr>>> + Send + 'resolver>>;

/// Resolves host names; tests answer what they like.
pub trait Resolver: Debug + Send + Sync {
    /// Returns the addresses of a host name.
    fn resolve<'resolver>(&'resolver self, host: &'resolver str) -> Resolved<'resolver>;
}

/// The machine's resolver.
#[derive(Debug, Clone, Copy, Default)]
pub struct SystemResolver;

impl Resolver for SystemResolver {
    fn resolve<'resolver>(&'resolver self, host: &'resolver str) -> Resolved<'resolver> {
        Box::pin(async move {
            let found = tokio::net::lookup_host((host, 0)).await?;
            Ok(found.map(|address| address.ip()).collect())
        })
    }
}

/// Answers every question of the HTTP client with addresses that were checked, so that no name is
/// resolved a second time.
#[derive(Debug, Clone)]
struct Checked(Vec<SocketAddr>);

impl Resolve for Checked {
    fn resolve(&self, _name: Name) -> Resolving {
        let addresses: Addrs = Box::new(self.0.clone().into_iter());
        Box::pin(async move { Ok(addresses) })
    }
}

/// Result of an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attempt {
    /// Status of the answer, if there was one.
    pub status: Option<u16>,
    /// Why it failed, for people; `None` if the receiver took the delivery.
    pub failure: Option<String>,
}

/// Reason why the sender cannot be created.
#[derive(Debug, thiserror::Error)]
pub enum SenderError {
    /// The file of CA certificates cannot be read.
    #[error("cannot read `webhooks.ca`, `{}`", path.display())]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: io::Error,
    },
    /// The file of CA certificates has no certificates.
    #[error("`webhooks.ca`, `{}`, has no certificates in PEM", path.display())]
    Authority {
        /// Path of the file.
        path: PathBuf,
    },
}

/// Sends deliveries.
#[derive(Debug)]
pub struct Sender {
    rules: Rules,
    authorities: Vec<Certificate>,
    resolver: Arc<dyn Resolver>,
}

impl Sender {
    /// Creates a sender, which trusts the machine's CA certificates and those of the configuration.
    ///
    /// # Errors
    /// The file of CA certificates cannot be read.
    pub fn new(rules: Rules, resolver: Arc<dyn Resolver>) -> Result<Self, SenderError> {
        // Fails if a provider is installed already, which is then the same one.
        let _first = rustls::crypto::ring::default_provider().install_default();
        let mut authorities = Vec::new();
        if let Some(path) = rules.config().ca.clone() {
            let text = std::fs::read(&path).map_err(|cause| SenderError::Unreadable {
                path: path.clone(),
                cause,
            })?;
            authorities = Certificate::from_pem_bundle(&text).unwrap_or_default();
            if authorities.is_empty() {
                return Err(SenderError::Authority { path });
            }
        }
        Ok(Self {
            rules,
            authorities,
            resolver,
        })
    }

    /// Sends a delivery once.
    pub async fn send(&self, outgoing: &OutgoingDelivery) -> Attempt {
        let request = match self.request(outgoing).await {
            Ok(request) => request,
            Err(failure) => return Attempt::without_answer(&failure),
        };
        match request.send().await {
            Ok(answer) => judge(answer).await,
            Err(error) => Attempt::without_answer(&failure_text(error)),
        }
    }

    async fn request(
        &self,
        outgoing: &OutgoingDelivery,
    ) -> Result<reqwest::RequestBuilder, String> {
        // Read again: the configuration may have changed since the webhook was set up.
        let url = self.rules.read(&outgoing.url);
        let url = url.map_err(|wrong| wrong.to_string())?;
        let addresses = self.addresses(&url).await?;
        let client = self.client(&url, addresses).await?;
        let timestamp_s = outgoing.at.as_second();
        let signed = signature(outgoing);
        Ok(client
            .post(url)
            .header(header::CONTENT_TYPE, "application/json")
            .header(TIMESTAMP_HEADER, timestamp_s)
            .header(DELIVERY_HEADER, outgoing.id.to_string())
            .header(SIGNATURE_HEADER, signed)
            .body(outgoing.body.clone()))
    }

    /// Resolves the host of a URL and checks what comes of it.
    async fn addresses(&self, url: &Url) -> Result<Vec<SocketAddr>, String> {
        let host = url.host_str().unwrap_or_default();
        if let Some(address) = literal(host) {
            // The rules for URLs have checked it.
            return Ok(vec![SocketAddr::new(address, 0)]);
        }
        let found = tokio::time::timeout(RESOLVE_MAX, self.resolver.resolve(host)).await;
        let found = found
            .map_err(|_elapsed| format!("`{host}` was not resolved in time"))?
            .map_err(|error| format!("`{host}` cannot be resolved: {error}"))?;
        if found.is_empty() || found.len() > ADDRESSES_MAX {
            let count = found.len();
            return Err(format!("`{host}` has {count} addresses"));
        }
        if let Some(refused) = found.iter().find(|address| !self.rules.allows(**address)) {
            return Err(format!(
                "`{host}` resolves to {refused}, which is not public; `allowed_networks` under \
                 `[webhooks]` in the server's configuration allows others"
            ));
        }
        // The port is the URL's.
        let with_port = |address| SocketAddr::new(address, 0);
        Ok(found.into_iter().map(with_port).collect())
    }

    /// Creates the HTTP client of one attempt, which connects to these addresses alone. The name
    /// that the certificate must have is still that of the URL.
    async fn client(&self, url: &Url, addresses: Vec<SocketAddr>) -> Result<Client, String> {
        let builder = Client::builder()
            .connect_timeout(CONNECT_MAX)
            .timeout(ANSWER_MAX)
            .pool_max_idle_per_host(0)
            .redirect(redirect::Policy::none())
            .referer(false)
            // A proxy would resolve the name again.
            .no_proxy()
            .http1_only()
            .http1_max_headers(HEADERS_MAX)
            .dns_resolver(Arc::new(Checked(addresses)))
            .user_agent(concat!("tread-server/", env!("CARGO_PKG_VERSION")));
        let builder = if url.scheme() == "https" {
            builder.tls_certs_merge(self.authorities.clone())
        } else {
            builder.tls_certs_only([])
        };
        // Reads the machine's CA certificates.
        let built = tokio::task::spawn_blocking(move || builder.build()).await;
        match built {
            Ok(Ok(client)) => Ok(client),
            Ok(Err(error)) => Err(failure_text(error)),
            Err(_panic) => Err("the HTTP client cannot be created".to_owned()),
        }
    }
}

impl Attempt {
    fn without_answer(failure: &str) -> Self {
        Self {
            status: None,
            failure: Some(cleaned(failure, DETAIL_MAX)),
        }
    }
}

/// Judges an attempt by the status of its answer.
async fn judge(answer: Response) -> Attempt {
    let status = answer.status();
    let failure = if status.is_success() {
        None
    } else if status.is_redirection() {
        Some("the receiver redirects, which is not followed: give its final URL".to_owned())
    } else {
        Some(response_text(status, answer).await)
    };
    Attempt {
        status: Some(status.as_u16()),
        failure: failure.map(|failure| cleaned(&failure, DETAIL_MAX)),
    }
}

/// Returns what an answer that is an error says, as far as it fits.
async fn response_text(status: StatusCode, mut answer: Response) -> String {
    let mut body = Vec::new();
    while let Ok(Some(chunk)) = answer.chunk().await {
        let room = BODY_MAX - body.len();
        body.extend_from_slice(&chunk[..chunk.len().min(room)]);
        if body.len() >= BODY_MAX {
            break;
        }
    }
    let text = String::from_utf8_lossy(&body);
    format!("the receiver answered {status}: {text}")
}

/// Returns why a request failed, with all causes and without the URL, whose path may be secret.
fn failure_text(error: reqwest::Error) -> String {
    let is_timeout = error.is_timeout();
    let error = error.without_url();
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(&error);
    while let Some(error) = cause {
        text.push_str(": ");
        text.push_str(&error.to_string());
        cause = error.source();
    }
    if is_timeout {
        format!("no answer in time: {text}")
    } else {
        text
    }
}
