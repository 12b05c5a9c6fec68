//! A whole recording: passes, what the estimator makes of each and of all, and how they agree.

use std::collections::BTreeSet;
use std::ops::{ControlFlow, Range};
use std::time::Duration;

use serde::Serialize;
use tread_agent::drive::ros2::refusal::Source;
use tread_api::friction::ThetaEstimate;
use tread_control::estimation::{EstimatorPrior, ThetaMeasurement};

use super::decode::{Decoder, Refusals, Timed};
use super::estimate::{EstimationSetup, Outcome, estimate};
use super::mapping::Mapping;
use super::reasons::{Reason, reasons};
use super::recording::{Recording, RecordingError};
use super::robot::Robot;
use super::statistics::{EffectiveTrack, Pair, effective_track, mean_chi_square, pairs};
use super::stretches::{Motion, drives, motion, parts, passes};
use super::timeline::{LoopInput, Timeline, assemble, since_begin_s};
use crate::parallel::in_parallel;
use crate::report::Check;

/// Most messages of one run: half a day of wheels at 50 Hz and an inertial unit at 100 Hz.
pub const MESSAGES_MAX: usize = 6_500_000;
/// Most passes of one run; pairs grow with their square.
pub const PASSES_MAX: usize = 2_000;

/// Why a recording cannot be analysed.
#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// More than [`MESSAGES_MAX`] messages.
    #[error(
        "the topics have more than {MESSAGES_MAX} messages: choose a time by `--from-s` and `--to-s`"
    )]
    TooLong,
    /// More than [`PASSES_MAX`] passes.
    #[error("there are more than {PASSES_MAX} passes: choose longer ones by `--pass-s`")]
    TooManyPasses,
    /// No message gave a value.
    #[error("no message gave wheel speeds: {0}")]
    NoWheels(String),
}

/// What to do with a recording.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Time of recording from which on messages count, seconds after the first message.
    pub from_s: f64,
    /// Time up to which they count.
    pub to_s: f64,
    /// Wanted length of a pass.
    pub pass: Duration,
    /// Whether wheel speeds that come too seldom are interpolated.
    pub interpolates: bool,
    /// Whether speeds of joints are their differentiated positions even where they are given.
    pub is_by_positions: bool,
    /// Largest χ² of a pair, in the mean of all pairs, at which passes count as consistent.
    pub chi_square_max: f64,
    /// What the estimator assumes of robot and tyres, if not what the robot's configuration says.
    pub prior: Option<EstimatorPrior>,
}

/// θ with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Theta {
    /// θ = 1/K.
    pub theta: f64,
    /// Its standard deviation, with all errors.
    pub std_dev: f64,
    /// Its standard deviation without errors that all of a robot's measurements share.
    pub own_std_dev: f64,
    /// Lower end of the 95 % interval.
    pub low_95: f64,
    /// Upper end of the 95 % interval.
    pub high_95: f64,
}

impl From<ThetaMeasurement> for Theta {
    fn from(found: ThetaMeasurement) -> Self {
        let estimate = ThetaEstimate {
            theta: found.theta,
            std_dev: found.std_dev,
        };
        let (low_95, high_95) = estimate.interval_95();
        Self {
            theta: found.theta,
            std_dev: found.std_dev,
            own_std_dev: found.own_std_dev,
            low_95,
            high_95,
        }
    }
}

/// What the estimator made of a stretch.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Verdict {
    /// Begin, seconds after the first message.
    pub from_s: f64,
    /// End.
    pub to_s: f64,
    /// How the robot moved.
    pub motion: Motion,
    /// θ; none where the estimator abstains.
    pub theta: Option<Theta>,
    /// Why it abstains, with what would help; empty where it does not.
    pub abstains: Vec<Reason>,
    /// Time until the first estimate, seconds.
    pub first_after_s: Option<f64>,
    /// Smallest and largest σ of θ over θ on the way.
    pub std_dev_ratios: Option<(f64, f64)>,
    /// Time in which sensors contradicted each other, seconds.
    pub contradicted_s: f64,
    /// Sensors that did.
    pub contradicting: BTreeSet<&'static str>,
    /// Changes of the ground that were detected.
    pub ground_changes: u64,
}

