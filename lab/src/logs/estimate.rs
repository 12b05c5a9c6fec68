//! Runs the loop's own sensing and estimation on recorded samples, tick by tick.

use std::collections::BTreeSet;
use std::time::Duration;

use tread_agent::drive::{Feedback, SAMPLES_MAX};
use tread_agent::testing::{Listener, ListenerOutput};
use tread_control::estimation::{Estimate, EstimatorPrior, NORMAL_95, ThetaMeasurement};
use tread_control::robot::RobotModel;

use super::timeline::LoopInput;
use crate::report::WIDE_RATIO;

/// Time without samples that is skipped instead of run tick by tick.
const SKIPPED: Duration = Duration::from_secs(1);

/// How samples are fed.
#[derive(Debug, Clone, Copy)]
pub struct EstimationSetup {
    /// The robot's model.
    pub model: RobotModel,
    /// What the estimator assumes of the robot and its tyres.
    pub prior: EstimatorPrior,
    /// Period of the loop.
    pub period: Duration,
}

/// What the loop made of samples.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// State of the estimator at the end.
    pub estimate: Estimate,
    /// Time in which sensors contradicted each other, so that nothing was learned, seconds.
    pub contradicted_s: f64,
    /// Sensors that did.
    pub contradicting: BTreeSet<&'static str>,
    /// Changes of the ground that were detected.
    pub ground_changes: u64,
    /// Time until the first measurement of θ, seconds; `None` without any.
    pub first_after_s: Option<f64>,
    /// Smallest and largest standard deviation of θ over θ on the way; `None` without any.
    pub std_dev_ratios: Option<(f64, f64)>,
}

impl Outcome {
    /// Returns the measurement of θ at the end; `None` if its interval is too wide for one.
    pub fn theta(&self) -> Option<ThetaMeasurement> {
        let is_narrow =
            |found: &ThetaMeasurement| NORMAL_95 * found.std_dev <= WIDE_RATIO * found.theta;
        self.estimate.theta.filter(is_narrow)
    }
}

/// State of a run.
struct Run<'f> {
    feeding: &'f EstimationSetup,
    listener: Listener,
    begin: Duration,
    feedback: Feedback,
    outcome: Outcome,
}

impl Run<'_> {
    /// Runs one tick on the samples that wait.
    fn tick(&mut self, now: Duration, fed: &LoopInput) {
        let feedback = std::mem::take(&mut self.feedback);
        let output = self.listener.step(now, &feedback, fed.noise);
        self.record(now, &output);
    }

    fn record(&mut self, now: Duration, output: &ListenerOutput) {
        let outcome = &mut self.outcome;
        outcome.estimate = output.estimate;
        outcome.ground_changes = output.ground_changes;
        if output.findings.consequence().is_some() {
            outcome.contradicted_s += self.feeding.period.as_secs_f64();
            let subjects = output.findings.iter().map(|finding| finding.subject.text());
            outcome.contradicting.extend(subjects);
        }
        if let Some(found) = output.estimate.theta {
            let ratio = found.std_dev / found.theta;
            let (least, most) = outcome.std_dev_ratios.unwrap_or((ratio, ratio));
            outcome.std_dev_ratios = Some((least.min(ratio), most.max(ratio)));
            let after_s = now.saturating_sub(self.begin).as_secs_f64();
            outcome.first_after_s.get_or_insert(after_s);
        }
    }
}

/// Feeds samples to the loop's stages as the loop does: each tick takes those since the tick before.
pub fn estimate(fed: &[LoopInput], feeding: &EstimationSetup) -> Outcome {
    let begin = fed.first().map(|first| first.sample.at).unwrap_or_default();
    let listener = Listener::new(feeding.model, feeding.prior);
    let mut run = Run {
        feeding,
        listener,
        begin,
        feedback: Feedback::default(),
        outcome: Outcome {
            estimate: Estimate::default(),
            contradicted_s: 0.0,
            contradicting: BTreeSet::new(),
            ground_changes: 0,
            first_after_s: None,
            std_dev_ratios: None,
        },
    };
    let mut now = begin + feeding.period;
    for one in fed {
        let at = one.sample.at;
        if at.saturating_sub(now) > SKIPPED {
            run.tick(now, one);
            now = at;
        }
        while at > now {
            run.tick(now, one);
            now += feeding.period;
        }
        // What comes faster than a tick can take is taken by a tick more.
        if run.feedback.samples().len() == SAMPLES_MAX {
            run.tick(now, one);
        }
        run.feedback.push(one.sample);
    }
    if let Some(last) = fed.last() {
        run.tick(now, last);
    }
    run.outcome
}
