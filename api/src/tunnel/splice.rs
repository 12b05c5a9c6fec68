//! Bidirectional copy between two streams: a robot's link and its zenoh session, on both ends of
//! the tunnel.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf, copy_bidirectional_with_sizes};
use tokio::sync::Notify;

/// Time that data in transit has left after one side has ended. Without this bound, a side that
/// does not close, or a dead network, would keep the connection forever.
const END_GRACE: Duration = Duration::from_secs(1);

/// Stream that notifies of the end of its input.
struct Ending<'ended, S> {
    stream: S,
    ended: &'ended Notify,
}

impl<S: AsyncRead + Unpin> AsyncRead for Ending<'_, S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = ready!(Pin::new(&mut self.stream).poll_read(context, buffer));
        if buffer.filled().len() == before {
            self.ended.notify_one();
        }
        Poll::Ready(read)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Ending<'_, S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

/// Copies in both directions until both sides have ended, or until [`END_GRACE`] after the first of
/// them has ended.
///
/// # Errors
/// The I/O error of a read or write on either stream.
pub async fn splice(
    one: impl AsyncRead + AsyncWrite + Unpin,
    other: impl AsyncRead + AsyncWrite + Unpin,
    buffer_bytes: usize,
) -> io::Result<()> {
    let ended = Notify::new();
    let mut one = Ending {
        stream: one,
        ended: &ended,
    };
    let mut other = Ending {
        stream: other,
        ended: &ended,
    };
    let copying = copy_bidirectional_with_sizes(&mut one, &mut other, buffer_bytes, buffer_bytes);
    let grace_over = async {
        ended.notified().await;
        tokio::time::sleep(END_GRACE).await;
    };
    tokio::select! {
        copied = copying => copied.map(|_bytes| ()),
        () = grace_over => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;

    const BUFFER_BYTES: usize = 64;

    #[tokio::test]
    async fn what_was_sent_arrives_and_a_side_that_does_not_end_holds_nothing() {
        let (mut robot, outside) = duplex(BUFFER_BYTES);
        let (mut router, inside) = duplex(BUFFER_BYTES);
        let begun = tokio::time::Instant::now();
        let ending = async {
            router.write_all(b"the last word").await.unwrap();
            drop(router);
            let mut heard = Vec::new();
            // The robot reads to the end and keeps its side open.
            robot.read_to_end(&mut heard).await.unwrap();
            heard
        };
        let (spliced, heard) = tokio::join!(splice(outside, inside, BUFFER_BYTES), ending);
        spliced.unwrap();
        assert_eq!(heard, b"the last word");
        let took = begun.elapsed();
        assert!(took >= END_GRACE && took < 5 * END_GRACE, "{took:?}");
    }
}