impl Verdict {
    fn new(fed: &[LoopInput], feeding: &EstimationSetup, outcome: &Outcome) -> Self {
        let motion = motion(fed, &feeding.model);
        let at_s = |fed: Option<&LoopInput>| fed.map_or(0.0, |fed| since_begin_s(fed.sample.at));
        let theta = outcome.theta().map(Theta::from);
        Self {
            from_s: at_s(fed.first()),
            to_s: at_s(fed.last()),
            abstains: if theta.is_some() {
                Vec::new()
            } else {
                reasons(&motion, outcome)
            },
            motion,
            theta,
            first_after_s: outcome.first_after_s,
            std_dev_ratios: outcome.std_dev_ratios,
            contradicted_s: outcome.contradicted_s,
            contradicting: outcome.contradicting.clone(),
            ground_changes: outcome.ground_changes,
        }
    }

    /// Whether there is an estimate or a reason, never both.
    fn is_decided(&self) -> bool {
        self.theta.is_some() == self.abstains.is_empty()
    }
}

/// What was made of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Analysis {
    /// Where each topic's times come from.
    pub clocks: Vec<(Source, &'static str)>,
    /// Messages that were refused.
    pub refusals: Refusals,
    /// Files that are torn, with where.
    pub torn: Vec<String>,
    /// Wheel speeds that were interpolated.
    pub interpolated: u64,
    /// Number of parts.
    pub parts: usize,
    /// Drives that are too short for a pass.
    pub short_drives: usize,
    /// One verdict for each pass, by an estimator of its own.
    pub passes: Vec<Verdict>,
    /// The verdict on everything, by one estimator.
    pub overall: Verdict,
    /// Pairs of passes with estimates.
    pub pairs: Vec<Pair>,
    /// Effective track of all steady turns.
    pub effective_track: Option<EffectiveTrack>,
    /// Goals.
    pub checks: Vec<Check>,
}

impl Analysis {
    /// Returns the mean χ² of the pairs; 1 is expected.
    pub fn mean_chi_square(&self) -> Option<f64> {
        mean_chi_square(&self.pairs)
    }

    /// Returns the smallest and the largest σ of θ over θ among passes with an estimate.
    pub fn std_dev_ratios(&self) -> Option<(f64, f64)> {
        let ratios = self.passes.iter().filter_map(|pass| pass.theta);
        let ratios = ratios.map(|theta| theta.std_dev / theta.theta);
        ratios.fold(None, |range, ratio| {
            let (least, most) = range.unwrap_or((ratio, ratio));
            Some((least.min(ratio), most.max(ratio)))
        })
    }
}

/// Reads the chosen topics.
fn read(
    recording: &Recording,
    mapping: &Mapping,
    options: &Options,
    begin_ns: i64,
) -> Result<(Vec<Timed>, Refusals, Vec<String>), AnalysisError> {
    let mut decoder = Decoder::new(mapping, options.is_by_positions);
    let (mut timed, mut is_full) = (Vec::new(), false);
    let torn = recording.read(&mapping.topics(), &mut |message| {
        #[expect(
            clippy::cast_precision_loss,
            reason = "times of a recording, in nanoseconds"
        )]
        let after_s = message.logged_ns.saturating_sub(begin_ns) as f64 * 1.0e-9;
        if !(options.from_s..=options.to_s).contains(&after_s) {
            return ControlFlow::Continue(());
        }
        timed.extend(decoder.take(message));
        is_full = timed.len() > MESSAGES_MAX;
        if is_full {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    })?;
    if is_full {
        return Err(AnalysisError::TooLong);
    }
    Ok((timed, decoder.refusals, torn))
}

