//! The time of a query to a client of a bare zenoh router, without anything of Tread: a command to a
//! robot cannot be faster.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use serde::Serialize;
use tokio::time::Instant;
use tread_tests::light_robot::open_session;
use tread_tests::report::quantile;

use crate::states::BareRouter;

/// Key of the queries.
const KEY: &str = "floor";
/// Number of queries, one after the other.
const QUERIES: usize = 500;
/// Maximum time for all of them.
const QUERIES_TIMEOUT: Duration = Duration::from_mins(1);
/// Payload of queries and answers, bytes: that of an offer of a circle.
const PAYLOAD_BYTES: usize = 600;

/// Times of queries.
#[derive(Debug, Serialize)]
pub(crate) struct QueryFloor {
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
}

/// Measures queries from one client of a router to another.
pub(crate) async fn query(node: &Path) -> anyhow::Result<QueryFloor> {
    let failed = |error: zenoh::Error| anyhow!("zenoh: {error}");
    let router = BareRouter::start(node)?;
    let endpoint = format!("tcp/{}", router.address);
    let (asks, answers) = (
        open_session(&endpoint).await?,
        open_session(&endpoint).await?,
    );
    let payload = vec![b'x'; PAYLOAD_BYTES];
    let answer = payload.clone();
    let _queryable = answers
        .declare_queryable(KEY)
        .callback(move |query| {
            let reply = query.reply(KEY, answer.clone());
            // Whoever asked may have gone; the next query shows whether the router still works.
            let _ = zenoh::Wait::wait(reply);
        })
        .await
        .map_err(failed)?;
    let asking = async {
        let mut times_ms = Vec::with_capacity(QUERIES);
        while times_ms.len() < QUERIES {
            let begin = Instant::now();
            let replies = asks.get(KEY).payload(payload.clone()).await;
            // Until the router knows of the queryable nobody answers.
            if replies.map_err(failed)?.recv_async().await.is_ok() {
                times_ms.push(1e3 * begin.elapsed().as_secs_f64());
            }
        }
        anyhow::Ok(times_ms)
    };
    let asked = tokio::time::timeout(QUERIES_TIMEOUT, asking).await;
    let mut times_ms = asked.context("a bare router does not answer in time")??;
    Ok(QueryFloor {
        p50_ms: quantile(&mut times_ms, 0.5),
        p99_ms: quantile(&mut times_ms, 0.99),
    })
}
