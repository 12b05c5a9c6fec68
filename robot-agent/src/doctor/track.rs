//! Checks the turn command and the track width by a turn on the spot. Pure.
//!
//! Two quantities are measured. The wheel speeds for a commanded turn rate give the track width that
//! the base itself uses, exactly and on any ground. The effective track width
//! `W_eff = r·(ω_R − ω_L)/ψ̇` depends on the ground. By the balance of moments of four equal contacts
//! in a turn on the spot
//!
//! ```text
//! W_eff = W + α·L²/W,    α = lateral over longitudinal slip stiffness
//! ```
//!
//! Isotropic friction gives α = 1 for any θ; for tyres of real robots α is within
//! [`STIFFNESS_RATIO`]. A configured W is therefore impossible if `W_eff` is below it, and
//! implausible if α would be outside that range. A wrong W within the range that `W_eff` allows
//! cannot be distinguished from another ground: the finding states the range, for comparison with a
//! tape measure.

use super::drive_summary::{Drives, TurnBlock};
use super::finding::{Finding, Key};
use crate::drive::ros2::settings::{CommandKind, Ros2Settings};
use tread_control::robot::RobotModel;

/// Plausible range of α, the ratio of lateral to longitudinal slip stiffness.
pub(super) const STIFFNESS_RATIO: std::ops::RangeInclusive<f64> = 0.4..=2.5;
/// Maximum accepted relative difference of measured and commanded speeds.
pub(super) const COMMAND_SHARE: f64 = 0.06;
/// Half-width of the interval of the effective track width, in standard errors.
const INTERVAL_DEVIATIONS: f64 = 2.4;
/// Relative error of the wheel radius, which widens the interval of the effective track width.
const RADIUS_SHARE: f64 = 0.02;
/// Minimum turn rate for measuring a track width, radians per second.
const TURNING_MIN_RAD_S: f64 = 0.02;
/// Difference below which track widths count as equal, metres.
const SAME_M: f64 = 1.0e-6;

/// Values with which wheel speeds and turn rates are converted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Calibration {
    /// Wheel radius in metres: measured over ground if possible, else that of the model.
    pub(super) radius_m: f64,
    /// Mean of the gyro while the robot was stopped, radians per second.
    pub(super) gyro_bias_rad_s: f64,
}

/// Geometry of a robot's wheels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Geometry {
    /// Track width, metres.
    pub(super) track_m: f64,
    /// Wheelbase, metres.
    pub(super) wheelbase_m: f64,
}

/// Effective track width with its interval, metres.
#[expect(clippy::struct_field_names, reason = "the unit belongs to every name")]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct EffectiveTrack {
    pub(super) mean_m: f64,
    pub(super) least_m: f64,
    pub(super) most_m: f64,
}

impl EffectiveTrack {
    /// Measures the effective track width in the blocks of a turn on the spot; `None` if the robot
    /// turned too slowly or fewer than three blocks were measured.
    pub(super) fn measured(blocks: &[TurnBlock], calibration: Calibration) -> Option<Self> {
        let Calibration {
            radius_m,
            gyro_bias_rad_s,
        } = calibration;
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

    /// Returns whether a robot with this geometry can have this effective track width.
    pub(super) fn allows(&self, geometry: Geometry) -> bool {
        let Geometry {
            track_m,
            wheelbase_m,
        } = geometry;
        let ratio = |effective_m: f64| (effective_m - track_m) * track_m / wheelbase_m.powi(2);
        ratio(self.most_m) >= *STIFFNESS_RATIO.start()
            && ratio(self.least_m) <= *STIFFNESS_RATIO.end()
    }

    /// Returns the smallest and the largest possible track width, metres; `None` if there is none.
    fn range_m(&self, wheelbase_m: f64) -> Option<(f64, f64)> {
        let most_m = Wheels {
            wheelbase_m,
            stiffness_ratio: *STIFFNESS_RATIO.start(),
        }
        .track_m(self.most_m)?;
        // Without a solution, use the bound of tracks shorter than the wheelbase.
        let least = Wheels {
            wheelbase_m,
            stiffness_ratio: *STIFFNESS_RATIO.end(),
        }
        .track_m(self.least_m);
        Some((least.unwrap_or(0.5 * self.least_m), most_m))
    }
}

/// Wheelbase and stiffness ratio α of the wheels, which relate track and effective track.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Wheels {
    wheelbase_m: f64,
    stiffness_ratio: f64,
}

impl Wheels {
    /// Returns the track width for an effective track width, the larger one of two solutions, metres;
    /// `None` if there is none.
    fn track_m(self, effective_m: f64) -> Option<f64> {
        let root = effective_m.powi(2) - 4.0 * self.stiffness_ratio * self.wheelbase_m.powi(2);
        (root >= 0.0).then(|| 0.5 * (effective_m + root.sqrt()))
    }
}

/// Ratios of measured to commanded wheel speeds, in the turn and in the drive forward.
#[derive(Debug, Clone, Copy, PartialEq)]
struct CommandRatios {
    turn: f64,
    forward: f64,
}

