use std::sync::Mutex as StdMutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use jiff::Timestamp;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};
use tokio_rustls::TlsAcceptor;
use tread_api::tunnel::{ALPN, SessionPrefix};

use super::*;
use crate::membership::Trust;

const PATIENCE: Duration = Duration::from_secs(20);

fn credentials(password: &str) -> RouterCredentials {
    RouterCredentials {
        user: "rover-1.yard".to_owned(),
        password: password.to_owned(),
        session_prefix: SessionPrefix::new(0x1234),
    }
}

/// A robots' port that sends back whatever it receives.
struct EchoPort {
    address: SocketAddr,
    credentials: Arc<StdMutex<RouterCredentials>>,
    joined: Arc<AtomicUsize>,
    membership: Membership,
    _tasks: JoinSet<()>,
}

fn provider() -> Arc<rustls::crypto::CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

impl EchoPort {
    async fn start(protocol: &[u8]) -> Self {
        let authority_key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let authority = params.self_signed(&authority_key).unwrap();
        let issuer = Issuer::new(params, authority_key);
        let leaf = |name: &str| {
            let key = KeyPair::generate().unwrap();
            let params = CertificateParams::new(vec![name.to_owned()]).unwrap();
            (params.signed_by(&key, &issuer).unwrap(), key)
        };
        let (port_certificate, port_key) = leaf("127.0.0.1");
        let (robot_certificate, robot_key) = leaf("rover-1");
        let mut roots = RootCertStore::empty();
        roots.add(authority.der().clone()).unwrap();
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider());
        let chain: Vec<CertificateDer<'static>> = vec![port_certificate.der().clone()];
        let mut config = ServerConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_client_cert_verifier(verifier.build().unwrap())
            .with_single_cert(chain, PrivateKeyDer::Pkcs8(port_key.serialize_der().into()))
            .unwrap();
        config.alpn_protocols = vec![protocol.to_vec()];
        let acceptor = TlsAcceptor::from(Arc::new(config));
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let address = listener.local_addr().unwrap();
        let credentials = Arc::new(StdMutex::new(credentials("first")));
        let joined = Arc::new(AtomicUsize::new(0));
        let mut tasks = JoinSet::new();
        let (sent, counted) = (Arc::clone(&credentials), Arc::clone(&joined));
        tasks.spawn(async move {
            let mut open = JoinSet::new();
            loop {
                let (stream, _peer) = listener.accept().await.unwrap();
                let (acceptor, sent, counted) =
                    (acceptor.clone(), Arc::clone(&sent), Arc::clone(&counted));
                open.spawn(async move {
                    let Ok(mut stream) = acceptor.accept(stream).await else {
                        return;
                    };
                    counted.fetch_add(1, Ordering::SeqCst);
                    let first = sent.lock().unwrap().to_bytes().unwrap();
                    let _ = stream.write_all(&first).await;
                    let mut bytes = [0; 256];
                    while let Ok(length @ 1..) = stream.read(&mut bytes).await {
                        let _ = stream.write_all(&bytes[..length]).await;
                    }
                });
            }
        });
        let membership = Membership {
            site: "yard".parse().unwrap(),
            robot: "rover-1".parse().unwrap(),
            enrolment: 1,
            certificate: robot_certificate.pem(),
            key: robot_key.serialize_pem(),
            authority: authority.pem(),
            server: String::new(),
            trust: Trust::Machine,
            endpoint: format!("tls/{address}"),
            issued_at: Timestamp::UNIX_EPOCH,
            lifetime_s: 60,
        };
        Self {
            address,
            credentials,
            joined,
            membership,
            _tasks: tasks,
        }
    }

    async fn tunnel(&self) -> Tunnel {
        let opening = Tunnel::open(&self.membership.endpoint, &self.membership);
        tokio::time::timeout(PATIENCE, opening)
            .await
            .unwrap()
            .unwrap()
    }
}

/// The first message of the session that a tunnel is for.
fn first_message(tunnel: &Tunnel) -> Vec<u8> {
    let id = u128::from_str_radix(&tunnel.user.session_id, 16).unwrap();
    [&[20_u8, 0, 0x01, 0x09, 0, 0][..], &id.to_le_bytes()].concat()
}

