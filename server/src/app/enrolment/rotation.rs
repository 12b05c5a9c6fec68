//! Rotation of the fleet's authority: which robots have moved to the new authority, which are left,
//! and which must join again.
//!
//! A robot has moved once it has shown a certificate of the new authority at the robots' port or
//! for a renewal. Signing one is not enough, since the answer may have been lost. The authority
//! shown last also decides which robots must join again after the former authority was retired.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tracing::{info, warn};
use tread_api::enrolment::{
    AuthorityRotation, Enrolment, FinishRotation, FleetAuthority, ReplaceAuthority, RobotLeft,
    TrustId,
};
use tread_api::robot::LinkState;

use crate::app::presence::RobotKey;
use crate::app::{App, AppError};
use crate::authority::{Authorities, RotationError, Trusted};
use crate::db;

/// Maximum number of remaining robots in a list.
const LEFT_LISTED_MAX: usize = 1_000;
/// Maximum number of remaining robots named in a refusal.
const LEFT_NAMED_MAX: usize = 10;
/// Interval at which an unconfirmed write of the authorities' files is tried again.
const SETTLE_EVERY: Duration = Duration::from_secs(5);

/// Stored enrolment and authority of the certificate that each robot showed last. Avoids repeated
/// writes of the same values.
#[derive(Debug, Default)]
pub(super) struct RecordedCertificates(Mutex<HashMap<RobotKey, (u32, String)>>);

impl RecordedCertificates {
    fn is_written(&self, robot: &RobotKey, enrolment: u32, authority: &str) -> bool {
        let shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let written = shown.get(robot);
        written.is_some_and(|(number, of)| *number == enrolment && of == authority)
    }

    fn written(&self, robot: RobotKey, enrolment: u32, authority: &str) {
        let mut shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        shown.insert(robot, (enrolment, authority.to_owned()));
    }

    /// Forgets a robot, because its row was changed otherwise.
    pub(super) fn remove(&self, robot: &RobotKey) {
        let mut shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        shown.remove(robot);
    }
}

impl App {
    fn authorities(&self) -> Result<&Arc<Authorities>, AppError> {
        self.service()
            .map(|service| &service.authorities)
            .ok_or(AppError::NoAuthority)
    }

    /// Returns the identifier of the trusted authorities; `None` where robots need no certificates.
    pub fn trust_id(&self) -> Option<TrustId> {
        self.authorities().ok().map(|it| it.present().id())
    }

    /// Returns the fleet's authority and the progress of its rotation.
    ///
    /// # Errors
    /// This server has no authority, or the database failed.
    pub async fn fleet_authority(&self) -> Result<FleetAuthority, AppError> {
        let trusted = self.authorities()?.present();
        self.describe(&trusted).await
    }

    async fn describe(&self, trusted: &Trusted) -> Result<FleetAuthority, AppError> {
        let signing = trusted.signing().fingerprint().to_owned();
        let mut described = FleetAuthority {
            signing,
            rotation: None,
            on_disk: self.authorities()?.is_durable(),
            robots_to_join: 0,
            to_join: Vec::new(),
        };
        if trusted.retiring().is_none() && !trusted.has_retired() {
            return Ok(described);
        }
        let in_force = self.in_force().await?;
        if let Some(retiring) = trusted.retiring() {
            let (moved, left) = self.moved_and_left(&in_force, trusted);
            let (robots_left, left) = counted(left);
            described.rotation = Some(AuthorityRotation {
                id: trusted.id(),
                retiring: retiring.authority.fingerprint().to_owned(),
                started_at: retiring.started_at,
                started_by: retiring.started_by.clone(),
                robots_moved: u32::try_from(moved).unwrap_or(u32::MAX),
                robots_left,
                left,
            });
        }
        if trusted.has_retired() {
            let must_join = |enrolment: &&Enrolment| must_join(enrolment, trusted);
            let to_join = in_force.iter().filter(must_join);
            let to_join = to_join.map(|it| self.robot_left(it)).collect();
            (described.robots_to_join, described.to_join) = counted(to_join);
        }
        Ok(described)
    }

