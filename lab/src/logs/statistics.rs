//! Consistency of disjoint passes, and the effective track.

use nalgebra::{Matrix3, Vector3};
use serde::Serialize;
use tread_api::friction::NORMAL_95;
use tread_control::estimation::{SensorNoise, ThetaMeasurement};
use tread_control::robot::RobotModel;

use super::timeline::LoopInput;

/// Length of the bins over which turns are averaged, seconds.
const BIN_S: f64 = 1.0;
/// Share of a bin that must be covered by samples.
const COVERED_SHARE: f64 = 0.8;
/// Longest interval of samples within a bin, seconds.
const INTERVAL_MAX_S: f64 = 0.35;
/// Slowest turn that is used, radians per second.
const TURN_MIN_RAD_S: f64 = 0.1;
/// Largest difference of the turn rate in both halves of a steady bin, as a share of it.
const STEADY_SHARE: f64 = 0.15;
/// Fewest bins of an effective track.
const BINS_MIN: usize = 5;
/// Smallest standard deviation of a bin's wheel difference over the track, radians per second: no
/// scatter is believed to be less.
const SCATTER_MIN_RAD_S: f64 = 2.0e-3;

/// Two disjoint passes, compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pair {
    /// Number of one pass.
    pub first: usize,
    /// Number of the other.
    pub second: usize,
    /// Square of the difference of θ over its variance; 1 is expected.
    pub chi_square: f64,
}

/// Returns the variance of the difference of θ of two passes of one robot on one ground. Errors
/// that both share cancel, as far as they are equal in both.
fn variance_of_difference(one: &ThetaMeasurement, other: &ThetaMeasurement) -> f64 {
    one.own_std_dev.powi(2)
        + other.own_std_dev.powi(2)
        + (one.common.robot - other.common.robot).powi(2)
        + (one.common.tyres - other.common.tyres).powi(2)
}

/// Compares all pairs of passes that have an estimate; each comes with its number.
pub fn pairs(passes: &[(usize, ThetaMeasurement)]) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for (index, (first, one)) in passes.iter().enumerate() {
        for (second, other) in &passes[index + 1..] {
            let difference = one.theta - other.theta;
            let variance = variance_of_difference(one, other).max(f64::MIN_POSITIVE);
            pairs.push(Pair {
                first: *first,
                second: *second,
                chi_square: difference * difference / variance,
            });
        }
    }
    pairs
}

/// Returns the mean χ² of the pairs, of which 1 is expected; `None` without pairs.
#[expect(clippy::cast_precision_loss, reason = "a number of pairs")]
pub fn mean_chi_square(pairs: &[Pair]) -> Option<f64> {
    let sum: f64 = pairs.iter().map(|pair| pair.chi_square).sum();
    (!pairs.is_empty()).then(|| sum / pairs.len() as f64)
}

/// Effective track width over the geometric one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EffectiveTrack {
    /// `W_eff/W`.
    pub ratio: f64,
    /// Its standard deviation: scatter of the bins, and what is unknown of radii and gyro.
    pub std_dev: f64,
    /// Lower end of the 95 % interval.
    pub low_95: f64,
    /// Upper end of the 95 % interval.
    pub high_95: f64,
    /// Bins of steady turns to the left.
    pub left_bins: usize,
    /// Bins of steady turns to the right.
    pub right_bins: usize,
}

/// A steady turn.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Steady {
    /// What multiplies `W_eff/W`, the gyro's offset and the difference of the radii: the turn rate,
    /// 1, and the mean rim speed over the track.
    regressors: Vector3<f64>,
    /// Difference of the rim speeds over the track, radians per second.
    difference_rad_s: f64,
}

/// Sums of a bin's halves.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    time_s: [f64; 2],
    turn_rad: [f64; 2],
    difference_m: f64,
    forward_m: f64,
}

impl Sums {
    fn steady(&self, track_m: f64) -> Option<Steady> {
        let [early_s, late_s] = self.time_s;
        let time_s = early_s + late_s;
        let least_s = 0.5 * COVERED_SHARE * BIN_S;
        if early_s < least_s || late_s < least_s {
            return None;
        }
        let turn_rad_s = (self.turn_rad[0] + self.turn_rad[1]) / time_s;
        let change_rad_s = (self.turn_rad[1] / late_s - self.turn_rad[0] / early_s).abs();
        let is_steady =
            turn_rad_s.abs() >= TURN_MIN_RAD_S && change_rad_s <= STEADY_SHARE * turn_rad_s.abs();
        is_steady.then(|| Steady {
            regressors: Vector3::new(turn_rad_s, 1.0, self.forward_m / time_s / track_m),
            difference_rad_s: self.difference_m / time_s / track_m,
        })
    }
}

