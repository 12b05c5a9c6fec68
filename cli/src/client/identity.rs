//! Who asks, and who is of the fleet.

use tread_api::enrolment::{CreateJoinToken, CreatedJoinToken, Enrolment, JoinToken};
use tread_api::identity::{AuditEntry, CreateToken, CreatedToken, Session, Token};
use tread_api::ids::{JoinTokenId, RobotId, SiteId, TokenId};
use tread_api::page::Page;

use super::{Client, ClientError};

impl Client {
    /// Who the token is.
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

    /// Makes a token by which a robot may join.
    pub(crate) async fn create_join_token(
        &self,
        request: &CreateJoinToken,
    ) -> Result<CreatedJoinToken, ClientError> {
        self.post("/v1/join-tokens", request).await
    }

    /// Join tokens, newest first.
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

    /// How the robots of a site stand that have ever joined.
    pub(crate) async fn enrolments(&self, site: &SiteId) -> Result<Vec<Enrolment>, ClientError> {
        self.all(&format!("/v1/sites/{site}/enrolments")).await
    }

    /// Puts a robot out of the fleet.
    pub(crate) async fn revoke_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Enrolment, ClientError> {
        self.delete(&format!("/v1/sites/{site}/enrolments/{robot}"))
            .await
    }

    /// The newest entries of the audit log, at most `limit`.
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
