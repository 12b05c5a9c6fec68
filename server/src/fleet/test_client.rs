//! A robot's link for tests with arbitrary credentials: TLS outside, zenoh inside.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use rcgen::KeyPair;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, copy_bidirectional};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tread_api::tunnel::{ALPN, RouterCredentials};
use zenoh::{Config, Session, Wait as _};

/// Maximum time for a link to end.
const END_TIMEOUT: Duration = Duration::from_secs(15);

/// Maximum time for a state to be reached.
const STATE_TIMEOUT: Duration = Duration::from_secs(20);
pub(super) const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// Waits until a state is reached.
///
/// A client sees the end of its link before the server has counted it, so tests wait for counters.
pub(super) async fn until(what: &str, mut holds: impl AsyncFnMut() -> bool) {
    let waiting = async {
        while !holds().await {
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    };
    let waited = tokio::time::timeout(STATE_TIMEOUT, waiting).await;
    assert!(waited.is_ok(), "not within {STATE_TIMEOUT:?}: {what}");
}

/// Credentials that a session presents instead of its own.
#[derive(Debug, Clone, Default)]
pub(super) struct ClientOverrides {
    pub(super) user: Option<String>,
    pub(super) password: Option<String>,
    pub(super) session_id: Option<String>,
    pub(super) mode: Option<&'static str>,
    pub(super) is_anonymous: bool,
}

/// Client of the robots' port.
pub(super) struct TestClient {
    address: SocketAddr,
    roots: RootCertStore,
    certificate: Option<(String, KeyPair)>,
    pub(super) protocols: Vec<Vec<u8>>,
}

/// An open session with its link.
pub(super) struct TestSession {
    pub(super) zenoh: Session,
    tunnel: JoinSet<()>,
}

impl TestSession {
    /// Waits until the link has ended.
    pub(super) async fn link_ended(&mut self) {
        self.tunnel.join_next().await;
    }

    pub(super) async fn close(self) {
        let session = self.zenoh.clone();
        let closing = tokio::task::spawn_blocking(move || session.close().wait());
        closing.await.unwrap().unwrap();
    }
}

impl TestClient {
    pub(super) fn new(
        address: SocketAddr,
        authority: &CertificateDer<'static>,
        certificate: Option<(String, KeyPair)>,
    ) -> Self {
        let mut roots = RootCertStore::empty();
        roots.add(authority.clone()).unwrap();
        Self {
            address,
            roots,
            certificate,
            protocols: vec![ALPN.to_vec()],
        }
    }

    fn connector(&self) -> TlsConnector {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(self.roots.clone());
        let mut config = match &self.certificate {
            None => builder.with_no_client_auth(),
            Some((certificate, key)) => {
                let chain = vec![CertificateDer::from_pem_slice(certificate.as_bytes()).unwrap()];
                let key = PrivateKeyDer::Pkcs8(key.serialize_der().into());
                builder.with_client_auth_cert(chain, key).unwrap()
            }
        };
        config.alpn_protocols.clone_from(&self.protocols);
        TlsConnector::from(Arc::new(config))
    }

    async fn dial(&self) -> Option<(TlsStream<TcpStream>, RouterCredentials)> {
        let stream = TcpStream::connect(self.address).await.unwrap();
        let name = ServerName::IpAddress(self.address.ip().into());
        let mut stream = self.connector().connect(name, stream).await.ok()?;
        let length = stream.read_u16().await.ok()?;
        let mut json = vec![0; usize::from(length)];
        stream.read_exact(&mut json).await.ok()?;
        Some((stream, serde_json::from_slice(&json).unwrap()))
    }

    /// Returns the credentials that the server sends to this certificate; `None` if it sends none.
    pub(super) async fn credentials(&self) -> Option<RouterCredentials> {
        self.dial().await.map(|(_stream, credentials)| credentials)
    }

    /// Opens a link that sends nothing after the handshake.
    pub(super) async fn silent(&self) -> Option<TlsStream<TcpStream>> {
        self.dial().await.map(|(stream, _credentials)| stream)
    }

    /// Sends these bytes in place of a session's opening; returns whether the server closes the
    /// link.
    pub(super) async fn says_instead(&self, bytes: &[u8]) -> bool {
        let (mut stream, _credentials) = self.dial().await.unwrap();
        stream.write_all(bytes).await.unwrap();
        let mut rest = Vec::new();
        tokio::time::timeout(END_TIMEOUT, stream.read_to_end(&mut rest))
            .await
            .is_ok()
    }

    /// Opens a session; `None` if the gate or router rejects it.
    pub(super) async fn open(&self, shown: &ClientOverrides, wait_ms: u32) -> Option<TestSession> {
        let (mut remote, credentials) = self.dial().await?;
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let config = config(listener.local_addr().unwrap(), &credentials, shown, wait_ms);
        let mut tunnel = JoinSet::new();
        tunnel.spawn(async move {
            let (mut local, _peer) = listener.accept().await.unwrap();
            let _ = copy_bidirectional(&mut local, &mut remote).await;
        });
        let opening = tokio::task::spawn_blocking(move || zenoh::open(config).wait());
        let zenoh = opening.await.unwrap().ok()?;
        Some(TestSession { zenoh, tunnel })
    }
}

fn config(
    local: SocketAddr,
    credentials: &RouterCredentials,
    shown: &ClientOverrides,
    wait_ms: u32,
) -> Config {
    let text = |text: &str| serde_json::Value::from(text).to_string();
    let own_id = credentials.session_prefix.session_id(7);
    let mut settings = vec![
        ("mode", text(shown.mode.unwrap_or("client"))),
        ("connect/endpoints", format!("[\"tcp/{local}\"]")),
        ("connect/timeout_ms", wait_ms.to_string()),
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("id", text(shown.session_id.as_ref().unwrap_or(&own_id))),
    ];
    if !shown.is_anonymous {
        let user = shown.user.as_ref().unwrap_or(&credentials.user);
        let password = shown.password.as_ref().unwrap_or(&credentials.password);
        settings.push(("transport/auth/usrpwd/user", text(user)));
        settings.push(("transport/auth/usrpwd/password", text(password)));
    }
    let mut config = Config::default();
    for (key, value) in settings {
        config.insert_json5(key, &value).unwrap();
    }
    config
}
