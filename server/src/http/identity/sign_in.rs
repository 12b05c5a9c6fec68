//! `/v1/sign-in`: how people sign in, and the sign-in at an OpenID provider.
//!
//! `…/oidc` sends a browser to the provider and gives it a cookie; the provider sends it back to
//! `…/oidc/callback`, which opens a session and redirects the browser to the page. Neither address has
//! a parameter for the target of that redirect, so a link cannot redirect a browser elsewhere.

use std::sync::Arc;

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde_json::json;
use tread_api::identity::SignInMethods;
use tread_api::problem::{ProblemBody, ProblemType};
use utoipa::IntoParams;

use super::browser;
use super::guard::{Audited, Peer, SignedIn, provenance};
use crate::app::App;
use crate::app::identity::people::{Answer, PersonError};
use crate::http::extract::{Json, Query};
use crate::http::page;
use crate::http::problem::Problem;
use crate::identity::origin::Names;
use crate::identity::pending::SIGN_IN_TIMEOUT;

/// Target of the redirect after a sign-in; the fragment makes the page request the session's user.
const SIGNED_IN: &str = "/#signed-in";

/// Get the available sign-in methods.
#[utoipa::path(get, path = "/v1/sign-in", tag = "identity", operation_id = "get_sign_in_methods",
    responses((status = 200, body = SignInMethods)))]
pub(in crate::http) async fn methods(State(app): State<App>) -> Json<SignInMethods> {
    Json(SignInMethods {
        token: true,
        oidc: app.oidc_sign_in(),
    })
}

/// Start a sign-in at the OpenID provider.
#[utoipa::path(get, path = "/v1/sign-in/oidc", tag = "identity", operation_id = "begin_sign_in",
    responses((status = 303), (status = 404, body = ProblemBody), (status = 503, body = ProblemBody)))]
pub(in crate::http) async fn begin(
    State(app): State<App>,
    Extension(names): Extension<Arc<Names>>,
    headers: HeaderMap,
) -> Response {
    let begun = match app.begin_sign_in(&provenance(&headers)) {
        Ok(begun) => begun,
        Err(error) => return refused(error, &headers),
    };
    let mut response = see_other(&begun.location);
    if let Some(cookie) = &begun.cookie {
        let (headers, lasts_s) = (response.headers_mut(), SIGN_IN_TIMEOUT.as_secs());
        browser::set_sign_in_cookie(headers, names.is_tls, cookie, lasts_s);
    }
    response
}

/// Query parameters with which the provider redirects a browser back. Others are ignored.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub(in crate::http) struct AnswerQuery {
    /// State of the sign-in, from the redirect to the provider.
    #[serde(default)]
    #[param(required = false)]
    state: String,
    /// Authorisation code; absent if the provider has not signed the person in.
    code: Option<String>,
    /// Error of the provider; absent if it has signed the person in.
    error: Option<String>,
    /// Issuer of the provider that redirects.
    iss: Option<String>,
}

/// Finish a sign-in at the OpenID provider.
///
/// Starts a session and redirects the browser to the dashboard.
#[utoipa::path(get, path = "/v1/sign-in/oidc/callback", tag = "identity",
    operation_id = "finish_sign_in", params(AnswerQuery),
    responses((status = 303), (status = 400, body = ProblemBody), (status = 403, body = ProblemBody),
        (status = 404, body = ProblemBody), (status = 503, body = ProblemBody)))]
pub(in crate::http) async fn finish(
    State(app): State<App>,
    Extension(names): Extension<Arc<Names>>,
    peer: Option<Extension<Peer>>,
    headers: HeaderMap,
    query: Result<Query<AnswerQuery>, Problem>,
) -> Response {
    let query = query.map(|Query(query)| query).unwrap_or_default();
    let address = peer.map_or([0, 0, 0, 0].into(), |Extension(Peer(address))| address);
    let cookie = browser::shown_sign_in_cookie(&headers, names.is_tls);
    let answer = Answer {
        state: query.state,
        code: query.code,
        error: query.error,
        issuer: query.iss,
    };
    let finished = app.finish_sign_in(address, cookie, &answer).await;
    let (mut response, what) = match finished {
        Ok((credential, secret)) => {
            let left = credential.expires_at.duration_since(app.clock().now());
            let mut response = see_other(SIGNED_IN);
            let headers = response.headers_mut();
            browser::set_session_cookie(headers, names.is_tls, secret.reveal(), left.as_secs());
            let session = credential.session;
            response.extensions_mut().insert(SignedIn(credential));
            (response, json!({"sign_in": "oidc", "session": session}))
        }
        Err(error) => {
            let what = match &error {
                PersonError::NoGroup { name, person } => {
                    json!({"sign_in": "oidc", "refused": "no group", "name": name, "person": person})
                }
                PersonError::NotConfigured
                | PersonError::Unavailable
                | PersonError::Busy
                | PersonError::NotBegun
                | PersonError::Declined(_)
                | PersonError::NotBelieved
                | PersonError::Failed(_) => {
                    json!({"sign_in": "oidc", "refused": error.to_string()})
                }
            };
            (refused(error, &headers), what)
        }
    };
    let is_to_be_tried_again = matches!(
        response.status(),
        StatusCode::SERVICE_UNAVAILABLE | StatusCode::TOO_MANY_REQUESTS
    );
    if cookie.is_some() && !is_to_be_tried_again {
        // It counts once.
        browser::set_sign_in_cookie(response.headers_mut(), names.is_tls, "", 0);
    }
    response.extensions_mut().insert(Audited(what));
    response
}

fn see_other(location: &str) -> Response {
    let mut response = StatusCode::SEE_OTHER.into_response();
    if let Ok(location) = HeaderValue::try_from(location) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    response
}

/// Returns the reason why a sign-in was refused: as a page for browsers, as a problem for programs.
fn refused(error: PersonError, headers: &HeaderMap) -> Response {
    let detail = error.to_string();
    let kind = match error {
        PersonError::NotConfigured => ProblemType::NotFound,
        PersonError::Unavailable => ProblemType::Unavailable,
        PersonError::Busy => ProblemType::TooManyRequests,
        PersonError::NotBegun | PersonError::Declined(_) | PersonError::NotBelieved => {
            ProblemType::SignInFailed
        }
        PersonError::NoGroup { .. } => ProblemType::SignInRefused,
        PersonError::Failed(cause) => return Problem::from(cause).into_response(),
    };
    let response = Problem::new(kind).detail(detail.clone()).into_response();
    let accepted = headers.get_all(header::ACCEPT).iter();
    let is_person = accepted
        .filter_map(|value| value.to_str().ok())
        .any(|accepted| accepted.contains("text/html"));
    if is_person {
        page::plain(response, kind, &detail)
    } else {
        response
    }
}
