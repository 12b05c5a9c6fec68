//! Sends one request to a port of this machine. Over TLS it accepts every certificate, because the
//! doctor examines the certificate itself.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::WebPkiSupportedAlgorithms;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{ClientConfig, DigitallySignedStruct, SignatureScheme};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use crate::health::reachable;

/// Maximum time for a connection and its answer.
const WAIT_MAX: Duration = Duration::from_secs(5);
/// Maximum length of an answer.
const ANSWER_BYTES_MAX: u64 = 64 * 1_024;

/// Answer of a port.
#[derive(Debug, Clone, Default)]
pub(super) struct Answer {
    /// Status line, headers and body.
    pub(super) text: String,
    /// The first certificate of the presented chain.
    pub(super) leaf: Option<CertificateDer<'static>>,
}

impl Answer {
    /// Returns whether this is the answer of a live Tread server.
    pub(super) fn is_health(&self) -> bool {
        self.text.starts_with("HTTP/1.1 200") && self.text.ends_with(r#"{"status":"ok"}"#)
    }

    /// Returns a header's value.
    pub(super) fn header(&self, name: &str) -> Option<&str> {
        let head = self.text.split("\r\n\r\n").next()?;
        head.lines().find_map(|line| {
            let (key, value) = line.split_once(':')?;
            key.eq_ignore_ascii_case(name).then_some(value.trim())
        })
    }
}

/// Requests a page; returns `None` if nothing answers in time.
pub(super) async fn get(address: SocketAddr, is_tls: bool, path: &str) -> Option<Answer> {
    let asking = async {
        let stream = TcpStream::connect(reachable(address)).await.ok()?;
        if !is_tls {
            let text = ask(stream, path).await?;
            return Some(Answer { text, leaf: None });
        }
        let (stream, leaf) = handshake(stream).await?;
        let text = ask(stream, path).await?;
        Some(Answer { text, leaf })
    };
    tokio::time::timeout(WAIT_MAX, asking).await.ok().flatten()
}

/// Begins TLS with a port, and returns the certificate that it presents.
pub(super) async fn certificate(address: SocketAddr) -> Option<CertificateDer<'static>> {
    let asking = async {
        let stream = TcpStream::connect(reachable(address)).await.ok()?;
        let (_stream, leaf) = handshake(stream).await?;
        leaf
    };
    tokio::time::timeout(WAIT_MAX, asking).await.ok().flatten()
}

/// Returns whether a program accepts connections.
pub(super) async fn is_open(address: SocketAddr) -> bool {
    let connecting = TcpStream::connect(reachable(address));
    matches!(tokio::time::timeout(WAIT_MAX, connecting).await, Ok(Ok(_)))
}

async fn ask(mut stream: impl AsyncRead + AsyncWrite + Unpin, path: &str) -> Option<String> {
    let request = format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.ok()?;
    let mut bytes = Vec::new();
    let read = stream.take(ANSWER_BYTES_MAX).read_to_end(&mut bytes).await;
    // A peer that does not close TLS properly has still answered.
    if read.is_err() && bytes.is_empty() {
        return None;
    }
    Some(String::from_utf8_lossy(&bytes).trim_end().to_owned())
}

type OverTls = (
    tokio_rustls::client::TlsStream<TcpStream>,
    Option<CertificateDer<'static>>,
);

async fn handshake(stream: TcpStream) -> Option<OverTls> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let shown = Arc::new(CapturingVerifier {
        leaf: Mutex::default(),
        algorithms: provider.signature_verification_algorithms,
    });
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .ok()?
        .dangerous()
        .with_custom_certificate_verifier(Arc::<CapturingVerifier>::clone(&shown))
        .with_no_client_auth();
    let name = ServerName::try_from("localhost").ok()?;
    let stream = TlsConnector::from(Arc::new(config)).connect(name, stream);
    let stream = stream.await.ok()?;
    let leaf = shown.leaf.lock().unwrap_or_else(PoisonError::into_inner);
    Some((stream, leaf.clone()))
}

/// Keeps the presented certificate, and accepts it, since the request contains no secret.
#[derive(Debug)]
struct CapturingVerifier {
    leaf: Mutex<Option<CertificateDer<'static>>>,
    algorithms: WebPkiSupportedAlgorithms,
}

impl ServerCertVerifier for CapturingVerifier {
    fn verify_server_cert(
        &self,
        leaf: &CertificateDer<'_>,
        _chain: &[CertificateDer<'_>],
        _name: &ServerName<'_>,
        _ocsp: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let mut shown = self.leaf.lock().unwrap_or_else(PoisonError::into_inner);
        *shown = Some(leaf.clone().into_owned());
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls12_signature(message, certificate, signature, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls13_signature(message, certificate, signature, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}
