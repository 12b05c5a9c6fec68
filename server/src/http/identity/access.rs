//! Table of rights: maps method and route to the required right, read from the OpenAPI description.

use std::collections::HashMap;

use axum::http::Method;
use serde_json::Value;
use tread_api::rights::Right;
use utoipa::openapi::OpenApi;
use utoipa::openapi::security::{ApiKey, ApiKeyValue, HttpAuthScheme, HttpBuilder, SecurityScheme};

use super::browser::COOKIE;
use crate::http::page;

/// All routes that need no credential.
pub const PUBLIC: [(Method, &str); 14] = [
    (Method::GET, page::ROOT),
    (Method::GET, page::FILES),
    (Method::GET, "/healthz"),
    (Method::GET, "/readyz"),
    (Method::POST, "/v1/session"),
    (Method::GET, "/v1/sign-in"),
    (Method::GET, "/v1/sign-in/oidc"),
    (Method::GET, "/v1/sign-in/oidc/callback"),
    (Method::POST, "/v1/enrolments"),
    (Method::POST, "/v1/enrolments/renew"),
    (Method::GET, "/openapi.json"),
    (Method::GET, "/docs"),
    (Method::GET, "/docs/"),
    (Method::GET, "/docs/{*rest}"),
];
/// Security scheme by which each route names its right.
const TOKEN_SCHEME: &str = "token";
/// Security scheme of a browser's cookie, added here to each route with a right.
const SESSION_SCHEME: &str = "session";

/// Requirement of a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RouteRequirement {
    /// No credential.
    Nothing,
    /// A token with this right.
    Right(Right),
}

/// Requirements of all routes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Access {
    routes: HashMap<String, Vec<(Method, RouteRequirement)>>,
}

impl Access {
    /// Reads the table from the description. An operation that names no right and is not public is
    /// left out, and its requests are refused.
    pub fn of(openapi: &OpenApi) -> Self {
        let mut access = Self::default();
        for (method, path) in PUBLIC {
            access.insert(path, method, RouteRequirement::Nothing);
        }
        let description = serde_json::to_value(openapi).unwrap_or_default();
        let paths = description["paths"].as_object();
        for (path, operations) in paths.into_iter().flatten() {
            for (method, operation) in operations.as_object().into_iter().flatten() {
                let Ok(method) = method.to_ascii_uppercase().parse::<Method>() else {
                    continue;
                };
                if PUBLIC.contains(&(method.clone(), path.as_str())) {
                    continue;
                }
                if let Some(right) = right_of(operation) {
                    access.insert(path, method, RouteRequirement::Right(right));
                } else {
                    tracing::error!("{method} {path} names no right and is refused");
                }
            }
        }
        access
    }

    /// Returns a table of one route that needs no credential.
    pub(in crate::http) fn open(path: &str) -> Self {
        let mut access = Self::default();
        access.insert(path, Method::GET, RouteRequirement::Nothing);
        access
    }

    fn insert(&mut self, path: &str, method: Method, needed: RouteRequirement) {
        let methods = self.routes.entry(path.to_owned()).or_default();
        methods.push((method, needed));
    }

    /// Returns the requirement of a route; `None` for a method that it does not have.
    pub fn needed(&self, method: &Method, route: &str) -> Option<RouteRequirement> {
        // HEAD needs the same right as GET.
        let method = if method == Method::HEAD {
            &Method::GET
        } else {
            method
        };
        let methods = self.routes.get(route)?;
        methods
            .iter()
            .find(|(of, _)| of == method)
            .map(|(_, needed)| *needed)
    }

    /// Returns the methods of a route as in the `Allow` header; `None` for an unknown route.
    pub fn methods(&self, route: &str) -> Option<String> {
        let methods = self.routes.get(route)?.iter();
        let mut names: Vec<&str> = methods.map(|(method, _)| method.as_str()).collect();
        if names.contains(&"GET") {
            names.push("HEAD");
        }
        names.sort_unstable();
        Some(names.join(","))
    }
}

/// Returns the right that an operation names; `None` unless it names exactly one existing right.
fn right_of(operation: &Value) -> Option<Right> {
    let requirements = operation["security"].as_array()?;
    let rights = requirements
        .iter()
        .find_map(|requirement| requirement.get(TOKEN_SCHEME))?;
    match rights.as_array()?.as_slice() {
        [right] => Right::from_name(right.as_str()?),
        _ => None,
    }
}

/// Describes the security schemes, and allows sessions on each route that takes a token.
pub(in crate::http) fn describe(openapi: &mut OpenApi) {
    let bearer = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some(
            "A token: `authorization: Bearer tread_…`. Each route names the right that it \
             requires. A token has the rights of its role, or a list of rights, for all or some \
             sites and robots.",
        ))
        .build();
    let cookie = ApiKeyValue::with_description(
        COOKIE,
        "A browser's session, from `POST /v1/session` or a sign-in at the provider. Under TLS the \
         name of the cookie has the prefix `__Host-`.",
    );
    let components = openapi.components.get_or_insert_default();
    components.add_security_scheme(TOKEN_SCHEME, SecurityScheme::Http(bearer));
    components.add_security_scheme(
        SESSION_SCHEME,
        SecurityScheme::ApiKey(ApiKey::Cookie(cookie)),
    );
    for item in openapi.paths.paths.values_mut() {
        let operations = [
            &mut item.get,
            &mut item.put,
            &mut item.post,
            &mut item.delete,
            &mut item.patch,
        ];
        for operation in operations.into_iter().flatten() {
            let written = serde_json::to_value(&*operation).unwrap_or_default();
            if let (Some(right), Some(security)) = (right_of(&written), &mut operation.security) {
                security.push(utoipa::openapi::SecurityRequirement::new(
                    SESSION_SCHEME,
                    [right.as_str()],
                ));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn operation(security: &Value) -> Value {
        serde_json::json!({ "security": security })
    }

    #[test]
    fn an_operation_needs_exactly_one_right_that_exists() {
        use serde_json::json;
        assert_eq!(
            right_of(&operation(&json!([{"token": ["administer"]}]))),
            Some(Right::Administer)
        );
        for wrong in [
            json!([]),
            json!(null),
            json!([{}]),
            json!([{"token": []}]),
            json!([{"token": ["admin"]}]),
            json!([{"token": ["read", "administer"]}]),
            json!([{"session": ["read"]}]),
        ] {
            assert_eq!(right_of(&operation(&wrong)), None, "{wrong}");
        }
    }

    #[test]
    fn what_the_description_does_not_say_is_refused() {
        #[derive(utoipa::OpenApi)]
        struct Empty;
        let mut openapi = <Empty as utoipa::OpenApi>::openapi();
        openapi.paths.paths.insert(
            "/v1/forgotten".to_owned(),
            serde_json::from_value(serde_json::json!({"get": {"responses": {}}})).unwrap(),
        );
        let access = Access::of(&openapi);
        assert_eq!(access.needed(&Method::GET, "/v1/forgotten"), None);
        assert_eq!(
            access.needed(&Method::HEAD, "/healthz"),
            Some(RouteRequirement::Nothing)
        );
        assert_eq!(access.needed(&Method::POST, "/healthz"), None);
        assert_eq!(access.methods("/healthz").as_deref(), Some("GET,HEAD"));
    }
}
