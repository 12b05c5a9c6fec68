//! Joining: one transaction consumes a robot's join token and stores its enrolment, or does
//! neither.
//!
//! ```text
//!  token looked at ─► certificate signed ─► token used up, enrolment written, committed
//!                                             │
//!           signed and written down again ◄── is the authority that signed it still trusted?
//!              │ a few times                  │ yes
//!              ▼                              ▼
//!            refused                        answer
//! ```
//!
//! No transaction locks the fleet's authority, which may be replaced at any moment. The certificate
//! is checked against the trusted authorities last, so that no robot gets one that is not accepted.

use std::net::IpAddr;
use std::sync::Arc;

use jiff::Timestamp;
use tread_api::enrolment::{EnrolRobot, Enrolment, RobotCertificate};
use tread_api::ids::RobotId;

use super::{EnrolError, Enrolled, EnrolmentService, FLEET_ROBOTS_MAX};
use crate::app::{App, AppError};
use crate::authority::{Issued, RobotName, RobotRequest, Trusted};
use crate::connections::Purpose;
use crate::db;
use crate::db::enrolments::Renewal;
use crate::identity::attempts::Source;
use crate::identity::secret::{Kind, Secret};

/// Maximum number of times that a certificate is signed again because the authority was replaced
/// meanwhile.
const SIGN_AGAIN_MAX: u32 = 5;

impl App {
    /// Enrols a robot: consumes its join token and revokes its earlier enrolment.
    ///
    /// # Errors
    /// [`EnrolError`]; all but `Request`, `Locked`, `Closed` and `App` look the same from outside.
    pub async fn enrol_robot(
        &self,
        address: IpAddr,
        request: &EnrolRobot,
    ) -> Result<Enrolled, EnrolError> {
        let service = self.service().ok_or(EnrolError::Closed)?;
        // A malformed request reveals nothing about the token, so it is checked first.
        let key = RobotRequest::read(&request.certificate_request).map_err(EnrolError::Request)?;
        let secret = Secret::read(&request.token).filter(|secret| secret.kind() == Kind::Join);
        let mut sources = vec![Source::of_address(address)];
        if let Some(secret) = &secret {
            sources.push(Source::Prefix(secret.prefix().to_owned()));
        }
        let enrolled = match &secret {
            Some(secret) if self.is_join_token(secret).await? => {
                self.enrol(service, secret, request.robot.as_ref(), &key)
                    .await
            }
            Some(_) => Err(EnrolError::Unknown),
            None => Err(EnrolError::Malformed),
        };
        match &enrolled {
            Ok(_) | Err(EnrolError::App(_) | EnrolError::Ended(_) | EnrolError::Retired(_)) => {
                return enrolled;
            }
            Err(_refused) => {}
        }
        if let Some(left) = self.locked_for(&sources) {
            return Err(EnrolError::Locked(left));
        }
        self.failed(sources);
        enrolled
    }

    /// Returns whether a secret is that of a join token, valid or not. Other secrets do not wait
    /// for the writing connection.
    async fn is_join_token(&self, secret: &Secret) -> Result<bool, AppError> {
        let _turn = self.lookup_permit(Purpose::Other).await?;
        let mut tx = self.db().read("enrolment").await?;
        let fingerprint = secret.fingerprint();
        let kept = db::join_tokens::by_lookup(&mut tx, &fingerprint).await?;
        Ok(kept.is_some_and(|kept| fingerprint.matches(&kept.hash)))
    }