fn refused(refusals: &Refusals) -> String {
    let all: Vec<String> = refusals
        .iter()
        .map(|(source, refusal, count)| format!("{count} {} on {source:?}", refusal.text()))
        .collect();
    if all.is_empty() {
        "the topics have no message of the robot's joints in this time".to_owned()
    } else {
        all.join(", ")
    }
}

/// Analyses a recording whose first message was recorded at `begin_ns`.
///
/// # Errors
/// [`AnalysisError`].
pub fn analyse(
    recording: &Recording,
    mapping: &Mapping,
    robot: &Robot,
    options: &Options,
    begin_ns: i64,
) -> Result<Analysis, AnalysisError> {
    let (timed, mut refusals, torn) = read(recording, mapping, options, begin_ns)?;
    let timeline = assemble(
        timed,
        &mapping.settings,
        &mut refusals,
        options.interpolates,
    );
    let fed = &timeline.fed;
    let feeding = EstimationSetup {
        model: robot.model,
        prior: options.prior.unwrap_or(robot.prior),
        period: Duration::from_secs_f64(robot.rate_hz.recip()),
    };
    if !fed.iter().any(|fed| fed.sample.wheel_speeds.is_some()) {
        return Err(AnalysisError::NoWheels(refused(&refusals)));
    }
    let parts = parts(fed);
    let drives: Vec<Range<usize>> = parts
        .iter()
        .flat_map(|part| drives(fed, part.clone(), &robot.model))
        .collect();
    let (mut stretches, mut short_drives) = (Vec::new(), 0);
    for drive in drives {
        let found = passes(fed, drive, options.pass);
        short_drives += usize::from(found.is_empty());
        stretches.extend(found);
    }
    if stretches.len() > PASSES_MAX {
        return Err(AnalysisError::TooManyPasses);
    }
    let count = stretches.len();
    stretches.push(0..fed.len());
    let outcomes = in_parallel(&stretches, |stretch| {
        estimate(&fed[stretch.clone()], &feeding)
    });
    let mut verdicts: Vec<Verdict> = stretches
        .iter()
        .zip(&outcomes)
        .map(|(stretch, outcome)| Verdict::new(&fed[stretch.clone()], &feeding, outcome))
        .collect();
    let measured: Vec<(usize, ThetaMeasurement)> = outcomes[..count]
        .iter()
        .enumerate()
        .filter_map(|(index, outcome)| Some((index + 1, outcome.theta()?)))
        .collect();
    let pairs = pairs(&measured);
    let overall = verdicts.split_off(count).remove(0);
    let Timeline {
        clocks,
        interpolated,
        ..
    } = &timeline;
    let checks = checks(&verdicts, &overall, &pairs, options.chi_square_max);
    Ok(Analysis {
        clocks: clocks
            .iter()
            .map(|(source, clock)| (*source, clock.text()))
            .collect(),
        refusals,
        torn,
        interpolated: *interpolated,
        parts: parts.len(),
        short_drives,
        effective_track: effective_track(fed, &robot.model),
        passes: verdicts,
        overall,
        pairs,
        checks,
    })
}

#[expect(clippy::cast_precision_loss, reason = "a number of passes")]
fn checks(
    passes: &[Verdict],
    overall: &Verdict,
    pairs: &[Pair],
    chi_square_max: f64,
) -> Vec<Check> {
    let all = passes.iter().chain([overall]);
    let undecided = all.filter(|verdict| !verdict.is_decided()).count();
    let mut checks = vec![
        Check::of(
            "passes that neither have an estimate nor a reason",
            undecided as f64,
        )
        .at_most(0.0),
    ];
    let mean = mean_chi_square(pairs);
    checks
        .extend(mean.map(|mean| Check::of("χ² per pair of passes", mean).at_most(chi_square_max)));
    checks
}
