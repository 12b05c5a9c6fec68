//! A server and agents of one process that go through a simulated time together.

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, ensure};
use jiff::Timestamp;
use reqwest::Method;
use serde_json::json;
use tempfile::TempDir;
use tread_agent::sim::scenario::Scenario;
use tread_agent::sim::time::PacedTime;
use tread_agent::sim::trace::Trace;
use tread_agent::{Agent, AgentConfig, RunningAgent};
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{MissionDetail, MissionState};
use tread_api::robot::{LinkState, Robot, RobotModel};
use tread_api::trajectory::Trajectory;
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::clock::Clock;
use tread_server::config::ServerArgs;
use tread_server::{Config, RunningServer, Server};

use crate::rest::Rest;

/// When the simulated time begins: the same in every run, and not near the end of an hour.
const BEGIN: &str = "2026-11-01T09:02:00Z";
/// How much faster than real time it goes at the most: networks and disks must keep up.
pub const PACE: f64 = 20.0;
/// The same while nobody drives.
const PACE_IDLE: f64 = 200.0;
/// Time between two looks at the server, real.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Longest wait for something that takes no driving, real.
const SOON: Duration = Duration::from_mins(1);
/// Longest wait for missions, real: a machine that does nothing else needs a fraction of it.
const MISSIONS_MAX: Duration = Duration::from_mins(20);
/// Time between two samples of the truth.
const TRACE_EVERY: Duration = Duration::from_millis(20);
/// Room for so many of them, a quarter of an hour.
const TRACE_MAX: usize = 45_000;

/// A robot that takes part.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Who it is in the scenario.
    pub robot: RobotId,
    /// What it is.
    pub model: RobotModel,
}

/// A robot at work.
#[derive(Debug)]
struct ActiveRobot {
    agent: RunningAgent,
    trace: Trace,
}

/// A server, its database, and robots.
#[derive(Debug)]
pub struct World {
    /// A client of the server.
    pub rest: Rest,
    time: PacedTime,
    folder: TempDir,
    server: RunningServer,
    robots: BTreeMap<(SiteId, RobotId), ActiveRobot>,
}

