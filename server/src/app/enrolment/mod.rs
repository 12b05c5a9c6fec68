//! Enrolment of robots: joining, renewal of certificates, and revocation.
//!
//! ```text
//!  join token ──made──► valid ──used by one robot──► used
//!                         └──revoked, or its time over──► dead
//!
//!  robot ──joins──► in force ──renews──► in force …
//!                      ├──put out──────► revoked
//!                      └──joins again──► revoked, and in force under the next number
//! ```
//!
//! Every failure gets the same answer; the cause is only in the audit log and the counters.

mod joining;
pub mod registry;
mod revoked_robots;
mod rotation;

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tread_api::enrolment::{
    CreateJoinToken, CreatedJoinToken, Enrolment, JOIN_MINUTES_DEFAULT, JOIN_MINUTES_MAX,
    JoinToken, RenewCertificate, RobotCertificate,
};
use tread_api::ids::{JoinTokenId, RobotId, SiteId};
use tread_api::page::Page;
use tread_api::rights::Scope;
use tread_api::robot::Alert;

use self::registry::EnrolmentRegistry;
use self::revoked_robots::RevokedRobots;
pub(super) use self::revoked_robots::{RETIRED_ALERT, REVOKED_ALERT, UNISSUED_ALERT};
use self::rotation::RecordedCertificates;
use super::identity::new_secret;
use super::identity::quota::{Count, Quota};
use super::identity::tokens::{DEAD_KEPT, FORGET_MAX};
use super::{App, AppError, page, site_row};
use crate::authority::{Authorities, CertificateError, Issued, RobotName, RobotRequest};
use crate::db::enrolments::{AcceptedCertificates, Renewal};
use crate::db::{self, DbError, Outcome, Tx};
use crate::identity::secret::Kind;

/// Maximum numbers of join tokens that are valid at once.
const JOIN_TOKENS: Quota = Quota {
    what: "valid join tokens",
    all: 1_000,
    reserved: 100,
    share: 300,
};
/// Maximum number of robots that may ever join.
pub const FLEET_ROBOTS_MAX: u32 = 10_000;

/// What the server needs to sign robots' certificates.
#[derive(Debug)]
pub struct EnrolmentService {
    /// The fleet's authority; during a rotation also the former one.
    pub authorities: Arc<Authorities>,
    /// Validity of a robot's certificate.
    pub lifetime: SignedDuration,
    /// The port that robots connect to.
    pub port: u16,
}

/// Membership of the fleet in memory.
#[derive(Debug)]
pub(super) struct Membership {
    pub(super) registry: Arc<EnrolmentRegistry>,
    service: Option<EnrolmentService>,
    revoked_robots: RevokedRobots,
    shown: RecordedCertificates,
}

impl Membership {
    /// With a service (an authority), only messages of robots that have joined are accepted.
    pub(super) fn new(service: Option<EnrolmentService>) -> Self {
        let registry = Arc::<EnrolmentRegistry>::default();
        if service.is_some() {
            registry.close();
        }
        Self {
            registry,
            service,
            revoked_robots: RevokedRobots::default(),
            shown: RecordedCertificates::default(),
        }
    }
}

/// Reason why a robot gets no certificate. The answer to the robot does not contain it.
#[derive(Debug, thiserror::Error)]
pub enum EnrolError {
    /// The certificate request cannot be parsed, independently of its sender.
    #[error(transparent)]
    Request(CertificateError),
    /// Neither the token nor the request names the robot.
    #[error("nobody names the robot")]
    Nameless(JoinTokenId),
    /// The join token is malformed.
    #[error("malformed")]
    Malformed,
    /// The join token is not in the database.
    #[error("unknown")]
    Unknown,
    /// The join token has expired.
    #[error("expired")]
    Expired(JoinTokenId),
    /// The join token was used by a robot before.
    #[error("used")]
    Used(JoinTokenId),
    /// The join token was revoked.
    #[error("revoked")]
    Revoked(JoinTokenId),
    /// The join token is for another robot.
    #[error("for another robot")]
    OtherRobot(JoinTokenId),
    /// A robot of this name exists, and the join token does not name it.
    #[error("the robot is known and the join token does not name it")]
    KnownRobot(JoinTokenId),
    /// The certificate, or the proof of possession of its key, is invalid.
    #[error("bad certificate")]
    Certificate(#[source] CertificateError),
    /// The robot's enrolment was revoked, or replaced by a later one.
    #[error("the enrolment was revoked")]
    Ended(RobotName),
    /// The authority that signed its certificate was retired.
    #[error("the authority of the certificate was retired")]
    Retired(RobotName),
    /// This server did not issue the certificate, or has issued newer ones since.
    #[error("this server did not give the certificate, or gave it long ago")]
    NotIssued(RobotName),
    /// Too many failures; the request is refused without a look-up. Holds the time until the next
    /// attempt.
    #[error("there were too many failed attempts; try again in {} s", .0.as_secs() + 1)]
    Locked(Duration),
    /// This server has no authority, so robots cannot join it.
    #[error("robots do not join this server")]
    Closed,
    /// Another error.
    #[error("the server failed")]
    App(#[from] AppError),
}

impl From<DbError> for EnrolError {
    fn from(cause: DbError) -> Self {
        Self::App(cause.into())
    }
}

impl EnrolError {
    /// Returns the identifier of the join token that was shown, if it is known.
    pub fn join_token(&self) -> Option<JoinTokenId> {
        match self {
            Self::Expired(id)
            | Self::Used(id)
            | Self::Revoked(id)
            | Self::OtherRobot(id)
            | Self::Nameless(id)
            | Self::KnownRobot(id) => Some(*id),
            Self::Request(_)
            | Self::Malformed
            | Self::Unknown
            | Self::Certificate(_)
            | Self::Ended(_)
            | Self::Retired(_)
            | Self::NotIssued(_)
            | Self::Locked(_)
            | Self::Closed
            | Self::App(_) => None,
        }
    }
}

/// Result of a robot's enrolment request, with what the audit log needs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Enrolled {
    /// Certificate that the robot gets.
    pub certificate: RobotCertificate,
    /// The join token that the robot used.
    pub join_token: JoinTokenId,
}

impl App {
    /// Returns the registry of robots that have joined.
    pub fn enrolment_registry(&self) -> &Arc<EnrolmentRegistry> {
        &self.membership().registry
    }

