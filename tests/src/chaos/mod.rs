//! One run of a fleet in which things fail at random, and what must hold afterwards.

mod judge;
mod plan;

use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;
use reqwest::Method;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::time::{Instant, timeout};
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::{MissionDetail, MissionState};

use crate::fleet::Fleet;
use crate::light_robot::now;
use crate::random::Random;
use crate::relay::Relay;
use plan::{Action, PlannedMission, RunPlan};

/// Longest time for every mission to end once nothing is broken any more.
const END_WAIT_MAX: Duration = Duration::from_secs(90);
/// Longest wait for the answer to a request.
const ANSWER_MAX: Duration = Duration::from_secs(15);
/// Longest time for a server to decide on a resumption: the servers of a pair exchange places.
const RESUMED_WITHIN: Duration = Duration::from_secs(30);
/// Time between two looks.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Tries to send a mission to a server that is away.
const SEND_TRIES_MAX: u32 = 200;

/// Something that must not have happened.
#[derive(Debug, Clone, Serialize)]
pub struct Violation {
    /// What kind, for counting.
    pub kind: &'static str,
    /// What exactly.
    pub text: String,
}

/// What came of a run.
#[derive(Debug, Default, Serialize)]
pub struct RunReport {
    /// Its seed.
    pub seed: u64,
    /// How the missions ended, by the server.
    pub ends: Vec<String>,
    /// How often the server was killed.
    pub server_kills: u64,
    /// How often the agent was killed.
    pub agent_kills: u64,
    /// How often the network was cut.
    pub cuts: u64,
    /// How often the network between server and database was cut.
    pub database_cuts: u64,
    /// Requests to change a mission that were answered.
    pub requests: u64,
    /// What must not have happened.
    pub violations: Vec<Violation>,
    /// What was done, when something was violated.
    pub actions: Vec<String>,
    /// The last lines that server and agent logged, when something was violated.
    pub logs: Vec<String>,
}

/// A mission of a run and what was asked of it.
#[derive(Debug)]
struct Followed {
    asked: PlannedMission,
    id: MissionId,
    is_cancel_asked: bool,
}

/// Runs one seed against the executable that is a server or an agent.
///
/// # Panics
/// If the fleet does not start at all.
pub async fn run(node: &Path, seed: u64) -> RunReport {
    let robot = robot();
    let mut fleet = Fleet::start_with(node).await;
    let database = fleet.put_database_behind_relay().await;
    let robots = fleet.start_agent_behind_relay(&robot, 0.0).await;
    run_on(fleet, Some(Relays { database, robots }), seed).await
}

/// The same with two servers on one PostgreSQL database, of which one is killed, frozen or cut off.
///
/// # Panics
/// If the fleet does not start at all.
pub async fn run_pair(node: &Path, seed: u64) -> RunReport {
    let mut fleet = Fleet::start_pair_with(node)
        .await
        .unwrap_or_else(|error| panic!("{error:#}"));
    fleet.start_agent(&robot(), 0.0).await;
    run_on(fleet, None, seed).await
}

fn robot() -> RobotId {
    "rover-1".parse().expect("it is an identifier")
}

async fn run_on(mut fleet: Fleet, relays: Option<Relays>, seed: u64) -> RunReport {
    let robot = robot();
    let has_database_network = relays
        .as_ref()
        .is_none_or(|relays| relays.database.is_some());
    let plan = RunPlan::new(seed, robot.as_str(), (now(), has_database_network));
    let mut report = RunReport {
        seed,
        ..RunReport::default()
    };
    let mut followed = Vec::new();
    for asked in &plan.missions {
        followed.push(Followed {
            id: send(&mut fleet, &asked.body).await,
            asked: asked.clone(),
            is_cancel_asked: false,
        });
    }
    let mut random = Random::new(seed ^ 0x5eed);
    let began = Instant::now();
    for &(at, action) in &plan.actions {
        tokio::time::sleep_until(began + at).await;
        report.actions.push(format!("{at:?} {action:?}"));
        let mut stage = Stage {
            fleet: &mut fleet,
            relays: relays.as_ref(),
            robot: &robot,
            report: &mut report,
            random: &mut random,
        };
        stage.act(action, &mut followed).await;
    }
    repair(&mut fleet, relays.as_ref());
    let details = ended(&mut fleet, &followed).await;
    await_quiet(&mut fleet, &robot).await;
    // What the robot reported late is in it now.
    let details = details_now(&mut fleet, &followed).await.unwrap_or(details);
    report.ends = details.iter().map(judge::end_of).collect();
    let memory = robots_memory(&mut fleet, &robot).await;
    judge::judge(&followed, &details, memory.as_ref(), &mut report);
    judge::judge_disks(&fleet, &robot, &mut report).await;
    if report.violations.is_empty() {
        report.actions.clear();
    } else {
        report.logs = fleet.servers_log_tail();
        report.logs.extend(fleet.log_tail(robot.as_str()));
    }
    report
}

