//! Somebody else on the robot's bus, who looks at the clock.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, anyhow};
use tokio::time::Instant;
use tread_ros2::cdr::decode;
use tread_ros2::messages::Twist;
use tread_tests::fleet::Fleet;
use zenoh::Wait as _;

use tread_tests::report::Check;

/// How long everything on the fleet's router is listened to.
const LISTEN_FOR: Duration = Duration::from_secs(2);
/// How often the graph is looked at before it must show everything.
const GRAPH_LOOKS_MAX: u32 = 10;
/// How long each look takes.
const GRAPH_WAIT: Duration = Duration::from_secs(1);
/// A command below this is rest, metres or radians per second.
const REST: f64 = 1.0e-9;
/// A command that comes later is not the answer to a sensor's message.
const ANSWER_MAX: Duration = Duration::from_secs(1);

/// Topic, type and the begin of the type's hash of all that the agent publishes to the robot, as tokens
/// have them.
const PUBLISHED: [&str; 4] = [
    "/%rover%tread%plan/nav_msgs::msg::dds_::Path_/RIHS01_1957a5bb",
    "/%rover%tread%driven/nav_msgs::msg::dds_::Path_/RIHS01_1957a5bb",
    "/%rover%tread%theta/std_msgs::msg::dds_::Float64MultiArray_/RIHS01_1025ddc6",
    "/%diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/RIHS01_5a8a36ef",
];

/// What was seen on the bus.
#[derive(Debug, Default)]
struct Seen {
    sensor_at: Option<Instant>,
    /// Whether the newest sensor's message has been answered.
    is_answered: bool,
    delays_ms: Vec<f64>,
    /// When each command came, and whether it was rest.
    commands: Vec<(Instant, bool)>,
}

/// An observer of one robot's bus.
#[derive(Debug)]
pub(crate) struct Observer {
    session: zenoh::Session,
    seen: Arc<Mutex<Seen>>,
}

fn client(endpoint: &str) -> anyhow::Result<zenoh::Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ] {
        let inserted = config.insert_json5(key, &value);
        inserted.map_err(|cause| anyhow!("{key}: {cause}"))?;
    }
    let opened = zenoh::open(config).wait();
    opened.map_err(|cause| anyhow!("no session at {endpoint}: {cause}"))
}