    fn service(&self) -> Option<&EnrolmentService> {
        self.membership().service.as_ref()
    }

    /// Loads the enrolments of all robots from the database.
    ///
    /// # Errors
    /// The database failed.
    pub async fn load_enrolments(&self) -> Result<(), AppError> {
        let mut tx = self.db().read("enrolment").await?;
        for enrolment in db::enrolments::all_newest(&mut tx).await? {
            self.enrolment_registry().record(&enrolment);
        }
        Ok(())
    }

    /// Creates a join token.
    ///
    /// # Errors
    /// This server has no authority, the site is not known, the validity is impossible, or there
    /// are too many join tokens.
    pub async fn create_join_token(
        &self,
        request: CreateJoinToken,
        (created_by, within): (&str, &Scope),
    ) -> Result<CreatedJoinToken, AppError> {
        if self.service().is_none() {
            return Err(AppError::NoAuthority);
        }
        let minutes = request.valid_minutes.unwrap_or(JOIN_MINUTES_DEFAULT);
        if !(1..=JOIN_MINUTES_MAX).contains(&minutes) {
            let detail = format!("valid_minutes must be 1 to {JOIN_MINUTES_MAX}, not {minutes}");
            return Err(AppError::Invalid {
                field: "valid_minutes",
                detail,
            });
        }
        let now = self.clock().now();
        let span = SignedDuration::from_mins(i64::from(minutes));
        let mut tx = self.db().write("enrolment").await?;
        site_row(&mut tx, &request.site).await?;
        let valid_count = db::join_tokens::valid_count(&mut tx, now).await?;
        let of_maker = db::join_tokens::valid_count_within(&mut tx, within, now).await?;
        let count = Count {
            all: valid_count,
            within_scope: of_maker,
        };
        JOIN_TOKENS.check(within, count)?;
        let secret = new_secret(Kind::Join)?;
        let join_token = JoinToken {
            id: self.clock().new_id::<JoinTokenId>(),
            site: request.site,
            robot: request.robot,
            created_at: now,
            created_by: created_by.to_owned(),
            expires_at: now.checked_add(span).unwrap_or(Timestamp::MAX),
            used_at: None,
            used_by: None,
            revoked_at: None,
        };
        db::join_tokens::insert(&mut tx, &join_token, &secret.fingerprint()).await?;
        if let Ok(before) = now.checked_sub(DEAD_KEPT) {
            db::join_tokens::delete_ended(&mut tx, before, FORGET_MAX).await?;
        }
        tx.commit().await?;
        Ok(CreatedJoinToken {
            join_token,
            secret: secret.reveal().to_owned(),
        })
    }

    /// Returns the join tokens of a scope, newest first, with used, revoked and expired ones.
    pub async fn join_tokens(
        &self,
        within: &Scope,
        before: Option<JoinTokenId>,
        limit: u32,
    ) -> Result<Page<JoinToken>, AppError> {
        let mut tx = self.db().read("enrolment").await?;
        let tokens = db::join_tokens::list(&mut tx, within, before, limit + 1).await?;
        Ok(page(tokens, limit, |token| token.id.to_string()))
    }

    /// Returns the site and robot that a join token is for; `None` if it is not known.
    pub async fn join_token_place(
        &self,
        id: JoinTokenId,
    ) -> Result<Option<(SiteId, Option<RobotId>)>, AppError> {
        let mut tx = self.db().read("enrolment").await?;
        let found = db::join_tokens::find(&mut tx, id).await?;
        Ok(found.map(|token| (token.site, token.robot)))
    }

