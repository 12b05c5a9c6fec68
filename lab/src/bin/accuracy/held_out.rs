//! The held-out set: a robot, courses, grounds, speeds and seeds on which no gain and no constant
//! of the estimator was chosen.

use serde_json::json;
use tread_control::robot::RobotModel;
use tread_lab::bench::husky_like;

use crate::drives::Drive;
use crate::report::{Options, Section};
use crate::robot::RobotSpec;
use crate::theta::{Goal, Scenario, measure};
use crate::tracking::held_out;

/// First seed of this part.
pub(crate) const FIRST_SEED: u64 = 1_000_000;
/// Stiffnesses K of this part.
pub(crate) const STIFFNESSES: [f64; 3] = [0.7, 3.0, 12.0];

/// The robot of the other parts, and one about as large as a Husky.
pub(crate) fn robots() -> [(&'static str, RobotModel); 2] {
    [("5 kg", RobotModel::yi2007()), ("50 kg", husky_like())]
}

/// Runs the part `held-out` and returns its tables and checks.
pub(crate) fn run(options: &Options) -> Section {
    let theta = measure(scenarios(), FIRST_SEED, options);
    let tracking = held_out::run(options);
    Section {
        text: format!("{}\n{}", theta.text, tracking.text),
        figures: json!({ "theta": theta.figures, "tracking": tracking.figures }),
        checks: theta.checks.into_iter().chain(tracking.checks).collect(),
    }
}

fn scenarios() -> Vec<Scenario> {
    let mut all = Vec::new();
    for (name, model) in robots() {
        for stiffness in STIFFNESSES {
            let mut push = |what: &str, has_torque, drive| {
                let mut robot = RobotSpec::on(stiffness);
                robot.model = model;
                robot.has_torque = has_torque;
                all.push(Scenario {
                    name: format!("{name}, {what}, K {stiffness}"),
                    drive,
                    robot,
                    goal: Goal::Measures { rms_max: None },
                });
            };
            push(
                "torque, circles R 3.7 m, 0.45 m/s",
                true,
                Drive::StraightThenCircles {
                    radius_m: 3.7,
                    speed_m_s: 0.45,
                },
            );
            push(
                "no torque, weaving, 0.7 m/s",
                false,
                Drive::Weave {
                    speed_m_s: 0.7,
                    curvature_1_m: 0.3,
                    period_s: 7.0,
                },
            );
        }
    }
    all
}
