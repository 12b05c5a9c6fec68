//! Checks that no mission triggers: robots that are restricted since a restoration, expiry, second
//! agents, the alerts of the server, and definitions of sites that robots lack.

use std::collections::HashMap;
use std::time::Duration;

use tread_api::ids::SiteId;
use tread_api::rights::Scope;

use super::jobs::{apply_change, push_site};
use super::needs::{Need, is_heard};
use super::unknown_missions::end_duplicate_agent;
use super::{Job, Reconciler, key_of, outcomes};
use crate::app::AppError;
use crate::app::missions::transitions::Change;
use crate::app::presence::{DuplicateAgent, RobotKey};
use crate::app::sites::SITES_MAX;
use crate::db;
use crate::db::missions::OpenMission;
use crate::db::restorations::RestrictedRobot;

/// Maximum number of missions that expire in one pass.
const EXPIRE_MAX: u32 = 1_000;
/// Maximum number of outcome queries to a robot, at most [`super::RETRY_MAX`] apart. An agent of an older
/// release does not know the query and never answers.
const OUTCOMES_TRIES_MAX: u32 = 6;
/// Time that a robot has to upload its reports before it gets an outcome query: reports contain more
/// than the answer to the query.
const OUTBOX_PATIENCE: Duration = Duration::from_secs(10);

impl Reconciler {
    /// Looks at everything that is not a step of a mission; `open` are the open missions, if they
    /// could be read.
    pub(super) async fn run_periodic_checks(
        &mut self,
        open: Option<&[OpenMission]>,
    ) -> Result<(), AppError> {
        self.query_restricted_robots();
        self.expire().await?;
        self.end_duplicate_agents();
        self.attendance.check(&self.app).await?;
        self.conditions.check(&self.app).await?;
        if let Some(open) = open {
            self.conditions.end_of_absent(&self.app, open).await?;
            self.delays.check(&self.app, open).await?;
        }
        self.push_sites().await
    }

    /// Sends the definition of its site to each robot that has an older one.
    async fn push_sites(&mut self) -> Result<(), AppError> {
        let mut tx = self.app.db().read("reconciler").await?;
        let sites = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        drop(tx);
        let revisions: HashMap<SiteId, (u64, u64)> = sites
            .into_iter()
            .map(|row| {
                let (terrains, fence) = (row.site.terrain_revision, row.site.geofence_revision);
                (row.site.id, (terrains, fence))
            })
            .collect();
        for (key, held) in self.app.presences().online(self.app.clock().elapsed()) {
            // A robot without any definition of its site sends a hello and gets one.
            let lags = revisions.get(&key.0).is_some_and(|&(terrains, fence)| {
                held.terrains.is_some_and(|held| held != terrains)
                    // A robot without support for geofences reports no revision.
                    || held.fence.is_some_and(|held| held != fence)
            });
            let job = Job::Site(key.clone());
            if lags && self.is_due(&job) {
                let app = self.app.clone();
                self.start(job, push_site(app, key));
            } else if !lags {
                self.retries.remove(&job);
            }
        }
        Ok(())
    }

    /// Sends outcome queries to the robots that await their release after a restoration.
    fn query_restricted_robots(&mut self) {
        let restricted: Vec<RestrictedRobot> = self.restricted.values().cloned().collect();
        let needs_outcomes = |key: &RobotKey| {
            let found = self.restricted.get(key);
            found.is_some_and(|found| found.outcomes_wanted)
        };
        self.outcome_queries.retain(|key, _| needs_outcomes(key));
        self.retries
            .retain(|job, _| !matches!(job, Job::Outcomes(key) if !needs_outcomes(key)));
        let now = self.app.clock().elapsed();
        for robot in restricted.into_iter().filter(|it| it.outcomes_wanted) {
            let key = key_of(&robot);
            let presence = self.app.presences().get(&key);
            if !is_heard(&presence, now) {
                continue;
            }
            let pending = presence.state().map_or(0, |state| state.outbox.pending);
            let (since, tries) = *self.outcome_queries.entry(key.clone()).or_insert((now, 0));
            let is_patient = pending > 0 && now.saturating_sub(since) < OUTBOX_PATIENCE;
            let job = Job::Outcomes(key.clone());
            if !is_patient && self.is_due(&job) {
                self.outcome_queries.insert(key, (since, tries + 1));
                let is_last = tries + 1 >= OUTCOMES_TRIES_MAX;
                let app = self.app.clone();
                self.start(job, outcomes::ask(app, robot, is_last));
            }
        }
    }

    async fn expire(&self) -> Result<(), AppError> {
        let now = self.app.clock().now();
        let mut tx = self.app.db().read("reconciler").await?;
        let overdue = db::missions::overdue(&mut tx, now, EXPIRE_MAX).await?;
        drop(tx);
        for mission in overdue {
            let key = (mission.site.clone(), mission.robot.clone());
            let heard = is_heard(&self.app.presences().get(&key), self.app.clock().elapsed());
            let expires = Need::Apply(Change::Expire);
            if self.defer_if_restricted(&key, heard, expires) != expires {
                continue;
            }
            apply_change(&self.app, &mission, Change::Expire, Duration::ZERO).await?;
        }
        Ok(())
    }

    /// Finds second agents that drive a mission, and commands them to end it.
    fn end_duplicate_agents(&mut self) {
        let duplicates = self
            .app
            .presences()
            .take_duplicate_agents(self.app.clock().elapsed());
        let driving = |key: &RobotKey| {
            let of_key =
                |duplicate: &&DuplicateAgent| duplicate.key == *key && duplicate.mission.is_some();
            duplicates.iter().find(of_key)
        };
        self.retries.retain(|job, _| match job {
            Job::EndDuplicateAgent(key) => driving(key).is_some(),
            Job::Offer(_)
            | Job::Replace(_)
            | Job::Hold(..)
            | Job::Cancel(_)
            | Job::Disown(_)
            | Job::Site(_)
            | Job::Outcomes(_)
            | Job::Stop(_) => true,
        });
        for duplicate in duplicates {
            let job = Job::EndDuplicateAgent(duplicate.key.clone());
            if duplicate.mission.is_some() && self.is_due(&job) {
                let app = self.app.clone();
                self.start(
                    job,
                    async move { Ok(end_duplicate_agent(app, duplicate).await) },
                );
            }
        }
    }
}