/// The network of a single server.
struct Relays {
    /// Between the server and a PostgreSQL database.
    database: Option<Relay>,
    /// Between the robot and the server.
    robots: Relay,
}

/// Lets everything go on and reach everything.
fn repair(fleet: &mut Fleet, relays: Option<&Relays>) {
    fleet.resume_servers();
    fleet.database_networks().for_each(Relay::heal);
    fleet.robot_networks().for_each(Relay::heal);
    if let Some(relays) = relays {
        relays.robots.heal();
        relays.database.iter().for_each(Relay::heal);
    }
}

/// Sends a mission until the server has taken it.
async fn send(fleet: &mut Fleet, body: &Value) -> MissionId {
    for _ in 0..SEND_TRIES_MAX {
        fleet.tend_pair().await;
        let answer = fleet.rest.call(Method::POST, "/v1/missions", Some(body));
        if let Some((status, answer)) = answer.await
            && status.is_success()
        {
            return serde_json::from_value(answer["id"].clone()).expect("a mission has an id");
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
    panic!("the server takes no missions");
}

struct Stage<'run> {
    fleet: &'run mut Fleet,
    /// `None` with a pair of servers.
    relays: Option<&'run Relays>,
    robot: &'run RobotId,
    report: &'run mut RunReport,
    random: &'run mut Random,
}

impl Stage<'_> {
    async fn act(&mut self, action: Action, followed: &mut [Followed]) {
        if matches!(
            action,
            Action::KillServer | Action::CutDatabase | Action::ResetDatabase
        ) {
            // The one that works by now.
            self.fleet.tend_pair().await;
        }
        match action {
            Action::KillServer => {
                self.report.server_kills += 1;
                self.fail_server();
            }
            Action::StartServer if self.relays.is_none() => self.fleet.resume_servers(),
            Action::StartServer => {
                // A server that does not reach its database at its start ends, and its service manager
                // starts it until it does.
                self.database_network(Relay::heal);
                self.fleet.start_server().await;
            }
            Action::KillAgent => {
                self.report.agent_kills += 1;
                self.fleet.kill_agent(self.robot);
            }
            Action::StartAgent => match self.relays {
                Some(Relays { robots, .. }) => {
                    self.fleet.spawn_agent_behind(self.robot, 0.0, robots);
                }
                None => self.fleet.spawn_agent(self.robot, 0.0),
            },
            Action::Cut => {
                self.report.cuts += 1;
                self.robots_network(Relay::cut);
            }
            Action::Heal => self.robots_network(Relay::heal),
            Action::Reset => self.robots_network(Relay::reset),
            Action::CutDatabase => {
                self.report.database_cuts += 1;
                self.database_network(Relay::cut);
            }
            // Another server may work by now.
            Action::HealDatabase if self.relays.is_none() => {
                self.fleet.database_networks().for_each(Relay::heal);
            }
            Action::HealDatabase => self.database_network(Relay::heal),
            Action::ResetDatabase => self.database_network(Relay::reset),
            Action::Cancel(index) => {
                // Even an answer that was lost may have been taken.
                followed[index].is_cancel_asked = true;
                self.request(followed[index].id, "cancel", &Value::Null)
                    .await;
            }
            Action::Pause(index) => {
                self.request(followed[index].id, "pause", &Value::Null)
                    .await;
            }
            Action::Resume(index) => {
                // A paused mission ends only if it is resumed, and there may be no server just now.
                let deadline = Instant::now() + RESUMED_WITHIN;
                while self
                    .request(followed[index].id, "resume", &Value::Null)
                    .await
                    == Outcome::Unavailable
                    && Instant::now() < deadline
                {
                    tokio::time::sleep(POLL_INTERVAL).await;
                }
            }
            Action::Replace(index) => {
                let body = json!({"trajectory": plan::path(self.random)});
                self.request(followed[index].id, "replace", &body).await;
            }
        }
    }

    /// Kills the server; one of a pair may also be frozen or cut off.
    fn fail_server(&mut self) {
        if self.relays.is_some() || self.random.chance(0.4) {
            self.fleet.kill_server();
        } else if self.random.chance(0.5) {
            self.fleet.signal_server(Signal::SIGSTOP);
        } else {
            self.fleet.cut_server_off();
        }
    }

    fn database_network(&self, act: impl Fn(&Relay)) {
        match self.relays {
            Some(relays) => relays.database.iter().for_each(act),
            None => self.fleet.database_network().into_iter().for_each(act),
        }
    }

    fn robots_network(&self, act: impl Fn(&Relay)) {
        match self.relays {
            Some(relays) => act(&relays.robots),
            None => self.fleet.robot_networks().for_each(act),
        }
    }

    async fn request(&mut self, mission: MissionId, verb: &str, body: &Value) -> Outcome {
        let path = format!("/v1/missions/{mission}/{verb}");
        self.fleet.tend_pair().await;
        let asked = self.fleet.rest.call(Method::POST, &path, Some(body));
        // A server that is frozen says nothing.
        let Ok(Some((status, answer))) = timeout(ANSWER_MAX, asked).await else {
            return Outcome::Unavailable;
        };
        self.report.requests += 1;
        let has_network = self.relays.is_none_or(|relays| relays.database.is_some());
        let is_away = has_network && status == reqwest::StatusCode::SERVICE_UNAVAILABLE;
        let is_fair = status.is_success() || status == reqwest::StatusCode::CONFLICT || is_away;
        if !is_fair {
            self.report.violations.push(Violation {
                kind: "policy",
                text: format!("{verb} was answered {status}: {answer}"),
            });
        }
        if is_away {
            Outcome::Unavailable
        } else {
            Outcome::Decided
        }
    }
}

