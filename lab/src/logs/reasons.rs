//! Why there is no estimate, and which manoeuvre would help.
//!
//! There is no estimate where the 95 % interval would be wider than ± 60 % of θ, or where nothing
//! reached the estimator. It does not say which of many causes that had; they are derived here from what
//! it does say (samples dropped, slip beyond the linear range, no new information), from the
//! findings of the consistency monitor, and from how the robot moved.

use serde::Serialize;

use tread_api::friction::NoEstimate;
use tread_control::estimation::manoeuvre::is_saturated;
use tread_control::estimation::{LateSensor, NORMAL_95, SensorDelays};

use super::estimate::Outcome;
use super::stretches::{ESTIMATOR_GAP_S, Motion};
use crate::report::WIDE_RATIO;

/// Share of a time, or of samples, from which a cause counts.
const SHARE: f64 = 0.2;

/// A reason, with what would help.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Reason {
    /// Name for programs.
    pub code: &'static str,
    /// The reason.
    pub reason: String,
    /// What to do.
    pub help: &'static str,
}

/// Returns what a robot without an estimate is asked for, for this reason.
fn help(reason: NoEstimate) -> &'static str {
    reason.help().unwrap_or_default()
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

/// Returns what keeps the estimator from knowing θ, the strongest first; never nothing.
pub fn reasons(motion: &Motion, outcome: &Outcome) -> Vec<Reason> {
    let mut reasons = of_recording(motion, outcome);
    if reasons.is_empty() {
        reasons = of_motion(motion, outcome);
    }
    if reasons.is_empty() {
        let (without, help) = if motion.has_torque {
            (
                "",
                "drive figure-8s of 2 to 4 m for a minute, at changing speed; record odometry over ground",
            )
        } else {
            (
                "without measured torque ",
                "drive figure-8s of 2 to 4 m for a minute, at changing speed; record the joints' torque and give `--effort torque`, or record odometry over ground",
            )
        };
        let on_the_way = outcome
            .std_dev_ratios
            .map_or_else(String::new, |(least, _)| {
                let half_width = percent(NORMAL_95 * least);
                format!("; on the way it was ± {half_width} at best")
            });
        reasons.push(Reason {
            code: "uncertain",
            reason: format!(
                "{without}the motion leaves a 95 % interval wider than ± {} of θ{on_the_way}",
                percent(WIDE_RATIO)
            ),
            help,
        });
    }
    reasons
}

/// What of the recording keeps samples from the estimator, whatever the robot does.
fn of_recording(motion: &Motion, outcome: &Outcome) -> Vec<Reason> {
    let mut reasons = Vec::new();
    if motion.long_interval_ratio > SHARE {
        reasons.push(Reason {
            code: "wheel_rate",
            reason: format!(
                "{} of the wheel speeds come more than {:.0} ms after the one before (every {:.0} ms in the median), and nothing is known of the motion in between",
                percent(motion.long_interval_ratio),
                1.0e3 * ESTIMATOR_GAP_S,
                1.0e3 * motion.wheel_interval_s
            ),
            help: "record wheel speeds at 20 Hz or more; `--interpolate` takes them as changing evenly in between",
        });
    }
    if motion.without_gyro_ratio > SHARE {
        reasons.push(Reason {
            code: "gyro",
            reason: format!(
                "{} of the wheel speeds have no yaw rate within 60 ms",
                percent(motion.without_gyro_ratio)
            ),
            help: "record the inertial unit at 50 Hz or more, by the same clock as the wheels",
        });
    }
    let duration_s = motion.duration_s.max(f64::MIN_POSITIVE);
    if outcome.contradicted_s > SHARE * duration_s {
        let subjects: Vec<&str> = outcome.contradicting.iter().copied().collect();
        reasons.push(Reason {
            code: "contradiction",
            reason: format!(
                "sensors contradict each other in {} of the time: {}",
                percent(outcome.contradicted_s / duration_s),
                subjects.join(", ")
            ),
            help: "check wheel radius, track width, the joints' signs and the inertial unit's mounting",
        });
    }
    #[expect(clippy::cast_precision_loss, reason = "counts of samples")]
    let dropped =
        outcome.estimate.dropped_samples as f64 / (motion.samples_hz * duration_s).max(1.0);
    if dropped > SHARE {
        reasons.push(Reason {
            code: "implausible",
            reason: format!("{} of the samples are impossible for this robot", percent(dropped)),
            help: "check the joints' unit and gear ratio, the wheel radius, and the limits of the model",
        });
    }
    if let Some(ratio) = outcome.estimate.misfit_ratio {
        reasons.push(Reason {
            code: "misfit",
            reason: format!(
                "the equations of motion do not describe what the sensors measure: residuals are {ratio:.0} times their expected size"
            ),
            help: "check mass, wheel radius and track width, the joints' signs, the inertial unit's mounting and orientation, and that all sensors have one clock",
        });
    }
    if let Some(ratio) = outcome.estimate.newest_misfit_ratio {
        reasons.push(Reason {
            code: "misfit",
            reason: format!(
                "the last seconds contradict the estimate: residuals are {ratio:.1} times those before"
            ),
            help: "look for a change of the ground, or a sensor that failed; estimates from before are under `passes`",
        });
    }
    if let Some(late) = outcome.estimate.late_sensor {
        reasons.push(Reason {
            code: "late_sensor",
            reason: late_text(&late, motion.has_acceleration),
            help: help(NoEstimate::LateSensor),
        });
    }
    reasons
}

