//! Revisions of what can be replaced: the `ETag` of an answer, and the `If-Match` of a request that
//! is done only while the revision is still that one.

use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tread_api::problem::ProblemType;

use super::extract::Json;
use super::problem::Problem;

/// Returns an answer with its revision as the `ETag`.
pub(super) fn tagged<T: Serialize>(status: StatusCode, revision: u64, answer: T) -> Response {
    let tag = format!("\"{revision}\"");
    (status, [(header::ETAG, tag)], Json(answer)).into_response()
}

/// Returns the revision in `If-Match`; `None` without the header, and for `*`.
///
/// # Errors
/// The header is not one revision, as in the `ETag`.
pub(super) fn expected(headers: &HeaderMap) -> Result<Option<u64>, Problem> {
    let Some(tag) = headers.get(header::IF_MATCH) else {
        return Ok(None);
    };
    let text = tag.to_str().unwrap_or_default().trim();
    if text == "*" {
        return Ok(None);
    }
    let wrong = |_error| {
        Problem::new(ProblemType::InvalidHeader)
            .detail("If-Match is one revision, as in the ETag")
            .field("if-match")
    };
    text.trim_matches('"').parse().map(Some).map_err(wrong)
}
