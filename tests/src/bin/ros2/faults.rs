//! A base that is dead, late, lying or restarting, in the middle of a mission.

use std::time::Duration;

use serde_json::json;
use tokio::time::Instant;
use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::robot::Robot;
use tread_tests::fleet::Fleet;
use tread_tests::wait::SHORT;

use crate::judgement::Judgement;
use crate::observer::Observer;
use crate::python_robot::PythonRobot;
use tread_tests::report::Check;

/// Longest from the last good word of the base to a zero command.
const ZERO_MAX_MS: f64 = 150.0;
/// The same for a base whose words are good but not true.
const ZERO_OF_A_LIE_MAX_MS: f64 = 900.0;
/// The same for a base that obeys somebody else too, every other moment.
const ZERO_OF_TWO_MASTERS_MAX_MS: f64 = 4_000.0;
/// How long a fault lasts.
const LASTS: Duration = Duration::from_millis(1_500);
/// Longest until the robot moves again.
const AGAIN_MAX: Duration = Duration::from_secs(10);
/// The same on a slow machine.
const AGAIN_AT_ALL_MAX: Duration = Duration::from_mins(1);
/// Time between two looks.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// How long it must have moved before the next fault.
const MOVES_FOR: Duration = Duration::from_secs(2);

/// A fault, what the agent must say of it, and how soon the robot must be commanded to rest.
struct Fault {
    name: &'static str,
    value: &'static str,
    /// Parts of alerts' texts, of which one must be said.
    said: &'static [&'static str],
    /// How soon rest must be commanded.
    zero_max_ms: f64,
    lasts: Duration,
}

const fn fault(name: &'static str, value: &'static str, said: &'static [&'static str]) -> Fault {
    Fault {
        name,
        value,
        said,
        zero_max_ms: ZERO_MAX_MS,
        lasts: LASTS,
    }
}

const FAULTS: [Fault; 12] = [
    fault("silent", "on", &["has not been heard"]),
    fault("late", "0.3", &["came late"]),
    fault("stamp", "3600", &["time stamp leapt"]),
    fault("nan", "on", &["impossible values"]),
    fault("hash", "on", &["another definition"]),
    fault("bare", "on", &["without attachment"]),
    fault("short", "on", &["not what their type says"]),
    fault("restart", "1.0", &["has not been heard"]),
    Fault {
        zero_max_ms: ZERO_OF_A_LIE_MAX_MS,
        // The drive compares wheels with their command, the monitor with all else: whichever is first
        // halts the robot, and then there is nothing left for the other to see.
        ..fault(
            "stuck",
            "on",
            &["do not follow their command", "wheel speeds"],
        )
    },
    // Started again under its identifier, after a pause that a supervisor makes.
    fault("again", "1.0", &["started again"]),
    // Somebody who halts the base every other quarter of a second, past every topic.
    Fault {
        zero_max_ms: ZERO_OF_TWO_MASTERS_MAX_MS,
        lasts: Duration::from_secs(5),
        ..fault("hijack", "on", &["as if another node commands"])
    },
    // What another node writes is heard, before it shows in the wheels.
    Fault {
        zero_max_ms: ZERO_OF_A_LIE_MAX_MS,
        ..fault(
            "rival",
            "0.4",
            &["another node writes on the command topic"],
        )
    },
];

/// What a robot's faults are tried with.
struct Trial<'a> {
    fleet: &'a Fleet,
    robot: &'a RobotId,
    observer: &'a Observer,
    judgement: Judgement,
}

/// Breaks the base in every way and mends it again.
pub(crate) async fn measure(
    fleet: &Fleet,
    robot: &RobotId,
    base: &mut PythonRobot,
    observer: &Observer,
    judgement: Judgement,
) -> anyhow::Result<Vec<Check>> {
    let circle = json!({"circle": {
        "center": {"x_m": 0.0, "y_m": 1.5}, "radius_m": 1.5, "speed_m_s": 0.5, "turns": 40.0
    }});
    let mission = fleet.rest.send(robot, circle).await;
    let active = [MissionState::Active];
    fleet.rest.mission_reaches(mission, &active, SHORT).await;
    let trial = Trial {
        fleet,
        robot,
        observer,
        judgement,
    };
    let mut checks = Vec::new();
    for fault in &FAULTS {
        if !trial.moves_for(MOVES_FOR).await {
            checks.push(Check::so(
                format!("{}: the robot moves before it", fault.name),
                false,
            ));
            break;
        }
        checks.extend(trial.of(fault, base).await?);
    }
    let goes_on = trial.moves_for(Duration::ZERO).await;
    let detail = fleet.rest.mission(mission).await;
    let is_active = detail.mission.state == MissionState::Active;
    if !is_active {
        eprintln!("{:#?}", detail.events);
    }
    checks.push(Check::so(
        "faults: the same mission is driven on at the end",
        goes_on && is_active,
    ));
    Ok(checks)
}

