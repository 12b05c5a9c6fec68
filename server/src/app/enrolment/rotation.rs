//! The rotation of the fleet's authority, as far as the fleet's robots are concerned: who was brought
//! over, who is left, and who comes too late.
//!
//! A robot counts as brought over when it has shown a certificate of the new authority at the robots'
//! port, or for a renewal. That one was signed for it is not enough: the answer may have been lost.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tracing::{info, warn};
use tread_api::enrolment::{AuthorityRotation, FleetAuthority, RobotLeft, TrustId};
use tread_api::robot::LinkState;

use crate::app::presence::RobotKey;
use crate::app::{App, AppError};
use crate::authority::{Authorities, RotationError, Trusted};
use crate::db;

/// Most robots that are listed as left.
const LEFT_LISTED_MAX: usize = 1_000;
/// Most robots that a refusal names.
const LEFT_NAMED_MAX: usize = 10;

/// Whose certificate each robot showed last, as far as it is written down; so that it is written once.
#[derive(Debug, Default)]
pub(super) struct Shown(Mutex<HashMap<RobotKey, (u32, String)>>);

impl Shown {
    fn is_written(&self, robot: &RobotKey, enrolment: u32, authority: &str) -> bool {
        let shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let written = shown.get(robot);
        written.is_some_and(|(number, of)| *number == enrolment && of == authority)
    }

    fn written(&self, robot: RobotKey, enrolment: u32, authority: &str) {
        let mut shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        shown.insert(robot, (enrolment, authority.to_owned()));
    }

    /// Something else was written.
    pub(super) fn forget(&self, robot: &RobotKey) {
        let mut shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        shown.remove(robot);
    }
}

impl App {
    fn authorities(&self) -> Result<&Arc<Authorities>, AppError> {
        self.office()
            .map(|office| &office.authorities)
            .ok_or(AppError::NoAuthority)
    }

    /// Which authorities robots are to trust; `None` where they need no certificates.
    pub fn trust_id(&self) -> Option<TrustId> {
        self.authorities().ok().map(|it| it.present().id())
    }

    /// The fleet's authority, and how far its rotation is.
    ///
    /// # Errors
    /// Robots do not join this server, or the database failed.
    pub async fn fleet_authority(&self) -> Result<FleetAuthority, AppError> {
        let trusted = self.authorities()?.present();
        self.describe(&trusted).await
    }

    async fn describe(&self, trusted: &Trusted) -> Result<FleetAuthority, AppError> {
        let signing = trusted.signing().fingerprint().to_owned();
        let Some(retiring) = trusted.retiring() else {
            let rotation = None;
            return Ok(FleetAuthority { signing, rotation });
        };
        let (moved, mut left) = self.moved_and_left(&signing).await?;
        let robots_left = left.len();
        left.truncate(LEFT_LISTED_MAX);
        let rotation = AuthorityRotation {
            retiring: retiring.authority.fingerprint().to_owned(),
            started_at: retiring.started_at,
            started_by: retiring.started_by.clone(),
            robots_moved: u32::try_from(moved).unwrap_or(u32::MAX),
            robots_left: u32::try_from(robots_left).unwrap_or(u32::MAX),
            left,
        };
        Ok(FleetAuthority {
            signing,
            rotation: Some(rotation),
        })
    }

    /// How many robots have shown a certificate of an authority, and who has not.
    async fn moved_and_left(&self, signing: &str) -> Result<(usize, Vec<RobotLeft>), AppError> {
        let mut tx = self.db().read("enrolment").await?;
        let newest = db::enrolments::all_newest(&mut tx).await?;
        drop(tx);
        let now = self.clock().elapsed();
        let mut moved = 0;
        let mut left = Vec::new();
        for enrolment in newest.into_iter().filter(|it| it.revoked_at.is_none()) {
            if enrolment.authority.as_deref() == Some(signing) {
                moved += 1;
                continue;
            }
            let key = (enrolment.site, enrolment.robot);
            let online = self.presences().get(&key).link(now) == LinkState::Online;
            let (site, robot) = key;
            left.push(RobotLeft {
                site,
                robot,
                renewed_at: enrolment.renewed_at,
                online,
            });
        }
        Ok((moved, left))
    }

    /// Starts a rotation of the fleet's authority.
    ///
    /// # Errors
    /// Robots do not join this server, one is under way, or the files cannot be written.
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

    /// Finishes the rotation of the fleet's authority: the former one is no longer trusted, and who has
    /// no certificate of the new one must join again.
    ///
    /// # Errors
    /// None is under way, robots are left and it is not forced, or the files cannot be written.
    pub async fn finish_rotation(&self, force: bool, by: &str) -> Result<FleetAuthority, AppError> {
        let authorities = Arc::clone(self.authorities()?);
        let present = authorities.present();
        if present.retiring().is_some() && !force {
            let (_moved, left) = self.moved_and_left(present.signing().fingerprint()).await?;
            if !left.is_empty() {
                return Err(AppError::RobotsLeft {
                    count: left.len(),
                    first: named(&left),
                });
            }
        }
        let finishing = tokio::task::spawn_blocking(move || authorities.finish());
        let trusted = ended(finishing.await)?;
        warn!("{by} has finished the rotation of the fleet's authority; the former one is retired");
        self.describe(&trusted).await
    }

    /// Notes during a rotation whose certificate a robot has shown at the robots' port.
    pub async fn note_shown(&self, robot: &RobotKey, enrolment: u32, authority: &str) {
        let is_rotating = self
            .authorities()
            .is_ok_and(|authorities| authorities.present().retiring().is_some());
        let shown = &self.membership().shown;
        if !is_rotating || shown.is_written(robot, enrolment, authority) {
            return;
        }
        let writing = async {
            let mut tx = self.db().write("enrolment").await?;
            let one = (&robot.0, &robot.1, enrolment);
            db::enrolments::note_authority(&mut tx, one, authority).await?;
            tx.commit().await?;
            Ok(())
        };
        match db::limited(writing).await {
            Ok(()) => {
                shown.written(robot.clone(), enrolment, authority);
                let (site, robot) = robot;
                info!(robot.id = %robot, "robot `{robot}` of site `{site}` shows a certificate of `{authority}`");
            }
            // Its next connection or renewal tells it again.
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

/// The first of those that are left, for people.
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
