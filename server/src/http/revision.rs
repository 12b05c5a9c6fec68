//! Revisions of what can be replaced: the `ETag` of an answer, and the `If-Match` of a request that
//! is done only while the revision is still one of those.

use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tread_api::problem::ProblemType;

use super::extract::Json;
use super::problem::Problem;
use crate::app::precondition::Precondition;

/// Returns an answer with its revision as the `ETag`.
pub(super) fn tagged<T: Serialize>(status: StatusCode, revision: u64, answer: T) -> Response {
    let tag = format!("\"{revision}\"");
    (status, [(header::ETAG, tag)], Json(answer)).into_response()
}

/// Reads `If-Match` (RFC 9110, 13.1.1): `*`, or a list of entity tags, which are compared strongly, so
/// that a weak one matches no revision.
///
/// # Errors
/// The header is neither.
pub(super) fn expected(headers: &HeaderMap) -> Result<Precondition, Problem> {
    let lines = headers.get_all(header::IF_MATCH).iter();
    // A value that is not text is no entity tag.
    let lines: Vec<&str> = lines.map(|line| line.to_str().unwrap_or("?")).collect();
    if lines.is_empty() {
        return Ok(Precondition::Any);
    }
    let list = lines.join(",");
    if list.trim() == "*" {
        return Ok(Precondition::Any);
    }
    let tags = strong_tags(&list).ok_or_else(|| {
        Problem::new(ProblemType::InvalidHeader)
            .detail(
                "If-Match must be `*` or a list of revisions as in ETag, in quotation marks: \"3\"",
            )
            .field("if-match")
    })?;
    let revision = |tag: &str| {
        let revision: u64 = tag.parse().ok()?;
        // `+3` and `03` are other tags.
        (revision.to_string() == tag).then_some(revision)
    };
    let revisions = tags.into_iter().filter_map(revision).collect();
    Ok(Precondition::OneOf(revisions))
}

/// Returns the contents of the strong tags in a list of entity tags; `None` if it is no such list.
fn strong_tags(list: &str) -> Option<Vec<&str>> {
    let (mut strong, mut is_any) = (Vec::new(), false);
    let mut rest = list;
    loop {
        // Elements of a list may be empty.
        rest = rest.trim_start_matches([' ', '\t', ',']);
        if rest.is_empty() {
            return is_any.then_some(strong);
        }
        let (is_weak, quoted) = match rest.strip_prefix("W/") {
            Some(quoted) => (true, quoted),
            None => (false, rest),
        };
        let (tag, after) = quoted.strip_prefix('"')?.split_once('"')?;
        rest = after.trim_start_matches([' ', '\t']);
        let is_separated = rest.is_empty() || rest.starts_with(',');
        if !is_separated || !tag.bytes().all(|byte| byte.is_ascii_graphic()) {
            return None;
        }
        is_any = true;
        if !is_weak {
            strong.push(tag);
        }
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn read(lines: &[&'static str]) -> Result<Precondition, Problem> {
        let mut headers = HeaderMap::new();
        for line in lines {
            headers.append(header::IF_MATCH, HeaderValue::from_static(line));
        }
        expected(&headers)
    }

    #[test]
    fn if_match_is_any_revision_or_a_list_that_is_compared_strongly() {
        let none: &[&'static str] = &[];
        for lines in [none, &["*"], &[" * "]] {
            assert_eq!(read(lines), Ok(Precondition::Any), "{lines:?}");
        }
        let cases: [(&[&'static str], &[u64]); 9] = [
            (&["\"3\""], &[3]),
            (&["\"3\", \"5\""], &[3, 5]),
            (&["\"3\"", "\"5\""], &[3, 5]),
            (&[",\"3\" ,, \"5\","], &[3, 5]),
            (&["W/\"3\""], &[]),
            (&["W/\"3\", \"5\""], &[5]),
            (&["\"of,another\", \"5\""], &[5]),
            (&["\"03\", \"+3\""], &[]),
            (&["\"\", \"99999999999999999999\""], &[]),
        ];
        for (lines, revisions) in cases {
            let wanted = Precondition::OneOf(revisions.to_vec());
            assert_eq!(read(lines), Ok(wanted), "{lines:?}");
        }
        for wrong in [
            "",
            ",",
            "3",
            "first",
            "\"3",
            "\"3\" \"5\"",
            "w/\"3\"",
            "*, \"3\"",
            "\"a b\"",
            "\"3\"x",
        ] {
            assert!(read(&[wrong]).is_err(), "`{wrong}` was taken");
        }
    }
}
