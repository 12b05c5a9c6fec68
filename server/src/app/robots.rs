//! Robots: listing, changes, and their hello.

use std::collections::BTreeSet;

use tracing::{info, warn};
use tread_api::ids::{RobotId, SiteId, Tag};
use tread_api::mission::Actor;
use tread_api::page::Page;
use tread_api::release::Peer;
use tread_api::rights::Scope;
use tread_api::robot::{ALERTS_MAX, Alert, Robot, RobotModel, TAGS_MAX, UpdateRobot};
use tread_api::site::NAME_LENGTH_MAX;
use tread_api::text::is_printable;
use tread_api::wire::encoding::Encoding;
use tread_api::wire::hello::{Hello, Welcome};
use tread_api::wire::{Refusal, RefusalCode};

use super::allowance::Kind;
use super::missions::end_all;
use super::missions::transitions::Change;
use super::terrains::site_definition;
use super::{App, AppError, name_or, page, site_row};
use crate::app::presence::RobotKey;
use crate::db::robots::{Introduction, RobotRow};
use crate::db::{self, Outcome};

/// Number of runs of one robot's agent that are kept; older ones only as long as their raw
/// measurements are.
pub(super) const RUNS_KEPT_MAX: u32 = 500;

impl App {
    /// Returns whether the allowance of a robot's agent permits another run now; takes one unit of
    /// it.
    pub(super) fn may_begin_run(&self, robot: &RobotKey) -> bool {
        let now = self.clock().elapsed();
        self.allowances().take(robot, Kind::Run, now)
    }

    /// Returns whether a robot's allowance permits another configuration now; takes one unit of it.
    pub(super) fn may_change_configuration(&self, robot: &RobotKey) -> bool {
        let now = self.clock().elapsed();
        self.allowances().take(robot, Kind::Configuration, now)
    }

    /// Returns a page of the robots of a site in a scope, after a cursor.
    pub async fn robots(
        &self,
        (site, within): (&SiteId, &Scope),
        cursor: Option<&str>,
        retired: bool,
        limit: u32,
    ) -> Result<Page<Robot>, AppError> {
        let mut tx = self.db().read("robots").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let (after, named) = (cursor.unwrap_or_default(), within.limit_of(site));
        let rows = db::robots::list(
            &mut tx,
            (site_pk, named.as_ref()),
            after,
            retired,
            limit + 1,
        )
        .await?;
        let mut robots = Vec::with_capacity(rows.len());
        for row in rows {
            let alerts = db::alerts::raised_of(&mut tx, row.pk).await?;
            robots.push(self.with_live(row, alerts));
        }
        Ok(page(robots, limit, |robot: &Robot| robot.id.to_string()))
    }

    /// Returns one robot with its live state.
    pub async fn robot(&self, site: &SiteId, id: &RobotId) -> Result<Robot, AppError> {
        let mut tx = self.db().read("robots").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let row = db::robots::find(&mut tx, site_pk, id).await?;
        let unknown = || AppError::UnknownRobot(site.clone(), id.clone());
        let row = row.ok_or_else(unknown)?;
        let alerts = db::alerts::raised_of(&mut tx, row.pk).await?;
        Ok(self.with_live(row, alerts))
    }

    /// Changes a robot's display name, retires it or ends its retirement. Retiring cancels all its
    /// missions.
    pub async fn update_robot(
        &self,
        site: &SiteId,
        id: &RobotId,
        change: UpdateRobot,
    ) -> Result<Robot, AppError> {
        let now = self.clock().now();
        let mut tx = self.db().write("robots").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let unknown = || AppError::UnknownRobot(site.clone(), id.clone());
        let found = db::robots::find(&mut tx, site_pk, id).await?;
        let row = found.ok_or_else(unknown)?;
        let mut ended = Vec::new();
        if change.name.is_some() {
            let name = name_or(change.name, id.as_str())?;
            db::robots::rename(&mut tx, row.pk, &name).await?;
        }
        if let Some(tags) = change.tags {
            db::robots::set_tags(&mut tx, row.pk, &distinct_tags(tags)?).await?;
        }
        match (change.retired, row.retired_at) {
            (Some(true), None) => {
                let why = (Change::Retire, Actor::Client, Change::Retire.reason());
                end_all(&mut tx, row.pk, why, now).await?;
                db::robots::set_retired(&mut tx, row.pk, Some(now)).await?;
                ended = self.end_work_alerts(&mut tx, row.pk).await?;
            }
            (Some(false), Some(_)) => db::robots::set_retired(&mut tx, row.pk, None).await?,
            (Some(true), Some(_)) | (Some(false), None) | (None, _) => {}
        }
        let found = db::robots::find(&mut tx, site_pk, id).await?;
        let row = found.ok_or_else(unknown)?;
        let alerts = db::alerts::raised_of(&mut tx, row.pk).await?;
        let app = self.clone();
        let committed = tx.commit_then(move |outcome| {
            if outcome == Outcome::Written {
                app.show_alerts(&ended);
                app.robots_changed();
            }
            app.recall();
        });
        committed.await?;
        Ok(self.with_live(row, alerts))
    }

