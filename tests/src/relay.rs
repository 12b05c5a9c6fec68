//! A network between robots and server that can be cut and healed.
//!
//! Every connection to the relay is carried on to its target. While it is cut, bytes are neither
//! read nor written and new connections hang, as on a radio link out of range: no side is notified.
//! A relay may carry only so many bytes a second each way, as a narrow link does.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use anyhow::Context;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::Instant;

/// Bytes carried at once.
const BUFFER_BYTES: usize = 16 * 1024;
/// Bytes carried at once by a narrow relay, and what its sockets may hold: its queue is that of the
/// sender, as on a radio.
const NARROW_BUFFER_BYTES: usize = 2 * 1024;
const NARROW_SOCKET_BYTES: u32 = 4 * 1024;

/// How far a narrow link may lag behind its rate and make up for it.
const SLACK: Duration = Duration::from_millis(4);
/// Connections that may wait to be carried.
const CONNECTIONS_WAITING_MAX: u32 = 1_024;

/// A running relay; dropping it closes every connection.
#[derive(Debug)]
pub struct Relay {
    address: SocketAddr,
    passes: watch::Sender<bool>,
    generation: watch::Sender<u64>,
    _carriers: JoinSet<()>,
}

impl Relay {
    /// Listens on a free port of the loopback and carries everything on to `target`.
    ///
    /// # Errors
    /// No port could be bound.
    #[expect(
        clippy::unused_async,
        reason = "it needs the runtime that it is awaited on"
    )]
    pub async fn start(target: SocketAddr) -> anyhow::Result<Self> {
        Self::start_with(target, None)
    }

    /// The same for a link that carries at most so many bytes a second each way.
    ///
    /// # Errors
    /// No port could be bound.
    #[expect(
        clippy::unused_async,
        reason = "it needs the runtime that it is awaited on"
    )]
    pub async fn start_narrow(target: SocketAddr, bytes_per_s: f64) -> anyhow::Result<Self> {
        Self::start_with(target, Some(bytes_per_s))
    }

    fn start_with(target: SocketAddr, bytes_per_s: Option<f64>) -> anyhow::Result<Self> {
        let socket = TcpSocket::new_v4()?;
        if bytes_per_s.is_some() {
            // What connects here inherits it.
            socket.set_recv_buffer_size(NARROW_SOCKET_BYTES)?;
        }
        socket.bind((Ipv4Addr::LOCALHOST, 0).into())?;
        let listener = socket.listen(CONNECTIONS_WAITING_MAX)?;
        let address = listener
            .local_addr()
            .context("a bound port has an address")?;
        let (passes, _) = watch::channel(true);
        let (generation, _) = watch::channel(0);
        let mut carriers = JoinSet::new();
        carriers.spawn(accept(
            listener,
            (target, bytes_per_s),
            passes.subscribe(),
            generation.subscribe(),
        ));
        Ok(Self {
            address,
            passes,
            generation,
            _carriers: carriers,
        })
    }

    /// Where the relay listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Stops carrying anything, without telling anybody.
    pub fn cut(&self) {
        self.passes.send_replace(false);
    }

    /// Carries again; what the ends sent meanwhile arrives now, unless they gave up.
    pub fn heal(&self) {
        self.passes.send_replace(true);
    }

    /// Resets every connection; new ones are possible if the relay is not cut.
    pub fn reset(&self) {
        self.generation.send_modify(|generation| *generation += 1);
    }
}

