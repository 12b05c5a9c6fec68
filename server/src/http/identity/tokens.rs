//! `/v1/tokens`.

use axum::extract::State;
use axum::http::StatusCode;
use serde::Deserialize;
use tread_api::identity::{CreateToken, CreatedToken, Token};
use tread_api::ids::TokenId;
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use utoipa::IntoParams;

use crate::app::App;
use crate::http::extract::{Json, Path, Query, cursor, page_limit};
use crate::http::problem::Problem;
use crate::http::subject::Subject;

/// Query parameters of the list of tokens.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct TokenQuery {
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List tokens, newest first, including expired and revoked ones.
///
/// Contains only tokens whose rights are within the caller's. Secrets are shown only when a token
/// is created.
#[utoipa::path(get, path = "/v1/tokens", tag = "identity", operation_id = "list_tokens",
    security(("token" = ["administer"])), params(TokenQuery),
    responses((status = 200, body = Page<Token>), (status = 400, body = ProblemBody)))]
pub(in crate::http) async fn list(
    State(app): State<App>,
    Subject(subject): Subject,
    Query(query): Query<TokenQuery>,
) -> Result<Json<Page<Token>>, Problem> {
    let limit = page_limit(query.limit)?;
    let before = cursor(query.cursor.as_deref())?;
    Ok(Json(app.tokens(&subject.scope, before, limit).await?))
}

/// Create a token with a role or a list of rights, for all or some sites and robots.
///
/// A token never has more rights than its creator. Only this response contains its secret.
#[utoipa::path(post, path = "/v1/tokens", tag = "identity", operation_id = "create_token",
    security(("token" = ["administer"])), request_body = CreateToken,
    responses((status = 201, body = CreatedToken), (status = 409, body = ProblemBody),
        (status = 422, body = ProblemBody)))]
pub(in crate::http) async fn create(
    State(app): State<App>,
    Subject(subject): Subject,
    Json(request): Json<CreateToken>,
) -> Result<(StatusCode, Json<CreatedToken>), Problem> {
    let created = app.create_token_as(request, &subject).await?;
    Ok((StatusCode::CREATED, Json(created)))
}

/// Revoke a token.
///
/// The token is refused from now on, its sessions end, and its open streams close.
#[utoipa::path(delete, path = "/v1/tokens/{token}", tag = "identity",
    operation_id = "revoke_token", security(("token" = ["administer"])),
    params(("token" = TokenId, Path)),
    responses((status = 200, body = Token), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn revoke(
    State(app): State<App>,
    Path(token): Path<TokenId>,
) -> Result<Json<Token>, Problem> {
    Ok(Json(app.revoke_token(token).await?))
}