/// Outcome of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Outcome {
    /// A server decided on it.
    Decided,
    /// No server answered, or none that reaches its database.
    Unavailable,
}

/// The missions once all have ended, or as they stand when time is up.
async fn ended(fleet: &mut Fleet, followed: &[Followed]) -> Vec<MissionDetail> {
    let deadline = Instant::now() + END_WAIT_MAX;
    loop {
        fleet.tend_pair().await;
        let details = details(fleet, followed).await;
        let is_late = Instant::now() > deadline;
        match details {
            Some(details) => {
                let mut states = details.iter().map(|detail| detail.mission.state);
                if is_late || states.all(MissionState::is_terminal) {
                    return details;
                }
            }
            // The servers of a pair exchange places.
            None if fleet.is_pair() && !is_late => {}
            None => panic!(
                "no mission from the server, which has ended: {}: {:#?}",
                fleet.has_server_ended(),
                fleet.servers_log_tail()
            ),
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}

/// The missions as the server has them; `None` if it does not answer.
async fn details(fleet: &Fleet, followed: &[Followed]) -> Option<Vec<MissionDetail>> {
    let mut details: Vec<MissionDetail> = Vec::new();
    for mission in followed {
        let path = format!("/v1/missions/{}", mission.id);
        let answer = fleet.rest.call(Method::GET, &path, None).await;
        let (status, body) = answer.filter(|(status, _)| status.is_success())?;
        let detail = serde_json::from_value(body);
        details.push(detail.unwrap_or_else(|error| panic!("{status}: {error}")));
    }
    Some(details)
}

/// Waits until the robot has uploaded everything and drives no mission, or until that takes too long.
async fn await_quiet(fleet: &mut Fleet, robot: &RobotId) {
    let deadline = Instant::now() + END_WAIT_MAX;
    loop {
        fleet.tend_pair().await;
        let live = fleet.rest.robot(robot).await.and_then(|robot| robot.live);
        let is_quiet = live.is_some_and(|live| {
            live.state_age_ms < 1_000 && live.outbox.pending == 0 && live.mission.is_none()
        });
        if is_quiet || Instant::now() > deadline {
            return;
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}

/// What the robot itself remembers.
async fn robots_memory(
    fleet: &mut Fleet,
    robot: &RobotId,
) -> Option<tread_agent::missions::MissionSlot> {
    // An agent that is asked to stop has written everything.
    _ = fleet.stop_agent(robot).await;
    let memory = tread_agent::missions::memory::Memory::new(&fleet.robot_folder(robot));
    memory.load().ok()
}

/// The missions as the server has them at last; `None` if none answers in time.
async fn details_now(fleet: &mut Fleet, followed: &[Followed]) -> Option<Vec<MissionDetail>> {
    let deadline = Instant::now() + END_WAIT_MAX;
    loop {
        fleet.tend_pair().await;
        let found = details(fleet, followed).await;
        if found.is_some() || Instant::now() > deadline {
            return found;
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}
