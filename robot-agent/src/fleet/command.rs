//! A received command, and its answer.

use serde::Serialize;
use tracing::warn;
use tread_api::keys::Verb;
use tread_api::wire::reply::Answer;
use tread_api::wire::{self, Refusal};
use zenoh::Wait;
use zenoh::query::Query;

/// A command that waits for its answer.
#[derive(Debug)]
pub struct IncomingCommand {
    /// Verb of the command.
    pub verb: Verb,
    /// Payload as received.
    pub payload: Vec<u8>,
    pub(super) query: Query,
}

impl IncomingCommand {
    /// Sends the answer; a failure is logged, since the server repeats the command.
    pub async fn answer<R: Serialize>(self, answer: &Answer<R>) {
        match wire::encode(answer) {
            Ok(payload) => self.reply(payload, false).await,
            Err(cause) => warn!(
                error = &cause as &dyn std::error::Error,
                "cannot write an answer"
            ),
        }
    }

    /// Refuses the whole message by an error reply.
    pub async fn refuse(self, refusal: &Refusal) {
        if let Ok(payload) = wire::encode(refusal) {
            self.reply(payload, true).await;
        }
    }

    async fn reply(self, payload: Vec<u8>, is_error: bool) {
        let replying = tokio::task::spawn_blocking(move || {
            if is_error {
                self.query.reply_err(payload).wait()
            } else {
                self.query
                    .reply(self.query.key_expr().clone(), payload)
                    .wait()
            }
        });
        if let Ok(Err(cause)) = replying.await {
            warn!("an answer could not be sent: {cause}");
        }
    }
}
