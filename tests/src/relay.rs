//! A network between robots and server that can be cut and healed.
//!
//! Every connection to the relay is carried on to its target. While it is cut, bytes are neither
//! read nor written and new connections hang, as on a radio link out of range: no side is told.

use std::net::{Ipv4Addr, SocketAddr};

use anyhow::Context;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

/// Bytes carried at once.
const BUFFER_BYTES: usize = 16 * 1024;

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
    pub async fn start(target: SocketAddr) -> anyhow::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await?;
        let address = listener
            .local_addr()
            .context("a bound port has an address")?;
        let (passes, _) = watch::channel(true);
        let (generation, _) = watch::channel(0);
        let mut carriers = JoinSet::new();
        carriers.spawn(accept(
            listener,
            target,
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
    target: SocketAddr,
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
                let far = TcpStream::connect(target).await.ok()?;
                carry_both_ways(near, far, passes).await;
                Some(())
            };
            tokio::select! {
                _ = carried => {}
                _ = generation.changed() => {}
            }
        });
    }
}

async fn carry_both_ways(near: TcpStream, far: TcpStream, passes: watch::Receiver<bool>) {
    _ = near.set_nodelay(true);
    _ = far.set_nodelay(true);
    let (near_read, near_write) = near.into_split();
    let (far_read, far_write) = far.into_split();
    // The end of one direction ends the connection, as a reset would.
    tokio::select! {
        () = carry(near_read, far_write, passes.clone()) => {}
        () = carry(far_read, near_write, passes) => {}
    }
}

async fn carry(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, mut passes: watch::Receiver<bool>) {
    let mut buffer = vec![0; BUFFER_BYTES];
    loop {
        let Ok(count @ 1..) = from.read(&mut buffer).await else {
            return;
        };
        if passes.wait_for(|passes| *passes).await.is_err() {
            return;
        }
        if to.write_all(&buffer[..count]).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

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