    /// Returns the enrolments that are in force.
    async fn in_force(&self) -> Result<Vec<Enrolment>, AppError> {
        let mut tx = self.db().read("enrolment").await?;
        let mut newest = db::enrolments::all_newest(&mut tx).await?;
        newest.retain(|enrolment| enrolment.revoked_at.is_none());
        Ok(newest)
    }

    /// Returns how many robots have shown a certificate of the signing authority, and the robots
    /// that have not.
    fn moved_and_left(&self, in_force: &[Enrolment], trusted: &Trusted) -> (usize, Vec<RobotLeft>) {
        let signing = Some(trusted.signing().fingerprint());
        let has_moved = |enrolment: &&Enrolment| enrolment.authority.as_deref() == signing;
        let (moved, left): (Vec<_>, Vec<_>) = in_force.iter().partition(has_moved);
        let left = left.into_iter().map(|it| self.robot_left(it)).collect();
        (moved.len(), left)
    }

    fn robot_left(&self, enrolment: &Enrolment) -> RobotLeft {
        let key = (enrolment.site.clone(), enrolment.robot.clone());
        let online = self.presences().get(&key).link(self.clock().elapsed()) == LinkState::Online;
        let (site, robot) = key;
        RobotLeft {
            site,
            robot,
            renewed_at: enrolment.renewed_at,
            online,
        }
    }

    /// Starts a rotation of the fleet's authority.
    ///
    /// # Errors
    /// This server has no authority, a rotation is under way, or the files cannot be written.
    pub async fn start_rotation(&self, by: &str) -> Result<FleetAuthority, AppError> {
        let (authorities, by) = (Arc::clone(self.authorities()?), by.to_owned());
        let now = self.clock().machine_time();
        let starter = by.clone();
        let starting = tokio::task::spawn_blocking(move || authorities.start(&starter, now));
        let trusted = ended(starting.await)?;
        let signing = trusted.signing().fingerprint();
        warn!("{by} has started a rotation of the fleet's authority; now `{signing}` signs");
        self.describe(&trusted).await
    }

    /// Finishes the rotation of the fleet's authority: the former authority is no longer trusted,
    /// and robots without a certificate of the new one must join again.
    ///
    /// # Errors
    /// No rotation or another one is under way, robots are left and `force` is not set, or the
    /// files cannot be written.
    pub async fn finish_rotation(
        &self,
        request: &FinishRotation,
        by: &str,
    ) -> Result<FleetAuthority, AppError> {
        let authorities = Arc::clone(self.authorities()?);
        let (rotation, present) = (request.rotation, authorities.present());
        present
            .check_rotation(rotation)
            .map_err(AppError::Rotation)?;
        if !request.force {
            let (_moved, left) = self.moved_and_left(&self.in_force().await?, &present);
            if !left.is_empty() {
                return Err(AppError::RobotsLeft {
                    count: left.len(),
                    first: named(&left),
                });
            }
        }
        let finishing = tokio::task::spawn_blocking(move || authorities.finish(rotation));
        let trusted = ended(finishing.await)?;
        warn!("{by} has finished the rotation of the fleet's authority; the former one is retired");
        self.retry_authority_sync();
        self.describe(&trusted).await
    }

    /// Replaces all trusted authorities by a new one: no earlier certificate is accepted from now
    /// on, and every robot must join again.
    ///
    /// # Errors
    /// This server has no authority, the signing authority is not the one named, or the files
    /// cannot be written.
    pub async fn replace_authority(
        &self,
        request: &ReplaceAuthority,
        by: &str,
    ) -> Result<FleetAuthority, AppError> {
        let authorities = Arc::clone(self.authorities()?);
        let (signing, now) = (request.signing.clone(), self.clock().machine_time());
        let replacing = tokio::task::spawn_blocking(move || authorities.replace(&signing, now));
        let trusted = ended(replacing.await)?;
        let signing = trusted.signing().fingerprint();
        warn!(
            "{by} has replaced the fleet's authority; `{signing}` signs now, and every robot must join \
             again"
        );
        self.describe(&trusted).await
    }

