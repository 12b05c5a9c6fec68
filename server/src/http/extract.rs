//! Extractors of bodies, paths and queries, whose rejections are problems.
//!
//! `Json` refuses unknown fields, so that a client learns of a misspelt one. (The decoder of robots'
//! payloads uses the same types but ignores unknown fields, so that versions can differ.)

use std::collections::BTreeMap;
use std::time::Duration;

use axum::body::Body;
use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::request::Parts;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt as _;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::value::{RawValue, to_raw_value};
use tread_api::page::{PAGE_LIMIT_DEFAULT, PAGE_LIMIT_MAX};
use tread_api::problem::ProblemType;

use super::problem::Problem;
use super::subject::{AuditSlot, Subject};

/// Maximum number of unknown fields named in a response.
const UNKNOWN_FIELDS_NAMED_MAX: usize = 5;

/// Maximum time for the body of a request with a credential to arrive.
pub const BODY_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum time for the body of a request without a credential to arrive.
pub const UNAUTHENTICATED_BODY_TIMEOUT: Duration = Duration::from_secs(2);

/// Maximum number of bytes beyond the limit of a body that are read and discarded, so that a client
/// that is still sending gets the response instead of a broken connection.
const DISCARDED_BYTES_MAX: usize = 64 * 1024 * 1024;

/// Maximum size of a route's body, bytes; a request extension set by a layer.
#[derive(Debug, Clone, Copy)]
pub(super) struct BodyLimit(pub(super) usize);

/// A JSON body of a request or response.
#[derive(Debug, Clone)]
pub struct Json<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Serialize> FromRequest<S> for Json<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, _state: &S) -> Result<Self, Problem> {
        if !is_json(request.headers()) {
            return Err(Problem::new(ProblemType::UnsupportedMediaType)
                .detail("send the body with `content-type: application/json`"));
        }
        if is_encoded(request.headers()) {
            return Err(Problem::new(ProblemType::UnsupportedMediaType)
                .detail("send the body uncompressed, without `content-encoding`"));
        }
        let limit = request.extensions().get::<BodyLimit>().copied();
        let limit = limit.unwrap_or(BodyLimit(super::BODY_MAX));
        let slot = request.extensions().get::<AuditSlot>().cloned();
        let subject = request.extensions().get::<Subject>().cloned();
        let within = match &subject {
            Some(_) => BODY_TIMEOUT,
            None => UNAUTHENTICATED_BODY_TIMEOUT,
        };
        let reading = read(request.into_body(), limit);
        let body = tokio::time::timeout(within, reading).await;
        let body = body.map_err(|_elapsed| {
            let detail = format!("the body did not arrive within {} s", within.as_secs());
            Problem::new(ProblemType::BodyTimeout).detail(detail)
        })??;
        if subject.is_some_and(|Subject(subject)| subject.ended().is_cancelled()) {
            return Err(Problem::new(ProblemType::Unauthenticated)
                .detail("the token was revoked, or the session ended, before the body arrived"));
        }
        let parsed = parse(&body)?;
        if let Some(slot) = slot {
            slot.leave(&body);
        }
        Ok(Self(parsed))
    }
}

impl<T: Serialize> IntoResponse for Json<T> {
    fn into_response(self) -> Response {
        match serde_json::to_vec(&self.0) {
            Ok(text) => ([(header::CONTENT_TYPE, "application/json")], text).into_response(),
            Err(error) => {
                tracing::error!("cannot write an answer: {error}");
                Problem::new(ProblemType::Internal).into_response()
            }
        }
    }
}

fn is_json(headers: &HeaderMap) -> bool {
    let value = headers
        .get(header::CONTENT_TYPE)
        .and_then(|value| value.to_str().ok());
    let essence = value
        .and_then(|value| value.split(';').next())
        .map(str::trim);
    essence.is_some_and(|essence| essence.eq_ignore_ascii_case("application/json"))
}

/// Returns whether a body is compressed, which no route decodes.
fn is_encoded(headers: &HeaderMap) -> bool {
    let mut encodings = headers.get_all(header::CONTENT_ENCODING).iter();
    encodings.any(|encoding| !encoding.as_bytes().eq_ignore_ascii_case(b"identity"))
}

