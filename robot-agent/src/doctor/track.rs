//! The turn command, and what a turn on the spot says of the track width. Pure.
//!
//! Two figures are measured. The first is exact: how fast the wheels turn for a commanded turn says
//! which track the base itself divides by, whatever the ground. The second is the effective track,
//! `W_eff = r·(ω_R − ω_L)/ψ̇`, and it depends on the ground. By the balance of moments of four
//! equal contacts in a turn on the spot
//!
//! ```text
//! W_eff = W + α·L²/W,    α = lateral over longitudinal slip stiffness
//! ```
//!
//! Ground with the same friction in all directions has α = 1, whatever its θ, and the tyres of real
//! robots lie within [`STIFFNESS_RATIO`]. So a configured W is impossible where `W_eff` is below
//! it, and implausible where α would have to lie outside that range. A W within the range that
//! `W_eff` allows looks like another ground: that range is said, to be compared with a tape
//! measure.

use super::drove::{Drove, TurnBlock};
use super::finding::Finding;
use crate::drive::ros2::settings::{CommandKind, Ros2Settings};
use tread_control::robot::RobotModel;

/// Lateral over longitudinal slip stiffness of tyres and ground.
pub(super) const STIFFNESS_RATIO: std::ops::RangeInclusive<f64> = 0.4..=2.5;
/// Error of a ratio of commanded and measured speeds that is borne, as a share.
pub(super) const COMMAND_SHARE: f64 = 0.06;
/// Standard errors on either side of the effective track's interval.
const INTERVAL_DEVIATIONS: f64 = 2.4;
/// Share by which the radius may be off that stands in the effective track.
const RADIUS_SHARE: f64 = 0.02;
/// Slowest turn of which a track is measured, radians per second.
const TURNING_MIN_RAD_S: f64 = 0.02;
/// Tracks are compared to this, metres.
const SAME_M: f64 = 1.0e-6;

/// The effective track, metres.
#[expect(clippy::struct_field_names, reason = "the unit belongs to every name")]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct EffectiveTrack {
    pub(super) mean_m: f64,
    pub(super) least_m: f64,
    pub(super) most_m: f64,
}

impl EffectiveTrack {
    /// From the parts of a turn on the spot; none where it turned too slowly or too little was
    /// said.
    pub(super) fn measured(
        blocks: &[TurnBlock],
        gyro_bias_rad_s: f64,
        radius_m: f64,
    ) -> Option<Self> {
        let tracks: Vec<f64> = blocks
            .iter()
            .map(|block| (block.difference_rad_s, block.turn_rad_s - gyro_bias_rad_s))
            .filter(|(_, turn_rad_s)| turn_rad_s.abs() > TURNING_MIN_RAD_S)
            .map(|(difference_rad_s, turn_rad_s)| radius_m * difference_rad_s / turn_rad_s)
            .collect();
        let count = f64::from(u32::try_from(tracks.len()).ok()?);
        (count >= 3.0).then_some(())?;
        let mean_m = tracks.iter().sum::<f64>() / count;
        let squares: f64 = tracks
            .iter()
            .map(|track_m| (track_m - mean_m).powi(2))
            .sum();
        let error_m = (squares / (count - 1.0) / count).sqrt();
        let half_m = INTERVAL_DEVIATIONS * error_m + RADIUS_SHARE * mean_m.abs();
        Some(Self {
            mean_m,
            least_m: mean_m - half_m,
            most_m: mean_m + half_m,
        })
    }

    /// Whether a robot of that track can turn so.
    pub(super) fn allows(&self, track_m: f64, wheelbase_m: f64) -> bool {
        let ratio = |effective_m: f64| (effective_m - track_m) * track_m / wheelbase_m.powi(2);
        ratio(self.most_m) >= *STIFFNESS_RATIO.start()
            && ratio(self.least_m) <= *STIFFNESS_RATIO.end()
    }

