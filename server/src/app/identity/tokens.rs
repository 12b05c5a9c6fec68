//! Tokens: creation, listing and revocation.

use jiff::{SignedDuration, Timestamp};
use tracing::warn;
use tread_api::identity::{
    AuditEntry, CreateToken, CreatedToken, Role, TOKEN_DAYS_DEFAULT, TOKEN_DAYS_MAX,
    TOKEN_NAME_MAX, Token,
};
use tread_api::ids::TokenId;
use tread_api::page::Page;
use tread_api::rights::{Right, Rights, Scope};

use super::quota::{Count, Quota};
use super::sessions::still_holds;
use super::{Credential, new_secret};
use crate::app::{App, AppError, PeopleField, page, people_line, site_row};
use crate::db::{self, Tx};
use crate::identity::secret::Kind;
use crate::identity::subject::{SubjectId, may_name_token};

/// Maximum numbers of valid tokens.
const TOKENS: Quota = Quota {
    what: "valid tokens",
    all: 1_000,
    reserved: 100,
    share: 100,
};
/// Time for which expired and revoked tokens and join tokens are listed.
pub(in crate::app) const DEAD_KEPT: SignedDuration = SignedDuration::from_hours(400 * 24);
/// Maximum number of expired or revoked tokens deleted with each new one.
pub(in crate::app) const FORGET_MAX: u32 = 10;

/// Ends a token's cached credentials when it is dropped: after a commit, or if there is none. A
/// token that is still valid in the database is cached again at its next look-up.
struct Ending(App, TokenId);

impl Drop for Ending {
    fn drop(&mut self) {
        let Self(app, id) = self;
        let revoked = SubjectId::Token(*id);
        app.identity().known.end(|known| known.subject == revoked);
    }
}

/// Request for the first token of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FirstAdmin {
    /// The token's name, for people.
    pub name: String,
    /// Validity, days.
    pub valid_days: u32,
    /// Whether to create it even if a valid admin's token exists, replacing a valid token of the
    /// same name.
    pub force: bool,
}

impl App {
    /// Creates a token whose rights are within those of its creator.
    ///
    /// # Errors
    /// The token would have rights or a scope that its creator does not have; and the errors of
    /// [`Self::create_token`].
    pub async fn create_token_as(
        &self,
        request: CreateToken,
        giver: &Credential,
    ) -> Result<CreatedToken, AppError> {
        let (rights, sites) = (rights_of(&request)?, sites_of(&request)?);
        if !giver.rights.includes_all(rights) {
            let own = giver.rights;
            let detail = format!(
                "nobody gives rights that he has not: `{}` has {own}",
                giver.name
            );
            return Err(AppError::BeyondRights(detail));
        }
        if rights.includes(Right::Hold) && !giver.rights.includes(Right::ReleaseHold) {
            let detail = "a token may end the limits of programs of its own name: whoever gives the right \
                          `hold` needs `release_hold`";
            return Err(AppError::BeyondRights(detail.to_owned()));
        }
        if !giver.scope.includes(&sites) {
            let own = &giver.scope;
            let detail = format!(
                "`{}` is for {own} alone, and nobody gives rights where he has none: name these, or \
                 some of them, as `sites`",
                giver.name
            );
            return Err(AppError::BeyondRights(detail));
        }
        let mut tx = self.db().write_uncounted("identity").await?;
        // The creator's token may have been revoked since the request began.
        let now = self.clock().now();
        let holds = still_holds(&mut tx, giver, now).await?;
        if !holds || giver.ended().is_cancelled() {
            return Err(AppError::BeyondRights(format!(
                "`{}` holds no longer",
                giver.name
            )));
        }
        let maker = (&*giver.name, &giver.scope);
        let created = self.new_token(&mut tx, request, maker).await?;
        tx.commit().await?;
        Ok(created)
    }