/// Reads a whole body, or discards one that is too large.
pub(super) async fn read(body: Body, BodyLimit(limit): BodyLimit) -> Result<Vec<u8>, Problem> {
    let mut chunks = body.into_data_stream();
    let mut text = Vec::new();
    let mut discarded = 0;
    while let Some(chunk) = chunks.next().await {
        let chunk = chunk.map_err(|_broken| {
            Problem::new(ProblemType::MalformedBody)
                .detail("the connection broke before the body was complete")
        })?;
        if discarded == 0 && text.len() + chunk.len() <= limit {
            text.extend_from_slice(&chunk);
        } else {
            text = Vec::new();
            discarded += chunk.len();
        }
        if discarded > DISCARDED_BYTES_MAX {
            break;
        }
    }
    if discarded == 0 {
        return Ok(text);
    }
    let detail = format!("the body of this request may have at most {limit} bytes");
    Err(Problem::new(ProblemType::BodyTooLarge).detail(detail))
}

fn parse<T: DeserializeOwned + Serialize>(body: &[u8]) -> Result<T, Problem> {
    let mut unknown = Vec::new();
    let mut reader = serde_json::Deserializer::from_slice(body);
    let mut note = |path: serde_ignored::Path<'_>| {
        if unknown.len() < UNKNOWN_FIELDS_NAMED_MAX {
            unknown.push(path.to_string());
        }
    };
    let watched = serde_ignored::Deserializer::new(&mut reader, &mut note);
    let parsed: T = serde_path_to_error::deserialize(watched).map_err(|error| {
        let path = error.path().to_string();
        let cause = error.inner();
        // The parser reports an unknown enum variant as a syntax error, although the text is JSON.
        let is_json = serde_json::from_slice::<serde::de::IgnoredAny>(body).is_ok();
        let (kind, detail) = if cause.is_data() || is_json {
            (
                ProblemType::InvalidBody,
                without_place(&cause.to_string()).to_owned(),
            )
        } else {
            (ProblemType::MalformedBody, cause.to_string())
        };
        let problem = Problem::new(kind).detail(detail);
        // `serde_ignored` writes a question mark for a step without a name.
        if path == "." || path.contains('?') {
            problem
        } else {
            problem.field(path)
        }
    })?;
    let trailing = |error: serde_json::Error| {
        Problem::new(ProblemType::MalformedBody).detail(error.to_string())
    };
    reader.end().map_err(trailing)?;
    refuse_lists_for_objects(&parsed, body)?;
    if unknown.is_empty() {
        return Ok(parsed);
    }
    let unknown: Vec<String> = unknown.iter().map(|path| spelt_out(path, body)).collect();
    let detail = format!("unknown fields: `{}`", unknown.join("`, `"));
    let problem = Problem::new(ProblemType::UnknownField).detail(detail);
    Err(match unknown.into_iter().next() {
        Some(first) => problem.field(first),
        None => problem,
    })
}

/// Returns a parser's message without line and column, which are useless in a one-line body.
fn without_place(message: &str) -> &str {
    message.split(" at line ").next().unwrap_or(message)
}

/// Parses a frame of a socket; as in bodies, a list in place of an object is refused.
///
/// # Errors
/// [`FrameError`].
pub(super) fn parse_frame<T: DeserializeOwned + Serialize>(text: &str) -> Result<T, FrameError> {
    let parsed: T = serde_json::from_str(text).map_err(FrameError::Parser)?;
    let meant = to_raw_value(&parsed).unwrap_or_default();
    match list_for_object(text.as_bytes(), &meant) {
        None => Ok(parsed),
        Some(_place) => Err(FrameError::List),
    }
}

/// Reason why a frame is refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum FrameError {
    /// It cannot be parsed.
    #[error("{0}")]
    Parser(serde_json::Error),
    /// It has a list in place of an object, which the parser would accept.
    #[error("a list was given where an object is required")]
    List,
}

