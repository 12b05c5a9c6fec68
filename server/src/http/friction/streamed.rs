//! Streamed responses.

use std::io;

use axum::body::{Body, Bytes};
use axum::http::{HeaderValue, header};
use axum::response::Response;
use futures_util::stream;

use crate::app::AppError;

/// The media type of JSON.
pub(super) const JSON_MEDIA_TYPE: &str = "application/json";
/// The media type of CSV.
pub(super) const CSV_MEDIA_TYPE: &str = "text/csv";
/// The media type of Parquet.
pub(super) const PARQUET_MEDIA_TYPE: &str = "application/vnd.apache.parquet";

/// Streams a response in chunks, each made when the preceding one was sent.
///
/// If a chunk cannot be made the connection is broken, so that a client does not take a part for
/// the whole; the cause is logged.
pub(super) fn streamed<E: Send + 'static, F>(
    media_type: &'static str,
    export: E,
    next: impl Fn(E) -> F + Send + 'static,
) -> Response
where
    F: Future<Output = Result<Option<(Vec<u8>, E)>, AppError>> + Send + 'static,
{
    let pieces = stream::try_unfold((export, next), async |(export, next)| {
        match next(export).await {
            Ok(Some((bytes, export))) => Ok(Some((Bytes::from(bytes), (export, next)))),
            Ok(None) => Ok(None),
            Err(error) => {
                tracing::error!("an export broke off: {error:?}");
                Err(io::Error::other("the export broke off"))
            }
        }
    });
    let mut response = Response::new(Body::from_stream(pieces));
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(header::VARY, HeaderValue::from_static("accept"));
    response
}
