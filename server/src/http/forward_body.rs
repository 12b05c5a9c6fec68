//! Bodies of answers that a standby forwards.

use std::future::ready;

use axum::body::{Body, HttpBody as _};
use axum::http::{Response, header};
use futures_util::{StreamExt as _, stream};
use tokio_util::sync::CancellationToken;

/// Tokens that end the answers of a standby.
#[derive(Debug, Clone, Default)]
pub(crate) struct EndTokens {
    /// Cancelled when the server stops.
    pub(crate) stop: CancellationToken,
    /// Cancelled when answers of the other server are not awaited any more.
    pub(crate) given_up: CancellationToken,
}

/// Cause of a body that breaks off.
#[derive(Debug, thiserror::Error)]
#[error("the server that has the database does not answer any more")]
struct ForwardTimeout;

/// Ends the body of an answer when the other server is given up, and a stream of events also at the stop:
/// its client goes on at another server. Other bodies break off, so that no part passes for the whole.
pub(super) fn cut_short(answer: Response<Body>, tokens: EndTokens) -> Response<Body> {
    if answer.body().is_end_stream() {
        return answer;
    }
    let EndTokens { stop, given_up } = tokens;
    let (parts, body) = answer.into_parts();
    let content = parts.headers.get(header::CONTENT_TYPE);
    let is_events =
        content.is_some_and(|content| content.as_bytes().starts_with(b"text/event-stream"));
    let body = body.into_data_stream();
    let body = if is_events {
        Body::from_stream(body.take_until(async move {
            tokio::select! {
                () = given_up.cancelled() => {}
                () = stop.cancelled() => {}
            }
        }))
    } else {
        let is_given_up = given_up.clone();
        let broken = move |()| {
            let cause = is_given_up.is_cancelled().then_some(ForwardTimeout);
            ready(cause.map(|cause| Err(axum::Error::new(cause))))
        };
        let rest = stream::once(ready(())).filter_map(broken);
        Body::from_stream(body.take_until(given_up.cancelled_owned()).chain(rest))
    };
    Response::from_parts(parts, body)
}

#[cfg(test)]
mod tests {
    use axum::body::{Bytes, to_bytes};

    use super::*;

    /// An answer that has said something and says nothing more.
    fn unfinished(content_type: &str) -> Response<Body> {
        let first = stream::once(ready(Ok::<_, axum::Error>(Bytes::from_static(b"first"))));
        let answer = Response::builder().header(header::CONTENT_TYPE, content_type);
        let body = Body::from_stream(first.chain(stream::pending()));
        answer.body(body).unwrap()
    }

    #[tokio::test]
    async fn a_stream_of_events_ends_and_other_bodies_break_off() {
        for content_type in ["text/event-stream", "text/csv"] {
            let tokens = EndTokens::default();
            let answer = cut_short(unfinished(content_type), tokens.clone());
            tokens.given_up.cancel();
            let whole = to_bytes(answer.into_body(), usize::MAX).await;
            let is_events = content_type == "text/event-stream";
            assert_eq!(whole.is_ok(), is_events, "{content_type}: {whole:?}");
        }
        // A stop ends streams alone.
        let tokens = EndTokens::default();
        let answer = cut_short(unfinished("text/event-stream"), tokens.clone());
        tokens.stop.cancel();
        to_bytes(answer.into_body(), usize::MAX).await.unwrap();
        let whole = Response::new(Body::from("whole"));
        let tokens = EndTokens::default();
        tokens.stop.cancel();
        let answer = cut_short(whole, tokens);
        assert_eq!(
            to_bytes(answer.into_body(), usize::MAX).await.unwrap(),
            "whole"
        );
    }
}
