//! `tread demo`: runs a whole fleet on this machine, each part in a process of its own.
//!
//! This executable starts itself as the server and as one agent for each robot of a scenario,
//! creates the scenario's terrains, sends its missions over REST, and shows their progress. The
//! robots measure the friction of the ground: only their simulated bases have the true values.

mod processes;
mod progress;
mod report;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use tokio::time::{Instant, MissedTickBehavior};
use tread_agent::sim::scenario::{Scenario, ScenarioRobot};
use tread_api::ids::{MissionId, TerrainId};
use tread_api::mission::{CreateMission, LinkPolicy, Mission, StartPolicy};
use tread_api::problem::ProblemType;
use tread_api::robot::{LinkState, Robot};
use tread_api::terrain::{CreateTerrain, Terrain, TerrainRef, TerrainShape, terrain_at};

use self::processes::Processes;
use self::progress::Progress;
use self::report::Report;
use crate::args::DemoArguments;
use crate::client::{Client, ClientError, Outage, Reading, TrustAnchor};
use crate::credentials::{self, Entry, Store};
use crate::output::{json_line, line, print_note};
use crate::signals::ShutdownSignals;

/// Maximum time until the server is ready, and until all robots are online.
const START_WAIT_MAX: Duration = Duration::from_secs(30);
/// Maximum time for the last measurements to be uploaded after the last mission has ended.
const UPLOAD_WAIT_MAX: Duration = Duration::from_secs(10);
/// Polling period of the fleet.
const POLL_INTERVAL: Duration = Duration::from_millis(200);
/// Number of newest missions that are polled.
const MISSIONS_MAX: u32 = 1_000;

