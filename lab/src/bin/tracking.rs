//! `tracking`: every law behind the shipped localisation, on both worlds' robots.
//!
//! `cargo run --release -p tread-lab --bin tracking -- [--seeds N] [--seed N] [--tune LAWS]
//! [--json | --markdown]`
//!
//! A line is a world, a course, a ground and a quality of positions; all laws drive it with the same
//! seeds. Printed are root mean squares of the true distance from the course, over seeds, and that
//! of the localisation's own error, below which no law comes for long.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

use std::process::ExitCode;

use clap::Parser;
use serde::Serialize;
use tread_control::geometry::{Point, Pose};
use tread_control::plan::Plan;
use tread_control::tracking::TrackerConfig;
use tread_control::trajectory::{CircleSpec, Direction, Trajectory, Waypoint, WaypointsSpec};
use tread_lab::bench::{CLOSED_PATH_M, KanayamaGains, Law, PursuitConfig, Track};
use tread_lab::parallel::in_parallel;
use tread_lab::report::{Check, checks_json};
use tread_lab::rough::spec::MAKES;
use tread_lab::rough::tracking::{Errors, Poses, ThetaSource, Trial, World, run};

/// Stiffnesses K of the grounds.
const GROUNDS: [f64; 3] = [0.7, 3.0, 12.0];
/// Maximum ratio of our error to the best peer's on a line, and of ours with its own θ to ours
/// without.
const LINE_GOAL: f64 = 1.02;
/// Maximum mean of our error over the mean of the best peer's, both above the localisation's own
/// error.
const MEAN_GOAL: f64 = 0.9;
/// Speed of the courses, metres per second.
const SPEED_M_S: f64 = 0.6;
/// Gains of the Kanayama tracker with integral action that `--tune` found, on other seeds.
const KANAYAMA: KanayamaGains = KanayamaGains {
    track: Track::Effective,
    along_1_s: 1.1,
    cross_1_m2: 22.4,
    heading_1_m: 8.4,
    integral_1_m2_s: 15.4,
};
/// Error that a lost robot counts with, metres.
const LOST_M: f64 = 1.0;
/// Step of the search for a peer's gains, as a factor.
const TUNE_STEP: f64 = 1.4;

#[derive(Debug, Parser)]
#[command(name = "tracking")]
struct Arguments {
    /// Drives of each line and law
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    seeds: u64,
    /// First seed
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Search for the gains of these laws on these lines first, instead of the ones found before
    #[arg(long, value_enum, value_delimiter = ',')]
    tune: Vec<Tuned>,
    /// Print one JSON object instead of a table
    #[arg(long, conflicts_with = "markdown")]
    json: bool,
    /// Print the table of the report
    #[arg(long)]
    markdown: bool,
}

/// Law whose gains are searched for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Tuned {
    /// Kanayama's tracker with integral action
    Kanayama,
    /// Regulated pure pursuit
    Pursuit,
    /// Our law
    Ours,
}

/// A line: what is driven where.
#[derive(Debug, Clone, Copy)]
struct Place<'a> {
    world: World,
    poses: Poses,
    course: (&'static str, &'a Plan),
    stiffness: f64,
}

#[derive(Debug, Clone, Copy, Serialize)]
struct Figures {
    /// Millimetres; none of a law that lost the robot.
    rms_mm: Option<f64>,
    localisation_mm: Option<f64>,
}

impl Figures {
    fn text(&self) -> String {
        let text = |value: Option<f64>| {
            value.map_or_else(|| "lost".to_owned(), |value| format!("{value:.2}"))
        };
        format!("{} ({})", text(self.rms_mm), text(self.localisation_mm))
    }
}

