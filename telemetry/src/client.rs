//! HTTP client of the exporter, with rustls and ring. It runs on the program's runtime, because the
//! exporter calls it on a separate thread without a runtime.

use std::time::Duration;

use async_trait::async_trait;
use opentelemetry_http::{Bytes, HttpClient, HttpError, Request, Response};
use tokio::runtime::Handle;

/// Maximum length of a collector's answer; it only lists the spans that the collector rejected.
const ANSWER_BYTES_MAX: usize = 64 * 1_024;

#[derive(Debug, Clone)]
pub(super) struct Client {
    http: reqwest::Client,
    runtime: Handle,
}

impl Client {
    /// Creates a client that sends on the present runtime.
    pub(super) fn new(timeout: Duration) -> Result<Self, reqwest::Error> {
        // Only the first call has an effect; all install the same provider.
        let _first = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder()
            .timeout(timeout)
            .user_agent(concat!("tread/", env!("CARGO_PKG_VERSION")))
            .build()?;
        Ok(Self {
            http,
            runtime: Handle::current(),
        })
    }
}

#[async_trait]
impl HttpClient for Client {
    async fn send_bytes(&self, request: Request<Bytes>) -> Result<Response<Bytes>, HttpError> {
        let request = reqwest::Request::try_from(request)?;
        let http = self.http.clone();
        let sending = self.runtime.spawn(async move {
            let mut answer = http.execute(request).await?;
            let status = answer.status();
            let mut body = Vec::new();
            while let Some(part) = answer.chunk().await? {
                let left = ANSWER_BYTES_MAX.saturating_sub(body.len());
                body.extend_from_slice(&part[..part.len().min(left)]);
                if left == 0 {
                    break;
                }
            }
            Ok::<_, reqwest::Error>((status, body))
        });
        let (status, body) = sending.await??;
        Ok(Response::builder().status(status).body(Bytes::from(body))?)
    }
}