/// Runs a fleet until its missions have ended, its time is over or it is asked to end, as by Ctrl-C.
pub(crate) async fn run(arguments: DemoArguments) -> anyhow::Result<ExitCode> {
    let scenario = match &arguments.scenario {
        Some(file) => Scenario::load(file)?,
        None => Scenario::built_in()?,
    };
    let robots = choose_robots(&scenario, arguments.robots)?;
    let folder = DataFolder::new(arguments.data_dir.clone())?;
    let print_step = |text: &str| {
        if !arguments.json {
            print_note(text);
        }
    };

    // Before anything starts that it must stop.
    let mut signals = ShutdownSignals::listen()?;
    print_step("starting server, database and router …");
    let mut processes = Processes::start_server(folder.path(), arguments.port, &scenario.site)?;
    let token = credentials::read_token(&processes.token_file())?;
    let client = Client::new(&processes.api_address(), Some(&token), TrustAnchor::System)?;
    let _signed_in = SignedIn::keep(&client, token);
    let demo = Demo {
        scenario: &scenario,
        robots: &robots,
        client: &client,
    };
    let began = tokio::select! {
        began = demo.begin(&mut processes, folder.path(), arguments.scenario.as_deref()) => Some(began),
        () = signals.next() => None,
    };
    let outcome = match began {
        None => None,
        Some(Err(error)) => Some(Err(error)),
        Some(Ok((terrains, missions))) => {
            print_step(&welcome(&client, &processes, folder.path(), missions.len()));
            let watch = Watch::new(&demo, &terrains, missions, &arguments);
            Some(watch.watch_until_end(&mut processes, &mut signals).await)
        }
    };
    print_step("stopping …");
    processes.stop().await;
    let Some(Ended {
        report,
        is_cut_short,
    }) = outcome.transpose()?
    else {
        return Ok(ExitCode::SUCCESS);
    };
    if arguments.json {
        json_line(&report)?;
    } else {
        line(&report.for_people())?;
    }
    // Whoever interrupts it does not wait for its missions.
    Ok(if is_cut_short || report.holds() {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn choose_robots(scenario: &Scenario, count: u32) -> anyhow::Result<Vec<ScenarioRobot>> {
    let count = usize::try_from(count)?;
    let available = scenario.robots.len();
    ensure!(
        count <= available,
        "the scenario has {available} robots, not {count}: ask for fewer with --robots, or write \
         more into a scenario of your own and give it with --scenario"
    );
    Ok(scenario.robots.iter().take(count).cloned().collect())
}

fn welcome(client: &Client, processes: &Processes, folder: &Path, missions: usize) -> String {
    format!(
        "\n  page           {api}/\n  REST API       {api}/v1\n  documentation  {api}/docs\n  zenoh router   {}\n  \
         data and logs  {}\n  admin's token  {}\n\n{missions} missions sent; try \
         `tread watch --server {api}` in another terminal: it finds the token.\n",
        processes.zenoh_endpoint(),
        folder.display(),
        processes.token_file().display(),
        api = client.address(),
    )
}

/// Guard that keeps the demo's token in the user's credentials file, so that other `tread` commands
/// find it while the demo runs.
struct SignedIn {
    store: Option<Store>,
    address: String,
    token: String,
}

impl SignedIn {
    fn keep(client: &Client, token: String) -> Self {
        let entry = Entry {
            key: client.address(),
            value: &token,
        };
        let store = Store::of_user().filter(|store| match store.save(entry) {
            Ok(()) => true,
            Err(error) => {
                print_note(&format!("other commands need --token-file: {error:#}"));
                false
            }
        });
        Self {
            store,
            address: client.address().to_owned(),
            token,
        }
    }
}

impl Drop for SignedIn {
    fn drop(&mut self) {
        if let Some(store) = &self.store {
            // A token that remains is useless: its server has ended.
            let _ = store.remove(&self.address, Some(&self.token));
        }
    }
}

/// Folder of the demo's files.
enum DataFolder {
    Temporary(tempfile::TempDir),
    Kept(PathBuf),
}

impl DataFolder {
    fn new(kept: Option<PathBuf>) -> anyhow::Result<Self> {
        let Some(path) = kept else {
            let folder = tempfile::Builder::new().prefix("tread-demo-").tempdir();
            return Ok(Self::Temporary(
                folder.context("cannot make a temporary folder")?,
            ));
        };
        std::fs::create_dir_all(&path)
            .with_context(|| format!("cannot make the folder {}", path.display()))?;
        Ok(Self::Kept(path))
    }

    fn path(&self) -> &Path {
        match self {
            Self::Temporary(folder) => folder.path(),
            Self::Kept(path) => path,
        }
    }
}

/// Scenario, robots and client of a demo.
#[derive(Clone, Copy)]
struct Demo<'demo> {
    scenario: &'demo Scenario,
    robots: &'demo [ScenarioRobot],
    client: &'demo Client,
}

impl Demo<'_> {
    /// Starts the agents and sends the missions, as soon as the server is ready.
    async fn begin(
        &self,
        processes: &mut Processes,
        folder: &Path,
        scenario_file: Option<&Path>,
    ) -> anyhow::Result<(Vec<Terrain>, Vec<MissionId>)> {
        self.wait_for_server(processes).await?;
        let terrains = self.draw_terrains().await?;
        for robot in self.robots {
            processes.start_agent(folder, &self.scenario.site, robot, scenario_file)?;
        }
        self.wait_for_robots(processes).await?;
        Ok((terrains, self.send_missions().await?))
    }

    async fn wait_for_server(&self, processes: &mut Processes) -> anyhow::Result<()> {
        let deadline = Instant::now() + START_WAIT_MAX;
        while !self.client.is_ready().await {
            processes.all_alive()?;
            ensure!(
                Instant::now() < deadline,
                "the server is not ready after {START_WAIT_MAX:?}"
            );
            tokio::time::sleep(POLL_INTERVAL).await;
        }
        Ok(())
    }

    async fn draw_terrains(&self) -> anyhow::Result<Vec<Terrain>> {
        for terrain in &self.scenario.terrains {
            let request = CreateTerrain {
                id: terrain.id.clone(),
                name: terrain.name.clone(),
                class: terrain.class,
                polygon: terrain.outline().map_err(anyhow::Error::msg)?,
                layer: terrain.layer,
            };
            match self
                .client
                .create_terrain(&self.scenario.site, &request)
                .await
            {
                // A folder of an earlier demo has them already.
                Err(ClientError::Refused { problem })
                    if problem.kind == ProblemType::AlreadyExists => {}
                other => _ = other?,
            }
        }
        Ok(self.client.terrains(&self.scenario.site).await?)
    }

    async fn present_robots(&self) -> Result<Vec<Robot>, ClientError> {
        self.client.robots(&self.scenario.site, false).await
    }

    async fn wait_for_robots(&self, processes: &mut Processes) -> anyhow::Result<()> {
        let deadline = Instant::now() + START_WAIT_MAX;
        let mut outage = Outage::default();
        loop {
            let present = outage.bridge(self.present_robots().await, print_note)?;
            let present = present.unwrap_or_default();
            let is_online = |robot: &&ScenarioRobot| {
                present.iter().any(|seen| {
                    seen.id == robot.id && seen.link == LinkState::Online && seen.live.is_some()
                })
            };
            let Some(missing) = self.robots.iter().find(|robot| !is_online(robot)) else {
                return Ok(());
            };
            processes.all_alive()?;
            if Instant::now() >= deadline {
                bail!(
                    "robot `{}` is not online after {START_WAIT_MAX:?}",
                    missing.id
                );
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    }

    async fn send_missions(&self) -> anyhow::Result<Vec<MissionId>> {
        let mut missions = Vec::new();
        for mission in &self.scenario.missions {
            if self.robots.iter().any(|robot| robot.id == mission.robot) {
                let request = CreateMission {
                    site: self.scenario.site.clone(),
                    robot: mission.robot.clone(),
                    trajectory: mission.trajectory.clone(),
                    latest_start: None,
                    priority: 0,
                    start_policy: StartPolicy::default(),
                    link_policy: LinkPolicy::default(),
                    lost_after_s: None,
                };
                missions.push(self.client.create_mission(&request).await?.id);
            }
        }
        Ok(missions)
    }
}

/// Results of a demo.
struct Ended {
    report: Report,
    /// It was asked to end before the demo was done.
    is_cut_short: bool,
}

/// Polls the fleet until the demo is done.
struct Watch<'demo> {
    demo: Demo<'demo>,
    shapes: Vec<TerrainShape>,
    missions: Vec<MissionId>,
    begin: Instant,
    exit_after: Option<Duration>,
    progress: Progress,
    seen: Vec<Mission>,
    driven: BTreeMap<TerrainId, Duration>,
}

impl<'demo> Watch<'demo> {
    fn new(
        demo: &Demo<'demo>,
        terrains: &[Terrain],
        missions: Vec<MissionId>,
        arguments: &DemoArguments,
    ) -> Self {
        let shape = |terrain: &Terrain| TerrainShape {
            terrain: TerrainRef {
                id: terrain.id.clone(),
                revision: terrain.revision,
            },
            polygon: terrain.polygon.clone(),
            layer: terrain.layer,
        };
        Self {
            demo: *demo,
            shapes: terrains.iter().map(shape).collect(),
            missions,
            begin: Instant::now(),
            exit_after: arguments.exit_after,
            progress: Progress::new(demo.robots, !arguments.json),
            seen: Vec::new(),
            driven: BTreeMap::new(),
        }
    }

    /// Shows the fleet until the demo is done or a signal asks it to end, and returns its results.
    async fn watch_until_end(
        mut self,
        processes: &mut Processes,
        signals: &mut ShutdownSignals,
    ) -> anyhow::Result<Ended> {
        let is_cut_short = tokio::select! {
            done = self.until_done(processes) => {
                done?;
                false
            }
            () = signals.next() => true,
        };
        self.progress.finish();
        // The last look may be of before, or none.
        self.poll().await?;
        let report = self.report().await?;
        Ok(Ended {
            report,
            is_cut_short,
        })
    }

    /// Returns when all missions have ended and all measurements are uploaded, or when the time is
    /// over. Without a time limit it shows the fleet until it is cancelled.
    ///
    /// # Errors
    /// A process has ended, or the server does not answer any more.
    async fn until_done(&mut self, processes: &mut Processes) -> anyhow::Result<()> {
        let mut ticks = tokio::time::interval(POLL_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut uploads_until: Option<Instant> = None;
        let mut outage = Outage::default();
        loop {
            ticks.tick().await;
            processes.all_alive()?;
            let polled = self.poll().await;
            let robots = outage.bridge(polled, |note| self.progress.notify(note))?;
            let Some(exit_after) = self.exit_after else {
                continue;
            };
            if self.begin.elapsed() >= exit_after {
                break;
            }
            let Some(robots) = robots else {
                continue;
            };
            if self.seen.iter().all(|mission| mission.state.is_terminal()) {
                let until = *uploads_until.get_or_insert(Instant::now() + UPLOAD_WAIT_MAX);
                let uploaded = |robot: &Robot| {
                    robot
                        .live
                        .as_ref()
                        .is_some_and(|live| live.outbox.pending == 0)
                };
                if robots.iter().all(uploaded) || Instant::now() >= until {
                    break;
                }
            }
        }
        Ok(())
    }

    async fn poll(&mut self) -> Result<Vec<Robot>, ClientError> {
        let robots = self.demo.present_robots().await?;
        let site = &self.demo.scenario.site;
        let page = self
            .demo
            .client
            .missions(site, None, None, MISSIONS_MAX)
            .await?;
        let is_ours = |mission: &Mission| self.missions.contains(&mission.id);
        self.seen = page.items.into_iter().filter(is_ours).collect();
        for live in robots.iter().filter_map(|robot| robot.live.as_ref()) {
            let place = live.pose.filter(|_| live.mission.is_some());
            let under = place.and_then(|pose| terrain_at(&self.shapes, pose.value.position()));
            if let Some(shape) = under {
                *self.driven.entry(shape.terrain.id.clone()).or_default() += POLL_INTERVAL;
            }
        }
        self.progress.show(&robots, &self.seen);
        Ok(robots)
    }

    async fn report(&self) -> anyhow::Result<Report> {
        let site = &self.demo.scenario.site;
        let measured = self
            .demo
            .client
            .terrain_friction(site, None, Reading::default())
            .await?;
        Ok(Report::new(
            self.demo.scenario,
            &self.seen,
            &self.driven,
            &measured,
            self.begin.elapsed(),
        ))
    }
}
