//! One connection to the robots' port: TCP, TLS with the robot's certificate, and the router's
//! credentials.

use std::io;
use std::str::FromStr as _;
use std::sync::Arc;
use std::time::Duration;

use rustls::client::Resumption;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{AlertDescription, CertificateError, ClientConfig, ClientConnection, RootCertStore};
use socket2::SockRef;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream, lookup_host};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tread_api::tunnel::{
    ALPN, CREDENTIALS_BYTES_MAX, NOT_SENT_BYTES_MAX, RouterCredentials, UNANSWERED_MAX,
};
use zenoh::config::EndPoint;

use crate::fleet::LinkError;
use crate::membership::Membership;

/// Timeout of one attempt to connect. The kernel repeats its first packet every second, so a
/// restored network is found within that; this value lies between two repetitions. It also bounds
/// the round trips of TCP and TLS on a link of high delay.
const DIAL_TIMEOUT: Duration = Duration::from_millis(2_500);
/// Kernel send buffer, bytes, unless the endpoint names one: priorities act only above that buffer,
/// so on a slow link a large one delays urgent messages behind bulk data.
const SEND_BUFFER_BYTES: u32 = 24 * 1024;
/// Data that rustls buffers when the socket's buffer is full, bytes.
const TLS_BUFFER_BYTES: usize = 4 * 1024;
/// Protocol name of an endpoint that is reached through the tunnel.
const PROTOCOL: &str = "tls";
/// Key of the send buffer's size in an endpoint, as in zenoh.
const SEND_BUFFER_KEY: &str = "so_sndbuf";

/// Why a connection could not be made. The agent tries again after each of them;
/// [`DialError::Unreachable`] and [`DialError::TooSlow`] may pass by themselves, and the others need
/// another clock, certificate, trust or version.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// The name cannot be resolved, no process listens there, or the handshake failed.
    #[error("the server's robot port cannot be reached")]
    Unreachable(#[source] io::Error),
    /// The server's certificate is of an authority that this robot does not trust.
    #[error("the server's robot port is of another authority than this robot trusts")]
    Distrusted(#[source] io::Error),
    /// The server refuses the robot's certificate because of its validity.
    #[error(
        "the server refuses this robot's certificate as expired: it is renewed while the server's \
         REST API can be reached; otherwise join again with `tread-agent enroll`"
    )]
    Expired(#[source] io::Error),
    /// The server's certificate is not valid by this robot's clock.
    #[error(
        "the server's certificate is not valid by this robot's clock: compare the clocks of robot \
         and server, and have both synchronised"
    )]
    ClockWrong(#[source] io::Error),
    /// The connection was not made in time.
    #[error("the server's robot port did not answer in time")]
    TooSlow,
    /// The server's protocol or credentials are not those of this version.
    #[error("the server's robot port does not speak this version of the protocol")]
    NotUnderstood,
}

impl DialError {
    /// Returns whether a certificate is refused because of its validity.
    pub(super) fn is_about_validity(&self) -> bool {
        matches!(self, Self::Expired(_) | Self::ClockWrong(_))
    }
}

impl From<io::Error> for DialError {
    fn from(cause: io::Error) -> Self {
        let tls = cause.get_ref().and_then(|cause| cause.downcast_ref());
        match tls {
            // Two authorities may have the same name; then the signature is wrong.
            Some(rustls::Error::InvalidCertificate(
                CertificateError::UnknownIssuer | CertificateError::BadSignature,
            )) => Self::Distrusted(cause),
            Some(rustls::Error::InvalidCertificate(
                CertificateError::Expired
                | CertificateError::ExpiredContext { .. }
                | CertificateError::NotValidYet
                | CertificateError::NotValidYetContext { .. },
            )) => Self::ClockWrong(cause),
            Some(rustls::Error::AlertReceived(AlertDescription::CertificateExpired)) => {
                Self::Expired(cause)
            }
            _ => Self::Unreachable(cause),
        }
    }
}