    /// The track of a robot that turns so with this ratio of stiffnesses, the wider of two; none
    /// where no track does.
    fn track_m(effective_m: f64, ratio: f64, wheelbase_m: f64) -> Option<f64> {
        let root = effective_m.powi(2) - 4.0 * ratio * wheelbase_m.powi(2);
        (root >= 0.0).then(|| 0.5 * (effective_m + root.sqrt()))
    }

    /// Tracks between which the robot's may lie.
    fn range_m(&self, wheelbase_m: f64) -> Option<(f64, f64)> {
        let most_m = Self::track_m(self.most_m, *STIFFNESS_RATIO.start(), wheelbase_m)?;
        // Below this the same turn may be of a track that is shorter than the wheelbase.
        let least = Self::track_m(self.least_m, *STIFFNESS_RATIO.end(), wheelbase_m);
        Some((least.unwrap_or(0.5 * self.least_m), most_m))
    }
}

/// How fast the wheels turned, over how fast they were commanded to.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Obeyed {
    turn: f64,
    forward: f64,
}

/// What was found of the command and of the track. The radius is the one by which the robot went
/// over ground, where that is known.
pub(super) fn findings(
    settings: &Ros2Settings,
    model: &RobotModel,
    turned: &Drove,
    forward: &Drove,
    radius_m: f64,
    gyro_bias_rad_s: f64,
) -> Vec<Finding> {
    let (Some(turning), Some(going)) = (turned.wheels, forward.wheels) else {
        return Vec::new();
    };
    let obeyed = Obeyed {
        turn: (turning.right_rad_s - turning.left_rad_s)
            / (turned.commanded.right_rad_s - turned.commanded.left_rad_s),
        forward: (going.left_rad_s + going.right_rad_s)
            / (forward.commanded.left_rad_s + forward.commanded.right_rad_s),
    };
    let effective = EffectiveTrack::measured(&turned.turn_blocks, gyro_bias_rad_s, radius_m);
    let mut findings = vec![of_radius_of_base(settings, obeyed)];
    findings.extend(of_tracks(settings, model, obeyed, effective));
    findings
}

/// The radius by which the base turns speeds into the wheels' speeds.
fn of_radius_of_base(settings: &Ros2Settings, obeyed: Obeyed) -> Finding {
    if (obeyed.forward - 1.0).abs() <= COMMAND_SHARE {
        return Finding::well(
            "command",
            "driving ahead the wheels turn as fast as they are commanded",
        );
    }
    let percent = 100.0 * obeyed.forward;
    if settings.command.kind == CommandKind::JointSpeeds {
        let text = format!("driving ahead the wheels turn at {percent:.0} % of their command");
        return Finding::wrong("command", "drive.ros2.joints.gear_ratio", text);
    }
    let base_radius_m = settings.command.base_radius_m / obeyed.forward;
    let text = format!(
        "driving ahead the wheels turn at {percent:.0} % of their command: the base itself divides by a \
         radius of about {base_radius_m:.3} m (or the gear is another)"
    );
    let value = format!("{base_radius_m:.3}");
    Finding::wrong("command", "drive.ros2.command.wheel_radius_m", text).with_line(
        "drive.ros2.command",
        "wheel_radius_m",
        value,
    )
}

