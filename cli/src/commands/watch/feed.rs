//! Event stream of the server, reopened where it was interrupted.

use std::time::Duration;

use anyhow::Context as _;
use tokio::sync::mpsc;
use tokio::time::timeout;
use tread_api::event::Event;
use tread_api::ids::{RobotId, SiteId};

use crate::client::{Client, ClientError};

/// Maximum number of news in the queue; while it is full, the stream is not read.
pub(super) const MESSAGES_MAX: usize = 256;
/// Time before the stream is reopened.
const REOPEN_REST: Duration = Duration::from_secs(1);
/// Silence after which a stream counts as interrupted; the server sends something every 15 s.
const SILENCE_MAX: Duration = Duration::from_secs(45);
/// Maximum size of the unread part of a stream, bytes; sufficient for a mission with the maximum
/// number of waypoints. A longer event interrupts the stream.
const LINE_MAX: usize = 32 * 1024 * 1024;

/// Message from the event stream.
#[derive(Debug)]
pub(super) enum FeedMessage {
    /// The stream is open.
    Opened,
    /// An event was received.
    Event(Box<Event>),
    /// The stream was interrupted, with the reason; it is reopened.
    Lost(String),
}

/// Event stream of one site.
pub(super) struct Feed<'client> {
    client: &'client Client,
    site: &'client SiteId,
    robot: Option<&'client RobotId>,
    /// Identifier of the last event, with which the stream is resumed.
    last: Option<String>,
    was_open: bool,
}

impl<'client> Feed<'client> {
    pub(super) fn new(
        client: &'client Client,
        site: &'client SiteId,
        robot: Option<&'client RobotId>,
    ) -> Self {
        Self {
            client,
            site,
            robot,
            last: None,
            was_open: false,
        }
    }

    /// Receives events until the receiver of `to` is dropped.
    ///
    /// # Errors
    /// The stream could not be opened at the first attempt, or the server refused it.
    pub(super) async fn run(mut self, to: mpsc::Sender<FeedMessage>) -> anyhow::Result<()> {
        while !to.is_closed() {
            match self.follow(&to).await {
                Ok(()) => {}
                Err(error) => {
                    let refused = error.downcast_ref::<ClientError>();
                    let is_refused = refused
                        .is_some_and(|error| error.problem().is_some() && !error.is_temporary());
                    if !self.was_open || is_refused {
                        return Err(error);
                    }
                    // The receiver may be dropped by now.
                    _ = to.send(FeedMessage::Lost(format!("{error:#}"))).await;
                }
            }
            tokio::time::sleep(REOPEN_REST).await;
        }
        Ok(())
    }

    /// Receives the events of one stream until it is interrupted. Returns only with an error.
    async fn follow(&mut self, to: &mpsc::Sender<FeedMessage>) -> anyhow::Result<()> {
        let last = self.last.clone();
        let opening = self.client.events(self.site, self.robot, last.as_deref());
        let mut stream = opening.await?;
        self.was_open = true;
        _ = to.send(FeedMessage::Opened).await;
        let mut text = Vec::new();
        loop {
            let chunk = timeout(SILENCE_MAX, stream.chunk()).await;
            let chunk =
                chunk.with_context(|| format!("{} sent nothing in time", self.client.address()))?;
            match chunk {
                Ok(Some(chunk)) => text.extend_from_slice(&chunk),
                Ok(None) => anyhow::bail!("{} has closed the stream", self.client.address()),
                Err(cause) => return Err(self.client.lost(cause).into()),
            }
            anyhow::ensure!(text.len() <= LINE_MAX, "an event is too long");
            while let Some(end) = text.windows(2).position(|pair| pair == b"\n\n") {
                let block: Vec<u8> = text.drain(..end + 2).collect();
                let (id, event) = read(self.client, &String::from_utf8_lossy(&block));
                if id.is_some() {
                    self.last = id;
                }
                if let Some(event) = event {
                    _ = to.send(FeedMessage::Event(event)).await;
                }
            }
        }
    }
}

/// Parses the identifier and the event of a block of lines. Unknown events of a newer server are
/// ignored.
fn read(client: &Client, block: &str) -> (Option<String>, Option<Box<Event>>) {
    let field = |name: &str| block.lines().find_map(|line| line.strip_prefix(name));
    let event = field("data: ").and_then(|text| client.read(text.as_bytes()).ok());
    (field("id: ").map(str::to_owned), event.map(Box::new))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::TrustAnchor;

    #[test]
    fn an_event_is_read_with_its_id_and_what_is_not_known_is_passed_over() {
        let _first = rustls::crypto::ring::default_provider().install_default();
        let client = Client::new("http://127.0.0.1:1", None, TrustAnchor::System).unwrap();
        let end = "event: snapshot_end\ndata: \"snapshot_end\"\nid: 5-7\n\n";
        let (id, event) = read(&client, end);
        assert_eq!(id.as_deref(), Some("5-7"));
        assert_eq!(event.as_deref(), Some(&Event::SnapshotEnd));
        assert_eq!(read(&client, ": keep-alive\n\n"), (None, None));
        assert_eq!(read(&client, "data: {\"weather\":{}}\n\n"), (None, None));
    }
}
