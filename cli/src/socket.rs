//! WebSocket to a robot, opened with the same HTTP client as every other request: with the same
//! address, TLS, trusted certificates and token.

use reqwest::{Method, StatusCode, Upgraded, header};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::handshake::client::generate_key;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};
use tread_api::ids::{RobotId, SiteId};

use crate::client::{Client, ClientError};

/// Maximum size of a frame from the server, bytes; a view has a few kilobytes.
const FRAME_MAX: usize = 1 << 20;

/// Socket to watch and drive a robot.
pub(crate) type Socket = WebSocketStream<Upgraded>;

/// Opens the drive socket of a robot.
///
/// # Errors
/// [`ClientError`] if the server does not answer, refuses, or does not open a WebSocket.
pub(crate) async fn open(
    client: &Client,
    site: &SiteId,
    robot: &RobotId,
) -> Result<Socket, ClientError> {
    let lost = |cause| client.lost(cause);
    let path = format!("/v1/sites/{site}/robots/{robot}/drive");
    let key = generate_key();
    let request = client
        .request(Method::GET, &path)
        .header(header::CONNECTION, "Upgrade")
        .header(header::UPGRADE, "websocket")
        .header(header::SEC_WEBSOCKET_VERSION, "13")
        .header(header::SEC_WEBSOCKET_KEY, &key);
    let response = request.send().await.map_err(lost)?;
    if response.status() != StatusCode::SWITCHING_PROTOCOLS {
        return Err(client.refusal(response).await);
    }
    let accepted = response.headers().get(header::SEC_WEBSOCKET_ACCEPT);
    if accepted.is_none_or(|accepted| accepted != derive_accept_key(key.as_bytes()).as_str()) {
        return Err(ClientError::NoWebSocket {
            address: client.address().to_owned(),
        });
    }
    let stream = response.upgrade().await.map_err(lost)?;
    let config = WebSocketConfig::default()
        .max_message_size(Some(FRAME_MAX))
        .max_frame_size(Some(FRAME_MAX));
    Ok(WebSocketStream::from_raw_socket(stream, Role::Client, Some(config)).await)
}
