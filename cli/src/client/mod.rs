//! Client of the REST API: sends requests and reads answers. The requests are in the modules below,
//! by subject.

mod error;
mod fleet;
mod identity;
mod map;
mod missions;
mod outage;
mod safety;
mod webhooks;

use std::borrow::Cow;
use std::io;
use std::net::IpAddr;
use std::path::Path;
use std::time::Duration;

use reqwest::{Certificate, Method, RequestBuilder, Response, Url};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use tread_agent::membership::{Fingerprint, Trust};
use tread_api::page::{DifferencePage, PAGE_LIMIT_MAX};
use tread_api::text;

pub(crate) use self::error::ClientError;
pub(crate) use self::map::{Area, HistoryTimes, MapTimes, Reading, TimedEntries};
pub(crate) use self::outage::Outage;

/// Maximum time for an answer; planning the longest path takes several seconds.
const ANSWER_WAIT_MAX: Duration = Duration::from_secs(30);
/// Maximum time that one event stream is read; it is resumed afterwards.
const STREAM_WAIT_MAX: Duration = Duration::from_hours(24);
/// Maximum time for a connection.
const CONNECT_WAIT_MAX: Duration = Duration::from_secs(3);
/// Maximum number of pages that are read of one list; further entries are left out.
const PAGES_MAX: usize = 100;