/// Address of the robots' port.
#[derive(Debug, Clone, PartialEq, Eq)]
struct PortAddress {
    host: String,
    port: u16,
    send_buffer_bytes: u32,
}

impl PortAddress {
    /// Parses an endpoint such as `tls/tread.example:7447`.
    fn read(endpoint: &str) -> Result<Self, LinkError> {
        let failed = |problem: &str| LinkError::Endpoint {
            endpoint: endpoint.to_owned(),
            problem: problem.to_owned(),
        };
        let parsed =
            EndPoint::from_str(endpoint).map_err(|problem| failed(&problem.to_string()))?;
        if parsed.protocol().as_str() != PROTOCOL {
            return Err(failed("a robot that has joined connects by `tls/`"));
        }
        let (host, port) = parsed
            .address()
            .as_str()
            .rsplit_once(':')
            .map(|(host, port)| (host.to_owned(), port.parse()))
            .ok_or_else(|| failed("it names no port"))?;
        let port = port.map_err(|_| failed("its port is no number"))?;
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        let send_buffer_bytes = match parsed.config().get(SEND_BUFFER_KEY) {
            None => SEND_BUFFER_BYTES,
            Some(text) => text
                .parse()
                .map_err(|_| failed("its `so_sndbuf` is no number of bytes"))?,
        };
        Ok(Self {
            host: bare.to_owned(),
            port,
            send_buffer_bytes,
        })
    }
}

/// Connects to the robots' port of one server as one robot.
pub(super) struct Dialer {
    address: PortAddress,
    name: ServerName<'static>,
    connector: TlsConnector,
}

/// A TLS connection on which the robot has presented its certificate.
pub(super) type Connection = TlsStream<TcpStream>;

/// Checks that a text is an endpoint of the robots' port.
///
/// # Errors
/// [`LinkError::Endpoint`].
pub(super) fn check_endpoint(endpoint: &str) -> Result<(), LinkError> {
    let address = PortAddress::read(endpoint)?;
    server_name(&address, endpoint).map(|_| ())
}

fn server_name(address: &PortAddress, endpoint: &str) -> Result<ServerName<'static>, LinkError> {
    ServerName::try_from(address.host.clone()).map_err(|problem| LinkError::Endpoint {
        endpoint: endpoint.to_owned(),
        problem: problem.to_string(),
    })
}

impl Dialer {
    /// Creates a dialer.
    ///
    /// # Errors
    /// [`LinkError`]: the endpoint is invalid, or the certificate cannot be used.
    pub(super) fn new(endpoint: &str, membership: &Membership) -> Result<Self, LinkError> {
        let address = PortAddress::read(endpoint)?;
        let name = server_name(&address, endpoint)?;
        let config = client_config(membership).map_err(LinkError::Certificate)?;
        Ok(Self {
            address,
            name,
            connector: TlsConnector::from(Arc::new(config)),
        })
    }

    /// Connects; `first` is sent as soon as the server is authenticated. Returns the connection and
    /// the router's credentials.
    pub(super) async fn dial(
        &self,
        first: &[u8],
    ) -> Result<(Connection, RouterCredentials), DialError> {
        let dialling = async {
            let stream = self.connect().await?;
            // Otherwise rustls would buffer 64 KiB when the socket is full, regardless of
            // priorities.
            let bound = |tls: &mut ClientConnection| tls.set_buffer_limit(Some(TLS_BUFFER_BYTES));
            let connecting = self
                .connector
                .connect_with(self.name.clone(), stream, bound);
            let mut stream = connecting.await?;
            if stream.get_ref().1.alpn_protocol() != Some(ALPN) {
                return Err(DialError::NotUnderstood);
            }
            if !first.is_empty() {
                stream.write_all(first).await?;
                stream.flush().await?;
            }
            let credentials = read_credentials(&mut stream).await?;
            Ok((stream, credentials))
        };
        tokio::time::timeout(DIAL_TIMEOUT, dialling)
            .await
            .unwrap_or(Err(DialError::TooSlow))
    }

