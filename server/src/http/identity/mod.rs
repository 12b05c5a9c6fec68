//! Authorisation of requests.
//!
//! The API description is the only source of the required rights: each route's `#[utoipa::path]`
//! names one, such as `security(("token" = ["dispatch"]))`. [`access`] reads the rights from the
//! description. [`guard`] checks each request against them and refuses routes that the description
//! does not contain. [`place`] refuses sites and robots outside the token's scope. Handlers get the
//! authenticated client as a [`crate::http::subject::Subject`].

pub(super) mod access;
pub(super) mod audit;
pub(super) mod authority;
pub(super) mod browser;
pub(super) mod enrolment;
pub(super) mod guard;
mod place;
pub(super) mod session;
pub(super) mod sessions;
pub(super) mod sign_in;
pub(super) mod tokens;