/// Returns the means of all steady turns. A sample's values count for the time since the sample
/// before.
fn steady_turns(fed: &[LoopInput], model: &RobotModel) -> Vec<Steady> {
    let (radius_m, track_m) = (model.wheel_radius_m(), model.track_width_m());
    let mut found = Vec::new();
    let (mut sums, mut bin) = (Sums::default(), None);
    let mut last_s: Option<f64> = None;
    for one in fed {
        let sample = &one.sample;
        let (Some(wheels), Some(turn_rad_s)) = (sample.wheel_speeds, sample.yaw_rate_rad_s) else {
            continue;
        };
        let at_s = sample.at.as_secs_f64();
        let dt_s = at_s - last_s.replace(at_s).unwrap_or(at_s);
        let number = (at_s / BIN_S).floor();
        if bin.replace(number.to_bits()) != Some(number.to_bits()) {
            found.extend(std::mem::take(&mut sums).steady(track_m));
        }
        if dt_s <= 0.0 || dt_s > INTERVAL_MAX_S {
            continue;
        }
        let half = usize::from(at_s - number * BIN_S >= 0.5 * BIN_S);
        sums.time_s[half] += dt_s;
        sums.turn_rad[half] += turn_rad_s * dt_s;
        sums.difference_m += radius_m * (wheels.right_rad_s - wheels.left_rad_s) * dt_s;
        sums.forward_m += 0.5 * radius_m * (wheels.right_rad_s + wheels.left_rad_s) * dt_s;
    }
    found.extend(sums.steady(track_m));
    found
}

/// Finds the effective track in steady turns: `r(ω_R − ω_L)/W = (W_eff/W) ω + b + δ v/W` by least
/// squares, with the gyro's offset b and the difference δ of the radii as far as turns to both sides
/// tell them. `None` with fewer than five steady turns of a second.
#[expect(clippy::cast_precision_loss, reason = "a number of bins")]
pub fn effective_track(fed: &[LoopInput], model: &RobotModel) -> Option<EffectiveTrack> {
    let turns = steady_turns(fed, model);
    if turns.len() < BINS_MIN {
        return None;
    }
    let noise = SensorNoise::default();
    let nominal = model.effective_track_ratio();
    let mut scatter = SCATTER_MIN_RAD_S;
    let mut solved = None;
    // The scatter weighs data against what is known beforehand, and follows from the residuals.
    for _ in 0..3 {
        let mut information = Matrix3::from_diagonal(&Vector3::new(
            0.0,
            (noise.gyro_offset_rad_s * nominal).powi(-2),
            noise.radius_ratio.powi(-2),
        ));
        let mut weighted = Vector3::zeros();
        let weight = scatter.powi(-2);
        for turn in &turns {
            let row = turn.regressors;
            information += weight * row * row.transpose();
            weighted += weight * row * turn.difference_rad_s;
        }
        let covariance = information.try_inverse()?;
        let solution = covariance * weighted;
        let squares = turns.iter().map(|turn| {
            let residual = turn.difference_rad_s - turn.regressors.dot(&solution);
            residual * residual
        });
        let freedom = (turns.len() - 1) as f64;
        scatter = (squares.sum::<f64>() / freedom)
            .sqrt()
            .max(SCATTER_MIN_RAD_S);
        solved = Some((solution[0], covariance[(0, 0)]));
    }
    let (ratio, variance) = solved?;
    // The mean radius scales what wheels say of all turns alike.
    let std_dev = variance.sqrt().hypot(noise.radius_ratio * ratio);
    let left_bins = turns.iter().filter(|turn| turn.regressors[0] > 0.0).count();
    Some(EffectiveTrack {
        ratio,
        std_dev,
        low_95: ratio - NORMAL_95 * std_dev,
        high_95: ratio + NORMAL_95 * std_dev,
        left_bins,
        right_bins: turns.len() - left_bins,
    })
}

#[cfg(test)]
mod tests;
