//! Who may ask for what.
//!
//! One source: each route's `#[utoipa::path]` says `security(("token" = ["dispatch"]))`.
//! [`access`] reads the table from the document, [`guard`] enforces it on whatever matched, and
//! refuses what the document does not mention, and, by [`place`], what is about a site or robot that
//! the token is not for. Handlers find who asks as a [`crate::http::subject::Subject`].

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