/// Query parameters of a request.
type Query = Vec<(&'static str, String)>;

/// Returns a server's address in its canonical form, without trailing slashes.
pub(crate) fn address_of(address: &str) -> &str {
    address.trim_end_matches('/')
}

/// Whether the host is this machine, so that requests do not leave it.
fn is_here(url: &Url) -> bool {
    match url.host_str() {
        Some("localhost") => true,
        Some(host) => {
            let address = host.trim_start_matches('[').trim_end_matches(']');
            address
                .parse()
                .is_ok_and(|address: IpAddr| address.is_loopback())
        }
        None => false,
    }
}

/// Which certificates of a server are trusted.
#[derive(Debug, Clone, Copy)]
pub(crate) enum TrustAnchor<'a> {
    /// Those of the system's authorities.
    System,
    /// Those of the authorities in a PEM file.
    Authority(&'a Path),
    /// The one with this fingerprint, or those that the authority with it has signed.
    Fingerprint(Fingerprint),
}

/// Client of one server.
#[derive(Debug, Clone)]
pub(crate) struct Client {
    address: String,
    token: Option<String>,
    http: reqwest::Client,
    /// Whether to escape unprintable characters in answers, see [`Self::read`].
    escapes: bool,
}

fn certificates(file: &Path) -> Result<Vec<Certificate>, ClientError> {
    let unusable = |cause| ClientError::Authority {
        file: file.display().to_string(),
        cause,
    };
    let text = std::fs::read(file).map_err(unusable)?;
    let found = Certificate::from_pem_bundle(&text);
    found.map_err(|error| unusable(io::Error::new(io::ErrorKind::InvalidData, error)))
}

impl Client {
    /// Creates a client that sends this token, and trusts these certificates.
    pub(crate) fn new(
        address: &str,
        token: Option<&str>,
        trusted: TrustAnchor<'_>,
    ) -> Result<Self, ClientError> {
        let invalid = || ClientError::Address {
            address: address.to_owned(),
        };
        let url = Url::parse(address).map_err(|_| invalid())?;
        if !matches!(url.scheme(), "http" | "https") || url.host().is_none() {
            return Err(invalid());
        }
        let is_tls = url.scheme() == "https";
        let address = address_of(address).to_owned();
        if token.is_some() && !is_tls && !is_here(&url) {
            return Err(ClientError::ClearText { address });
        }
        let mut builder = reqwest::Client::builder()
            .timeout(ANSWER_WAIT_MAX)
            .connect_timeout(CONNECT_WAIT_MAX)
            .user_agent(concat!("tread/", env!("CARGO_PKG_VERSION")));
        builder = match trusted {
            TrustAnchor::Authority(file) => builder.tls_certs_only(certificates(file)?),
            // Without TLS no authority is trusted, so that the system's certificates are not
            // loaded.
            TrustAnchor::System | TrustAnchor::Fingerprint(_) if !is_tls => {
                builder.tls_certs_only([])
            }
            TrustAnchor::System => builder,
            TrustAnchor::Fingerprint(fingerprint) => {
                let config = Trust::Fingerprint(fingerprint).client_config(None);
                match config.map_err(ClientError::Tls)? {
                    Some(config) => builder.tls_backend_preconfigured(config),
                    None => builder,
                }
            }
        };
        let http = builder.build().map_err(|cause| ClientError::Unreachable {
            address: address.clone(),
            cause,
        })?;
        let token = token.map(str::to_owned);
        Ok(Self {
            address,
            token,
            http,
            escapes: false,
        })
    }

    /// Returns the same client; if `is_for_people`, it replaces characters that would control a
    /// terminal (cursor, direction of writing) by escapes in all answers.
    #[must_use]
    pub(crate) fn for_people(mut self, is_for_people: bool) -> Self {
        self.escapes = is_for_people;
        self
    }

    /// Returns a client that leaves answers unchanged.
    pub(crate) fn exactly(&self) -> Self {
        Self {
            escapes: false,
            ..self.clone()
        }
    }

    /// Parses an answer of the server. All data from outside passes through this function.
    pub(crate) fn read<T: DeserializeOwned>(&self, text: &[u8]) -> serde_json::Result<T> {
        // A text without backslashes and non-ASCII characters is printable already.
        let is_plain = |byte: &u8| byte.is_ascii() && !matches!(byte, b'\\' | 0x7f);
        if !self.escapes || text.iter().all(is_plain) {
            return serde_json::from_slice(text);
        }
        let mut value: Value = serde_json::from_slice(text)?;
        escape_all(&mut value);
        serde_json::from_value(value)
    }

    /// Returns the token that the client sends.
    pub(crate) fn token(&self) -> Option<&str> {
        self.token.as_deref()
    }

    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    pub(crate) fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.http.request(method, format!("{}{path}", self.address));
        match &self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// Converts a transport error of a request or an answer.
    pub(crate) fn lost(&self, cause: reqwest::Error) -> ClientError {
        let address = self.address.clone();
        if let Some(cause) = error::tls_error(&cause) {
            return ClientError::Untrusted { address, cause };
        }
        if cause.is_timeout() && !cause.is_connect() {
            ClientError::Silent { address, cause }
        } else {
            ClientError::Unreachable { address, cause }
        }
    }

    /// Sends a request; an answer with an error status is converted to an error.
    async fn answered(&self, request: RequestBuilder) -> Result<Response, ClientError> {
        let response = request.send().await.map_err(|cause| self.lost(cause))?;
        if response.status().is_success() {
            return Ok(response);
        }
        Err(self.refusal(response).await)
    }

    async fn send<T: DeserializeOwned>(&self, request: RequestBuilder) -> Result<T, ClientError> {
        let response = self.answered(request).await?;
        let status = response.status();
        let body = response.bytes().await.map_err(|cause| self.lost(cause))?;
        self.read(&body)
            .map_err(|cause| ClientError::NotUnderstood {
                address: self.address.clone(),
                status,
                cause,
            })
    }

    /// Converts an answer with an error status.
    pub(crate) async fn refusal(&self, response: Response) -> ClientError {
        let (address, status) = (self.address.clone(), response.status());
        let body = match response.bytes().await {
            Ok(body) => body,
            Err(cause) => return self.lost(cause),
        };
        match self.read(&body) {
            Ok(problem) => ClientError::Refused { problem },
            Err(cause) => ClientError::NotUnderstood {
                address,
                status,
                cause,
            },
        }
    }

    async fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        self.send(self.request(Method::GET, path)).await
    }

    async fn get_with<T: DeserializeOwned>(
        &self,
        path: &str,
        query: &Query,
    ) -> Result<T, ClientError> {
        self.send(self.request(Method::GET, path).query(query))
            .await
    }

    async fn post<B: Serialize + Sync, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        self.send(self.request(Method::POST, path).json(body)).await
    }

    async fn delete<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        self.send(self.request(Method::DELETE, path)).await
    }

    /// Reads all pages of a list, at most [`PAGES_MAX`].
    async fn all<T: DeserializeOwned>(&self, path: &str) -> Result<Vec<T>, ClientError> {
        self.all_with(path, &Vec::new()).await
    }

    /// Reads all pages of a list with query parameters, at most [`PAGES_MAX`].
    async fn all_with<T: DeserializeOwned>(
        &self,
        path: &str,
        query: &Query,
    ) -> Result<Vec<T>, ClientError> {
        Ok(self.all_of_map(path, query).await?.items)
    }

    /// Reads all pages of a list of the map, at most [`PAGES_MAX`], with the times to which it
    /// refers.
    async fn all_of_map<T: DeserializeOwned>(
        &self,
        path: &str,
        query: &Query,
    ) -> Result<TimedEntries<T>, ClientError> {
        let mut items = Vec::new();
        let mut of = MapTimes::default();
        let mut cursor: Option<String> = None;
        for _ in 0..PAGES_MAX {
            let mut query = query.clone();
            query.push(("limit", PAGE_LIMIT_MAX.to_string()));
            query.extend(cursor.map(|cursor| ("cursor", cursor)));
            let page: DifferencePage<T> = self.get_with(path, &query).await?;
            of = MapTimes {
                from: page.from,
                as_of: page.as_of,
            };
            items.extend(page.items);
            cursor = page.next_cursor;
            if cursor.is_none() {
                break;
            }
        }
        Ok(TimedEntries { items, of })
    }

    /// Whether the server is ready: `/readyz` answers with success.
    pub(crate) async fn is_ready(&self) -> bool {
        let answer = self.request(Method::GET, "/readyz").send().await;
        answer.is_ok_and(|response| response.status().is_success())
    }
}

