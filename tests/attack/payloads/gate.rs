//! Openings of a zenoh session, damaged, at the robots' port by a robot's own certificate.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::Context as _;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tread_agent::fleet::Tunnel;
use tread_agent::membership::Membership;
use tread_api::tunnel::ALPN;
use tread_tests::damage::damage;
use tread_tests::random::Random;

use super::Sent;

/// Longest wait for the server: an opening takes 5 s at the most.
const END_MAX: Duration = Duration::from_secs(10);
/// Rest between two of them.
const REST: Duration = Duration::from_millis(5);
/// Longest wait for what the zenoh session says first.
const RECORD_MAX: Duration = Duration::from_secs(10);

/// What a good session begins with: length and bytes of its first frame.
pub(super) struct Recorded {
    init: Vec<u8>,
}

async fn frame(from: &mut (impl AsyncRead + Unpin)) -> anyhow::Result<Vec<u8>> {
    let length = from.read_u16_le().await?;
    let mut frame = length.to_le_bytes().to_vec();
    frame.resize(2 + usize::from(length), 0);
    from.read_exact(&mut frame[2..]).await?;
    Ok(frame)
}

/// Records how a session of this robot begins, by listening where its router would.
pub(super) async fn record(endpoint: &str, membership: &Membership) -> anyhow::Result<Recorded> {
    let tunnel = Tunnel::open(endpoint, membership).await?;
    let mut config = tunnel.session_config()?;
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let here = format!("[\"tcp/{}\"]", listener.local_addr()?);
    let set = config.insert_json5("connect/endpoints", &here);
    set.map_err(|error| anyhow::anyhow!("zenoh refuses an endpoint: {error}"))?;
    let opening = tokio::task::spawn_blocking(move || zenoh::Wait::wait(zenoh::open(config)));
    let recording = async {
        let (mut stream, _) = listener.accept().await?;
        frame(&mut stream).await
    };
    let init = timeout(RECORD_MAX, recording)
        .await
        .context("no session began")??;
    opening.abort();
    Ok(Recorded { init })
}

/// TLS as the robot of this membership.
fn connector(membership: &Membership) -> anyhow::Result<TlsConnector> {
    // The key leaves a membership only as it is stored.
    let stored = serde_json::to_value(membership)?;
    let key = stored["key"].as_str().context("a membership has a key")?;
    let mut roots = RootCertStore::empty();
    for authority in CertificateDer::pem_slice_iter(membership.authority.as_bytes()) {
        roots.add(authority?)?;
    }
    let chain = CertificateDer::pem_slice_iter(membership.certificate.as_bytes());
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut config = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_root_certificates(roots)
        .with_client_auth_cert(
            chain.collect::<Result<_, _>>()?,
            PrivateKeyDer::from_pem_slice(key.as_bytes())?,
        )?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    Ok(TlsConnector::from(Arc::new(config)))
}

/// Connects and reads the credentials that the server sends first.
async fn dial(address: SocketAddr, by: &TlsConnector) -> anyhow::Result<TlsStream<TcpStream>> {
    let stream = TcpStream::connect(address).await?;
    let name = ServerName::try_from(address.ip().to_string())?;
    let mut stream = by.connect(name, stream).await?;
    let length = usize::from(stream.read_u16().await?);
    stream.read_exact(&mut vec![0; length]).await?;
    Ok(stream)
}

/// What is sent in place of the first frame, and perhaps of the second.
fn opening(recorded: &Recorded, random: &mut Random) -> Vec<u8> {
    let mut init = recorded.init.clone();
    match random.index(6) {
        // Half a frame, a length that nothing follows, one that is too large, noise.
        0 => init.truncate(random.index(init.len())),
        1 => init = vec![0xff, 0x0f],
        2 => {
            init = vec![0xff, 0xff];
            init.resize(70_000, 0x41);
        }
        3 => {
            init = (0..random.index(4_000))
                .map(|_| random.next_u64().to_le_bytes()[0])
                .collect();
        }
        4 => {
            // The frame as it is, and noise where the second is due.
            let mut second = vec![0x20, 0x00];
            second.extend((0..32).map(|_| random.next_u64().to_le_bytes()[0]));
            init.extend(second);
        }
        _ => {
            let mut inside = init.split_off(2);
            damage(&mut inside, random);
            let length = u16::try_from(inside.len()).unwrap_or(u16::MAX);
            init = length.to_le_bytes().to_vec();
            init.extend(inside);
        }
    }
    init
}

/// Opens sessions in damaged ways until it is time.
pub(super) async fn attack(
    address: SocketAddr,
    membership: Membership,
    recorded: Recorded,
    sent: Arc<Sent>,
    mut random: Random,
    until: Instant,
) {
    let Ok(by) = connector(&membership) else {
        return;
    };
    while Instant::now() < until {
        tokio::time::sleep(REST).await;
        let Ok(Ok(mut stream)) = timeout(END_MAX, dial(address, &by)).await else {
            continue;
        };
        sent.openings.fetch_add(1, Ordering::Relaxed);
        let bytes = opening(&recorded, &mut random);
        let trying = async {
            // The server may end it before all is sent.
            let _ = stream.write_all(&bytes).await;
            let _ = stream.flush().await;
            if random.chance(0.5) {
                // A link that goes away in the middle.
                return;
            }
            let mut answer = [0; 4_096];
            while let Ok(1..) = stream.read(&mut answer).await {}
        };
        if timeout(END_MAX, trying).await.is_ok() {
            sent.ended_openings.fetch_add(1, Ordering::Relaxed);
        }
    }
}