/// Returns the delays of a late sensor in milliseconds.
fn late_text(late: &LateSensor, has_accelerometer: bool) -> String {
    let sensor = |name: &str, of: fn(&SensorDelays) -> f64| {
        let [newest_ms, identified_ms] =
            [&late.newest, &late.identified].map(|delays| 1.0e3 * of(delays));
        format!(
            "the {name} is {newest_ms:.0} ms later than the wheel speeds (identified: {identified_ms:.0} ms)"
        )
    };
    let mut sensors = vec![sensor("gyro", |delays| delays.gyro_s)];
    if has_accelerometer {
        sensors.push(sensor("accelerometer", |delays| delays.accelerometer_s));
    }
    format!(
        "by the time stamps {}; delays of up to 30 ms that do not change are identified",
        sensors.join(", ")
    )
}

/// What of the motion leaves θ unknown.
fn of_motion(motion: &Motion, outcome: &Outcome) -> Vec<Reason> {
    let mut reasons = Vec::new();
    let manoeuvres = &motion.manoeuvres;
    if manoeuvres.is_too_short() {
        reasons.push(Reason {
            code: "short",
            reason: format!("the robot drove for {:.1} s only", manoeuvres.moving_s),
            help: help(NoEstimate::Short),
        });
    }
    if is_saturated(outcome.estimate.saturation_share) {
        reasons.push(Reason {
            code: "slip",
            reason: format!(
                "the wheels slip beyond the range in which friction follows from slip in {} of the time",
                percent(outcome.estimate.saturation_share)
            ),
            help: help(NoEstimate::Slip),
        });
    }
    if manoeuvres.has_no_turns() {
        let spot = if manoeuvres.turns_on_the_spot() {
            ", but for turns on the spot"
        } else {
            ""
        };
        reasons.push(Reason {
            code: "no_turns",
            reason: format!("the robot rolled straight on nearly all the time{spot}"),
            help: help(NoEstimate::NoTurns),
        });
    } else if manoeuvres.is_one_sided() {
        reasons.push(Reason {
            code: "one_sided",
            reason:
                "nearly all turns were to one side, so that different wheel radii look like slip"
                    .to_owned(),
            help: help(NoEstimate::OneSided),
        });
    }
    if manoeuvres.has_no_acceleration() {
        reasons.push(Reason {
            code: "no_acceleration",
            reason: "the speed hardly changed".to_owned(),
            help: help(NoEstimate::NoAcceleration),
        });
    }
    if outcome.estimate.no_new_information {
        reasons.push(Reason {
            code: "no_excitation",
            reason: "the last seconds brought no new information on θ".to_owned(),
            help: "drive figure-8s at changing speed",
        });
    }
    reasons
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use tread_control::estimation::Estimate;
    use tread_control::estimation::manoeuvre::ManoeuvreTimes;

    use super::*;

    fn outcome() -> Outcome {
        Outcome {
            estimate: Estimate::default(),
            contradicted_s: 0.0,
            contradicting: BTreeSet::new(),
            ground_changes: 0,
            first_after_s: None,
            std_dev_ratios: None,
        }
    }

    /// The manoeuvres in a minute of figure-8s.
    fn figure_8s() -> ManoeuvreTimes {
        ManoeuvreTimes {
            moving_s: 60.0,
            left_s: 20.0,
            right_s: 20.0,
            accelerating_s: 15.0,
            ..ManoeuvreTimes::default()
        }
    }

    /// A minute of figure-8s.
    fn excited() -> Motion {
        Motion {
            duration_s: 60.0,
            manoeuvres: figure_8s(),
            samples_hz: 50.0,
            wheel_interval_s: 0.02,
            ..Motion::default()
        }
    }

    fn codes(motion: &Motion, outcome: &Outcome) -> Vec<&'static str> {
        let reasons = reasons(motion, outcome);
        reasons.iter().map(|reason| reason.code).collect()
    }

    #[test]
    fn there_is_always_a_reason_and_a_help() {
        let found = reasons(&excited(), &outcome());
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].code, "uncertain");
        assert!(!found[0].help.is_empty());
    }

    #[test]
    fn a_recording_that_says_too_little_is_named_before_the_motion() {
        let seldom = Motion {
            wheel_interval_s: 0.2,
            long_interval_ratio: 1.0,
            manoeuvres: ManoeuvreTimes {
                left_s: 0.0,
                right_s: 0.0,
                ..figure_8s()
            },
            ..excited()
        };
        assert_eq!(codes(&seldom, &outcome()), ["wheel_rate"]);
        let contradicted = Outcome {
            contradicted_s: 30.0,
            contradicting: BTreeSet::from(["gyro"]),
            ..outcome()
        };
        let found = reasons(&excited(), &contradicted);
        assert!(
            found[0].reason.contains("50 %") && found[0].reason.contains("gyro"),
            "{found:?}"
        );
    }

    #[test]
    fn a_model_that_does_not_fit_is_the_reason_and_not_the_motion() {
        let misfit = Outcome {
            estimate: Estimate {
                misfit_ratio: Some(7.2),
                saturation_share: 0.95,
                ..Estimate::default()
            },
            ..outcome()
        };
        let found = reasons(&excited(), &misfit);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(
            found[0].code == "misfit" && found[0].reason.contains("7 times"),
            "{found:?}"
        );
    }

    #[test]
    fn last_seconds_that_contradict_the_estimate_are_the_reason() {
        let changed = Outcome {
            estimate: Estimate {
                newest_misfit_ratio: Some(3.2),
                ..Estimate::default()
            },
            ..outcome()
        };
        let found = reasons(&excited(), &changed);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(
            found[0].reason.contains("3.2 times those before"),
            "{found:?}"
        );
    }

    #[test]
    fn delays_of_a_late_sensor_are_stated_in_milliseconds() {
        let late = Outcome {
            estimate: Estimate {
                late_sensor: Some(LateSensor {
                    newest: SensorDelays {
                        gyro_s: 0.0412,
                        accelerometer_s: 0.0,
                    },
                    identified: SensorDelays {
                        gyro_s: 0.012,
                        accelerometer_s: 0.0,
                    },
                }),
                ..Estimate::default()
            },
            ..outcome()
        };
        let found = reasons(&excited(), &late);
        let reason = &found[0].reason;
        assert_eq!(found[0].code, "late_sensor");
        assert!(
            reason.contains("gyro is 41 ms") && reason.contains("identified: 12 ms"),
            "{reason}"
        );
        assert!(
            !reason.contains("accelerometer"),
            "it measured none: {reason}"
        );
        let motion = Motion {
            has_acceleration: true,
            ..excited()
        };
        assert!(
            reasons(&motion, &late)[0]
                .reason
                .contains("accelerometer is 0 ms")
        );
    }

    #[test]
    fn torque_is_asked_for_only_where_there_is_none() {
        let help = |has_torque: bool| {
            let motion = Motion {
                has_torque,
                ..excited()
            };
            reasons(&motion, &outcome())[0].help
        };
        assert!(help(false).contains("--effort torque"));
        assert!(!help(true).contains("torque"));
    }

    #[test]
    fn each_missing_manoeuvre_is_asked_for() {
        let with = |manoeuvres: ManoeuvreTimes| Motion {
            manoeuvres,
            ..excited()
        };
        let straight = with(ManoeuvreTimes {
            left_s: 1.0,
            right_s: 1.0,
            ..figure_8s()
        });
        assert_eq!(codes(&straight, &outcome()), ["no_turns"]);
        let circle = with(ManoeuvreTimes {
            left_s: 55.0,
            right_s: 0.0,
            accelerating_s: 1.0,
            ..figure_8s()
        });
        assert_eq!(codes(&circle, &outcome()), ["one_sided", "no_acceleration"]);
        let slipping = Outcome {
            estimate: Estimate {
                saturation_share: 0.95,
                ..Estimate::default()
            },
            ..outcome()
        };
        assert_eq!(codes(&excited(), &slipping), ["slip"]);
    }
}
