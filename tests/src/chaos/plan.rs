//! What one run asks for and breaks, and when: all from its seed.

use std::time::Duration;

use serde_json::{Value, json};

use crate::random::Random;

/// Missions of one run.
const MISSIONS: usize = 3;
/// Time in which things are broken.
const BREAKING: Duration = Duration::from_secs(9);
/// Longest that the server, the agent or the network stays away.
const AWAY_MAX_S: f64 = 4.0;
/// Silence after which a mission may tell its robot to stop, seconds.
pub(super) const SILENCE_S: f64 = 1.5;
/// Absence after which a mission may count its robot as lost, seconds.
pub(super) const LOST_AFTER_S: f64 = 2.0;

/// A mission of a run.
#[derive(Debug, Clone)]
pub(super) struct PlannedMission {
    /// The body of its request.
    pub(super) body: Value,
    /// Whether its robot stops when the server is silent.
    pub(super) is_server_silent_too_long: bool,
    /// Whether it bears a short absence of its robot only.
    pub(super) is_soon_lost: bool,
    /// Whether it may start for a short time only.
    pub(super) expires: bool,
}

/// Something that happens during a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Action {
    KillServer,
    StartServer,
    KillAgent,
    StartAgent,
    /// Nothing passes any more, and nobody is notified.
    Cut,
    Heal,
    /// Every connection is reset, and new ones do not pass while it is cut.
    Reset,
    /// The same between the server and its database.
    CutDatabase,
    HealDatabase,
    ResetDatabase,
    Cancel(usize),
    Pause(usize),
    Resume(usize),
    Replace(usize),
}

/// A whole run.
#[derive(Debug, Clone)]
pub(super) struct RunPlan {
    pub(super) missions: Vec<PlannedMission>,
    /// By their times from the first request.
    pub(super) actions: Vec<(Duration, Action)>,
}

/// A short path from about where the robot is, to either side.
pub(super) fn path(random: &mut Random) -> Value {
    let x_m = random.between(0.0..1.0);
    let bend_m = random.between(-0.5..0.5);
    let length_m = random.between(1.5..3.0);
    json!({"waypoints": {"speed_m_s": 0.8, "points": [
        {"x_m": x_m, "y_m": 0.0},
        {"x_m": x_m + 0.5 * length_m, "y_m": 0.2 * bend_m},
        {"x_m": x_m + length_m, "y_m": bend_m},
    ]}})
}

fn asked(random: &mut Random, robot: &str, now: jiff::Timestamp) -> PlannedMission {
    let mut body = json!({
        "site": crate::fleet::SITE, "robot": robot, "trajectory": path(random),
    });
    let is_server_silent_too_long = random.chance(0.25);
    let is_soon_lost = !is_server_silent_too_long && random.chance(0.25);
    let expires = random.chance(0.2);
    if is_server_silent_too_long {
        body["link_policy"] = json!({"stop_after": {"silence_s": SILENCE_S}});
    }
    if is_soon_lost {
        body["lost_after_s"] = json!(LOST_AFTER_S);
    }
    if expires {
        let latest = now + Duration::from_secs_f64(random.between(2.5..12.0));
        body["latest_start"] = json!(latest);
    }
    PlannedMission {
        body,
        is_server_silent_too_long,
        is_soon_lost,
        expires,
    }
}

impl RunPlan {
    /// The run of a seed; `now` is what latest starts are counted from. The network to the database fails
    /// too if it has one.
    pub(super) fn new(
        seed: u64,
        robot: &str,
        (now, has_database_network): (jiff::Timestamp, bool),
    ) -> Self {
        let mut random = Random::new(seed);
        let missions = (0..MISSIONS)
            .map(|_| asked(&mut random, robot, now))
            .collect();
        let mut actions = Vec::new();
        let mut away = |random: &mut Random, share: f64, begin: Action, end: Action| {
            if random.chance(share) {
                let from_s = random.between(0.0..BREAKING.as_secs_f64());
                let for_s = random.between(0.05..AWAY_MAX_S);
                let at = Duration::from_secs_f64;
                actions.push((at(from_s), begin));
                actions.push((at(from_s + for_s), end));
                return Some((from_s, for_s));
            }
            None
        };
        away(&mut random, 0.6, Action::KillServer, Action::StartServer);
        away(&mut random, 0.6, Action::KillAgent, Action::StartAgent);
        let cut = away(&mut random, 0.7, Action::Cut, Action::Heal);
        if let Some((from_s, for_s)) = cut.filter(|_| random.chance(0.5)) {
            let at_s = from_s + for_s * random.share();
            actions.push((Duration::from_secs_f64(at_s), Action::Reset));
        }
        for mission in 0..MISSIONS {
            let at = Duration::from_secs_f64(random.between(0.0..BREAKING.as_secs_f64()));
            if random.chance(0.25) {
                actions.push((at, Action::Cancel(mission)));
            }
            if random.chance(0.25) {
                actions.push((at, Action::Pause(mission)));
            }
            if random.chance(0.2) {
                actions.push((at, Action::Replace(mission)));
            }
            // Whatever was paused is to end.
            actions.push((BREAKING + Duration::from_secs(5), Action::Resume(mission)));
        }
        if has_database_network {
            // Nothing else differs from the run of this seed on a file.
            let mut random = Random::new(!seed);
            let (from_s, for_s) = (
                random.between(0.0..BREAKING.as_secs_f64()),
                random.between(0.05..AWAY_MAX_S),
            );
            let at = Duration::from_secs_f64;
            actions.push((at(from_s), Action::CutDatabase));
            actions.push((at(from_s + for_s), Action::HealDatabase));
            if random.chance(0.5) {
                actions.push((at(from_s + for_s * random.share()), Action::ResetDatabase));
            }
        }
        actions.sort_by_key(|(at, _)| *at);
        Self { missions, actions }
    }
}