/// The track of the base and that of the model.
fn of_tracks(
    settings: &Ros2Settings,
    model: &RobotModel,
    obeyed: Obeyed,
    effective: Option<EffectiveTrack>,
) -> Vec<Finding> {
    let (model_m, command_m) = (model.track_width_m(), settings.command.base_track_m);
    let wheelbase_m = model.wheelbase_m();
    let ratio = obeyed.turn / obeyed.forward;
    let is_obeyed = (ratio - 1.0).abs() <= COMMAND_SHARE;
    let base_m = command_m * ratio;
    let allows = |track_m: f64| effective.is_none_or(|it| it.allows(track_m, wheelbase_m));
    // Where the command's track is the model's, one wrong figure shows in both.
    let is_one_figure = (model_m - command_m).abs() < SAME_M;
    let is_models = !is_obeyed && is_one_figure && !allows(model_m) && allows(base_m);
    let mut findings = Vec::new();
    if is_obeyed {
        let text = "turning the wheels turn as fast as they are commanded";
        findings.push(Finding::well("turn command", text));
    } else if settings.command.kind == CommandKind::JointSpeeds {
        let text = format!(
            "turning the wheels turn at {:.0} % of their command",
            100.0 * obeyed.turn
        );
        findings.push(Finding::wrong(
            "turn command",
            "drive.ros2.command.topic",
            text,
        ));
    } else if !is_models {
        let text = format!(
            "turning the wheels turn at {:.0} % of their command, ahead at {:.0} %: the base itself \
             divides by a track of {base_m:.3} m (its wheel separation times its multiplier), the \
             configuration says {command_m:.3} m",
            100.0 * obeyed.turn,
            100.0 * obeyed.forward,
        );
        let wrong = Finding::wrong("turn command", "drive.ros2.command.track_width_m", text);
        findings.push(wrong.with_line(
            "drive.ros2.command",
            "track_width_m",
            format!("{base_m:.3}"),
        ));
    }
    let Some(effective) = effective else {
        findings.push(Finding::skipped(
            "track",
            "the effective track: the turn was not measured",
        ));
        return findings;
    };
    let shown = format!(
        "the robot turns as with an effective track of {:.3} m ({:.3} to {:.3} m), {:.2} of the model's \
         {model_m:.3} m",
        effective.mean_m,
        effective.least_m,
        effective.most_m,
        effective.mean_m / model_m,
    );
    let range = effective.range_m(wheelbase_m).map(|(least_m, most_m)| {
        format!(
            "with a wheelbase of {wheelbase_m:.3} m, tracks from {least_m:.3} to {most_m:.3} m turn so on some \
             ground"
        )
    });
    let range = range.unwrap_or_else(|| {
        format!("with a wheelbase of {wheelbase_m:.3} m no track turns so: measure both")
    });
    if allows(model_m) {
        findings.push(Finding::well("track", format!("{shown}; {range}")));
        return findings;
    }
    let fits_m = if allows(base_m) && (base_m - model_m).abs() > SAME_M {
        Some(base_m)
    } else {
        EffectiveTrack::track_m(effective.mean_m, 1.0, wheelbase_m)
    };
    let why = if effective.most_m < model_m {
        "less than the track itself, which no wheels can"
    } else if effective.mean_m < 2.0 * model_m {
        "nearer to it than tyres that scrub can"
    } else {
        "wider than tyres that scrub do"
    };
    let text = format!("{shown}: {why}; {range}. Measure the track and the wheelbase with a tape");
    let mut wrong = Finding::wrong("track", "model.track_width_m", text);
    if let Some(fits_m) = fits_m {
        wrong = wrong.with_line("model", "track_width_m", format!("{fits_m:.3}"));
    }
    findings.push(wrong);
    findings
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tread_control::measured::WheelSpeeds;
    use tread_control::robot::{RobotModel, RobotModelSpec};

    use super::*;
    use crate::drive::ros2::tests::settings;

    /// A robot as it is: four contacts whose forces are worked out one by one.
    #[derive(Debug, Clone, Copy)]
    struct Truth {
        track_m: f64,
        wheelbase_m: f64,
        radius_m: f64,
        /// Lateral over longitudinal stiffness of every contact.
        ratio: f64,
        /// The track by which the base turns a turn rate into its wheels' speeds.
        base_track_m: f64,
    }

    impl Truth {
        fn moment(&self, rim_m_s: f64, turn_rad_s: f64) -> f64 {
            let mut moment = 0.0;
            for (x_m, y_m) in [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)] {
                let (x_m, y_m) = (x_m * self.wheelbase_m, y_m * self.track_m);
                let rim_m_s = if y_m > 0.0 { -rim_m_s } else { rim_m_s };
                let (forward_m_s, left_m_s) = (-turn_rad_s * y_m - rim_m_s, turn_rad_s * x_m);
                let (force_x, force_y) = (-forward_m_s, -self.ratio * left_m_s);
                moment += x_m * force_y - y_m * force_x;
            }
            moment
        }

        /// The turn rate at which the moments balance, by halving.
        fn turn_rad_s(&self, rim_m_s: f64) -> f64 {
            let (mut slow, mut fast) = (0.0, 10.0);
            for _ in 0..80 {
                let middle = 0.5 * (slow + fast);
                if self.moment(rim_m_s, middle) > 0.0 {
                    slow = middle;
                } else {
                    fast = middle;
                }
            }
            0.5 * (slow + fast)
        }

        /// What both motions measure with that track in the configuration's command.
        fn drive(&self, command_m: f64, noise: f64, bias_rad_s: f64) -> [Drove; 2] {
            let commanded = 0.2 / self.radius_m;
            let wheels_rad_s = commanded * self.base_track_m / command_m;
            let turn_rad_s = self.turn_rad_s(wheels_rad_s * self.radius_m);
            let speeds = |left_rad_s, right_rad_s| WheelSpeeds {
                left_rad_s,
                right_rad_s,
            };
            let blocks = (0..8).map(|index| {
                let sign = if index % 2 == 0 { noise } else { -noise };
                TurnBlock {
                    difference_rad_s: 2.0 * wheels_rad_s,
                    turn_rad_s: turn_rad_s * (1.0 + sign) + bias_rad_s,
                }
            });
            [
                Drove {
                    commanded: speeds(-commanded, commanded),
                    wheels: Some(speeds(-wheels_rad_s, wheels_rad_s)),
                    turn_blocks: blocks.collect(),
                    ..Drove::default()
                },
                Drove {
                    commanded: speeds(commanded, commanded),
                    wheels: Some(speeds(commanded, commanded)),
                    ..Drove::default()
                },
            ]
        }

        fn examined(
            &self,
            model_m: f64,
            command_m: f64,
            noise: f64,
            bias_rad_s: f64,
        ) -> Vec<Finding> {
            let spec = RobotModelSpec {
                track_width_m: model_m,
                wheelbase_m: self.wheelbase_m,
                wheel_radius_m: self.radius_m,
                ..RobotModelSpec::from(RobotModel::yi2007())
            };
            let model = RobotModel::try_from(spec).unwrap();
            let mut settings = settings();
            settings.command.base_track_m = command_m;
            let [turned, forward] = self.drive(command_m, noise, bias_rad_s);
            findings(
                &settings,
                &model,
                &turned,
                &forward,
                self.radius_m,
                bias_rad_s,
            )
        }
    }

    fn keys(findings: &[Finding]) -> Vec<&'static str> {
        findings.iter().filter_map(|finding| finding.key).collect()
    }

    fn value(findings: &[Finding], table: &str) -> f64 {
        let mut lines = findings.iter().flat_map(|finding| &finding.lines);
        let line = lines.find(|line| line.table == table).unwrap();
        assert_eq!(line.key, "track_width_m");
        line.value.parse().unwrap()
    }

    const PAPER: Truth = Truth {
        track_m: 0.43,
        wheelbase_m: 0.28,
        radius_m: 0.08,
        ratio: 1.0,
        base_track_m: 0.43,
    };

    #[test]
    fn a_track_of_six_tenths_on_a_robot_of_0_43_m_is_the_models_and_nothing_else() {
        // The command takes the model's track where it is not configured itself.
        for command_m in [0.6, 0.43] {
            let found = PAPER.examined(0.6, command_m, 0.01, 0.0);
            assert_eq!(keys(&found), ["model.track_width_m"], "{found:#?}");
            let fits_m = value(&found, "model");
            assert!((fits_m - 0.43).abs() < 0.01, "{fits_m}");
        }
    }

    #[test]
    fn a_wrong_track_of_the_command_alone_is_named_with_the_one_that_is_right() {
        for command_m in [0.3, 0.36, 0.5, 0.6, 0.9] {
            let found = PAPER.examined(0.43, command_m, 0.01, 0.0);
            assert_eq!(keys(&found), ["drive.ros2.command.track_width_m"]);
            let right_m = value(&found, "drive.ros2.command");
            assert!((right_m - 0.43).abs() < 0.002, "{right_m}");
        }
    }

    #[test]
    fn a_base_with_a_multiplier_for_slip_is_named_by_its_own_track() {
        let with_multiplier = Truth {
            base_track_m: 0.612,
            ..PAPER
        };
        let found = with_multiplier.examined(0.43, 0.43, 0.01, 0.0);
        assert_eq!(keys(&found), ["drive.ros2.command.track_width_m"]);
        assert!((value(&found, "drive.ros2.command") - 0.612).abs() < 0.002);
    }

    #[test]
    fn a_track_that_another_ground_explains_is_not_named_and_the_range_is_said() {
        let found = PAPER.examined(0.5, 0.43, 0.01, 0.0);
        assert_eq!(keys(&found), Vec::<&str>::new());
        let track = found
            .iter()
            .find(|finding| finding.name == "track")
            .unwrap();
        assert!(
            track.text.contains("effective track of 0.61"),
            "{}",
            track.text
        );
        assert!(track.text.contains("tracks from"), "{}", track.text);
    }

    #[test]
    fn the_gyros_bias_is_taken_off_before_a_track_is_measured() {
        for bias_rad_s in [-0.2, 0.0, 0.2] {
            let found = PAPER.examined(0.43, 0.43, 0.01, bias_rad_s);
            assert_eq!(keys(&found), Vec::<&str>::new());
            assert!(found[2].text.contains("of 0.61"), "{}", found[2].text);
        }
    }

    proptest! {
        /// No robot whose configuration is right is blamed, on any ground within the range.
        #[test]
        fn a_right_track_is_never_blamed(
            track_m in 0.2_f64..1.2,
            wheelbase_share in 0.3_f64..1.2,
            ratio in 0.45_f64..2.4,
            multiplier in 0.8_f64..2.0,
            noise in 0.0_f64..0.03,
        ) {
            let truth = Truth {
                track_m,
                wheelbase_m: wheelbase_share * track_m,
                radius_m: 0.1,
                ratio,
                base_track_m: multiplier * track_m,
            };
            let found = truth.examined(track_m, truth.base_track_m, noise, 0.0);
            prop_assert_eq!(keys(&found), Vec::<&str>::new());
        }

        /// The interval holds what was put in.
        #[test]
        fn the_effective_track_lies_in_its_interval(
            track_m in 0.2_f64..1.2,
            wheelbase_share in 0.3_f64..1.2,
            ratio in 0.45_f64..2.4,
            noise in 0.0_f64..0.05,
        ) {
            let wheelbase_m = wheelbase_share * track_m;
            let truth = Truth { track_m, wheelbase_m, radius_m: 0.1, ratio, base_track_m: track_m };
            let [turned, _] = truth.drive(track_m, noise, 0.0);
            let found = EffectiveTrack::measured(&turned.turn_blocks, 0.0, 0.1).unwrap();
            let expected_m = track_m + ratio * wheelbase_m.powi(2) / track_m;
            prop_assert!(found.least_m < expected_m && expected_m < found.most_m, "{found:?} {expected_m}");
            prop_assert!(found.most_m - found.least_m < 0.25 * expected_m);
        }

        /// A track so wide that the robot turns within it is always named.
        #[test]
        fn a_track_wider_than_the_effective_one_is_always_named(
            track_m in 0.2_f64..1.2,
            wheelbase_share in 0.3_f64..1.0,
            ratio in 0.45_f64..2.4,
            excess in 1.06_f64..2.0,
        ) {
            let wheelbase_m = wheelbase_share * track_m;
            let truth = Truth { track_m, wheelbase_m, radius_m: 0.1, ratio, base_track_m: track_m };
            let effective_m = track_m + ratio * wheelbase_m.powi(2) / track_m;
            let found = truth.examined(excess * effective_m, track_m, 0.005, 0.0);
            prop_assert_eq!(keys(&found), ["model.track_width_m"]);
        }
    }
}