/// Escapes unprintable characters in all texts of a value.
fn escape_all(value: &mut Value) {
    match value {
        Value::String(text) => {
            if let Cow::Owned(escaped) = text::escaped(text) {
                *text = escaped;
            }
        }
        Value::Array(items) => items.iter_mut().for_each(escape_all),
        Value::Object(fields) => {
            let taken = std::mem::take(fields);
            for (name, mut field) in taken {
                escape_all(&mut field);
                fields.insert(text::escaped(&name).into_owned(), field);
            }
        }
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_goes_over_the_network_only_by_tls() {
        let _first = rustls::crypto::ring::default_provider().install_default();
        let to = |address| Client::new(address, Some("t"), TrustAnchor::System).map(|_| ());
        for here in [
            "http://127.0.0.1:8420/",
            "http://[::1]:8420",
            "http://localhost:1",
        ] {
            assert!(to(here).is_ok(), "{here}");
        }
        for away in [
            "http://192.0.2.1:8420",
            "http://tread.example",
            "http://localhost.example",
        ] {
            assert!(
                matches!(to(away), Err(ClientError::ClearText { .. })),
                "{away}"
            );
            assert!(Client::new(away, None, TrustAnchor::System).is_ok());
        }
        let client = Client::new("http://127.0.0.1:1", None, TrustAnchor::System).unwrap();
        let sent = r#"{"a\u001b": ["x\ny", "\u202ee\u009b", "ü"], "n": 1.5}"#.as_bytes();
        let shown: Value = client.clone().for_people(true).read(sent).unwrap();
        let said = serde_json::json!({"a\\u{1b}": ["x\\ny", "\\u{202e}e\\u{9b}", "ü"], "n": 1.5});
        assert_eq!(shown, said);
        let exact: Value = client.for_people(true).exactly().read(sent).unwrap();
        assert_eq!(exact["a\u{1b}"][0], "x\ny");
        assert!(matches!(
            to("ftp://127.0.0.1"),
            Err(ClientError::Address { .. })
        ));
    }
}