/// Refuses a list in place of an object: the parser would assign its entries to the fields in
/// order, bypassing the check for unknown fields.
fn refuse_lists_for_objects<T: Serialize>(parsed: &T, body: &[u8]) -> Result<(), Problem> {
    let meant = to_raw_value(parsed).unwrap_or_default();
    match list_for_object(body, &meant) {
        None => Ok(()),
        Some(place) => {
            let problem = Problem::new(ProblemType::InvalidBody)
                .detail("a list was given where an object is required");
            Err(if place.is_empty() {
                problem
            } else {
                problem.field(place)
            })
        }
    }
}

/// Returns the path of the first list that was parsed as an object.
///
/// Compares one level of both texts at a time, so that a path of many thousand points needs a
/// pointer each and no tree.
fn list_for_object(sent: &[u8], meant: &RawValue) -> Option<String> {
    let meant = meant.get();
    let within = |name: &str, place: String| match place.as_str() {
        "" => name.to_owned(),
        _ => format!("{name}.{place}"),
    };
    match (sent.trim_ascii_start().first()?, meant.as_bytes().first()?) {
        (b'[', b'{') => Some(String::new()),
        (b'[', b'[') => {
            let sent: Vec<&RawValue> = serde_json::from_slice(sent).ok()?;
            let meant: Vec<&RawValue> = serde_json::from_str(meant).ok()?;
            let mut pairs = sent.iter().zip(meant).enumerate();
            pairs.find_map(|(index, (sent, meant))| {
                list_for_object(sent.get().as_bytes(), meant)
                    .map(|place| within(&index.to_string(), place))
            })
        }
        (b'{', b'{') => {
            let sent: BTreeMap<String, &RawValue> = serde_json::from_slice(sent).ok()?;
            let meant: BTreeMap<String, &RawValue> = serde_json::from_str(meant).ok()?;
            sent.iter().find_map(|(name, sent)| {
                let meant = meant.get(name)?;
                list_for_object(sent.get().as_bytes(), meant).map(|place| within(name, place))
            })
        }
        _ => None,
    }
}

/// Returns the path of an unknown field with the names of enum variants, for which `serde_ignored`
/// writes only `?`.
fn spelt_out(path: &str, body: &[u8]) -> String {
    let whole: serde_json::Value = serde_json::from_slice(body).unwrap_or_default();
    let mut place = &whole;
    let mut names: Vec<&str> = Vec::new();
    let steps: Vec<&str> = path.split('.').collect();
    for (index, &step) in steps.iter().enumerate() {
        let step = if step == "?" {
            let following = steps.get(index + 1).copied().unwrap_or_default();
            let variant = place
                .as_object()
                .filter(|object| !object.contains_key(following));
            match variant.and_then(|object| object.keys().next()) {
                Some(name) => name.as_str(),
                // An optional value, which has no step of its own in JSON.
                None => continue,
            }
        } else {
            step
        };
        names.push(step);
        let inner = step
            .parse::<usize>()
            .ok()
            .and_then(|index| place.get(index));
        place = inner
            .or_else(|| place.get(step))
            .unwrap_or(&serde_json::Value::Null);
    }
    names.join(".")
}

/// The parameters of a path.
#[derive(Debug, Clone)]
pub struct Path<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for Path<T> {
    type Rejection = Problem;

    #[expect(clippy::disallowed_types, reason = "this is what wraps it")]
    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let path = axum::extract::Path::from_request_parts(parts, state).await;
        path.map(|axum::extract::Path(value)| Self(value))
            .map_err(|rejection| {
                Problem::new(ProblemType::InvalidPath).detail(rejection.body_text())
            })
    }
}

/// The parameters of a query. Their types refuse unknown ones with `deny_unknown_fields`.
#[derive(Debug, Clone)]
pub struct Query<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for Query<T> {
    type Rejection = Problem;

    #[expect(clippy::disallowed_types, reason = "this is what wraps it")]
    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let query = axum::extract::Query::from_request_parts(parts, state).await;
        query
            .map(|axum::extract::Query(value)| Self(value))
            .map_err(|rejection| {
                Problem::new(ProblemType::InvalidQuery).detail(rejection.body_text())
            })
    }
}

/// Returns the number of entries of a page, within its limits.
pub(super) fn page_limit(limit: Option<u32>) -> Result<u32, Problem> {
    let limit = limit.unwrap_or(PAGE_LIMIT_DEFAULT);
    if (1..=PAGE_LIMIT_MAX).contains(&limit) {
        Ok(limit)
    } else {
        let detail = format!("limit must be 1 to {PAGE_LIMIT_MAX}, not {limit}");
        Err(Problem::new(ProblemType::InvalidQuery)
            .detail(detail)
            .field("limit"))
    }
}

