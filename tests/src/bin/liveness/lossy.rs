//! Cuts that lose packets: TCP sends them again, ever more rarely, which a cut that only holds
//! bytes back does not show.
//!
//! The program runs itself in a network namespace of its own, where a filter drops what arrives
//! from or at the router's port. Nothing outside is touched, and all goes with the namespace. That
//! needs root, `unshare`, `ip` and `nft`.

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use tokio::time::Instant;
use tread_api::ids::RobotId;
use tread_api::robot::LinkState;
use tread_tests::fleet::Fleet;
use tread_tests::random::Random;
use tread_tests::report::Check;

use super::{HEALING_MAX_S, SILENCE_MAX_S, settle, shown_since, worst_and_median};

/// How long cuts last, about, seconds.
const CUTS_S: [f64; 3] = [1.0, 4.0, 10.0];
/// How much longer or shorter they are, as a share: what is sent again keeps its own times.
const SPREAD: f64 = 0.25;
/// Said aloud where nothing was measured.
pub(crate) const NOT_MEASURED: &str = "NOT MEASURED: cuts that lose packets need root and nft";

/// What was seen of cuts of one length, seconds.
#[derive(Debug, Serialize, Deserialize)]
#[expect(clippy::struct_field_names, reason = "the unit stands last")]
pub(crate) struct Times {
    cut_s: f64,
    gone_s: Vec<f64>,
    back_s: Vec<f64>,
}

impl Times {
    pub(crate) fn checks(self) -> Vec<Check> {
        let cut_s = self.cut_s;
        let back = format!("healing to online, {cut_s} s of lost packets");
        let mut checks = worst_and_median(&back, HEALING_MAX_S, self.back_s).to_vec();
        // After the shortest cut the robot may be heard again before it is shown offline.
        if !self.gone_s.is_empty() {
            let gone = format!("lost packets to offline, cut of {cut_s} s");
            checks.extend(worst_and_median(&gone, SILENCE_MAX_S, self.gone_s));
        }
        checks
    }
}

fn works(program: &str, arguments: &[&str]) -> bool {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null());
    let status = command.stdout(Stdio::null()).stderr(Stdio::null()).status();
    status.is_ok_and(|status| status.success())
}

/// Measures in a namespace of its own; `None` where that cannot be.
pub(crate) async fn measure(trials: u32, seed: u64) -> anyhow::Result<Option<Vec<Times>>> {
    // Asked within a namespace: root in a container may have no right to it.
    let can = works("unshare", &["--net", "ip", "link", "set", "lo", "up"])
        && works("unshare", &["--net", "nft", "list", "ruleset"]);
    if !can {
        return Ok(None);
    }
    let mut inside = Command::new("unshare");
    inside.arg("--net").arg(std::env::current_exe()?);
    inside.args(["--lossy-here", "--trials", &trials.to_string()]);
    inside.args(["--seed", &seed.to_string()]);
    inside.stdin(Stdio::null()).stderr(Stdio::inherit());
    let said = tokio::task::spawn_blocking(move || inside.output()).await??;
    anyhow::ensure!(said.status.success(), "the cuts ended with {}", said.status);
    let times = serde_json::from_slice(&said.stdout).context("what the cuts took")?;
    Ok(Some(times))
}

/// Measures in this process's own network, of which only the loopback is used.
pub(crate) async fn measure_here(
    node: &Path,
    trials: u32,
    seed: u64,
) -> anyhow::Result<Vec<Times>> {
    anyhow::ensure!(
        works("ip", &["link", "set", "lo", "up"]),
        "no loopback can be set up"
    );
    let mut fleet = Fleet::start_with(node).await;
    let robot: RobotId = "rover-1".parse()?;
    fleet.start_agent(&robot, 0.0).await;
    let endpoint = fleet.zenoh_endpoint();
    let port = endpoint
        .rsplit_once(':')
        .context("an endpoint has a port")?;
    let filter = Filter::set_up(port.1)?;
    let mut random = Random::new(seed);
    let mut all = Vec::new();
    for cut_s in CUTS_S {
        let (mut gone_s, mut back_s) = (Vec::new(), Vec::new());
        for _ in 0..trials {
            settle(&mut random).await;
            let length = cut_s * random.between(1.0 - SPREAD..1.0 + SPREAD);
            let cut_at = Instant::now();
            filter.cut()?;
            let until = cut_at + Duration::from_secs_f64(length);
            if cut_s * (1.0 - SPREAD) > SILENCE_MAX_S {
                gone_s.push(shown_since(&fleet, &robot, LinkState::Offline, cut_at).await?);
            }
            tokio::time::sleep_until(until).await;
            let healed_at = Instant::now();
            filter.heal()?;
            back_s.push(shown_since(&fleet, &robot, LinkState::Online, healed_at).await?);
        }
        all.push(Times {
            cut_s,
            gone_s,
            back_s,
        });
    }
    Ok(all)
}

/// The filter of this namespace.
struct Filter {
    port: String,
}

impl Filter {
    fn set_up(port: &str) -> anyhow::Result<Self> {
        // Where packets arrive: a sender whose packet is dropped at its own end is notified.
        nft("table inet cut {\nchain arriving {\ntype filter hook input priority 0;\n}\n}")?;
        Ok(Self {
            port: port.to_owned(),
        })
    }

    fn cut(&self) -> anyhow::Result<()> {
        let rule = |end: &str| format!("add rule inet cut arriving tcp {end} {} drop", self.port);
        nft(&[rule("dport"), rule("sport")].join("\n"))
    }

    #[expect(clippy::unused_self, reason = "only what was set up can be healed")]
    fn heal(&self) -> anyhow::Result<()> {
        nft("flush chain inet cut arriving")
    }
}

fn nft(script: &str) -> anyhow::Result<()> {
    let mut command = Command::new("nft");
    let mut nft = command.args(["-f", "-"]).stdin(Stdio::piped()).spawn()?;
    let mut input = nft.stdin.take().context("nft reads")?;
    input.write_all(script.as_bytes())?;
    drop(input);
    let status = nft.wait()?;
    anyhow::ensure!(status.success(), "nft refuses `{script}`");
    Ok(())
}
