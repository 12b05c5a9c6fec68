//! `/v1/session`: a browser signs in with a token and gets a cookie.

use std::sync::Arc;

use axum::extract::{Extension, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use tread_api::identity::{CreateSession, Session, SignedOut};
use tread_api::problem::ProblemBody;

use super::browser;
use super::guard::{Peer, SignedIn, sign_in_problem, unauthenticated};
use crate::app::identity::CredentialKind;
use crate::app::{App, AppError};
use crate::connections::Purpose;
use crate::http::extract::Json;
use crate::http::problem::Problem;
use crate::http::subject::Subject;
use crate::identity::origin::Names;

/// Sign a browser in with a token.
///
/// The response sets a cookie and contains the identity.
#[utoipa::path(post, path = "/v1/session", tag = "identity", operation_id = "create_session",
    request_body = CreateSession,
    responses((status = 201, body = Session), (status = 401, body = ProblemBody),
        (status = 429, body = ProblemBody)))]
pub(in crate::http) async fn create(
    State(app): State<App>,
    Extension(names): Extension<Arc<Names>>,
    peer: Option<Extension<Peer>>,
    Json(request): Json<CreateSession>,
) -> Result<Response, Problem> {
    let address = peer.map_or([0, 0, 0, 0].into(), |Extension(Peer(address))| address);
    let found = app
        .authenticate(
            address,
            request.token.trim(),
            CredentialKind::Token,
            Purpose::Other,
        )
        .await;
    let credential = match found {
        Ok(credential) => credential,
        Err(error) => return Ok(sign_in_problem(&app, &error)),
    };
    let opened = app.open_session(&credential).await;
    let (credential, secret) = opened.map_err(|error| {
        if matches!(error, AppError::UnknownToken(_)) {
            // It was revoked in between.
            return unauthenticated();
        }
        error.into()
    })?;
    let left = credential.expires_at.duration_since(app.clock().now());
    let answer = (StatusCode::CREATED, Json(credential.session()));
    let mut response = answer.into_response();
    let lasts_s = left.as_secs();
    browser::set_session_cookie(
        response.headers_mut(),
        names.is_tls,
        secret.reveal(),
        lasts_s,
    );
    response.extensions_mut().insert(SignedIn(credential));
    Ok(response)
}

/// Get the caller's identity, by token or cookie.
#[utoipa::path(get, path = "/v1/session", tag = "identity", operation_id = "get_session",
    security(("token" = ["stop"])), responses((status = 200, body = Session)))]
pub(in crate::http) async fn get(Subject(subject): Subject) -> Json<Session> {
    Json(subject.session())
}

/// Sign a browser out.
///
/// The token stays valid until an admin revokes it. For a session of the OpenID provider, the
/// response contains the provider's sign-out address, if it has one.
#[utoipa::path(delete, path = "/v1/session", tag = "identity", operation_id = "end_session",
    security(("token" = ["stop"])),
    responses((status = 200, body = SignedOut), (status = 204)))]
pub(in crate::http) async fn end(
    State(app): State<App>,
    Extension(names): Extension<Arc<Names>>,
    Subject(subject): Subject,
) -> Result<Response, Problem> {
    let provider = app.sign_out_at_provider(&subject);
    if let Some(session) = subject.session {
        app.end_session(session).await?;
    }
    let mut response = match provider {
        Some(provider) => Json(SignedOut { provider }).into_response(),
        None => StatusCode::NO_CONTENT.into_response(),
    };
    browser::remove_session_cookie(response.headers_mut(), names.is_tls);
    Ok(response)
}