async fn accept(
    listener: TcpListener,
    (target, bytes_per_s): (SocketAddr, Option<f64>),
    passes: watch::Receiver<bool>,
    generation: watch::Receiver<u64>,
) {
    let mut connections = JoinSet::new();
    while let Ok((near, _)) = listener.accept().await {
        while connections.try_join_next().is_some() {}
        let mut passes = passes.clone();
        let mut generation = generation.clone();
        generation.mark_unchanged();
        connections.spawn(async move {
            let carried = async {
                passes.wait_for(|passes| *passes).await.ok()?;
                let socket = TcpSocket::new_v4().ok()?;
                if bytes_per_s.is_some() {
                    socket.set_recv_buffer_size(NARROW_SOCKET_BYTES).ok()?;
                }
                let far = socket.connect(target).await.ok()?;
                carry_both_ways((near, far), bytes_per_s, passes).await;
                Some(())
            };
            tokio::select! {
                _ = carried => {}
                _ = generation.changed() => {}
            }
        });
    }
}

async fn carry_both_ways(
    (near, far): (TcpStream, TcpStream),
    bytes_per_s: Option<f64>,
    passes: watch::Receiver<bool>,
) {
    _ = near.set_nodelay(true);
    _ = far.set_nodelay(true);
    let (near_read, near_write) = near.into_split();
    let (far_read, far_write) = far.into_split();
    // The end of one direction ends the connection, as a reset would.
    tokio::select! {
        () = carry((near_read, far_write), bytes_per_s, passes.clone()) => {}
        () = carry((far_read, near_write), bytes_per_s, passes) => {}
    }
}

async fn carry(
    (mut from, mut to): (OwnedReadHalf, OwnedWriteHalf),
    bytes_per_s: Option<f64>,
    mut passes: watch::Receiver<bool>,
) {
    let size = bytes_per_s.map_or(BUFFER_BYTES, |_| NARROW_BUFFER_BYTES);
    let mut buffer = vec![0; size];
    // When the link has carried everything that it took before.
    let mut free_at = Instant::now();
    loop {
        tokio::time::sleep_until(free_at).await;
        let Ok(count @ 1..) = from.read(&mut buffer).await else {
            return;
        };
        if passes.wait_for(|passes| *passes).await.is_err() {
            return;
        }
        if let Some(bytes_per_s) = bytes_per_s {
            #[expect(clippy::cast_precision_loss, reason = "a buffer's length")]
            let takes = Duration::from_secs_f64(count as f64 / bytes_per_s);
            // Timers are coarse: a little of what was slept too long may be made up for.
            let now = Instant::now();
            free_at = free_at.max(now.checked_sub(SLACK).unwrap_or(now)) + takes;
        }
        if to.write_all(&buffer[..count]).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_narrow_link_carries_at_its_rate() {
        let target = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let address = target.local_addr().unwrap();
        let relay = Relay::start_narrow(address, 1e6).await.unwrap();
        let mut near = TcpStream::connect(relay.address()).await.unwrap();
        let (mut far, _) = target.accept().await.unwrap();
        let began = Instant::now();
        let mut sending = JoinSet::new();
        sending.spawn(async move {
            near.write_all(&vec![7; 500_000]).await.unwrap();
            near
        });
        far.read_exact(&mut vec![0; 500_000]).await.unwrap();
        let took_s = began.elapsed().as_secs_f64();
        assert!((0.45..1.5).contains(&took_s), "{took_s} s");
        sending.join_all().await;
    }

    #[tokio::test]
    async fn what_is_sent_during_a_cut_arrives_after_it() {
        let target = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let relay = Relay::start(target.local_addr().unwrap()).await.unwrap();
        let mut near = TcpStream::connect(relay.address()).await.unwrap();
        let (mut far, _) = target.accept().await.unwrap();
        let mut byte = [0; 1];
        near.write_all(b"a").await.unwrap();
        far.read_exact(&mut byte).await.unwrap();
        relay.cut();
        near.write_all(b"b").await.unwrap();
        let during = tokio::time::timeout(Duration::from_millis(100), far.read(&mut byte)).await;
        assert!(during.is_err(), "a byte passed the cut");
        relay.heal();
        far.read_exact(&mut byte).await.unwrap();
        assert_eq!(&byte, b"b");
        relay.reset();
        assert_eq!(
            far.read(&mut byte).await.unwrap_or(0),
            0,
            "the connection outlived a reset"
        );
    }
}
