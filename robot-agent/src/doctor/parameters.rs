//! Estimates the robot's parameters from the motions of the examination, with the estimator that
//! drives use.

use std::time::Duration;

use tread_control::estimation::{
    Estimator, EstimatorPrior, IdentifiedRobot, IdentifiedValue, SensorNoise,
};
use tread_control::robot::RobotModel;

use super::finding::Finding;
use crate::drive::{Feedback, motion_of};

/// Half-width of a 95 % interval, in standard deviations.
const NORMAL_95: f64 = tread_api::friction::NORMAL_95;
/// Name of the finding.
const NAME: &str = "parameters";

/// Estimator of the examined robot, fed with the samples of the base.
#[derive(Debug)]
pub(super) struct Parameters {
    estimator: Estimator,
    last: Option<Duration>,
}

impl Parameters {
    /// Creates the estimator with the configured model and prior.
    pub(super) fn new(model: RobotModel, prior: EstimatorPrior) -> Self {
        Self {
            estimator: Estimator::with_prior(model, SensorNoise::default(), prior),
            last: None,
        }
    }

    /// Adds the samples that the base has sent since the last call.
    pub(super) fn take(&mut self, feedback: &Feedback) {
        for sample in feedback.samples() {
            let Some(motion) = motion_of(sample) else {
                continue;
            };
            if let Some(last) = self.last.replace(sample.at) {
                let dt_s = sample.at.saturating_sub(last).as_secs_f64();
                self.estimator.update(&motion, dt_s);
            }
        }
    }

    /// Returns the finding: the parameters with 95 % intervals, or why there are none.
    pub(super) fn finding(&self) -> Finding {
        match self.estimator.estimate().robot {
            Some(robot) => Finding::on(NAME).ok(text(&robot)),
            None => Finding::on(NAME).skipped(
                "mass, inertia and centre of mass: the motion excited them too little, or \
                 `[estimation]` takes the model as exact",
            ),
        }
    }
}

/// Returns the finding for a robot whose other findings make the parameters meaningless.
pub(super) fn spoiled() -> Finding {
    let text = "mass, inertia and centre of mass: they need the findings above mended";
    Finding::on(NAME).skipped(text)
}

fn text(robot: &IdentifiedRobot) -> String {
    let value = |found: IdentifiedValue, decimals: usize, unit: &str| {
        let prior = if found.is_prior_dominated {
            ", mostly prior"
        } else {
            ""
        };
        let (value, half_width) = (found.value, NORMAL_95 * found.std_dev);
        format!("{value:.decimals$} ± {half_width:.decimals$}{unit}{prior}")
    };
    format!(
        "in 95 % intervals: apparent mass over the configured mass {}; yaw inertia per mass over the \
         configured {}; centre of mass {} forward, {} to the left. A figure-8 of a minute tells more",
        value(robot.apparent_mass_ratio, 2, ""),
        value(robot.inertia_ratio, 2, ""),
        value(robot.centre_forward_m, 3, " m"),
        value(robot.centre_left_m, 3, " m"),
    )
}

#[cfg(test)]
mod tests {
    use tread_control::measured::{BodyAcceleration, WheelSpeeds};

    use super::*;
    use crate::drive::SensorSample;

    #[test]
    fn a_robot_that_never_moved_has_no_parameters_and_one_that_turned_has() {
        let prior = EstimatorPrior::default();
        let mut parameters = Parameters::new(RobotModel::yi2007(), prior);
        assert!(parameters.finding().is_skipped);
        for tick in 0..900_u32 {
            let at = Duration::from_millis(10) * tick;
            let turn_rad_s = (f64::from(tick) * 0.01).min(1.0);
            let mut feedback = Feedback::default();
            feedback.push(SensorSample {
                at,
                yaw_rate_rad_s: Some(0.5 * turn_rad_s),
                wheel_speeds: Some(WheelSpeeds {
                    left_rad_s: 3.0 - 2.0 * turn_rad_s,
                    right_rad_s: 3.0 + 2.0 * turn_rad_s,
                }),
                acceleration: Some(BodyAcceleration::default()),
                ..SensorSample::default()
            });
            parameters.take(&feedback);
        }
        let finding = parameters.finding();
        assert!(finding.holds && !finding.is_skipped, "{finding:?}");
        assert!(finding.text.contains("mostly prior"), "{}", finding.text);
    }
}