fn lock(seen: &Mutex<Seen>) -> std::sync::MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Observer {
    /// Listens to joints and commands of any robot on the bus.
    pub(crate) fn start(endpoint: &str) -> anyhow::Result<Self> {
        let session = client(endpoint)?;
        let seen = Arc::new(Mutex::new(Seen::default()));
        let sensors = Arc::clone(&seen);
        let listened = session
            .declare_subscriber("*/**/joint_states/*/*")
            .callback(move |_| {
                let mut seen = lock(&sensors);
                (seen.sensor_at, seen.is_answered) = (Some(Instant::now()), false);
            })
            .background()
            .wait();
        listened.map_err(|cause| anyhow!("joints: {cause}"))?;
        let commands = Arc::clone(&seen);
        let listened = session
            .declare_subscriber("*/**/cmd_vel/*/*")
            .callback(move |sample| {
                let now = Instant::now();
                let bytes = sample.payload().to_bytes();
                let Ok(twist) = decode::<Twist>(&bytes) else {
                    return;
                };
                let mut seen = lock(&commands);
                if let Some(sensor_at) = seen.sensor_at.filter(|_| !seen.is_answered) {
                    let delay = now.duration_since(sensor_at);
                    if delay < ANSWER_MAX {
                        seen.delays_ms.push(1.0e3 * delay.as_secs_f64());
                    }
                    seen.is_answered = true;
                }
                let is_rest = twist.linear.x.abs() < REST && twist.angular.z.abs() < REST;
                seen.commands.push((now, is_rest));
            })
            .background()
            .wait();
        listened.map_err(|cause| anyhow!("commands: {cause}"))?;
        Ok(Self { session, seen })
    }

    /// Delays from a sensor's message to the command after it, milliseconds; begins afresh.
    pub(crate) fn take_delays_ms(&self) -> Vec<f64> {
        std::mem::take(&mut lock(&self.seen).delays_ms)
    }

    /// When the last sensor's message came.
    pub(crate) fn sensor_at(&self) -> Option<Instant> {
        lock(&self.seen).sensor_at
    }

    /// Forgets the commands so far.
    pub(crate) fn clear_commands(&self) {
        lock(&self.seen).commands.clear();
    }

    /// From `since` to the first command that was rest, and to the last that was not.
    pub(crate) fn zero_after(&self, since: Instant) -> Option<(Duration, Option<Duration>)> {
        let seen = lock(&self.seen);
        let after = || seen.commands.iter().filter(|(at, _)| *at >= since);
        let first = after().find(|(_, is_rest)| *is_rest)?.0;
        let last = after().rev().find(|(_, is_rest)| !is_rest);
        let last = last.map(|(at, _)| at.duration_since(since));
        Some((first.duration_since(since), last))
    }

    /// Whether the newest command moves the robot.
    pub(crate) fn is_moving(&self) -> bool {
        let seen = lock(&self.seen);
        seen.commands.last().is_some_and(|(_, is_rest)| !is_rest)
    }

    /// What the ROS graph shows of the agent; asked again where not all of it is there yet.
    pub(crate) async fn graph(&self, domain: u32) -> anyhow::Result<Vec<Check>> {
        let mut shown = Vec::new();
        for _ in 0..GRAPH_LOOKS_MAX {
            let tokens = self.tokens(domain)?;
            tokio::time::sleep(GRAPH_WAIT).await;
            shown = shown_by(&lock_all(&tokens));
            if shown.iter().all(|check| check.holds) {
                break;
            }
        }
        Ok(shown)
    }

    /// Asks for all tokens of the graph, which come by and by.
    fn tokens(&self, domain: u32) -> anyhow::Result<Arc<Mutex<Vec<String>>>> {
        let found = Arc::new(Mutex::new(Vec::new()));
        let tokens = Arc::clone(&found);
        // With a callback: the default handler would block above 256 tokens.
        let asked = self
            .session
            .liveliness()
            .get(format!("@ros2_lv/{domain}/**"))
            .callback(move |reply| {
                if let Ok(sample) = reply.result() {
                    lock_all(&tokens).push(sample.key_expr().to_string());
                }
            })
            .wait();
        asked.map_err(|cause| anyhow!("the graph: {cause}"))?;
        Ok(found)
    }
}

fn lock_all(keys: &Mutex<Vec<String>>) -> std::sync::MutexGuard<'_, Vec<String>> {
    keys.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What these tokens of a graph show of the agent.
fn shown_by(tokens: &[String]) -> Vec<Check> {
    let of_agent = |kind: &str| {
        let is_one = |token: &&String| token.contains(kind) && token.contains("/tread_agent");
        tokens.iter().filter(is_one).count()
    };
    let counted = |name: &str, kind: &str, count: usize| {
        Check::so(format!("graph: {name}"), of_agent(kind) == count)
    };
    vec![
        counted("the agent's node", "/NN/", 1),
        counted("what it publishes", "/MP/", 1 + PUBLISHED.len()),
        counted("what it listens to", "/MS/", 5),
        Check::so(
            "graph: plan, driven path, friction and diagnostics by topic and type",
            PUBLISHED.iter().all(|topic| of_agent(topic) == 1),
        ),
        Check::so(
            "graph: the robot's own node",
            tokens.iter().any(|token| token.ends_with("/base")),
        ),
    ]
}

/// Whether nothing of ROS is heard on the fleet's router.
pub(crate) async fn stays_on_the_robot(fleet: &Fleet) -> anyhow::Result<Check> {
    let address: SocketAddr = fleet.zenoh_address();
    let endpoint = format!("tcp/{address}");
    let session = tokio::task::spawn_blocking(move || client(&endpoint)).await??;
    let keys = Arc::new(Mutex::new(Vec::new()));
    let heard = Arc::clone(&keys);
    let listened = session
        .declare_subscriber("**")
        .callback(move |sample| {
            lock_all(&heard).push(sample.key_expr().to_string());
        })
        .background()
        .wait();
    listened.map_err(|cause| anyhow!("the fleet's router: {cause}"))?;
    tokio::time::sleep(LISTEN_FOR).await;
    let keys = lock_all(&keys);
    let first = keys
        .first()
        .context("nothing at all was heard of the fleet")?;
    let is_of_fleet = keys.iter().all(|key| key.starts_with("tread/"));
    Ok(Check::so(
        format!(
            "bus: all {} keys on the fleet's router are like {first}",
            keys.len()
        ),
        is_of_fleet,
    ))
}
