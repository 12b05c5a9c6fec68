//! Streamed responses.

use std::io;

use axum::body::{Body, Bytes};
use axum::http::{HeaderValue, header};
use axum::response::Response;
use futures_util::{StreamExt as _, stream};

use crate::app::AppError;
use crate::http::problem::Problem;

/// The media type of JSON.
pub(super) const JSON_MEDIA_TYPE: &str = "application/json";
/// The media type of CSV.
pub(super) const CSV_MEDIA_TYPE: &str = "text/csv";
/// The media type of Parquet.
pub(super) const PARQUET_MEDIA_TYPE: &str = "application/vnd.apache.parquet";
/// Number of chunks that are made before the response begins: the head of a table and its first rows.
const CHUNKS_BEFORE_RESPONSE: usize = 2;

/// Streams a response in chunks, each made when the preceding one was sent.
///
/// If a later chunk cannot be made the connection is broken, so that a client does not take a part
/// for the whole; the cause is logged.
///
/// # Errors
/// One of the first chunks cannot be made.
pub(super) async fn streamed<E: Send + 'static, F>(
    media_type: &'static str,
    export: E,
    next: impl Fn(E) -> F + Send + 'static,
) -> Result<Response, Problem>
where
    F: Future<Output = Result<Option<(Vec<u8>, E)>, AppError>> + Send + 'static,
{
    let mut first = Vec::with_capacity(CHUNKS_BEFORE_RESPONSE);
    let mut rest = Some(export);
    while first.len() < CHUNKS_BEFORE_RESPONSE {
        let Some(export) = rest.take() else { break };
        if let Some((bytes, export)) = next(export).await? {
            first.push(Ok::<_, io::Error>(Bytes::from(bytes)));
            rest = Some(export);
        }
    }
    let later = stream::try_unfold((rest, next), async |(export, next)| {
        let Some(export) = export else {
            return Ok(None);
        };
        match next(export).await {
            Ok(Some((bytes, export))) => Ok(Some((Bytes::from(bytes), (Some(export), next)))),
            Ok(None) => Ok(None),
            Err(error) => {
                tracing::error!("an export broke off: {error:?}");
                Err(io::Error::other("the export broke off"))
            }
        }
    });
    let chunks = stream::iter(first).chain(later);
    let mut response = Response::new(Body::from_stream(chunks));
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(header::VARY, HeaderValue::from_static("accept"));
    Ok(response)
}

#[cfg(test)]
mod tests {
    use std::future::ready;

    use axum::body::to_bytes;
    use axum::http::StatusCode;
    use axum::response::IntoResponse as _;

    use super::*;

    /// A response of chunks `0`, `1`, … until one cannot be made.
    async fn failing_at(failing: u8) -> Result<Response, Problem> {
        let next = move |number: u8| {
            ready(if number == failing {
                Err(AppError::Unwritable("a disk failed".to_owned()))
            } else {
                Ok(Some((vec![number], number + 1)))
            })
        };
        streamed(CSV_MEDIA_TYPE, 0, next).await
    }

    #[tokio::test]
    async fn a_failure_before_the_first_row_is_a_problem_and_a_later_one_breaks_the_body() {
        for failing in [0, 1] {
            let refused = failing_at(failing).await.unwrap_err().into_response();
            let status = refused.status();
            assert_eq!(status, StatusCode::INTERNAL_SERVER_ERROR, "{failing}");
        }
        for failing in [2, 3] {
            let begun = failing_at(failing).await.unwrap();
            let body = to_bytes(begun.into_body(), usize::MAX).await;
            assert!(body.is_err(), "{failing}: {body:?}");
        }
    }
}
