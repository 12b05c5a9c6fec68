//! Checks the opening of a zenoh session; the gate forwards the rest of the session unread.
//!
//! ```text
//!  robot ── InitSyn: client, own session id ──► router
//!        ◄──────────── InitAck ────────────────
//!        ── OpenSyn: own user name ───────────►
//! ```
//!
//! Each frame has a length (two bytes, little-endian) and its bytes. The router reads one message
//! of each of the first two frames with the same codec as this module, so it sees exactly what was
//! checked. The router itself checks the password.

use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tread_api::tunnel::RouterCredentials;
use zenoh_buffers::reader::HasReader as _;
use zenoh_codec::{RCodec as _, Zenoh080};
use zenoh_protocol::common::ZExtUnknown;
use zenoh_protocol::common::extension::ZExtBody;
use zenoh_protocol::common::iext::ID_MASK;
use zenoh_protocol::core::WhatAmI;
use zenoh_protocol::transport::{InitSyn, OpenSyn, TransportBody, TransportMessage};

/// Maximum size of a frame in the opening, bytes. The largest one is the router's, with its cookie.
const FRAME_BYTES_MAX: u16 = 4 * 1024;
/// Zenoh's number of the authentication method by user name and password.
const USER_PASSWORD_ID: u8 = 0x2;

/// Reason why a session is rejected.
#[derive(Debug, thiserror::Error)]
pub(super) enum OpeningRefused {
    /// The link broke or was closed by the client.
    #[error("the link ended while the session opened")]
    Ended(#[from] std::io::Error),
    /// A frame is too long for an opening; holds its length in bytes.
    #[error("a frame of {0} bytes is no part of an opening")]
    TooLong(u16),
    /// Another message arrived than the expected one.
    #[error("the message is not the {0} that is due")]
    NotDue(&'static str),
    /// The client declares itself a router or a peer.
    #[error("a session that opens as {0} and not as client")]
    NotClient(WhatAmI),
    /// The session's identifier does not belong to this robot.
    #[error("a session id that is not this robot's")]
    ForeignId,
    /// The user name is not that of this robot.
    #[error("a user name that is not this robot's")]
    ForeignUser,
}

/// The checked first message of a session.
#[derive(Debug)]
pub(super) struct Init {
    /// The session's id.
    pub(super) session_id: u128,
    frame: Vec<u8>,
}

/// Reads and checks the first message of a session. The router is contacted only afterwards, since
/// it has few places for opening sessions.
///
/// # Errors
/// [`OpeningRefused`].
pub(super) async fn read_init(
    robot: &mut (impl AsyncRead + Unpin),
    credentials: &RouterCredentials,
) -> Result<Init, OpeningRefused> {
    let frame = read_frame(robot).await?;
    let session_id = check_init(&frame, credentials)?;
    Ok(Init { session_id, frame })
}

/// Forwards and checks the opening of a session between robot and router.
///
/// # Errors
/// [`OpeningRefused`]; the messages that the router has received by then do not open a session.
pub(super) async fn pass_opening(
    robot: &mut (impl AsyncRead + AsyncWrite + Unpin),
    router: &mut TcpStream,
    init: &Init,
    credentials: &RouterCredentials,
) -> Result<(), OpeningRefused> {
    write_frame(router, &init.frame).await?;
    let answer = read_frame(router).await?;
    write_frame(robot, &answer).await?;
    let frame = read_frame(robot).await?;
    check_open(&frame, credentials)?;
    write_frame(router, &frame).await
}

async fn read_frame(from: &mut (impl AsyncRead + Unpin)) -> Result<Vec<u8>, OpeningRefused> {
    let length = from.read_u16_le().await?;
    if length > FRAME_BYTES_MAX {
        return Err(OpeningRefused::TooLong(length));
    }
    let mut frame = vec![0; usize::from(length)];
    from.read_exact(&mut frame).await?;
    Ok(frame)
}

async fn write_frame(
    to: &mut (impl AsyncWrite + Unpin),
    frame: &[u8],
) -> Result<(), OpeningRefused> {
    // Cannot fail: the length was read from two bytes.
    let length = u16::try_from(frame.len()).unwrap_or(u16::MAX);
    let whole = [&length.to_le_bytes()[..], frame].concat();
    to.write_all(&whole).await?;
    to.flush().await?;
    Ok(())
}

/// Returns the only message of a frame; `None` unless there is exactly one.
fn message(frame: &[u8]) -> Option<TransportBody> {
    let mut reader = frame.reader();
    let message: TransportMessage = Zenoh080::new().read(&mut reader).ok()?;
    reader.is_empty().then_some(message.body)
}

fn check_init(frame: &[u8], credentials: &RouterCredentials) -> Result<u128, OpeningRefused> {
    let Some(TransportBody::InitSyn(InitSyn { whatami, zid, .. })) = message(frame) else {
        return Err(OpeningRefused::NotDue("InitSyn"));
    };
    if whatami != WhatAmI::Client {
        return Err(OpeningRefused::NotClient(whatami));
    }
    let session_id = u128::from_le_bytes(zid.to_le_bytes());
    if !credentials.session_prefix.is_of(session_id) {
        return Err(OpeningRefused::ForeignId);
    }
    Ok(session_id)
}

fn check_open(frame: &[u8], credentials: &RouterCredentials) -> Result<(), OpeningRefused> {
    let Some(TransportBody::OpenSyn(open)) = message(frame) else {
        return Err(OpeningRefused::NotDue("OpenSyn"));
    };
    match user_in(&open) {
        Some(user) if user == credentials.user.as_bytes() => Ok(()),
        _ => Err(OpeningRefused::ForeignUser),
    }
}

/// Returns the user name in an opening message; `None` unless there is exactly one.
fn user_in(open: &OpenSyn) -> Option<Vec<u8>> {
    let shown = open.ext_auth.as_ref()?;
    let codec = Zenoh080::new();
    let shown: Vec<ZExtUnknown> = codec.read(&mut shown.value.reader()).ok()?;
    let [ZExtUnknown { id, body }] = &shown[..] else {
        return None;
    };
    let ZExtBody::ZBuf(value) = body else {
        return None;
    };
    if id & ID_MASK != USER_PASSWORD_ID {
        return None;
    }
    codec.read(&mut value.reader()).ok()
}
