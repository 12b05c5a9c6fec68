//! Checks `[estimation]` of `robot.toml`: the prior of the robot's and the tyres' parameters.

use std::ops::RangeInclusive;

use tread_control::estimation::{EstimatorPrior, ModelUncertainty, TyrePrior};

use super::file::EstimationFile;
use super::{ConfigError, DriveConfig};

/// Permitted relative standard deviation of mass and inertia.
const RATIO_RANGE: RangeInclusive<f64> = 0.0..=1.0;
/// Permitted curvature of tyres and standard deviation of it, per friction coefficient.
const CURVATURE_RANGE: RangeInclusive<f64> = 0.0..=10.0;
/// Permitted relaxation length of tyres and standard deviation of it, metres.
const RELAXATION_RANGE_M: RangeInclusive<f64> = 0.0..=1.0;
/// Permitted friction coefficient up to which the tyre curvature is valid.
const MU_RANGE: RangeInclusive<f64> = 0.05..=10.0;

/// Returns the default prior of a base.
pub(super) fn default_of(drive: &DriveConfig) -> EstimatorPrior {
    match drive {
        // It behaves exactly as its model.
        DriveConfig::Simulated(_) => EstimatorPrior::exact(),
        DriveConfig::Ros2(_) => EstimatorPrior::default(),
    }
}

/// Returns the prior, with `default` for missing keys.
///
/// # Errors
/// [`ConfigError::OutOfRange`] for a value that is not permitted.
pub(super) fn checked(
    file: EstimationFile,
    default: EstimatorPrior,
) -> Result<EstimatorPrior, ConfigError> {
    let within = |key, value: Option<f64>, default: f64, range: RangeInclusive<f64>| {
        let value = value.unwrap_or(default);
        if range.contains(&value) {
            return Ok(value);
        }
        let problem = format!("{value} is not within {} to {}", range.start(), range.end());
        Err(ConfigError::OutOfRange { key, problem })
    };
    let EstimatorPrior { tyres, model } = default;
    let mass = "estimation.mass_std_dev_ratio";
    let inertia = "estimation.inertia_std_dev_ratio";
    let curvature = "estimation.tyre_curvature";
    let std_dev = "estimation.tyre_curvature_std_dev";
    Ok(EstimatorPrior {
        tyres: TyrePrior {
            curvature: within(
                curvature,
                file.tyre_curvature,
                tyres.curvature,
                CURVATURE_RANGE,
            )?,
            curvature_std_dev: within(
                std_dev,
                file.tyre_curvature_std_dev,
                tyres.curvature_std_dev,
                CURVATURE_RANGE,
            )?,
            mu_max: file
                .tyre_mu_max
                .map(|mu_max| within("estimation.tyre_mu_max", Some(mu_max), mu_max, MU_RANGE))
                .transpose()?
                .or(tyres.mu_max),
            relaxation_m: within(
                "estimation.tyre_relaxation_m",
                file.tyre_relaxation_m,
                tyres.relaxation_m,
                RELAXATION_RANGE_M,
            )?,
            relaxation_std_dev_m: within(
                "estimation.tyre_relaxation_std_dev_m",
                file.tyre_relaxation_std_dev_m,
                tyres.relaxation_std_dev_m,
                RELAXATION_RANGE_M,
            )?,
            rotor_ratio: within(
                "estimation.rotor_ratio",
                file.rotor_ratio,
                tyres.rotor_ratio,
                RATIO_RANGE,
            )?,
            rotor_std_dev_ratio: within(
                "estimation.rotor_std_dev_ratio",
                file.rotor_std_dev_ratio,
                tyres.rotor_std_dev_ratio,
                RATIO_RANGE,
            )?,
            load_difference_std_dev: within(
                "estimation.load_difference_std_dev",
                file.load_difference_std_dev,
                tyres.load_difference_std_dev,
                RATIO_RANGE,
            )?,
            ..tyres
        },
        model: ModelUncertainty {
            mass_ratio: within(mass, file.mass_std_dev_ratio, model.mass_ratio, RATIO_RANGE)?,
            payload_ratio: within(
                "estimation.payload_ratio",
                file.payload_ratio,
                model.payload_ratio,
                RATIO_RANGE,
            )?,
            inertia_ratio: within(
                inertia,
                file.inertia_std_dev_ratio,
                model.inertia_ratio,
                RATIO_RANGE,
            )?,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_said_is_that_of_a_robot_known_by_its_data_sheet_and_bounds_are_checked() {
        let default = checked(EstimationFile::default(), EstimatorPrior::default()).unwrap();
        assert_eq!(default, EstimatorPrior::default());
        let weighed = EstimationFile {
            mass_std_dev_ratio: Some(0.0),
            tyre_mu_max: Some(0.7),
            ..EstimationFile::default()
        };
        let prior = checked(weighed, EstimatorPrior::default()).unwrap();
        assert_eq!(
            (prior.model.mass_ratio, prior.tyres.mu_max),
            (0.0, Some(0.7))
        );
        for (file, key) in [
            (
                EstimationFile {
                    inertia_std_dev_ratio: Some(f64::NAN),
                    ..weighed
                },
                "estimation.inertia_std_dev_ratio",
            ),
            (
                EstimationFile {
                    tyre_curvature: Some(-0.1),
                    ..weighed
                },
                "estimation.tyre_curvature",
            ),
            (
                EstimationFile {
                    tyre_mu_max: Some(0.0),
                    ..weighed
                },
                "estimation.tyre_mu_max",
            ),
        ] {
            let refused = checked(file, EstimatorPrior::default())
                .unwrap_err()
                .to_string();
            assert!(refused.contains(key), "{refused}");
        }
    }
}