/// Parses a cursor that is an identifier.
pub(super) fn cursor<T: std::str::FromStr>(cursor: Option<&str>) -> Result<Option<T>, Problem> {
    let bad = |_error| {
        Problem::new(ProblemType::InvalidQuery)
            .detail("this is not a cursor; use `next_cursor` of the previous page")
            .field("cursor")
    };
    cursor.map(|cursor| cursor.parse().map_err(bad)).transpose()
}

#[cfg(test)]
mod tests {
    use tread_api::mission::CreateMission;

    use super::*;

    fn problem(body: &str) -> serde_json::Value {
        let problem = parse::<CreateMission>(body.as_bytes()).unwrap_err();
        serde_json::to_value(format!("{problem:?}")).unwrap()
    }

    #[test]
    fn a_list_is_no_object_however_deep() {
        let said = problem(r#"["a","b",{"circle":[{"x_m":0,"y_m":0},3,0.5]},null]"#).to_string();
        assert!(
            said.contains("InvalidBody") && said.contains("a list was given"),
            "{said}"
        );
        let text = r#"{"site":"a","robot":"b","trajectory":{"circle":
            {"center":[0.0,0.0],"radius_m":1.0,"speed_m_s":0.5}}}"#;
        let said = problem(text).to_string();
        assert!(said.contains("trajectory.circle.center"), "{said}");
    }

    #[test]
    fn json_that_says_nothing_known_is_json_all_the_same() {
        let said = problem(r#"{"site":"a","robot":"b","trajectory":{}}"#).to_string();
        assert!(
            said.contains("InvalidBody") && !said.contains("at line"),
            "{said}"
        );
        assert!(problem("{").to_string().contains("MalformedBody"));
    }

    #[test]
    fn an_unknown_field_is_named_with_its_path_however_deep() {
        let text = r#"{"site":"a","robot":"b","trajectory":{"circle":
            {"center":{"x_m":0.0,"y_m":0.0},"radius_m":1.0,"speed_m_s":0.5,"colour":1}}}"#;
        let said = problem(text).to_string();
        assert!(
            said.contains("UnknownField") && said.contains("trajectory.circle.colour"),
            "{said}"
        );
    }

    #[test]
    fn a_value_out_of_its_range_is_named_with_its_path() {
        let circle = |values: &str| {
            format!(r#"{{"circle":{{"center":{{"x_m":0.0,"y_m":0.0}},"radius_m":1.0,{values}}}}}"#)
        };
        let waypoints = |points: &str| {
            format!(r#"{{"waypoints":{{"speed_m_s":1,"points":[{{"x_m":0,"y_m":0}},{points}]}}}}"#)
        };
        for (trajectory, path) in [
            (circle(r#""speed_m_s":99"#), "circle.speed_m_s"),
            (circle(r#""speed_m_s":1,"turns":0"#), "circle.turns"),
            (
                circle(r#""speed_m_s":1,"options":{"excitation":{"period_s":0}}"#),
                "circle.options.excitation.period_s",
            ),
            (waypoints(r#"{"x_m":0,"y_m":0}"#), "waypoints.points[1]"),
            (waypoints(r#"{"x_m":1}"#), "waypoints.points[1]"),
        ] {
            let text = format!(r#"{{"site":"a","robot":"b","trajectory":{trajectory}}}"#);
            let said = problem(&text).to_string();
            let field = format!(r#"Some(\"trajectory.{path}\")"#);
            assert!(
                said.contains("InvalidBody") && said.contains(&field),
                "{said}"
            );
        }
    }

    #[test]
    fn what_is_impossible_is_named_with_its_path() {
        let said = problem(r#"{"site":"A B","robot":"b","trajectory":{}}"#).to_string();
        assert!(
            said.contains("InvalidBody") && said.contains("site"),
            "{said}"
        );
        let said = problem("{\"site\": NaN}").to_string();
        assert!(said.contains("MalformedBody"), "{said}");
    }
}
