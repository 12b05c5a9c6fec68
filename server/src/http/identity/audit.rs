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

/// Query parameters of the list of entries.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct AuditQuery {
    /// Only entries of the token or person of this name.
    who: Option<String>,
    /// Only requests that were refused or failed.
    #[serde(default)]
    #[param(required = false)]
    refused: bool,
    /// Order of the entries; `newest` when absent.
    #[serde(default)]
    #[param(required = false)]
    order: AuditOrder,
    /// `next_cursor` of the previous page, which is the number of its last entry.
    cursor: Option<String>,
    /// Maximum number of entries of the page, 1 to 1000; 100 when absent.
    limit: Option<u32>,
}

/// List the entries of the audit log: changes and refused requests.
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
/// To verify the chain, recompute the hashes of the entries and compare them.
#[utoipa::path(get, path = "/v1/audit/chain", tag = "identity", operation_id = "get_audit_chain",
    security(("token" = ["administer"])),
    responses((status = 200, body = AuditChain), (status = 404, body = ProblemBody)))]
pub(in crate::http) async fn chain(State(app): State<App>) -> Result<Json<AuditChain>, Problem> {
    let chain = app.audit_chain().await?;
    let no_record = || Problem::new(ProblemType::NotFound).detail("the hash chain has no record");
    Ok(Json(chain.ok_or_else(no_record)?))
}