    /// Creates a token.
    ///
    /// # Errors
    /// The name or validity is impossible, the name is taken, a site is not known, or there are too
    /// many tokens.
    pub async fn create_token(
        &self,
        request: CreateToken,
        created_by: &str,
    ) -> Result<CreatedToken, AppError> {
        let mut tx = self.db().write_uncounted("identity").await?;
        let maker = (created_by, &Scope::EVERYWHERE);
        let created = self.new_token(&mut tx, request, maker).await?;
        tx.commit().await?;
        Ok(created)
    }

    /// Creates an admin's token without a request, for `tread-server init`.
    ///
    /// # Errors
    /// A valid admin's token exists and `force` is not set.
    pub async fn create_first_admin(&self, first: FirstAdmin) -> Result<CreatedToken, AppError> {
        let now = self.clock().now();
        let mut tx = self.db().write_uncounted("identity").await?;
        let (_, admin_count) = db::tokens::valid_counts(&mut tx, now).await?;
        if admin_count > 0 && !first.force {
            return Err(AppError::AlreadyExists {
                what: "an admin's token",
                id: "init".to_owned(),
            });
        }
        let name = first.name.trim();
        let replaced = db::tokens::valid_by_name(&mut tx, name, now).await?;
        if let Some(replaced) = &replaced {
            db::tokens::revoke(&mut tx, replaced.id, now).await?;
        }
        let request = CreateToken {
            valid_days: Some(first.valid_days),
            ..CreateToken::of_role(first.name, Role::Admin)
        };
        let maker = ("init", &Scope::EVERYWHERE);
        let created = self.new_token(&mut tx, request, maker).await?;
        let entry = AuditEntry {
            id: 0,
            at: now,
            since: None,
            count: 1,
            who: Some("init".to_owned()),
            token: None,
            person: None,
            role: None,
            address: "this machine".to_owned(),
            method: "RUN".to_owned(),
            route: "tread-server init".to_owned(),
            path: "tread-server init".to_owned(),
            status: 201,
            request_id: String::new(),
            what: Some(serde_json::json!({"name": created.token.name, "role": "admin"})),
            previous_hash: None,
            hash: None,
        };
        db::audit::append(&mut tx, std::slice::from_ref(&entry)).await?;
        let ending = replaced.map(|replaced| Ending(self.clone(), replaced.id));
        tx.commit_then(move |_outcome| drop(ending)).await?;
        Ok(created)
    }

    /// Returns the number of valid admins' tokens.
    async fn admin_count(&self) -> Result<i64, AppError> {
        let mut tx = self.db().read("identity").await?;
        let counts = db::tokens::valid_counts(&mut tx, self.clock().now()).await?;
        Ok(counts.1)
    }

    /// Logs a warning if nobody can sign in yet, and a failure to read that as an error.
    pub(crate) async fn warn_without_admin(&self) {
        match self.admin_count().await {
            Ok(0) => warn!(
                "nobody can sign in yet: make the first admin's token with `tread-server init`"
            ),
            Ok(_) => {}
            Err(error) => self.log_failure("count the admins", &error),
        }
    }

    async fn new_token(
        &self,
        tx: &mut Tx,
        request: CreateToken,
        (created_by, within): (&str, &Scope),
    ) -> Result<CreatedToken, AppError> {
        let now = self.clock().now();
        let name = people_line(PeopleField::Name, &request.name, TOKEN_NAME_MAX)?;
        if !may_name_token(&name) {
            let detail =
                "no token is called like a person (`oidc:NAME`) or by a person's identifier";
            return Err(AppError::Invalid {
                field: "name",
                detail: detail.to_owned(),
            });
        }
        let expires_at = expiry(now, request.valid_days)?;
        let (valid_count, _) = db::tokens::valid_counts(tx, now).await?;
        let of_maker = db::tokens::valid_count_within(tx, within, now).await?;
        let count = Count {
            all: valid_count,
            within_scope: of_maker,
        };
        TOKENS.check(within, count)?;
        if db::tokens::valid_by_name(tx, &name, now).await?.is_some() {
            return Err(AppError::AlreadyExists {
                what: "token",
                id: name,
            });
        }
        let (rights, sites) = (rights_of(&request)?, sites_of(&request)?);
        for site in sites.sites().into_iter().flatten() {
            site_row(tx, site).await?;
        }
        let secret = new_secret(Kind::Token(request.role))?;
        let token = Token {
            id: self.clock().new_id::<TokenId>(),
            name,
            role: request.role,
            rights,
            sites,
            created_at: now,
            created_by: created_by.to_owned(),
            expires_at,
            revoked_at: None,
            last_used_at: None,
        };
        db::tokens::insert(tx, &token, &secret.fingerprint()).await?;
        if let Ok(before) = now.checked_sub(DEAD_KEPT) {
            db::tokens::delete_ended(tx, before, FORGET_MAX).await?;
        }
        Ok(CreatedToken {
            token,
            secret: secret.reveal().to_owned(),
        })
    }