    /// Revokes a join token.
    ///
    /// # Errors
    /// [`AppError::UnknownJoinToken`].
    pub async fn revoke_join_token(&self, id: JoinTokenId) -> Result<JoinToken, AppError> {
        let mut tx = self.db().write("enrolment").await?;
        db::join_tokens::revoke(&mut tx, id, self.clock().now()).await?;
        let found = db::join_tokens::find(&mut tx, id).await?;
        let token = found.ok_or(AppError::UnknownJoinToken(id))?;
        tx.commit().await?;
        Ok(token)
    }

    /// Returns the newest enrolment of each robot of a site within a scope, ordered by name.
    pub async fn enrolments(
        &self,
        (site, within): (&SiteId, &Scope),
        after: &str,
        limit: u32,
    ) -> Result<Page<Enrolment>, AppError> {
        let mut tx = self.db().read("enrolment").await?;
        site_row(&mut tx, site).await?;
        let named = within.limit_of(site);
        let found = db::enrolments::list(&mut tx, (site, named.as_ref()), after, limit + 1).await?;
        Ok(page(found, limit, |enrolment| enrolment.robot.to_string()))
    }

    /// Revokes a robot: its messages are refused, its link is closed, and it gets no certificate
    /// until it joins again with a token that names it.
    ///
    /// # Errors
    /// [`AppError::UnknownRobot`] if it has never joined.
    pub async fn revoke_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
        revoked_by: &str,
    ) -> Result<Enrolment, AppError> {
        let mut tx = self.db().write("enrolment").await?;
        db::enrolments::revoke(&mut tx, (site, robot), revoked_by, self.clock().now()).await?;
        let found = db::enrolments::newest(&mut tx, site, robot).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        let enrolment = found.ok_or_else(unknown)?;
        let ended = match db::robots::pk_of(&mut tx, site, robot).await? {
            Some(robot_pk) => self.end_work_alerts(&mut tx, robot_pk).await?,
            None => Vec::new(),
        };
        self.commit_enrolment(tx, &enrolment, ended).await?;
        tracing::warn!(robot.id = %robot, "robot `{robot}` of site `{site}` was put out by {revoked_by}");
        Ok(enrolment)
    }

    /// Commits, and then updates the registry and publishes the events.
    async fn commit_enrolment(
        &self,
        tx: Tx,
        enrolment: &Enrolment,
        alerts: Vec<Alert>,
    ) -> Result<(), DbError> {
        let (app, enrolment) = (self.clone(), enrolment.clone());
        tx.commit_then(move |outcome| {
            if outcome == Outcome::Written {
                app.enrolment_registry().record(&enrolment);
                app.show_alerts(&alerts);
            }
        })
        .await
    }

    /// Renews the certificate of a robot that has joined.
    ///
    /// # Errors
    /// [`EnrolError`]; all but `Request`, `Closed` and `App` look the same from outside.
    pub async fn renew_certificate(
        &self,
        request: &RenewCertificate,
        proof: &[u8],
    ) -> Result<RobotCertificate, EnrolError> {
        let service = self.service().ok_or(EnrolError::Closed)?;
        let key = RobotRequest::read(&request.certificate_request).map_err(EnrolError::Request)?;
        let now = self.clock().now();
        let trusted = service.authorities.present();
        let present = trusted
            .read_robot(&request.certificate, now)
            .map_err(EnrolError::Certificate)?;
        let proven = present.check_proof(&request.certificate_request, proof);
        proven.map_err(EnrolError::Certificate)?;
        let name = present.name();
        if present.is_retired() {
            self.alert_retired_authority(name);
            return Err(EnrolError::Retired(name.clone()));
        }
        let (certificate, next) =
            service.sign(&trusted, &key, name, self.clock().machine_time())?;
        let mut tx = self.db().write("enrolment").await?;
        let enrolment = (&name.site, &name.robot, name.enrolment);
        let (shown, mut ended) = (present.fingerprint(), Vec::new());
        let accepted_certificates =
            match db::enrolments::accepted_certificates(&mut tx, enrolment).await? {
                AcceptedCertificates::None => {
                    drop(tx);
                    let key = (name.site.clone(), name.robot.clone());
                    self.alert_revoked(&key);
                    return Err(EnrolError::Ended(name.clone()));
                }
                AcceptedCertificates::Any => {
                    ended = self.end_unissued(&mut tx, name).await?;
                    Issued::one(shown.clone())
                }
                AcceptedCertificates::These(issued) => issued,
            };
        let Some(issued) = accepted_certificates.renewed(&shown, next) else {
            drop(tx);
            self.alert_unissued_certificate(name);
            return Err(EnrolError::NotIssued(name.clone()));
        };
        let renewal = Renewal {
            at: now,
            expires_at: certificate.expires_at,
            authority: present.issuer(),
            issued: &issued,
        };
        db::enrolments::renew(&mut tx, enrolment, renewal).await?;
        self.commit_alerts(tx, ended).await?;
        self.membership()
            .shown
            .remove(&(name.site.clone(), name.robot.clone()));
        self.counters().certificates_renewed.one();
        Ok(certificate)
    }
}
