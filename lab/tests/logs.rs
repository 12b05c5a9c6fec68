//! Recordings as files: the agent's own, which other tests hold against its loop, and what is wrong
//! with others.

#![cfg(feature = "logs")]

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context as _;
use tread_agent::RecordingConfig;
use tread_agent::drive::ros2::settings::Effort;
use tread_agent::sim::scenario::Scenario;
use tread_agent::testing::Bench;
use tread_api::friction::ThetaEstimate;
use tread_api::geometry::Point;
use tread_api::trajectory::{Circle, Direction, Trajectory, TrajectoryOptions};
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;
use tread_control::robot::RobotModel;
use tread_lab::logs::analysis::{Analysis, Options, analyse};
use tread_lab::logs::mapping::{RequestedTopics, choose};
use tread_lab::logs::recording::Recording;
use tread_lab::logs::robot::Robot;
use tread_lab::logs::statistics::Pair;

/// θ of the concrete slab, on which the circles are: K is 8.
const THETA: f64 = 0.125;

const OPTIONS: Options = Options {
    from_s: 0.0,
    to_s: f64::INFINITY,
    pass: Duration::from_secs(15),
    interpolates: false,
    is_by_positions: false,
    chi_square_max: 4.0,
    prior: None,
};

/// Circles on the concrete slab of the built-in scenario.
fn circles() -> Trajectory {
    Trajectory::Circle(Circle {
        center: Point { x_m: 8.0, y_m: 6.0 },
        radius_m: 2.0,
        speed_m_s: Some(0.6),
        period_s: None,
        direction: Direction::CounterClockwise,
        turns: 4.0,
        options: TrajectoryOptions::default(),
    })
}

/// Records circles of the agent's own simulated robot; returns the file, and θ as the agent
/// reported it in the end.
fn record(
    folder: &Path,
    prior: EstimatorPrior,
) -> anyhow::Result<(PathBuf, Option<ThetaEstimate>)> {
    let scenario = Scenario::built_in()?;
    let robot = scenario.robots.first().context("it has a robot")?;
    let start = Pose {
        x_m: robot.x_m,
        y_m: robot.y_m,
        heading_rad: robot.heading_rad,
    };
    let mut bench = Bench::new(&scenario, start, robot.seed)?.with_prior(prior);
    let config = RecordingConfig {
        folder: folder.to_owned(),
        file_bytes: 256 << 20,
        files: 2,
    };
    bench.record(config, scenario.site.clone(), robot.id.clone());
    bench.run_for(Duration::from_secs(2));
    bench.begin(1, &circles(), None)?;
    bench.run_for(Duration::from_secs(40));
    anyhow::ensure!(bench.end_record() == 0, "notes were lost");
    let file = std::fs::read_dir(folder)?.next();
    Ok((file.context("a file was written")??.path(), bench.theta()))
}

fn analysed(
    file: &Path,
    requested: &RequestedTopics,
    options: &Options,
) -> anyhow::Result<Analysis> {
    let recording = Recording::open(&[file.to_owned()])?;
    let contents = recording.contents()?;
    let robot = Robot {
        model: RobotModel::yi2007(),
        prior: EstimatorPrior::default(),
        settings: None,
        rate_hz: 100.0,
    };
    let mapping = choose(&recording, &contents, &robot, requested)?;
    let begin_ns = contents.topics.iter().map(|topic| topic.first_ns).min();
    let begin_ns = begin_ns.context("it has messages")?;
    Ok(analyse(&recording, &mapping, &robot, options, begin_ns)?)
}

#[test]
fn a_recording_of_the_agent_gives_what_the_agent_said() {
    let folder = tempfile::tempdir().unwrap();
    let (file, said) = record(folder.path(), EstimatorPrior::default()).unwrap();
    let said = said.expect("the robot measures torque");
    let requested = RequestedTopics {
        effort: Some(Effort::Torque),
        ..RequestedTopics::default()
    };
    let analysis = analysed(&file, &requested, &OPTIONS).unwrap();
    assert!(
        analysis.checks.iter().all(|check| check.holds),
        "{:?}",
        analysis.checks
    );
    let found = analysis.overall.theta.expect("as the agent had one");
    // The speed over ground is not in a recording's topics for others, so that the two differ, by
    // less than the error of either.
    let off = (found.theta - said.theta).abs();
    assert!(off < said.std_dev, "{found:?}, agent: {said:?}");
    let (low_95, high_95) = said.interval_95();
    assert!((low_95..=high_95).contains(&THETA), "agent: {said:?}");
    assert!((found.low_95..=found.high_95).contains(&THETA), "{found:?}");
    assert!(analysis.passes.len() >= 2, "{:?}", analysis.passes);
    let is_finite = |pair: &Pair| pair.chi_square.is_finite();
    assert!(analysis.pairs.iter().all(is_finite));
    let track = analysis.effective_track.expect("a circle is a steady turn");
    // The way to the circle may turn to the other side.
    assert!(track.left_bins > 10 * track.right_bins.max(1), "{track:?}");
    let at_low_speed = RobotModel::yi2007().effective_track_ratio();
    assert!((track.ratio / at_low_speed - 1.0).abs() < 0.05, "{track:?}");
}

#[test]
fn a_part_of_a_recording_can_be_chosen_and_standing_is_no_pass() {
    let folder = tempfile::tempdir().unwrap();
    let (file, _) = record(folder.path(), EstimatorPrior::default()).unwrap();
    let standing = Options {
        to_s: 1.5,
        ..OPTIONS
    };
    let analysis = analysed(&file, &RequestedTopics::default(), &standing).unwrap();
    assert_eq!((analysis.passes.len(), analysis.pairs.len()), (0, 0));
    assert!(analysis.overall.theta.is_none());
    let codes: Vec<&str> = analysis
        .overall
        .abstains
        .iter()
        .map(|reason| reason.code)
        .collect();
    assert_eq!(codes[0], "short", "{codes:?}");
    assert!(analysis.overall.to_s < 1.6);
}