impl World {
    /// A server without robots, with a first site.
    ///
    /// # Errors
    /// The server does not start.
    pub async fn start(site: &SiteId) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir()?;
        let anywhere = "127.0.0.1:0".parse()?;
        let config = Config::load(&ServerArgs {
            http: Some(anywhere),
            zenoh: Some(anywhere),
            database: Some(folder.path().join("tread.db")),
            site: Some(site.clone()),
            ..ServerArgs::default()
        })?;
        let time = PacedTime::new(BEGIN.parse()?, PACE);
        let site_time = time.clone();
        let clock = Clock::of_site(move || site_time.wall());
        let server = Server::start_with_clock(config, clock).await?;
        let first = FirstAdmin {
            name: "scenario".to_owned(),
            valid_days: 1,
            force: false,
        };
        let token = server.app().create_first_admin(first).await?.secret;
        Ok(Self {
            rest: Rest::new(format!("http://{}", server.http_address()), &token),
            time,
            folder,
            server,
            robots: BTreeMap::new(),
        })
    }

    /// The simulated time since the begin.
    pub fn now(&self) -> Duration {
        self.time.now()
    }

    /// The simulated wall time.
    pub fn wall(&self) -> Timestamp {
        self.time.wall()
    }

    /// From now on goes at most so many times as fast as real time.
    pub fn set_pace(&self, pace: f64) {
        self.time.set_pace(pace);
    }

    /// Makes a site, unless it is there, and draws a scenario's terrains on it.
    ///
    /// # Errors
    /// The server refuses them.
    pub async fn draw(&self, scenario: &Scenario) -> anyhow::Result<()> {
        let site = &scenario.site;
        let made = json!({"id": site, "cell_m": scenario.cell_m});
        let answer = self.rest.call(Method::POST, "/v1/sites", Some(&made)).await;
        let (status, said) = answer.context("the server answers")?;
        ensure!(
            status.is_success() || status == reqwest::StatusCode::CONFLICT,
            "the site was refused: {said}"
        );
        for terrain in &scenario.terrains {
            let outline = terrain.outline().map_err(anyhow::Error::msg)?;
            let drawn = json!({
                "id": terrain.id, "class": terrain.class, "polygon": outline,
                "layer": terrain.layer,
            });
            self.rest
                .post(&format!("/v1/sites/{site}/terrains"), &drawn)
                .await;
        }
        Ok(())
    }

    /// The same, unless the site has been drawn before.
    ///
    /// # Errors
    /// The server refuses them.
    pub async fn draw_once(&self, scenario: &Scenario) -> anyhow::Result<()> {
        let path = format!("/v1/sites/{}", scenario.site);
        let answer = self.rest.call(Method::GET, &path, None).await;
        let (status, _) = answer.context("the server answers")?;
        if status.is_success() {
            return Ok(());
        }
        self.draw(scenario).await
    }

    /// Starts the agents of some robots of a scenario and waits until the server hears them.
    ///
    /// # Errors
    /// One does not start, or is not heard.
    pub async fn start_robots(
        &mut self,
        scenario: &Scenario,
        entries: &[Entry],
    ) -> anyhow::Result<()> {
        for Entry { robot, model } in entries {
            let site = &scenario.site;
            let data_dir = self.folder.path().join(format!("{site}-{robot}"));
            let endpoint = self.server.zenoh_endpoint();
            let mut config =
                AgentConfig::simulated(scenario.clone(), robot.clone(), endpoint, data_dir)?;
            config.model = model.clone();
            let trace = Trace::new(TRACE_EVERY, TRACE_MAX);
            let drive = config.drive.simulated_mut();
            drive.context("a simulated base")?.trace = Some(trace.clone());
            let clock = Arc::new(self.time.clock());
            let agent = Agent::start_with_clock(config, clock)
                .with_context(|| format!("the agent of {robot}"))?;
            let key = (site.clone(), robot.clone());
            self.robots.insert(key, ActiveRobot { agent, trace });
        }
        for Entry { robot, .. } in entries {
            let path = format!("/v1/sites/{}/robots/{robot}", scenario.site);
            self.until(&format!("{robot} is online"), SOON, || async {
                let (_, body) = self.rest.call(Method::GET, &path, None).await?;
                let seen: Robot = serde_json::from_value(body).ok()?;
                let placed = seen.live.as_ref().is_some_and(|live| live.pose.is_some());
                (seen.link == LinkState::Online && placed).then_some(())
            })
            .await?;
        }
        Ok(())
    }

    /// Stops the agents of all robots, which send what they have left.
    pub async fn stop_robots(&mut self) {
        let robots = std::mem::take(&mut self.robots);
        let stops = robots.into_values().map(|robot| robot.agent.stop());
        futures_util::future::join_all(stops).await;
    }

    /// What a robot truly did so far.
    ///
    /// # Errors
    /// It does not take part, or its store was full.
    pub fn trace(&self, site: &SiteId, robot: &RobotId) -> anyhow::Result<Trace> {
        let at_work = self.robots.get(&(site.clone(), robot.clone()));
        let trace = &at_work.context("the robot is not at work")?.trace;
        ensure!(trace.missed() == 0, "the run of {robot} was too long");
        Ok(trace.clone())
    }

    /// Asks for a mission.
    ///
    /// # Errors
    /// The server's answer is none.
    pub async fn send(
        &self,
        site: &SiteId,
        robot: &RobotId,
        trajectory: &Trajectory,
    ) -> anyhow::Result<MissionId> {
        let body = json!({"site": site, "robot": robot, "trajectory": trajectory});
        let mission = self.rest.post("/v1/missions", &body).await;
        Ok(serde_json::from_value(mission["id"].clone())?)
    }

    /// Waits until missions have ended, and gives them with their history.
    ///
    /// # Errors
    /// One does not end.
    pub async fn ended(&self, missions: &[MissionId]) -> anyhow::Result<Vec<MissionDetail>> {
        let mut ended = Vec::with_capacity(missions.len());
        for mission in missions {
            let look = || async {
                let path = format!("/v1/missions/{mission}");
                let (_, body) = self.rest.call(Method::GET, &path, None).await?;
                let detail: MissionDetail = serde_json::from_value(body).ok()?;
                detail.mission.state.is_terminal().then_some(detail)
            };
            let what = format!("mission {mission} has ended");
            ended.push(self.until(&what, MISSIONS_MAX, look).await?);
        }
        self.all_is_uploaded().await?;
        Ok(ended)
    }

    /// The same for missions that must have been driven to their ends.
    ///
    /// # Errors
    /// One was not.
    pub async fn succeeded(&self, missions: &[MissionId]) -> anyhow::Result<Vec<MissionDetail>> {
        let ended = self.ended(missions).await?;
        for detail in &ended {
            let state = detail.mission.state;
            let driven = detail.driven.as_ref();
            ensure!(
                state == MissionState::Succeeded,
                "mission {} of {} is {state:?} at {:?}: {:?}; {:?}",
                detail.mission.id,
                detail.mission.robot,
                driven.and_then(|driven| driven.points.last()),
                detail.mission.reason,
                detail.mission.progress,
            );
        }
        Ok(ended)
    }

    /// Waits until the server has all that was measured so far.
    async fn all_is_uploaded(&self) -> anyhow::Result<()> {
        self.until("all measurements have arrived", SOON, || async {
            let agents = self.robots.values().map(|robot| &robot.agent);
            let pending: u64 = agents.map(|agent| agent.outbox_status().pending).sum();
            (pending == 0).then_some(())
        })
        .await
    }

    /// Lets the simulated time pass up to a moment.
    ///
    /// # Errors
    /// It does not, for nobody drives through it.
    pub async fn pass_until(&self, moment: Duration) -> anyhow::Result<()> {
        self.set_pace(PACE_IDLE);
        let passed = self.until("the time passes", MISSIONS_MAX, || async {
            (self.now() >= moment).then_some(())
        });
        let passed = passed.await;
        self.set_pace(PACE);
        passed
    }

    /// Looks again and again, until a look gives something.
    ///
    /// # Errors
    /// None does within the bound.
    pub async fn until<T, F>(
        &self,
        what: &str,
        bound: Duration,
        mut look: impl FnMut() -> F,
    ) -> anyhow::Result<T>
    where
        F: Future<Output = Option<T>>,
    {
        let looking = async {
            loop {
                if let Some(found) = look().await {
                    return found;
                }
                tokio::time::sleep(POLL_INTERVAL).await;
            }
        };
        let found = tokio::time::timeout(bound, looking).await;
        found.with_context(|| format!("not within {bound:?}: {what}"))
    }

    /// Stops robots and server.
    ///
    /// # Errors
    /// A part of the server had failed.
    pub async fn stop(mut self) -> anyhow::Result<()> {
        self.stop_robots().await;
        self.server.stop().await
    }
}