    /// Connects to the first address of the name that accepts.
    async fn connect(&self) -> io::Result<TcpStream> {
        let mut failed = io::Error::from(io::ErrorKind::NotFound);
        for address in lookup_host((&*self.address.host, self.address.port)).await? {
            let socket = if address.is_ipv4() {
                TcpSocket::new_v4()?
            } else {
                TcpSocket::new_v6()?
            };
            socket.set_send_buffer_size(self.address.send_buffer_bytes)?;
            match socket.connect(address).await {
                Ok(stream) => {
                    stream.set_nodelay(true)?;
                    let socket = SockRef::from(&stream);
                    socket.set_tcp_notsent_lowat(NOT_SENT_BYTES_MAX)?;
                    socket.set_tcp_user_timeout(Some(UNANSWERED_MAX))?;
                    return Ok(stream);
                }
                Err(cause) => failed = cause,
            }
        }
        Err(failed)
    }
}

async fn read_credentials(stream: &mut Connection) -> Result<RouterCredentials, DialError> {
    let length = usize::from(stream.read_u16().await?);
    if length > CREDENTIALS_BYTES_MAX {
        return Err(DialError::NotUnderstood);
    }
    let mut json = vec![0; length];
    stream.read_exact(&mut json).await?;
    serde_json::from_slice(&json).map_err(|_| DialError::NotUnderstood)
}

/// Creates the configuration of mutual TLS 1.3: the robot's certificate, and the fleet's
/// authorities.
fn client_config(membership: &Membership) -> Result<ClientConfig, rustls::Error> {
    let unreadable = |_| rustls::Error::General("it does not read as PEM".to_owned());
    let mut roots = RootCertStore::empty();
    for authority in CertificateDer::pem_slice_iter(membership.authority.as_bytes()) {
        roots.add(authority.map_err(unreadable)?)?;
    }
    let chain = CertificateDer::pem_slice_iter(membership.certificate.as_bytes())
        .collect::<Result<Vec<_>, _>>()
        .map_err(unreadable)?;
    let key = PrivateKeyDer::from_pem_slice(membership.key.as_bytes()).map_err(unreadable)?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut config = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_root_certificates(roots)
        .with_client_auth_cert(chain, key)?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    // Each connection is verified as a whole, as the server does.
    config.resumption = Resumption::disabled();
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_name_a_host_and_a_port_and_may_name_a_send_buffer() {
        for (endpoint, host, port, send_buffer_bytes) in [
            (
                "tls/tread.example:7447",
                "tread.example",
                7447,
                SEND_BUFFER_BYTES,
            ),
            ("tls/192.0.2.1:7#so_sndbuf=9000", "192.0.2.1", 7, 9_000),
            (
                "tls/[2001:db8::1]:7447",
                "2001:db8::1",
                7447,
                SEND_BUFFER_BYTES,
            ),
        ] {
            let expected = PortAddress {
                host: host.to_owned(),
                port,
                send_buffer_bytes,
            };
            assert_eq!(PortAddress::read(endpoint).unwrap(), expected);
            check_endpoint(endpoint).unwrap();
        }
    }

    #[test]
    fn what_is_no_endpoint_of_the_robots_port_is_refused_with_its_text() {
        for endpoint in [
            "",
            "nonsense",
            "tls/",
            "tls/tread.example",
            "tls/tread.example:x",
            "tls/tread.example:70000",
            "tls/:7447",
            "tls/a b:7447",
            "tls/h:7447#so_sndbuf=much",
            "tcp/h:7447",
            "quic/h:7447",
        ] {
            let refused = check_endpoint(endpoint).unwrap_err().to_string();
            assert!(refused.contains(endpoint), "{refused}");
        }
    }
}