/// Sends bytes to the tunnel's local port; what comes back until there is as much, or the end.
async fn say(tunnel: &Tunnel, bytes: &[u8]) -> Vec<u8> {
    let mut local = TcpStream::connect(tunnel.local).await.unwrap();
    let _ = local.write_all(bytes).await;
    let mut answer = vec![0; bytes.len()];
    let reading = tokio::time::timeout(PATIENCE, local.read_exact(&mut answer));
    match reading.await.expect("it is answered or closed") {
        Ok(_) => answer,
        Err(_) => Vec::new(),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_reconnects_until_the_server_has_other_credentials_for_it() {
    let port = EchoPort::start(ALPN).await;
    let tunnel = port.tunnel().await;
    let message = first_message(&tunnel);
    for connections in 1..=3 {
        assert_eq!(say(&tunnel, &message).await, message);
        assert_eq!(port.joined.load(Ordering::SeqCst), connections);
    }
    assert!(!tunnel.stale.is_cancelled());
    *port.credentials.lock().unwrap() = credentials("second");
    assert_eq!(say(&tunnel, &message).await, b"", "nothing passes");
    let stale = tokio::time::timeout(PATIENCE, tunnel.stale());
    stale.await.expect("the owner is notified to open another");
    let another = port.tunnel().await;
    assert_eq!(another.user.password, "second");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_program_on_the_robot_reaches_nobody_through_the_local_port() {
    let port = EchoPort::start(ALPN).await;
    let tunnel = port.tunnel().await;
    let message = first_message(&tunnel);
    // The session's own connection, after which each further one is dialled.
    assert_eq!(say(&tunnel, &message).await, message);
    let mut other_id = message.clone();
    other_id[21] ^= 1;
    for bytes in [
        &other_id[..],
        &[0, 0],
        &[0xff; 64],
        b"GET / HTTP/1.1\r\n\r\n",
        &[9, 0, 1],
    ] {
        assert_eq!(say(&tunnel, bytes).await, b"");
    }
    assert_eq!(port.joined.load(Ordering::SeqCst), 1);
    // None of it stands in the session's way.
    assert_eq!(say(&tunnel, &message).await, message);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn programs_that_say_nothing_take_no_place_of_the_session() {
    let port = EchoPort::start(ALPN).await;
    let tunnel = port.tunnel().await;
    let message = first_message(&tunnel);
    let mut silent = Vec::new();
    for _ in 0..2 * CONNECTIONS_MAX {
        silent.push(TcpStream::connect(tunnel.local).await.unwrap());
    }
    assert_eq!(say(&tunnel, &message).await, message);
    // The oldest of them gave their places to the newest.
    let mut nothing = [0; 1];
    let reading = tokio::time::timeout(PATIENCE, silent[0].read(&mut nothing));
    assert!(matches!(reading.await.unwrap(), Ok(0) | Err(_)));
}

#[test]
fn other_programs_are_logged_now_and_then_with_their_count() {
    let log = UnknownClientLog::default();
    let begun = tokio::time::Instant::now();
    assert_eq!(log.count_client(begun), Some(1));
    for _ in 0..1_000 {
        assert_eq!(
            log.count_client(begun + UNKNOWN_CLIENTS_LOG_EVERY / 2),
            None
        );
    }
    assert_eq!(
        log.count_client(begun + UNKNOWN_CLIENTS_LOG_EVERY),
        Some(1_001)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_of_another_fleet_or_protocol_gets_no_tunnel() {
    let port = EchoPort::start(ALPN).await;
    let mut foreign = EchoPort::start(ALPN).await.membership;
    foreign.endpoint.clone_from(&port.membership.endpoint);
    let dialer = Dialer::new(&foreign.endpoint, &foreign).unwrap();
    assert!(matches!(
        dialer.dial(&[]).await,
        Err(DialError::Distrusted(_))
    ));
    let (mut distrusted, mut unreachable) = (RETRY_FIRST, RETRY_FIRST);
    for _ in 0..20 {
        let cause = io::Error::from(io::ErrorKind::Other);
        distrusted = next_pause(distrusted, &DialError::Distrusted(cause));
        unreachable = next_pause(unreachable, &DialError::TooSlow);
    }
    assert_eq!((distrusted, unreachable), (DISTRUSTED_RETRY_MAX, RETRY_MAX));
    let older = EchoPort::start(b"tread/1").await;
    let dialer = Dialer::new(&older.membership.endpoint, &older.membership).unwrap();
    assert!(matches!(
        dialer.dial(&[]).await,
        Err(DialError::Unreachable(_))
    ));
    let mut damaged = port.membership.clone();
    damaged.key = "no key".to_owned();
    let refused = Dialer::new(&damaged.endpoint, &damaged);
    assert!(matches!(refused.err(), Some(LinkError::Certificate(_))));
    assert_eq!(port.address.to_string(), port.membership.endpoint[4..]);
}
