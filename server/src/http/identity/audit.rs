//! `/v1/audit`.

use axum::extract::State;
use serde::Deserialize;
use tread_api::audit::AuditChain;
use tread_api::identity::{AuditEntry, AuditOrder};
use tread_api::page::Page;
use tread_api::problem::{ProblemBody, ProblemType};
use utoipa::IntoParams;

use crate::app::App;
use crate::app::identity::audit::AuditFilter;
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
    /// Which come first: `newest` when absent.
    #[serde(default)]
    #[param(required = false)]
    order: AuditOrder,
    /// `next_cursor` of the page before, which is the number of its last entry.
    cursor: Option<String>,
    /// Most entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List the audit log: who changed what, from where, and who was refused.
#[utoipa::path(get, path = "/v1/audit", tag = "identity", operation_id = "list_audit",
    security(("token" = ["administer"])), params(AuditQuery),
    responses((status = 200, body = Page<AuditEntry>), (status = 400, body = ProblemBody)))]
pub(in crate::http) async fn list(
    State(app): State<App>,
    Query(query): Query<AuditQuery>,
) -> Result<Json<Page<AuditEntry>>, Problem> {
    let limit = page_limit(query.limit)?;
    let filter = AuditFilter {
        order: query.order,
        beyond: cursor(query.cursor.as_deref())?,
        who: query.who,
        refused: query.refused,
    };
    Ok(Json(app.audit_log(&filter, limit).await?))
}

/// Get the ends of the audit log's hash chain.
///
/// To verify the chain, compute the hashes of the entries again and compare them.
#[utoipa::path(get, path = "/v1/audit/chain", tag = "identity", operation_id = "get_audit_chain",
    security(("token" = ["administer"])),
    responses((status = 200, body = AuditChain), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn chain(State(app): State<App>) -> Result<Json<AuditChain>, Problem> {
    let chain = app.audit_chain().await?;
    let gone = || Problem::new(ProblemType::NotFound).detail("the record of the chain is gone");
    Ok(Json(chain.ok_or_else(gone)?))
}
