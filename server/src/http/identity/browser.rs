//! Sets the session cookie and security headers of responses to browsers, and the CORS rules for
//! foreign pages.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::Response;
use tower_http::cors::{AllowOrigin, CorsLayer};

use crate::identity::origin::{Names, Origin};

/// Name of the session cookie; under TLS it has the prefix `__Host-`, which browsers accept from
/// this host over TLS alone.
pub(super) const COOKIE: &str = "tread_session";
/// Maximum time that a browser caches a CORS preflight response, seconds.
const PREFLIGHT_KEPT_S: u64 = 600;
/// Content security policy of responses that are no pages: nothing may run or be framed.
const POLICY_OF_DATA: &str = "default-src 'none'; frame-ancestors 'none'";
/// Content security policy of pages: only resources of this server.
const POLICY_OF_PAGES: &str = "default-src 'none'; script-src 'self'; \
    style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src 'self'; \
    connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; \
    frame-ancestors 'none'";
/// `Strict-Transport-Security`: a year.
const ONLY_TLS: &str = "max-age=31536000";

/// Name of the cookie of a pending sign-in at the provider.
const SIGN_IN_COOKIE: &str = "tread_sign_in";

fn name_of(cookie: &str, is_tls: bool) -> String {
    let prefix = if is_tls { "__Host-" } else { "" };
    format!("{prefix}{cookie}")
}

/// Cookies that are set.
#[derive(Clone, Copy)]
enum CookieKind {
    Session,
    SignIn,
}

fn cookie(kind: CookieKind, is_tls: bool, value: &str, lasts_s: i64) -> HeaderValue {
    let (name, same_site) = match kind {
        CookieKind::Session => (COOKIE, "Strict"),
        CookieKind::SignIn => (SIGN_IN_COOKIE, "Lax"),
    };
    let secure = if is_tls { "; Secure" } else { "" };
    let name = name_of(name, is_tls);
    let text = format!(
        "{name}={value}; Path=/; HttpOnly; SameSite={same_site}; Max-Age={lasts_s}{secure}"
    );
    // Names and secrets consist of letters and digits.
    HeaderValue::try_from(text).unwrap_or_else(|_| HeaderValue::from_static(""))
}

/// Sets the session cookie, for `lasts_s` seconds.
pub(super) fn set_session_cookie(
    headers: &mut HeaderMap,
    is_tls: bool,
    secret: &str,
    lasts_s: i64,
) {
    let session = cookie(CookieKind::Session, is_tls, secret, lasts_s);
    headers.append(header::SET_COOKIE, session);
}

/// Removes the session cookie.
pub(super) fn remove_session_cookie(headers: &mut HeaderMap, is_tls: bool) {
    set_session_cookie(headers, is_tls, "", 0);
}

/// Sets the cookie of a pending sign-in. The browser returns from the provider by a navigation from
/// another site, with which `Strict` cookies are not sent.
pub(super) fn set_sign_in_cookie(headers: &mut HeaderMap, is_tls: bool, value: &str, lasts_s: i64) {
    let pending = cookie(CookieKind::SignIn, is_tls, value, lasts_s);
    headers.append(header::SET_COOKIE, pending);
}

/// Returns the session cookie of a request.
pub(super) fn shown_cookie(headers: &HeaderMap, is_tls: bool) -> Option<&str> {
    shown(COOKIE, headers, is_tls)
}

/// Returns the cookie of a pending sign-in of a request.
pub(super) fn shown_sign_in_cookie(headers: &HeaderMap, is_tls: bool) -> Option<&str> {
    shown(SIGN_IN_COOKIE, headers, is_tls)
}

fn shown<'headers>(
    name: &str,
    headers: &'headers HeaderMap,
    is_tls: bool,
) -> Option<&'headers str> {
    let name = name_of(name, is_tls);
    let pairs = headers.get_all(header::COOKIE).into_iter();
    pairs
        .filter_map(|value| value.to_str().ok())
        .flat_map(|text| text.split(';'))
        .filter_map(|pair| pair.trim().split_once('='))
        .find_map(|(of, value)| (of == name).then_some(value))
}

/// Sets the security headers of every response.
pub(in crate::http) async fn set_headers(
    State(names): State<Arc<Names>>,
    request: Request,
    next: Next,
) -> Response {
    let is_page = request.uri().path().starts_with("/docs");
    let is_data = request.uri().path().starts_with("/v1/");
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    let policy = if is_page {
        POLICY_OF_PAGES
    } else {
        POLICY_OF_DATA
    };
    let fixed: [(HeaderName, &'static str); 6] = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CONTENT_SECURITY_POLICY, policy),
        (
            HeaderName::from_static("cross-origin-opener-policy"),
            "same-origin",
        ),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ];
    for (name, value) in fixed {
        headers
            .entry(name)
            .or_insert(HeaderValue::from_static(value));
    }
    if is_data {
        let kept = headers.entry(header::CACHE_CONTROL);
        kept.or_insert(HeaderValue::from_static("no-store"));
    }
    if names.is_tls {
        let only_tls = headers.entry(header::STRICT_TRANSPORT_SECURITY);
        only_tls.or_insert(HeaderValue::from_static(ONLY_TLS));
    }
    response
}

/// Returns the CORS layer that allows pages of these origins to use a token of their own; `None`
/// without origins. Cookies are never accepted from them.
pub(in crate::http) fn foreign_pages(allowed: &[Origin]) -> Option<CorsLayer> {
    if allowed.is_empty() {
        return None;
    }
    let origins = allowed
        .iter()
        .filter_map(|origin| HeaderValue::try_from(origin.as_str()).ok());
    let layer = CorsLayer::new()
        .allow_origin(AllowOrigin::list(origins))
        .allow_methods([
            Method::GET,
            Method::POST,
            Method::PUT,
            Method::PATCH,
            Method::DELETE,
        ])
        .allow_headers([
            header::AUTHORIZATION,
            header::CONTENT_TYPE,
            HeaderName::from_static("idempotency-key"),
            HeaderName::from_static("last-event-id"),
        ])
        .expose_headers([HeaderName::from_static("x-request-id"), header::RETRY_AFTER])
        .max_age(std::time::Duration::from_secs(PREFLIGHT_KEPT_S));
    Some(layer)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cookie_that_was_given_is_found_among_others() {
        for is_tls in [false, true] {
            let mut given = HeaderMap::new();
            set_session_cookie(&mut given, is_tls, "tread_s_1", 60);
            let text = given[header::SET_COOKIE].to_str().unwrap();
            assert!(
                text.contains("HttpOnly") && text.contains("SameSite=Strict"),
                "{text}"
            );
            assert_eq!(
                text.contains("Secure") && text.starts_with("__Host-"),
                is_tls,
                "{text}"
            );
            let pair = text.split(';').next().unwrap();
            let mut sent = HeaderMap::new();
            sent.append(header::COOKIE, "a=b; tread=c".parse().unwrap());
            sent.append(header::COOKIE, format!("x={pair}; {pair}").parse().unwrap());
            assert_eq!(shown_cookie(&sent, is_tls), Some("tread_s_1"));
            assert_eq!(shown_cookie(&sent, !is_tls), None);
        }
    }
}
