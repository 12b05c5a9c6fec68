//! Extensions of a request from the guard: the authenticated caller, and the slot of the body for
//! the audit log.

use std::sync::{Arc, OnceLock};

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use serde_json::Value;
use tread_api::problem::ProblemType;

use super::problem::Problem;
use crate::app::identity::Credential;
use crate::identity::redact::redacted_text;

/// The authenticated caller; present on all but the public routes.
#[derive(Debug, Clone)]
pub(super) struct Subject(pub(super) Arc<Credential>);

impl<S: Send + Sync> FromRequestParts<S> for Subject {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> Result<Self, Problem> {
        let subject = parts.extensions.get::<Self>().cloned();
        subject.ok_or_else(|| Problem::new(ProblemType::Unauthenticated))
    }
}

/// Slot for the body of a change, for the audit log.
#[derive(Debug, Clone, Default)]
pub(super) struct AuditSlot(Arc<OnceLock<Value>>);

impl AuditSlot {
    /// Stores a body, without its secrets.
    pub(super) fn leave(&self, body: &[u8]) {
        // The first one is the request's; there is no second.
        let _ = self.0.set(redacted_text(body));
    }

    /// Returns the stored body.
    pub(super) fn left(&self) -> Option<&Value> {
        self.0.get()
    }
}
