//! Who may ask for what.
//!
//! One source: each route's `#[utoipa::path]` says `security(("token" = ["operator"]))`.
//! [`access`] reads the table from the document, [`guard`] enforces it on whatever matched, and
//! refuses what the document does not mention. Handlers find who asks as a [`guard::Subject`].

pub(super) mod access;
pub(super) mod audit;
pub(super) mod browser;
pub(super) mod enrolment;
pub(super) mod guard;
pub(super) mod session;
pub(super) mod tokens;
