//! `/v1/audit`.

use axum::extract::State;
use serde::Deserialize;
use tread_api::identity::AuditEntry;
use tread_api::page::Page;
use tread_api::problem::ProblemBody;
use utoipa::IntoParams;

use crate::app::App;
use crate::db::audit::AuditFilter;
use crate::http::extract::{Json, Query, cursor, page_limit};
use crate::http::problem::Problem;

/// Which entries, and which page of them.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct AuditQuery {
    /// Only those of the token of this name.
    who: Option<String>,
    /// Only what was refused or failed.
    #[serde(default)]
    #[param(required = false)]
    refused: bool,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// Who changed what, from where, and who was refused; newest first.
#[utoipa::path(get, path = "/v1/audit", tag = "identity", operation_id = "list_audit",
    security(("token" = ["admin"])), params(AuditQuery),
    responses((status = 200, body = Page<AuditEntry>), (status = 400, body = ProblemBody)))]
pub(in crate::http) async fn list(
    State(app): State<App>,
    Query(query): Query<AuditQuery>,
) -> Result<Json<Page<AuditEntry>>, Problem> {
    let limit = page_limit(query.limit)?;
    let filter = AuditFilter {
        before: cursor(query.cursor.as_deref())?,
        who: query.who,
        refused: query.refused,
    };
    Ok(Json(app.audit_log(&filter, limit).await?))
}