/// Returns the findings on the command and on the track width.
pub(super) fn findings(
    settings: &Ros2Settings,
    model: &RobotModel,
    Drives { turned, forward }: &Drives,
    calibration: Calibration,
) -> Vec<Finding> {
    let (Some(turning), Some(driving)) = (turned.wheels, forward.wheels) else {
        return Vec::new();
    };
    let obeyed = CommandRatios {
        turn: (turning.right_rad_s - turning.left_rad_s)
            / (turned.commanded.right_rad_s - turned.commanded.left_rad_s),
        forward: (driving.left_rad_s + driving.right_rad_s)
            / (forward.commanded.left_rad_s + forward.commanded.right_rad_s),
    };
    let effective = EffectiveTrack::measured(&turned.turn_blocks, calibration);
    let mut findings = vec![of_radius_of_base(settings, obeyed)];
    findings.extend(of_tracks(settings, model, obeyed, effective));
    findings
}

/// Returns the finding on the wheel radius by which the base converts commands to wheel speeds.
fn of_radius_of_base(settings: &Ros2Settings, obeyed: CommandRatios) -> Finding {
    if (obeyed.forward - 1.0).abs() <= COMMAND_SHARE {
        return Finding::on("command")
            .ok("driving forward, the wheels turn as fast as they are commanded");
    }
    let percent = 100.0 * obeyed.forward;
    if settings.command.kind == CommandKind::JointSpeeds {
        let text = format!("driving forward, the wheels turn at {percent:.0} % of their command");
        return Finding::on("command").wrong(Key("drive.ros2.joints.gear_ratio"), text);
    }
    let base_radius_m = settings.command.base_radius_m / obeyed.forward;
    let text = format!(
        "driving forward, the wheels turn at {percent:.0} % of their command: the base itself divides by a \
         radius of about {base_radius_m:.3} m (or the gear is another)"
    );
    let value = format!("{base_radius_m:.3}");
    Finding::on("command")
        .wrong(Key("drive.ros2.command.wheel_radius_m"), text)
        .with_line(Key("drive.ros2.command.wheel_radius_m"), value)
}

/// Returns the findings on the track widths of the base and of the model.
fn of_tracks(
    settings: &Ros2Settings,
    model: &RobotModel,
    obeyed: CommandRatios,
    effective: Option<EffectiveTrack>,
) -> Vec<Finding> {
    let (model_m, command_m) = (model.track_width_m(), settings.command.base_track_m);
    let wheelbase_m = model.wheelbase_m();
    let ratio = obeyed.turn / obeyed.forward;
    let is_obeyed = (ratio - 1.0).abs() <= COMMAND_SHARE;
    let base_m = command_m * ratio;
    let allows = |track_m: f64| {
        let geometry = Geometry {
            track_m,
            wheelbase_m,
        };
        effective.is_none_or(|it| it.allows(geometry))
    };
    // If the command uses the model's track width, one wrong value causes both findings.
    let is_one_figure = (model_m - command_m).abs() < SAME_M;
    let is_models = !is_obeyed && is_one_figure && !allows(model_m) && allows(base_m);
    let mut findings = Vec::new();
    if is_obeyed {
        let text = "in a turn the wheels turn as fast as they are commanded";
        findings.push(Finding::on("turn command").ok(text));
    } else if settings.command.kind == CommandKind::JointSpeeds {
        let text = format!(
            "in a turn the wheels turn at {:.0} % of their command",
            100.0 * obeyed.turn
        );
        findings.push(Finding::on("turn command").wrong(Key("drive.ros2.command.topic"), text));
    } else if !is_models {
        let text = format!(
            "in a turn the wheels turn at {:.0} % of their command, driving forward at {:.0} %: the base itself \
             divides by a track of {base_m:.3} m (its wheel separation times its multiplier), the \
             configuration says {command_m:.3} m",
            100.0 * obeyed.turn,
            100.0 * obeyed.forward,
        );
        let wrong =
            Finding::on("turn command").wrong(Key("drive.ros2.command.track_width_m"), text);
        findings.push(wrong.with_line(
            Key("drive.ros2.command.track_width_m"),
            format!("{base_m:.3}"),
        ));
    }
    let Some(effective) = effective else {
        findings
            .push(Finding::on("track").skipped("the effective track: the turn was not measured"));
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
        findings.push(Finding::on("track").ok(format!("{shown}; {range}")));
        return findings;
    }
    let fits_m = if allows(base_m) && (base_m - model_m).abs() > SAME_M {
        Some(base_m)
    } else {
        Wheels {
            wheelbase_m,
            stiffness_ratio: 1.0,
        }
        .track_m(effective.mean_m)
    };
    let why = if effective.most_m < model_m {
        "less than the track itself, which no wheels can"
    } else if effective.mean_m < 2.0 * model_m {
        "nearer to it than tyres that scrub can"
    } else {
        "wider than tyres that scrub do"
    };
    let text = format!("{shown}: {why}; {range}. Measure the track and the wheelbase with a tape");
    let mut wrong = Finding::on("track").wrong(Key("model.track_width_m"), text);
    if let Some(fits_m) = fits_m {
        wrong = wrong.with_line(Key("model.track_width_m"), format!("{fits_m:.3}"));
    }
    findings.push(wrong);
    findings
}

#[cfg(test)]
mod tests;
