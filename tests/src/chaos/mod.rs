//! One run of a fleet in which things fail at random, and what must hold afterwards.

mod judge;
mod plan;

use std::path::Path;
use std::time::Duration;

use reqwest::Method;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::time::Instant;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::MissionDetail;

use crate::fleet::Fleet;
use crate::light_robot::now;
use crate::random::Random;
use crate::relay::Relay;
use plan::{Action, Asked, RunPlan};

/// Longest time for every mission to end once nothing is broken any more.
const END_WAIT_MAX: Duration = Duration::from_secs(90);
/// Time between two looks.
const LOOK_EVERY: Duration = Duration::from_millis(100);
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
    asked: Asked,
    id: MissionId,
    is_cancel_asked: bool,
}

/// Runs one seed against the executable that is a server or an agent.
///
/// # Panics
/// If the fleet does not start at all.
pub async fn run(node: &Path, seed: u64) -> RunReport {
    let robot: RobotId = "rover-1".parse().expect("it is an identifier");
    let mut fleet = Fleet::start_with(node).await;
    let database_relay = fleet.put_database_behind_relay().await;
    let relay = fleet.start_agent_behind_relay(&robot, 0.0).await;
    let plan = RunPlan::new(seed, robot.as_str(), (now(), database_relay.is_some()));
    let mut report = RunReport {
        seed,
        ..RunReport::default()
    };
    let mut followed = Vec::new();
    for asked in &plan.missions {
        followed.push(Followed {
            id: send(&fleet, &asked.body).await,
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
            relay: &relay,
            database_relay: database_relay.as_ref(),
            robot: &robot,
            report: &mut report,
            random: &mut random,
        };
        stage.act(action, &mut followed).await;
    }
    relay.heal();
    if let Some(relay) = &database_relay {
        relay.heal();
    }
    let details = ended(&fleet, &followed).await;
    report.ends = details.iter().map(judge::end_of).collect();
    let memory = robots_memory(&mut fleet, &robot, &details).await;
    judge::judge(&followed, &details, memory.as_ref(), &mut report);
    judge::judge_disks(&fleet, &robot, &mut report).await;
    if report.violations.is_empty() {
        report.actions.clear();
    } else {
        report.logs = ["server", robot.as_str()]
            .iter()
            .flat_map(|name| fleet.log_tail(name))
            .collect();
    }
    report
}

/// Sends a mission until the server has taken it.
async fn send(fleet: &Fleet, body: &Value) -> MissionId {
    for _ in 0..SEND_TRIES_MAX {
        let answer = fleet.rest.call(Method::POST, "/v1/missions", Some(body));
        if let Some((status, answer)) = answer.await
            && status.is_success()
        {
            return serde_json::from_value(answer["id"].clone()).expect("a mission has an id");
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
    panic!("the server takes no missions");
}

struct Stage<'run> {
    fleet: &'run mut Fleet,
    relay: &'run Relay,
    database_relay: Option<&'run Relay>,
    robot: &'run RobotId,
    report: &'run mut RunReport,
    random: &'run mut Random,
}

impl Stage<'_> {
    async fn act(&mut self, action: Action, followed: &mut [Followed]) {
        match action {
            Action::KillServer => {
                self.report.server_kills += 1;
                self.fleet.kill_server();
            }
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
            Action::StartAgent => self.fleet.spawn_agent_behind(self.robot, 0.0, self.relay),
            Action::Cut => {
                self.report.cuts += 1;
                self.relay.cut();
            }
            Action::Heal => self.relay.heal(),
            Action::Reset => self.relay.reset(),
            Action::CutDatabase => {
                self.report.database_cuts += 1;
                self.database_network(Relay::cut);
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
                self.request(followed[index].id, "resume", &Value::Null)
                    .await;
            }
            Action::Replace(index) => {
                let body = json!({"trajectory": plan::path(self.random)});
                self.request(followed[index].id, "replace", &body).await;
            }
        }
    }

    fn database_network(&self, act: impl FnOnce(&Relay)) {
        if let Some(relay) = self.database_relay {
            act(relay);
        }
    }

    async fn request(&mut self, mission: MissionId, verb: &str, body: &Value) {
        let path = format!("/v1/missions/{mission}/{verb}");
        let answer = self.fleet.rest.call(Method::POST, &path, Some(body)).await;
        let Some((status, answer)) = answer else {
            return;
        };
        self.report.requests += 1;
        let is_away =
            self.database_relay.is_some() && status == reqwest::StatusCode::SERVICE_UNAVAILABLE;
        let is_fair = status.is_success() || status == reqwest::StatusCode::CONFLICT || is_away;
        if !is_fair {
            self.report.violations.push(Violation {
                kind: "policy",
                text: format!("{verb} was answered {status}: {answer}"),
            });
        }
    }
}

/// The missions once all have ended, or as they stand when time is up.
async fn ended(fleet: &Fleet, followed: &[Followed]) -> Vec<MissionDetail> {
    let deadline = Instant::now() + END_WAIT_MAX;
    loop {
        let mut details: Vec<MissionDetail> = Vec::new();
        for mission in followed {
            let path = format!("/v1/missions/{}", mission.id);
            let answer = fleet.rest.call(Method::GET, &path, None).await;
            let Some((status, body)) = answer.filter(|(status, _)| status.is_success()) else {
                panic!(
                    "no mission from the server, which has ended: {}: {:#?}",
                    fleet.has_server_ended(),
                    fleet.log_tail("server")
                );
            };
            let detail = serde_json::from_value(body);
            details.push(detail.unwrap_or_else(|error| panic!("{status}: {error}")));
        }
        let all_ended = details
            .iter()
            .all(|detail| detail.mission.state.is_terminal());
        if all_ended || Instant::now() > deadline {
            return details;
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// What the robot itself remembers, once it has uploaded everything.
async fn robots_memory(
    fleet: &mut Fleet,
    robot: &RobotId,
    details: &[MissionDetail],
) -> Option<tread_agent::missions::MissionSlot> {
    let deadline = Instant::now() + END_WAIT_MAX;
    loop {
        let live = fleet.rest.robot(robot).await.and_then(|robot| robot.live);
        let is_quiet = live.is_some_and(|live| {
            live.heard_age_ms < 1_000 && live.outbox.pending == 0 && live.mission.is_none()
        });
        if is_quiet || Instant::now() > deadline {
            break;
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
    // An agent that is asked to stop has written everything.
    _ = fleet.stop_agent(robot).await;
    let memory = tread_agent::missions::memory::Memory::new(&fleet.robot_folder(robot));
    let slot = memory.load().ok()?;
    // What the server remembers of the ends may still have been on its way.
    for detail in details {
        _ = fleet.rest.mission(detail.mission.id).await;
    }
    Some(slot)
}
