//! Responses with an `ETag`, which a client need not fetch again while they are unchanged.

use std::hash::{DefaultHasher, Hash, Hasher as _};

use axum::body::Bytes;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tread_api::problem::ProblemType;

use super::problem::Problem;

/// Returns JSON with an `ETag` of its content; 304 without a body if the client has it already.
pub(super) fn json<T: Serialize>(headers: &HeaderMap, answer: &T) -> Response {
    match serde_json::to_vec(answer) {
        Ok(text) => bytes(headers, "application/json", text.into()),
        Err(error) => {
            tracing::error!("cannot write an answer: {error}");
            Problem::new(ProblemType::Internal).into_response()
        }
    }
}

/// Returns a body with an `ETag` of its content; 304 without a body if the client has it already.
pub(super) fn bytes(headers: &HeaderMap, media_type: &'static str, body: Bytes) -> Response {
    let mut hasher = DefaultHasher::new();
    media_type.hash(&mut hasher);
    body.hash(&mut hasher);
    let tag = format!("\"{:016x}-{:x}\"", hasher.finish(), body.len());
    let make = || {
        let media_type = HeaderValue::from_static(media_type);
        ([(header::CONTENT_TYPE, media_type)], body).into_response()
    };
    tagged(headers, tag, make)
}

/// Returns a streamed response with a weak `ETag` of `state`, which must change whenever the
/// response does; 304 without a body if the client has it already, and then `make` is not run.
///
/// # Errors
/// The response cannot be begun.
pub(super) async fn streamed(
    headers: &HeaderMap,
    media_type: &'static str,
    state: impl Hash,
    make: impl Future<Output = Result<Response, Problem>>,
) -> Result<Response, Problem> {
    let mut hasher = DefaultHasher::new();
    (media_type, state).hash(&mut hasher);
    let tag = format!("W/\"{:016x}\"", hasher.finish());
    let response = if is_held(headers, &tag) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        make.await?
    };
    Ok(with_tag(response, tag))
}

fn tagged(headers: &HeaderMap, tag: String, make: impl FnOnce() -> Response) -> Response {
    let response = if is_held(headers, &tag) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        make()
    };
    with_tag(response, tag)
}

fn with_tag(mut response: Response, tag: String) -> Response {
    let headers = response.headers_mut();
    if let Ok(tag) = HeaderValue::try_from(tag) {
        headers.insert(header::ETAG, tag);
    }
    // Cached, but revalidated each time: the map changes while robots drive.
    let held = HeaderValue::from_static("private, no-cache");
    headers.insert(header::CACHE_CONTROL, held);
    response
}

/// Returns whether `If-None-Match` contains this tag.
fn is_held(headers: &HeaderMap, tag: &str) -> bool {
    let held = headers.get_all(header::IF_NONE_MATCH).into_iter();
    let mut listed = held
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .map(|entry| entry.trim().trim_start_matches("W/"));
    let tag = tag.trim_start_matches("W/");
    listed.any(|entry| entry == tag || entry == "*")
}