impl Trial<'_> {
    async fn of(&self, fault: &Fault, base: &mut PythonRobot) -> anyhow::Result<Vec<Check>> {
        let name = fault.name;
        self.observer.clear_commands();
        let switched_at = Instant::now();
        base.switch(name, fault.value)?;
        // The base is mended in time however long an answer takes: without a position a mission fails.
        let (mut is_said, tried) = tokio::join!(
            self.is_said_by(switched_at + fault.lasts.mul_f64(0.9), fault.said),
            async {
                tokio::time::sleep_until(switched_at + fault.lasts).await;
                let checks = self.of_rest(fault, switched_at);
                if !starts_again(name) {
                    base.switch(name, "off")?;
                }
                anyhow::Ok(checks)
            }
        );
        let mut checks = tried?;
        if self.judgement == Judgement::Behaviour && !is_said {
            // A robot says how it is twice a second, and what it dropped for a while afterwards.
            is_said = self.is_said_by(Instant::now() + SHORT, fault.said).await;
        }
        if !is_said && let Some(seen) = self.fleet.rest.robot(self.robot).await {
            let fault = seen.live.and_then(|live| live.fault);
            eprintln!("{name}: it says {fault:?} and {:?}", seen.alerts);
        }
        let moves_again = self.moves_for(Duration::ZERO).await;
        checks.push(Check::so(format!("{name}: it says so"), is_said));
        checks.push(Check::so(
            format!("{name}: the robot moves again"),
            moves_again,
        ));
        Ok(checks)
    }

    /// Whether and how soon the robot was commanded to rest.
    fn of_rest(&self, fault: &Fault, switched_at: Instant) -> Vec<Check> {
        let name = fault.name;
        let most_ms = fault.zero_max_ms;
        // The last good word: the last of all, if the base fell silent, or the one before the fault.
        let last_word = self.observer.sensor_at().unwrap_or(switched_at);
        let fell_silent = name == "silent" || starts_again(name);
        let is_of_pause = last_word.duration_since(switched_at) < Duration::from_millis(100);
        let since = if fell_silent && is_of_pause {
            last_word
        } else {
            switched_at
        };
        let ms = |span: Duration| 1.0e3 * span.as_secs_f64();
        let zero = self.observer.zero_after(since);
        let zero_ms = zero.map_or(f64::INFINITY, |(first, _)| ms(first));
        let last_ms = zero.and_then(|(_, last)| last).map_or(0.0, ms);
        let first = format!("{name}: first zero command, ms");
        let last = format!("{name}: last command that was none, ms");
        let mut checks = vec![self.judgement.at_most(Check::of(first, zero_ms), most_ms)];
        // A base that obeys now and then is tried again and again, and what a rival writes is no rest.
        let is_shared = name == "hijack" || name == "rival";
        if !is_shared {
            checks.push(self.judgement.at_most(Check::of(last, last_ms), most_ms));
        }
        // A base that starts again may be heard again by now.
        if !starts_again(name) && !is_shared {
            let is_at_rest = zero.is_some() && !self.observer.is_moving();
            checks.push(Check::so(
                format!("{name}: it is commanded to rest"),
                is_at_rest,
            ));
        }
        checks
    }

    /// Whether the robot says this of itself before that time.
    async fn is_said_by(&self, until: Instant, said: &[&str]) -> bool {
        loop {
            let seen = self.fleet.rest.robot(self.robot).await;
            if seen.is_some_and(|seen| said.iter().any(|words| says(&seen, words))) {
                return true;
            }
            if Instant::now() >= until {
                return false;
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    }

    /// Waits until the robot has been commanded to move for so long without a pause.
    async fn moves_for(&self, span: Duration) -> bool {
        let bound = self.judgement.patience(AGAIN_MAX, AGAIN_AT_ALL_MAX) + span;
        let until = Instant::now() + bound;
        let mut since = None;
        while Instant::now() < until {
            if self.observer.is_moving() {
                let since: Instant = *since.get_or_insert_with(Instant::now);
                if since.elapsed() >= span {
                    return true;
                }
            } else {
                since = None;
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        }
        false
    }
}

/// Whether it is a base that starts again, and ends by itself.
fn starts_again(name: &str) -> bool {
    name == "restart" || name == "again"
}

/// Whether the robot says this of itself.
fn says(seen: &Robot, words: &str) -> bool {
    let fault = seen.live.as_ref().and_then(|live| live.fault.as_ref());
    fault.is_some_and(|fault| fault.contains(words))
        || seen.alerts.iter().any(|alert| alert.text.contains(words))
}
