//! Tracking: every law on every course, ground, lag and noise, and the figures that must hold.

mod courses;
mod figures;
pub(crate) mod held_out;
mod simulate;

use std::fmt::Write as _;

use serde_json::{Value, json};
use tread_lab::bench::{Course, KanayamaGains, Law, PursuitConfig, Track};
use tread_lab::parallel::in_parallel;

use tread_control::robot::RobotModel;
use tread_control::tracking::TrackerConfig;

use crate::report::{Options, Section};
use simulate::{Case, Terrain, ThetaSource, simulate};

/// Stiffnesses K of the table.
const STIFFNESSES: [f64; 5] = [0.5, 1.0, 2.0, 5.0, 20.0];
/// Heading gains among which the tuned peer takes the best for each line.
const PEER_HEADING_GAINS: [f64; 3] = [4.0, 6.0, 8.0];

/// The columns of the table.
const LAWS: [&str; 7] = [
    "Kanayama, raw track",
    "Kanayama",
    "tuned with integral",
    "pure pursuit",
    "yi2007",
    "ours, θ unknown",
    "ours, own θ",
];
/// Column of the peer, with which goals compare.
const PEER: usize = 2;
/// Column of ours without θ.
const UNKNOWN: usize = 5;
/// Column of ours with its own θ.
const OWN: usize = 6;

/// One line of the table.
struct Line {
    course: &'static str,
    terrain: Terrain,
    lag_s: f64,
    noisy: bool,
    /// RMS cross-track error of each law over the second half of the run, metres.
    rms_m: [f64; LAWS.len()],
    most_m: [f64; LAWS.len()],
}

/// Runs the part `tracking` and returns its tables and checks.
pub(crate) fn run(options: &Options) -> Section {
    let courses = courses::all();
    let mut wanted = Vec::new();
    for (name, course) in &courses {
        let uniform = STIFFNESSES.into_iter().map(Terrain::Uniform);
        for terrain in uniform.chain([Terrain::Switching([5.0, 0.7])]) {
            for noisy in [false, true] {
                for lag_s in [0.0, 0.05, 0.1] {
                    wanted.push((*name, course, terrain, lag_s, noisy));
                }
            }
        }
    }
    let seeds = u64::from((options.runs / 100).clamp(1, 20));
    let lines = in_parallel(&wanted, |&(name, course, terrain, lag_s, noisy)| {
        let case = Case {
            model: RobotModel::yi2007(),
            course,
            terrain,
            lag_s,
            noisy,
            seed: 0,
            tracker: TrackerConfig::default(),
        };
        line(name, &case, if noisy { seeds } else { 1 })
    });
    let found = figures::find(&courses, &lines);
    Section {
        text: table(&lines, seeds) + &found.text,
        figures: json!({
            "seeds_per_noisy_line": seeds,
            "table": lines.iter().map(Line::figures).collect::<Vec<Value>>(),
            "others": found.figures,
        }),
        checks: found.checks,
    }
}

/// Returns the peer with this heading gain.
fn tuned(heading_1_m: f64) -> Law {
    Law::Kanayama(KanayamaGains {
        heading_1_m,
        ..KanayamaGains::tuned()
    })
}

/// Returns the root mean square over `seeds` seeds, from the case's own on, and the maximum of the
/// cross-track error of one law, metres.
fn score(case: &Case, seeds: u64, law: Law, knowing: ThetaSource) -> (f64, f64) {
    let (mut sum, mut most_m) = (0.0, 0.0_f64);
    for seed in case.seed..case.seed + seeds {
        let trace = simulate(
            &Case {
                seed,
                ..case.clone()
            },
            law,
            knowing,
        );
        sum += trace.second_half_rms_m().powi(2);
        most_m = most_m.max(trace.second_half_most_m());
    }
    #[expect(clippy::cast_precision_loss, reason = "a few seeds")]
    let count = seeds as f64;
    ((sum / count).sqrt(), most_m)
}

/// Returns the scores of the peer with the best of its heading gains for this line.
fn peer(case: &Case, seeds: u64) -> (f64, f64) {
    PEER_HEADING_GAINS
        .map(|gain| score(case, seeds, tuned(gain), ThetaSource::Nothing))
        .into_iter()
        .fold((f64::INFINITY, f64::INFINITY), |best, found| {
            if found.0 < best.0 { found } else { best }
        })
}

fn line(course: &'static str, case: &Case, seeds: u64) -> Line {
    let raw = KanayamaGains {
        track: Track::Raw,
        ..KanayamaGains::usual()
    };
    let others = |law, knowing| score(case, seeds, law, knowing);
    let found = [
        others(Law::Kanayama(raw), ThetaSource::Nothing),
        others(Law::Kanayama(KanayamaGains::usual()), ThetaSource::Nothing),
        peer(case, seeds),
        others(Law::Pursuit(PursuitConfig::default()), ThetaSource::Nothing),
        others(Law::Yi2007, ThetaSource::Nothing),
        others(Law::Shipped(None), ThetaSource::Nothing),
        others(Law::Shipped(None), ThetaSource::Own),
    ];
    Line {
        course,
        terrain: case.terrain,
        lag_s: case.lag_s,
        noisy: case.noisy,
        rms_m: found.map(|(rms_m, _)| rms_m),
        most_m: found.map(|(_, most_m)| most_m),
    }
}

impl Line {
    fn ground(&self) -> String {
        match self.terrain {
            Terrain::Uniform(stiffness) => format!("{stiffness}"),
            Terrain::Switching([first, second])
            | Terrain::Border {
                pair: [first, second],
                ..
            } => format!("{first} ↔ {second}"),
        }
    }

    fn figures(&self) -> Value {
        // JSON knows no infinity: a law that lost the robot has no figure.
        let finite = |values: &[f64]| -> Vec<Option<f64>> {
            values
                .iter()
                .map(|value| value.is_finite().then_some(1.0e3 * value))
                .collect()
        };
        json!({
            "course": self.course, "stiffness": self.ground(), "lag_s": self.lag_s,
            "noise": self.noisy, "laws": LAWS,
            "rms_mm": finite(&self.rms_m), "most_mm": finite(&self.most_m),
        })
    }
}

/// Millimetres for people.
fn millimetres(value_m: f64) -> String {
    if value_m.is_finite() {
        format!("{:.2}", 1.0e3 * value_m)
    } else {
        "lost".to_owned()
    }
}

fn table(lines: &[Line], seeds: u64) -> String {
    let mut text = format!(
        "Cross-track RMS (largest) of the second half, mm; noisy lines over {seeds} seeds.\n\n\
         | course | K | lag, ms | noise | {} |\n|---|---|---|---|{}\n",
        LAWS.join(" | "),
        "---|".repeat(LAWS.len())
    );
    for line in lines {
        let _ = write!(
            text,
            "| {} | {} | {:.0} | {} |",
            line.course,
            line.ground(),
            1.0e3 * line.lag_s,
            if line.noisy { "yes" } else { "no" }
        );
        for (rms_m, most_m) in line.rms_m.iter().zip(&line.most_m) {
            let _ = write!(
                text,
                " {} ({}) |",
                millimetres(*rms_m),
                millimetres(*most_m)
            );
        }
        text.push('\n');
    }
    text
}

/// The courses by name.
type Courses = [(&'static str, Course)];
