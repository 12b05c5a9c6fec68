//! `/v1/sessions`: people who are signed in.

use axum::extract::State;
use axum::http::StatusCode;
use serde::Deserialize;
use tread_api::identity::PersonSession;
use tread_api::ids::SessionId;
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use utoipa::IntoParams;

use crate::app::App;
use crate::http::extract::{Json, Path, Query, cursor, page_limit};
use crate::http::problem::Problem;
use crate::http::subject::Subject;

/// Query parameters of the list of sessions.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct SessionQuery {
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List sessions of people who signed in at the OpenID provider, newest first.
///
/// Contains only sessions whose rights are within the caller's. Sessions of tokens end with their
/// token.
#[utoipa::path(get, path = "/v1/sessions", tag = "identity", operation_id = "list_sessions",
    security(("token" = ["administer"])), params(SessionQuery),
    responses((status = 200, body = Page<PersonSession>), (status = 400, body = ProblemBody)))]
pub(in crate::http) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Query(query): Query<SessionQuery>,
) -> Result<Json<Page<PersonSession>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    let listed = app.sessions_of_people(&subject.scope, before, limit);
    Ok(Json(listed.await?))
}

/// End a person's session.
///
/// The session is refused from now on, and its open streams close. A person whom the provider still
/// admits can sign in again.
#[utoipa::path(delete, path = "/v1/sessions/{session}", tag = "identity",
    operation_id = "end_session_of", security(("token" = ["administer"])),
    params(("session" = SessionId, Path)),
    responses((status = 204), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn end(
    State(app): State<App>,
    Path(session): Path<SessionId>,
) -> Result<StatusCode, Problem> {
    app.end_session_of(session).await?;
    Ok(StatusCode::NO_CONTENT)
}