#[derive(Debug, Serialize)]
struct Line {
    world: &'static str,
    poses: &'static str,
    course: &'static str,
    stiffness: f64,
    laws: Vec<(&'static str, Figures)>,
    /// Ours over the best peer; ours with its own θ over ours without.
    over_peer: f64,
    over_unknown: f64,
    /// Ours and the best peer's, less the localisation's own error.
    above_localisation_mm: [f64; 2],
}

/// Courses of 3 m radius, a lemniscate of 8 m by 4 m, and a closed path of twelve points.
fn plans() -> anyhow::Result<Vec<(&'static str, Plan)>> {
    const EIGHT_POINTS: u32 = 24;
    let circle = Trajectory::Circle(CircleSpec {
        center: Point { x_m: 0.0, y_m: 3.0 },
        radius_m: 3.0,
        speed_m_s: SPEED_M_S,
        direction: Direction::CounterClockwise,
        turns: 1.5,
    });
    let path = |points: Vec<(f64, f64)>| {
        let points = points.into_iter();
        Trajectory::Waypoints(WaypointsSpec {
            points: points
                .map(|(x_m, y_m)| Waypoint::from(Point { x_m, y_m }))
                .collect(),
            speed_m_s: SPEED_M_S,
        })
    };
    let eight = (0..=EIGHT_POINTS).map(|index| {
        let angle = std::f64::consts::TAU * f64::from(index) / f64::from(EIGHT_POINTS);
        (4.0 * angle.sin(), 2.0 * (2.0 * angle).sin())
    });
    let closed = CLOSED_PATH_M
        .iter()
        .copied()
        .cycle()
        .take(CLOSED_PATH_M.len() + 1);
    let model = MAKES[0].model()?;
    let plan = |trajectory: &Trajectory, heading_rad: f64| -> anyhow::Result<Plan> {
        let start = Pose {
            heading_rad,
            ..Pose::default()
        };
        Ok(Plan::new(trajectory, start, &model)?)
    };
    Ok(vec![
        ("circle", plan(&circle, 0.0)?),
        ("figure-8", plan(&path(eight.collect()), 0.785)?),
        ("waypoints", plan(&path(closed.collect()), -0.1)?),
    ])
}

/// Root mean squares over seeds.
fn drive(
    place: &Place<'_>,
    arguments: &Arguments,
    law: Law,
    config: TrackerConfig,
    knowing: ThetaSource,
) -> anyhow::Result<Errors> {
    let mut sum = Errors {
        rms_m: 0.0,
        most_m: 0.0,
        localisation_rms_m: 0.0,
    };
    for seed in arguments.seed..arguments.seed + arguments.seeds {
        let which = usize::try_from(seed).unwrap_or(0) % MAKES.len();
        let found = run(&Trial {
            world: place.world,
            poses: place.poses,
            make: MAKES[which],
            stiffness: place.stiffness,
            plan: place.course.1,
            seed,
            law,
            config,
            knowing,
        })?;
        sum.rms_m += found.rms_m.powi(2);
        sum.most_m = sum.most_m.max(found.most_m);
        sum.localisation_rms_m += found.localisation_rms_m.powi(2);
    }
    #[expect(clippy::cast_precision_loss, reason = "far below 2^53")]
    let count = arguments.seeds as f64;
    Ok(Errors {
        rms_m: (sum.rms_m / count).sqrt(),
        localisation_rms_m: (sum.localisation_rms_m / count).sqrt(),
        ..sum
    })
}

/// A law's gains as numbers to search over.
trait Gains: Copy + std::fmt::Debug + Sync {
    const GAINS: usize;
    fn scaled(self, gain: usize, by: f64) -> Self;
    fn law(self) -> (Law, TrackerConfig);
}

impl Gains for KanayamaGains {
    const GAINS: usize = 4;
    fn scaled(mut self, gain: usize, by: f64) -> Self {
        match gain {
            0 => self.cross_1_m2 *= by,
            1 => self.heading_1_m *= by,
            2 => self.integral_1_m2_s *= by,
            _ => self.along_1_s *= by,
        }
        self
    }
    fn law(self) -> (Law, TrackerConfig) {
        (Law::Kanayama(self), TrackerConfig::default())
    }
}

impl Gains for PursuitConfig {
    const GAINS: usize = 4;
    fn scaled(mut self, gain: usize, by: f64) -> Self {
        match gain {
            0 => self.lookahead_time_s *= by,
            1 => self.lookahead_min_m *= by,
            2 => self.lookahead_max_m *= by,
            _ => self.scaling_radius_m *= by,
        }
        self.lookahead_max_m = self.lookahead_max_m.max(self.lookahead_min_m);
        self
    }
    fn law(self) -> (Law, TrackerConfig) {
        (Law::Pursuit(self), TrackerConfig::default())
    }
}

/// Ours, to be tuned like them.
impl Gains for TrackerConfig {
    const GAINS: usize = 11;
    fn scaled(mut self, gain: usize, by: f64) -> Self {
        match gain {
            0 => self.quiet.cross_1_m2 *= by,
            1 => self.quiet.heading_1_m *= by,
            2 => self.quiet.integral_1_m3 *= by,
            3 => self.quiet.yaw_rate *= by,
            4 => self.noisy.cross_1_m2 *= by,
            5 => self.noisy.heading_1_m *= by,
            6 => self.noisy.integral_1_m3 *= by,
            7 => self.noisy.yaw_rate *= by,
            8 => self.position_middle_m *= by,
            9 => self.adaptation_gain *= by,
            _ => self.beyond_gain *= by,
        }
        self
    }
    fn law(self) -> (Law, TrackerConfig) {
        (Law::Shipped(None), self)
    }
}

/// Mean of the logarithm of the error over all lines.
fn mean_log_error<P: Gains>(
    places: &[Place<'_>],
    arguments: &Arguments,
    peer: P,
) -> anyhow::Result<f64> {
    let (law, config) = peer.law();
    let errors = in_parallel(places, |place| {
        drive(place, arguments, law, config, ThetaSource::Nothing)
    });
    let errors = errors
        .into_iter()
        .collect::<anyhow::Result<Vec<Errors>>>()?;
    #[expect(clippy::cast_precision_loss, reason = "a few lines")]
    let count = errors.len() as f64;
    Ok(errors
        .iter()
        .map(|found| found.rms_m.min(LOST_M).ln())
        .sum::<f64>()
        / count)
}

/// Steps one gain at a time until none of them helps: the optimum is inside what was tried.
fn tuned<P: Gains>(places: &[Place<'_>], arguments: &Arguments, from: P) -> anyhow::Result<P> {
    let mut best = from;
    let mut least = mean_log_error(places, arguments, best)?;
    loop {
        let mut is_better = false;
        for gain in 0..P::GAINS {
            for by in [TUNE_STEP, TUNE_STEP.recip()] {
                loop {
                    let next = best.scaled(gain, by);
                    let found = mean_log_error(places, arguments, next).unwrap_or(f64::INFINITY);
                    if found >= least - 1.0e-3 {
                        break;
                    }
                    (best, least, is_better) = (next, found, true);
                    eprintln!("{:.3} mm: {best:?}", 1.0e3 * least.exp());
                }
            }
        }
        if !is_better {
            return Ok(best);
        }
    }
}

fn millimetres(value_m: f64) -> Option<f64> {
    value_m.is_finite().then_some(1.0e3 * value_m)
}

fn line(
    place: &Place<'_>,
    laws: &[(&'static str, (Law, TrackerConfig), ThetaSource)],
    arguments: &Arguments,
) -> anyhow::Result<Line> {
    let mut found = Vec::new();
    for &(name, law, knowing) in laws {
        found.push((name, drive(place, arguments, law.0, law.1, knowing)?));
    }
    let [peers @ .., ours, own] = found.as_slice() else {
        anyhow::bail!("ours is not among the laws");
    };
    let peer = peers
        .iter()
        .map(|(_, errors)| errors)
        .min_by(|one, other| one.rms_m.total_cmp(&other.rms_m))
        .ok_or_else(|| anyhow::anyhow!("there is no peer"))?;
    let above = |errors: &Errors| 1.0e3 * (errors.rms_m - errors.localisation_rms_m).max(0.0);
    Ok(Line {
        world: place.world.text(),
        poses: place.poses.text(),
        course: place.course.0,
        stiffness: place.stiffness,
        over_peer: ours.1.rms_m / peer.rms_m,
        over_unknown: own.1.rms_m / ours.1.rms_m,
        above_localisation_mm: [above(&ours.1), above(peer)],
        laws: found
            .iter()
            .map(|(name, errors)| {
                let figures = Figures {
                    rms_mm: millimetres(errors.rms_m),
                    localisation_mm: millimetres(errors.localisation_rms_m),
                };
                (*name, figures)
            })
            .collect(),
    })
}

fn print(lines: &[Line]) {
    for (index, line) in lines.iter().enumerate() {
        if index == 0 {
            print!("{:<6} {:<13} {:<10} {:>5}", "world", "poses", "course", "K");
            for (name, _) in &line.laws {
                print!(" {name:>18}");
            }
            println!(" {:>8} {:>8}", "/ peer", "/ no θ");
        }
        print!(
            "{:<6} {:<13} {:<10} {:>5}",
            line.world, line.poses, line.course, line.stiffness
        );
        for (_, figures) in &line.laws {
            print!(" {:>18}", figures.text());
        }
        println!(" {:>8.3} {:>8.3}", line.over_peer, line.over_unknown);
    }
}

/// Prints the table of the report: a law's error, and the localisation's in brackets.
fn print_markdown(lines: &[Line]) {
    for (index, line) in lines.iter().enumerate() {
        if index == 0 {
            let names: Vec<_> = line.laws.iter().map(|(name, _)| *name).collect();
            println!(
                "| world | positions | course | K | {} | / peer | / no θ |",
                names.join(" | ")
            );
            println!("|{}", "---|".repeat(names.len() + 6));
        }
        let figures: Vec<_> = line
            .laws
            .iter()
            .map(|(_, figures)| figures.text())
            .collect();
        println!(
            "| {} | {} | {} | {} | {} | {:.2} | {:.2} |",
            line.world,
            line.poses,
            line.course,
            line.stiffness,
            figures.join(" | "),
            line.over_peer,
            line.over_unknown
        );
    }
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let plans = plans()?;
    let mut places = Vec::new();
    for world in [World::Own, World::Rough] {
        for poses in [Poses::Fine, Poses::Coarse] {
            for (name, plan) in &plans {
                for stiffness in GROUNDS {
                    places.push(Place {
                        world,
                        poses,
                        course: (name, plan),
                        stiffness,
                    });
                }
            }
        }
    }
    let (mut kanayama, mut pursuit) = (KANAYAMA, PursuitConfig::default());
    let mut ours = TrackerConfig::default();
    for law in &arguments.tune {
        match law {
            Tuned::Kanayama => kanayama = tuned(&places, &arguments, kanayama)?,
            Tuned::Pursuit => pursuit = tuned(&places, &arguments, pursuit)?,
            Tuned::Ours => ours = tuned(&places, &arguments, ours)?,
        }
    }
    let laws = [
        ("Kanayama, integral", kanayama.law(), ThetaSource::Nothing),
        ("pure pursuit", pursuit.law(), ThetaSource::Nothing),
        ("ours", ours.law(), ThetaSource::Nothing),
        ("ours, own θ", ours.law(), ThetaSource::Own),
    ];
    let lines = in_parallel(&places, |place| line(place, &laws, &arguments));
    let lines = lines.into_iter().collect::<anyhow::Result<Vec<Line>>>()?;
    let mut checks = Vec::new();
    for line in &lines {
        let name = format!(
            "{}, {}, {}, K {}",
            line.world, line.poses, line.course, line.stiffness
        );
        for (what, value) in [
            ("ours over the best peer", line.over_peer),
            ("with its own θ over without", line.over_unknown),
        ] {
            checks.push(Check::of(format!("{name}: {what}"), value).at_most(LINE_GOAL));
        }
    }
    let sum = |which: usize| -> f64 {
        lines
            .iter()
            .map(|line| line.above_localisation_mm[which])
            .sum()
    };
    let mean = sum(0) / sum(1);
    checks.push(
        Check::of(
            "ours over the best peer, both means over the lines above the localisation's own error",
            mean,
        )
        .at_most(MEAN_GOAL),
    );
    let failed = checks.iter().filter(|check| !check.holds).count();
    if arguments.json {
        println!(
            "{}",
            serde_json::json!({ "lines": lines, "checks": checks_json(&checks) })
        );
    } else {
        if arguments.markdown {
            print_markdown(&lines);
            println!();
        } else {
            print(&lines);
        }
        println!(
            "above the localisation's own error, ours is {mean:.3} of the best peer in the mean"
        );
        println!("{failed} of {} checks fail", checks.len());
    }
    Ok(if failed == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