    pub(super) fn with_live(&self, row: RobotRow, mut alerts: Vec<Alert>) -> Robot {
        alerts.truncate(ALERTS_MAX);
        let now = self.clock().elapsed();
        let presence = self.presences().get(&(row.site.clone(), row.id.clone()));
        Robot {
            id: row.id,
            site: row.site,
            name: row.name,
            tags: row.tags,
            retired_at: row.retired_at,
            awaits_release_since: row.awaits_release_since,
            model: row.model,
            configuration: row.configuration,
            capabilities: row.capabilities,
            agent_version: row.agent_version,
            first_seen_at: row.first_seen_at,
            last_hello_at: row.last_hello_at,
            measurements: row.measurements,
            link: presence.link(now),
            link_cause: presence.link_cause(now),
            link_quality: presence.link_quality(now),
            alerts,
            live: presence.live(now),
        }
    }

    /// Loads from the database the robots that have sent a hello before, so that their messages are
    /// accepted without another one.
    ///
    /// # Errors
    /// The database failed.
    pub async fn load_robots(&self) -> Result<(), AppError> {
        let mut tx = self.db().read("robots").await?;
        for key in db::robots::names(&mut tx).await? {
            self.presences().register(key);
        }
        Ok(())
    }

    /// Processes a robot's hello and returns the definition of its site.
    ///
    /// # Errors
    /// The refusal that the robot gets: its site is not known, its model is invalid, or the server
    /// cannot write now.
    pub async fn hello(&self, site: &SiteId, hello: &Hello) -> Result<Welcome, Refusal> {
        check_model(hello).map_err(|detail| refusal(RefusalCode::Malformed, detail))?;
        // The states of a known robot are accepted at once, even if the hello cannot be stored.
        let key = (site.clone(), hello.robot.clone());
        if self.presences().is_known(&key) {
            self.presences()
                .hello(key.clone(), hello.boot, self.clock().elapsed());
        }
        let introducing = db::limited(self.introduce(site, hello));
        let welcome = introducing.await.map_err(|error| {
            self.log_failure("write down a robot's introduction", &error);
            refusal(RefusalCode::Busy, "the server cannot write now".to_owned())
        })?;
        let unknown = || {
            self.counters().refused_unknown_site.one();
            refusal(
                RefusalCode::UnknownSite,
                format!("site `{site}` is not known"),
            )
        };
        let welcome = welcome.ok_or_else(unknown)?.map_err(|too_much| {
            let detail = format!("the robot has {too_much} of late");
            refusal(RefusalCode::Busy, detail)
        })?;
        info!(robot.id = %hello.robot, "robot `{}` of site `{site}` said hello", hello.robot);
        let (peer, version) = (Peer::of(&hello.agent_version), &hello.agent_version);
        if matches!(peer, Peer::TooOld | Peer::TooNew) {
            warn!(robot.id = %hello.robot, "agent {version} of robot `{}` {peer}", hello.robot);
        }
        self.presences()
            .hello(key, hello.boot, self.clock().elapsed());
        self.robots_changed();
        self.wake();
        Ok(welcome)
    }

