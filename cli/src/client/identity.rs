//! Requests about identities, enrolment, the fleet's authority and the audit log.

use reqwest::Method;
use tread_api::audit::AuditChain;
use tread_api::enrolment::{
    CreateJoinToken, CreatedJoinToken, Enrolment, FinishRotation, FleetAuthority, JoinToken,
    ReplaceAuthority,
};
use tread_api::identity::{AuditEntry, CreateToken, CreatedToken, PersonSession, Session, Token};
use tread_api::ids::{JoinTokenId, RobotId, SessionId, SiteId, TokenId};
use tread_api::page::{PAGE_LIMIT_MAX, Page};

use super::{Client, ClientError};

impl Client {
    /// Requests identity and rights of the token in use.
    pub(crate) async fn session(&self) -> Result<Session, ClientError> {
        self.get("/v1/session").await
    }

    pub(crate) async fn tokens(&self) -> Result<Vec<Token>, ClientError> {
        self.all("/v1/tokens").await
    }

    pub(crate) async fn create_token(
        &self,
        request: &CreateToken,
    ) -> Result<CreatedToken, ClientError> {
        self.post("/v1/tokens", request).await
    }

    pub(crate) async fn revoke_token(&self, token: TokenId) -> Result<Token, ClientError> {
        self.delete(&format!("/v1/tokens/{token}")).await
    }

    /// Lists the sessions of people, newest first.
    pub(crate) async fn sessions(&self) -> Result<Vec<PersonSession>, ClientError> {
        self.all("/v1/sessions").await
    }

    /// Ends the session of a person.
    pub(crate) async fn end_session(&self, session: SessionId) -> Result<(), ClientError> {
        let request = self.request(Method::DELETE, &format!("/v1/sessions/{session}"));
        self.answered(request).await.map(|_done| ())
    }

    /// Creates a join token.
    pub(crate) async fn create_join_token(
        &self,
        request: &CreateJoinToken,
    ) -> Result<CreatedJoinToken, ClientError> {
        self.post("/v1/join-tokens", request).await
    }

    /// Lists the join tokens, newest first.
    pub(crate) async fn join_tokens(&self) -> Result<Vec<JoinToken>, ClientError> {
        self.all("/v1/join-tokens").await
    }

    /// Revokes a join token.
    pub(crate) async fn revoke_join_token(
        &self,
        id: JoinTokenId,
    ) -> Result<JoinToken, ClientError> {
        self.delete(&format!("/v1/join-tokens/{id}")).await
    }

    /// Lists the newest enrolment of each robot of a site.
    pub(crate) async fn enrolments(&self, site: &SiteId) -> Result<Vec<Enrolment>, ClientError> {
        self.all(&format!("/v1/sites/{site}/enrolments")).await
    }

    /// Revokes the enrolment of a robot.
    pub(crate) async fn revoke_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Enrolment, ClientError> {
        self.delete(&format!("/v1/sites/{site}/enrolments/{robot}"))
            .await
    }

    /// Requests the fleet's authority and its rotation.
    pub(crate) async fn authority(&self) -> Result<FleetAuthority, ClientError> {
        self.get("/v1/authority").await
    }

    /// Starts a rotation of the fleet's authority.
    pub(crate) async fn start_rotation(&self) -> Result<FleetAuthority, ClientError> {
        self.post("/v1/authority/rotation", &serde_json::json!({}))
            .await
    }

    /// Finishes a rotation of the fleet's authority.
    pub(crate) async fn finish_rotation(
        &self,
        request: &FinishRotation,
    ) -> Result<FleetAuthority, ClientError> {
        self.post("/v1/authority/rotation/finish", request).await
    }

    /// Replaces the fleet's authority.
    pub(crate) async fn replace_authority(
        &self,
        request: &ReplaceAuthority,
    ) -> Result<FleetAuthority, ClientError> {
        self.post("/v1/authority/replace", request).await
    }

    /// Requests a page of the audit log, the oldest entry first, behind the entry with this number.
    pub(crate) async fn audit_after(
        &self,
        after: Option<u64>,
    ) -> Result<Page<AuditEntry>, ClientError> {
        let mut query = vec![
            ("order", "oldest".to_owned()),
            ("limit", PAGE_LIMIT_MAX.to_string()),
        ];
        query.extend(after.map(|after| ("cursor", after.to_string())));
        self.get_with("/v1/audit", &query).await
    }

    /// Requests numbers and hashes at both ends of the audit log's hash chain.
    pub(crate) async fn audit_chain(&self) -> Result<AuditChain, ClientError> {
        self.get("/v1/audit/chain").await
    }

    /// Lists the newest entries of the audit log, at most `limit`.
    pub(crate) async fn audit(
        &self,
        who: Option<&str>,
        refused: bool,
        limit: u32,
    ) -> Result<Page<AuditEntry>, ClientError> {
        let mut query = vec![
            ("limit", limit.to_string()),
            ("refused", refused.to_string()),
        ];
        query.extend(who.map(|who| ("who", who.to_owned())));
        self.get_with("/v1/audit", &query).await
    }
}