    /// Retries the write of the authorities' files in the background until the disk confirms it.
    fn retry_authority_sync(&self) {
        let Ok(authorities) = self.authorities() else {
            return;
        };
        if authorities.is_durable() {
            return;
        }
        let (authorities, stop) = (Arc::clone(authorities), self.supervisor().stop_token());
        self.supervisor().spawn_passing("authorities", async move {
            while !authorities.is_durable() {
                tokio::select! {
                    () = stop.cancelled() => return,
                    () = tokio::time::sleep(SETTLE_EVERY) => {}
                }
                let retried = Arc::clone(&authorities);
                let syncing = tokio::task::spawn_blocking(move || retried.retry_sync());
                match syncing.await {
                    Ok(Ok(())) => {
                        info!("the disk has confirmed that the former authority is retired");
                    }
                    Ok(Err(failed)) => warn!(
                        error = &failed as &dyn std::error::Error,
                        "the disk still has not confirmed that the former authority is retired"
                    ),
                    Err(panicked) => warn!("the disk was not asked again: {panicked}"),
                }
            }
        });
    }

    /// Records whose certificate a robot has shown at the robots' port, once there was a rotation.
    pub async fn record_shown_certificate(
        &self,
        robot: &RobotKey,
        enrolment: u32,
        authority: &str,
    ) {
        let matters = self.authorities().is_ok_and(|authorities| {
            let present = authorities.present();
            present.retiring().is_some() || present.has_retired()
        });
        let shown = &self.membership().shown;
        if !matters || shown.is_written(robot, enrolment, authority) {
            return;
        }
        let writing = async {
            let one = (&robot.0, &robot.1, enrolment);
            // All robots reconnect after a restart, and few of them show another authority than
            // before.
            let mut tx = self.db().read("enrolment").await?;
            let newest = db::enrolments::newest(&mut tx, &robot.0, &robot.1).await?;
            drop(tx);
            if newest.is_some_and(|newest| newest.authority.as_deref() == Some(authority)) {
                return Ok(());
            }
            let mut tx = self.db().write("enrolment").await?;
            db::enrolments::record_authority(&mut tx, one, authority).await?;
            tx.commit().await?;
            Ok(())
        };
        match db::limited(writing).await {
            Ok(()) => {
                shown.written(robot.clone(), enrolment, authority);
                let (site, robot) = robot;
                info!(robot.id = %robot, "robot `{robot}` of site `{site}` shows a certificate of `{authority}`");
            }
            // The robot's next connection or renewal records it again.
            Err::<(), AppError>(error) => {
                self.log_failure("note whose certificate a robot shows", &error);
            }
        }
    }
}

fn ended(
    changed: Result<Result<Arc<Trusted>, RotationError>, tokio::task::JoinError>,
) -> Result<Arc<Trusted>, AppError> {
    match changed {
        Ok(Ok(trusted)) => Ok(trusted),
        Ok(Err(RotationError::Refused(refused))) => Err(AppError::Rotation(refused)),
        Ok(Err(RotationError::Files(failed))) => Err(AppError::AuthorityFiles(failed)),
        Ok(Err(RotationError::Key(failed))) => Err(AppError::NoRandomness(failed.to_string())),
        Err(panicked) => Err(AppError::NoRandomness(panicked.to_string())),
    }
}

/// Returns whether a robot must join again. A robot without a recorded authority has not shown a
/// certificate of the new authority before the former one was retired.
fn must_join(enrolment: &Enrolment, trusted: &Trusted) -> bool {
    match &enrolment.authority {
        Some(shown) => !trusted.is_trusted(shown),
        None => trusted.retiring().is_none(),
    }
}

/// Returns the number of robots and the first of them.
fn counted(mut robots: Vec<RobotLeft>) -> (u32, Vec<RobotLeft>) {
    let count = u32::try_from(robots.len()).unwrap_or(u32::MAX);
    robots.truncate(LEFT_LISTED_MAX);
    (count, robots)
}

/// Formats the first of the remaining robots for people.
fn named(left: &[RobotLeft]) -> String {
    let names = left.iter().take(LEFT_NAMED_MAX);
    let names: Vec<String> = names
        .map(|left| format!("`{}` of site `{}`", left.robot, left.site))
        .collect();
    let more = left.len().saturating_sub(LEFT_NAMED_MAX);
    match more {
        0 => names.join(", "),
        more => format!("{} and {more} more", names.join(", ")),
    }
}