    /// Returns the tokens whose scope is within a scope, newest first, with expired and revoked
    /// ones.
    pub async fn tokens(
        &self,
        within: &Scope,
        before: Option<TokenId>,
        limit: u32,
    ) -> Result<Page<Token>, AppError> {
        let mut tx = self.db().read("identity").await?;
        let tokens = db::tokens::list(&mut tx, within, before, limit + 1).await?;
        Ok(page(tokens, limit, |token: &Token| token.id.to_string()))
    }

    /// Returns the scope of a token; `None` if it is not known.
    pub async fn token_scope(&self, id: TokenId) -> Result<Option<Scope>, AppError> {
        let mut tx = self.db().read("identity").await?;
        Ok(db::tokens::find(&mut tx, id)
            .await?
            .map(|token| token.sites))
    }

    /// Revokes a token: it is refused from now on, its sessions end, and its open connections
    /// close.
    ///
    /// # Errors
    /// [`AppError::UnknownToken`]. After any error the token's open connections close, and it is
    /// looked up again.
    pub async fn revoke_token(&self, id: TokenId) -> Result<Token, AppError> {
        let ending = Ending(self.clone(), id);
        let mut tx = self.db().write_uncounted("identity").await?;
        db::tokens::revoke(&mut tx, id, self.clock().now()).await?;
        let token = db::tokens::find(&mut tx, id).await?;
        let token = token.ok_or(AppError::UnknownToken(id))?;
        tx.commit_then(move |_outcome| drop(ending)).await?;
        Ok(token)
    }
}

/// Returns the rights that a new token is to have.
fn rights_of(request: &CreateToken) -> Result<Rights, AppError> {
    let wrong = |detail: &str| AppError::Invalid {
        field: "rights",
        detail: detail.to_owned(),
    };
    match (request.role, &request.rights) {
        (Some(role), None) => Ok(role.into()),
        (None, Some(rights)) if !rights.is_empty() => Ok(rights.iter().copied().collect()),
        (None, Some(_)) => Err(wrong("name at least one right")),
        (None, None) => Err(wrong("give the token a `role`, or `rights`")),
        (Some(_), Some(_)) => Err(wrong("a token has a `role` or `rights`, not both")),
    }
}

/// Returns the scope that a new token is to have.
fn sites_of(request: &CreateToken) -> Result<Scope, AppError> {
    Scope::try_from(request.sites.clone()).map_err(|invalid| AppError::Invalid {
        field: "sites",
        detail: invalid.to_string(),
    })
}

fn expiry(now: Timestamp, valid_days: Option<u32>) -> Result<Timestamp, AppError> {
    let days = valid_days.unwrap_or(TOKEN_DAYS_DEFAULT);
    if !(1..=TOKEN_DAYS_MAX).contains(&days) {
        let detail = format!("valid_days must be 1 to {TOKEN_DAYS_MAX}, not {days}");
        return Err(AppError::Invalid {
            field: "valid_days",
            detail,
        });
    }
    let span = SignedDuration::from_hours(24 * i64::from(days));
    Ok(now.checked_add(span).unwrap_or(Timestamp::MAX))
}
