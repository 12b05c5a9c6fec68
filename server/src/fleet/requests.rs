//! Queries of robots that expect an answer: hellos and uploads.

use std::sync::Arc;

use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::ids::{RobotId, SiteId};
use tread_api::keys::Key;
use tread_api::wire::encoding::Encoding;
use tread_api::wire::hello::Hello;
use tread_api::wire::ingest::Batch;
use tread_api::wire::{self, Refusal, RefusalCode};
use zenoh::Wait as _;
use zenoh::query::Query;

use super::rate_limits::RateLimits;
use super::received::{
    LimitedQuery, RefusedMessage, count_refusal, explained, log_refusal, next, refuse_key,
};
use crate::app::App;
use crate::app::ingest::Upload;
use crate::supervisor::Supervisor;

/// Maximum number of replies under way; each may block a thread on a full link.
const REPLIES_MAX: usize = 384;

/// Sends replies without blocking the task that reads the queries.
#[derive(Debug, Clone)]
pub(super) struct Replies {
    app: App,
    limits: RateLimits,
    supervisor: Supervisor,
    slots: Arc<Semaphore>,
}

impl Replies {
    pub(super) fn new(app: App, limits: RateLimits, supervisor: Supervisor) -> Self {
        Self {
            app,
            limits,
            supervisor,
            slots: Arc::new(Semaphore::new(REPLIES_MAX)),
        }
    }

    /// Awaits the answer in a task and sends it. Without a free slot the query is dropped: its
    /// robot gets no reply and asks again.
    fn answer<T, F>(&self, LimitedQuery { query, place }: LimitedQuery, answering: F)
    where
        T: Serialize + Send + 'static,
        F: Future<Output = Result<T, Refusal>> + Send + 'static,
    {
        let Ok(slot) = Arc::clone(&self.slots).try_acquire_owned() else {
            self.app.counters().replies_dropped.one();
            return;
        };
        let supervisor = self.supervisor.clone();
        self.supervisor.spawn_passing("reply", async move {
            let answer = answering.await;
            // Sending blocks its thread when the robot's link is full.
            supervisor.blocking(move || send(&query, &answer)).await;
            drop((slot, place));
        });
    }

    /// Parses a query's body, and checks that it names the robot of its key and that messages of
    /// this robot are accepted.
    fn read<T: DeserializeOwned>(
        &self,
        query: &Query,
        robot_of: impl Fn(&T) -> &RobotId,
    ) -> Option<(SiteId, Result<T, Refusal>)> {
        let key = query.key_expr().as_str();
        let Some(Key::Hello(site, robot) | Key::Ingest(site, robot)) = Key::parse(key) else {
            refuse_key(&self.app, key);
            return None;
        };
        // No reply means not delivered: a robot that joins again has lost nothing.
        let of = (site.clone(), robot.clone());
        if !self.app.admits(&of) {
            return None;
        }
        let payload = query
            .payload()
            .map(zenoh::bytes::ZBytes::to_bytes)
            .unwrap_or_default();
        let encoding = query.encoding().map(ToString::to_string);
        let encoding = Encoding::of_media_type(encoding.as_deref().unwrap_or_default());
        let body = match wire::decode_as::<T>(encoding, &payload) {
            Ok(body) if *robot_of(&body) == robot => Ok(body),
            Ok(body) => {
                self.app.counters().refused_impersonation.one();
                let detail = format!(
                    "the key names robot `{robot}`, the body `{}`",
                    robot_of(&body)
                );
                Err(Refusal {
                    code: RefusalCode::Impersonation,
                    detail,
                })
            }
            Err(error) => {
                count_refusal(&self.app, &error);
                let detail = explained(&error);
                Err(Refusal {
                    detail,
                    ..Refusal::from(&error)
                })
            }
        };
        if let Err(refusal) = &body {
            let refused = RefusedMessage {
                key,
                why: &refusal.detail,
            };
            log_refusal(&self.app, &self.limits, &of, refused);
        }
        Some((site, body))
    }
}

fn send<T: Serialize>(query: &Query, answer: &Result<T, Refusal>) {
    let encoded = match answer {
        Ok(body) => wire::encode(body),
        Err(refusal) => wire::encode(refusal),
    };
    let payload = match encoded {
        Ok(payload) => payload,
        Err(error) => return warn!("cannot write an answer: {error}"),
    };
    let sent = match answer {
        Ok(_) => query.reply(query.key_expr().clone(), payload).wait(),
        Err(_) => query.reply_err(payload).wait(),
    };
    if let Err(error) = sent {
        debug!(
            "an answer on `{}` did not go out: {error}",
            query.key_expr()
        );
    }
}

/// Answers hellos until the stop.
pub(super) async fn serve_hellos(
    replies: Replies,
    mut queries: mpsc::Receiver<LimitedQuery>,
    stop: CancellationToken,
) {
    while let Some(limited) = next(&mut queries, &stop).await {
        let Some((site, hello)) = replies.read(&limited.query, |hello: &Hello| &hello.robot) else {
            continue;
        };
        let app = replies.app.clone();
        replies.answer(limited, async move {
            let welcome = app.hello(&site, &hello?).await?;
            app.counters().hellos_answered.one();
            Ok(welcome)
        });
    }
}

/// Passes uploads to the writer and its answers to the robots, until the stop.
pub(super) async fn serve_uploads(
    replies: Replies,
    mut queries: mpsc::Receiver<LimitedQuery>,
    writer: mpsc::Sender<Upload>,
    stop: CancellationToken,
) {
    while let Some(limited) = next(&mut queries, &stop).await {
        let Some((site, batch)) = replies.read(&limited.query, |batch: &Batch| &batch.robot) else {
            continue;
        };
        let outcome = batch.and_then(|batch| {
            let (answer, answered) = oneshot::channel();
            let upload = Upload {
                site,
                batch,
                answer,
            };
            writer.try_send(upload).map(|()| answered).map_err(|_full| {
                replies.app.counters().ingest_dropped_busy.one();
                busy("too many uploads are waiting")
            })
        });
        replies.answer(limited, async move {
            let answered = outcome?;
            answered
                .await
                .unwrap_or_else(|_stopping| Err(busy("the server is stopping")))
        });
    }
}

fn busy(detail: &str) -> Refusal {
    Refusal {
        code: RefusalCode::Busy,
        detail: detail.to_owned(),
    }
}