    async fn enrol(
        &self,
        service: &EnrolmentService,
        secret: &Secret,
        robot: Option<&RobotId>,
        key: &RobotRequest,
    ) -> Result<Enrolled, EnrolError> {
        let now = self.clock().now();
        let mut tx = self.db().write("enrolment").await?;
        let fingerprint = secret.fingerprint();
        let kept = db::join_tokens::by_lookup(&mut tx, &fingerprint).await?;
        let kept = kept.filter(|kept| fingerprint.matches(&kept.hash));
        let token = kept.ok_or(EnrolError::Unknown)?.token;
        if token.revoked_at.is_some() {
            return Err(EnrolError::Revoked(token.id));
        }
        if token.used_at.is_some() {
            return Err(EnrolError::Used(token.id));
        }
        if token.expires_at <= now {
            return Err(EnrolError::Expired(token.id));
        }
        let robot = match (&token.robot, robot) {
            (Some(named), Some(requested)) if named != requested => {
                return Err(EnrolError::OtherRobot(token.id));
            }
            (Some(named), _) => named.clone(),
            (None, Some(requested)) => requested.clone(),
            (None, None) => return Err(EnrolError::Nameless(token.id)),
        };
        let former = db::enrolments::newest(&mut tx, &token.site, &robot).await?;
        let is_known =
            former.is_some() || db::robots::is_known(&mut tx, Some(&token.site), &robot).await?;
        if is_known && token.robot.is_none() {
            return Err(EnrolError::KnownRobot(token.id));
        }
        let robot_count = db::enrolments::robot_count(&mut tx).await?;
        if former.is_none() && robot_count >= i64::from(FLEET_ROBOTS_MAX) {
            return Err(EnrolError::App(AppError::TooMany {
                what: "robots that have joined",
                count: FLEET_ROBOTS_MAX as usize,
            }));
        }
        let floor = db::restorations::enrolment_floor(&mut tx).await?;
        let number = former.map_or(0, |former| former.number).max(floor);
        let number = number.saturating_add(1);
        let name = RobotName {
            site: token.site.clone(),
            robot: robot.clone(),
            enrolment: number,
        };
        let trusted = service.authorities.present();
        let (certificate, fingerprint) =
            service.sign(&trusted, key, &name, self.clock().machine_time())?;
        if !db::join_tokens::consume(&mut tx, token.id, &robot, now).await? {
            return Err(EnrolError::Used(token.id));
        }
        db::enrolments::revoke(&mut tx, (&token.site, &robot), "a new enrolment", now).await?;
        let enrolment = Enrolment {
            site: token.site,
            robot,
            number,
            enrolled_at: now,
            join_token: token.id,
            renewed_at: now,
            expires_at: certificate.expires_at,
            revoked_at: None,
            revoked_by: None,
            authority: Some(trusted.signing().fingerprint().to_owned()),
        };
        db::enrolments::insert(&mut tx, &enrolment, &Issued::one(fingerprint)).await?;
        let ended = self.end_credential_alerts(&mut tx, &enrolment).await?;
        self.commit_enrolment(tx, &enrolment, ended).await?;
        self.counters().robots_enrolled.one();
        let (site, robot) = (&enrolment.site, &enrolment.robot);
        tracing::info!(robot.id = %robot, "robot `{robot}` joined site `{site}`");
        let certificate = self
            .signed_by_trusted(service, (key, &name), (trusted, certificate))
            .await?;
        Ok(Enrolled {
            certificate,
            join_token: token.id,
        })
    }

    /// Returns the certificate of a stored enrolment, signed by an authority that is trusted now.
    /// If the signing authority was replaced or retired meanwhile it signs again, at most
    /// [`SIGN_AGAIN_MAX`] times; after that the robot gets no certificate.
    async fn signed_by_trusted(
        &self,
        service: &EnrolmentService,
        (key, name): (&RobotRequest, &RobotName),
        (mut trusted, mut certificate): (Arc<Trusted>, RobotCertificate),
    ) -> Result<RobotCertificate, EnrolError> {
        for signed_again in 0..=SIGN_AGAIN_MAX {
            let present = service.authorities.present();
            if present.is_trusted(trusted.signing().fingerprint()) {
                return Ok(certificate);
            }
            if signed_again == SIGN_AGAIN_MAX {
                break;
            }
            trusted = present;
            let now = self.clock().machine_time();
            let (again, fingerprint) = service.sign(&trusted, key, name, now)?;
            certificate = again;
            let renewal = Renewal {
                at: self.clock().now(),
                expires_at: certificate.expires_at,
                authority: trusted.signing().fingerprint(),
                issued: &Issued::one(fingerprint),
            };
            let enrolment = (&name.site, &name.robot, name.enrolment);
            let mut tx = self.db().write("enrolment").await?;
            if !db::enrolments::renew(&mut tx, enrolment, renewal).await? {
                return Err(EnrolError::Ended(name.clone()));
            }
            tx.commit().await?;
        }
        Err(EnrolError::Retired(name.clone()))
    }
}

impl EnrolmentService {
    /// Signs a certificate and returns it with its fingerprint.
    pub(super) fn sign(
        &self,
        trusted: &Trusted,
        key: &RobotRequest,
        name: &RobotName,
        now: Timestamp,
    ) -> Result<(RobotCertificate, String), EnrolError> {
        let signed = trusted.signing().sign(key, name, now, self.lifetime);
        let signed = signed.map_err(|cause| {
            tracing::error!("cannot sign a certificate: {cause:?}");
            EnrolError::App(AppError::NoRandomness(cause.to_string()))
        })?;
        let certificate = RobotCertificate {
            site: name.site.clone(),
            robot: name.robot.clone(),
            enrolment: name.enrolment,
            certificate: signed.certificate,
            authority: trusted.bundle_pem(),
            lifetime_s: u64::try_from(self.lifetime.as_secs()).unwrap_or_default(),
            expires_at: signed.expires_at,
            port: self.port,
        };
        Ok((certificate, signed.fingerprint))
    }
}

#[cfg(test)]
mod tests;