    /// Returns `None` if the site is not known, and what exceeded the robot's allowance, if
    /// anything.
    async fn introduce(
        &self,
        site: &SiteId,
        hello: &Hello,
    ) -> Result<Option<Result<Welcome, &'static str>>, AppError> {
        let now = self.clock().now();
        let mut tx = self.db().write("robots").await?;
        let Some(row) = db::sites::find(&mut tx, site).await? else {
            return Ok(None);
        };
        let key = (site.clone(), hello.robot.clone());
        let before = db::robots::find(&mut tx, row.pk, &hello.robot).await?;
        let known_run = match &before {
            Some(before) => db::robots::find_boot(&mut tx, before.pk, hello.boot).await?,
            None => None,
        };
        if known_run.is_none() && !self.may_begin_run(&key) {
            return Ok(Some(Err("begun too many runs")));
        }
        let configuration = hello.model.configuration();
        let changes = before.is_some_and(|before| before.configuration != configuration);
        if changes && !self.may_change_configuration(&key) {
            return Ok(Some(Err("changed its configuration too often")));
        }
        let introduction = Introduction {
            id: &hello.robot,
            boot: hello.boot,
            agent_version: &hello.agent_version,
            model: &hello.model,
            capabilities: &hello.capabilities,
            at: now,
        };
        db::robots::introduce(&mut tx, row.pk, introduction, RUNS_KEPT_MAX).await?;
        let definition = site_definition(&mut tx, site).await?;
        tx.commit().await?;
        Ok(definition.map(|site| {
            Ok(Welcome {
                site,
                server_time: now,
                upload_encodings: vec![Encoding::Cbor],
            })
        }))
    }
}

fn refusal(code: RefusalCode, detail: String) -> Refusal {
    Refusal { code, detail }
}

fn check_model(hello: &Hello) -> Result<(), String> {
    let RobotModel {
        name,
        tyres,
        mass_kg,
        track_width_m,
        wheelbase_m,
        wheel_radius_m,
        yaw_inertia_kg_m2,
        limits,
    } = &hello.model;
    let none = String::new();
    let base = hello.capabilities.base.as_ref().unwrap_or(&none);
    for (field, text) in [
        ("name", name),
        ("tyres", tyres),
        ("agent_version", &hello.agent_version),
        ("capabilities.base", base),
    ] {
        if text.chars().count() > NAME_LENGTH_MAX {
            return Err(format!(
                "{field} is longer than {NAME_LENGTH_MAX} characters"
            ));
        }
        if let Some(letter) = text.chars().find(|letter| !is_printable(*letter)) {
            let code = u32::from(letter);
            return Err(format!(
                "{field} has the character U+{code:04X}, which is not printable"
            ));
        }
    }
    let figures = [
        ("mass_kg", *mass_kg),
        ("track_width_m", *track_width_m),
        ("wheelbase_m", *wheelbase_m),
        ("wheel_radius_m", *wheel_radius_m),
        ("yaw_inertia_kg_m2", *yaw_inertia_kg_m2),
        ("limits.linear_max_m_s", limits.linear_max_m_s),
        ("limits.angular_max_rad_s", limits.angular_max_rad_s),
        (
            "limits.linear_acceleration_max_m_s2",
            limits.linear_acceleration_max_m_s2,
        ),
        (
            "limits.lateral_acceleration_max_m_s2",
            limits.lateral_acceleration_max_m_s2,
        ),
        ("limits.linear_jerk_max_m_s3", limits.linear_jerk_max_m_s3),
        ("limits.wheel_speed_max_rad_s", limits.wheel_speed_max_rad_s),
        (
            "limits.wheel_acceleration_max_rad_s2",
            limits.wheel_acceleration_max_rad_s2,
        ),
    ];
    match figures
        .into_iter()
        .find(|(_field, value)| !(value.is_finite() && *value > 0.0))
    {
        Some((field, value)) => Err(format!("model.{field} must be positive, not {value}")),
        None => Ok(()),
    }
}

/// Returns tags without repetition.
///
/// # Errors
/// There are more than [`TAGS_MAX`].
fn distinct_tags(tags: Vec<Tag>) -> Result<BTreeSet<Tag>, AppError> {
    let tags: BTreeSet<Tag> = tags.into_iter().collect();
    if tags.len() > TAGS_MAX {
        return Err(AppError::Invalid {
            field: "tags",
            detail: format!("{} tags; a robot has at most {TAGS_MAX}", tags.len()),
        });
    }
    Ok(tags)
}
