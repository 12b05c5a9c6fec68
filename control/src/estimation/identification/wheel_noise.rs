//! White noise of the measured wheel speeds.
//!
//! The model is driven by the measured wheel speeds, and their noise looks like slip: the output
//! has an error e whose slope ∂e/∂p is correlated with it, which biases the estimates as in any
//! regression with errors in the variables (Söderström, Errors-in-Variables Methods in System
//! Identification, 2018, ch. 3). This module gives independent noise of about the same density,
//! from which the module `hypothesis` learns the bias and subtracts it (simulation extrapolation:
//! Cook and Stefanski, Journal of the American Statistical Association 89, 1994).
//!
//! The density is estimated from wheel speeds alone, by the power of two filters: third differences
//! of sums of two values, around 10 Hz, and fourth differences, at higher frequencies. A smooth
//! motion passes neither. Speeds that are differences of encoder counts have noise that cancels in
//! sums: its spectrum rises as `x = 4 sin²(ω/2)`, of which the filters see the means 1.75 and 3.6,
//! while white noise has the same power in both. So the two are distinguished by extrapolation to x
//! = 0. Wheels that truly move at 10 Hz, as behind noisy positions, count as noise here; the
//! accelerometer measures such motion too, by which the module `fast_changes` distinguishes it.

use super::recent::RecentBlocks;

/// The filters, and the squares of their norms.
const MIDDLE: [f64; 8] = [1.0, 1.0, -3.0, -3.0, 3.0, 3.0, -1.0, -1.0];
const HIGH: [f64; 5] = [1.0, -4.0, 6.0, -4.0, 1.0];
const MIDDLE_SQUARE: f64 = 40.0;
const HIGH_SQUARE: f64 = 70.0;
/// Mean of `4 sin²(ω/2)` over the power of each filter.
const MIDDLE_X: f64 = 1.75;
const HIGH_X: f64 = 3.6;
/// Minimum time over which wheel speeds are averaged before differences are taken, seconds. Noise
/// matters below 25 Hz.
const MEAN_S: f64 = 0.02;
/// Minimum number of blocks before the noise is taken into account.
const BLOCKS_MIN: usize = 4;
/// Standard errors by which the density must be above 0 to be more than chance.
const SIGNIFICANT: f64 = 4.0;
/// Minimum time of one sample for which noise is given, seconds.
const SAMPLE_MIN_S: f64 = 1.0e-3;

/// Estimate of the density of the noise of the wheel speeds.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct WheelNoise {
    sides: [SpeedMeans; 2],
    sum_rad: [f64; 2],
    time_s: f64,
    /// Sum over the open block, (rad/s)²·s, and the number of values in it.
    open: (f64, f64),
    /// The blocks' densities, (rad/s)²·s.
    blocks: RecentBlocks,
    added: AddedNoise,
    /// Whether [`WheelNoise::added_noise`] gives noise.
    pub(super) is_noise_added: bool,
}

/// The newest means of one wheel's speed, the newest last.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct SpeedMeans {
    means_rad_s: [f64; MIDDLE.len()],
    known: usize,
}

impl SpeedMeans {
    /// Adds a mean speed. Returns an estimate of the variance of white noise, (rad/s)², negative as
    /// often as not if there is none; None before enough means.
    fn add(&mut self, mean_rad_s: f64) -> Option<f64> {
        self.means_rad_s.rotate_left(1);
        self.means_rad_s[MIDDLE.len() - 1] = mean_rad_s;
        self.known = self.known.saturating_add(1);
        if self.known < MIDDLE.len() {
            return None;
        }
        let filtered = |filter: &[f64]| {
            let newest = &self.means_rad_s[MIDDLE.len() - filter.len()..];
            let terms = filter.iter().zip(newest);
            terms.map(|(c, mean)| c * mean).sum::<f64>()
        };
        let middle = filtered(&MIDDLE).powi(2) / MIDDLE_SQUARE;
        let high = filtered(&HIGH).powi(2) / HIGH_SQUARE;
        Some((HIGH_X * middle - MIDDLE_X * high) / (HIGH_X - MIDDLE_X))
    }
}

/// Independent noise that is added to the wheel speeds: values of either sign.
#[derive(Debug, Clone, Copy, PartialEq)]
struct AddedNoise {
    /// State of a xorshift generator (Marsaglia 2003), never 0.
    bits: u32,
    /// At the samples before, now and after, left and right, radians per second.
    before_rad_s: [f64; 2],
    now_rad_s: [f64; 2],
    after_rad_s: [f64; 2],
}

impl AddedNoise {
    fn sign(&mut self) -> f64 {
        self.bits ^= self.bits << 13;
        self.bits ^= self.bits >> 17;
        self.bits ^= self.bits << 5;
        if self.bits & 0x8000 == 0 { 1.0 } else { -1.0 }
    }

    fn next(&mut self, std_dev_rad_s: f64) {
        self.before_rad_s = self.now_rad_s;
        self.now_rad_s = self.after_rad_s;
        self.after_rad_s = [(); 2].map(|()| std_dev_rad_s * self.sign());
    }
}

impl WheelNoise {
    /// Creates the estimate without noise.
    pub(super) fn new() -> Self {
        Self {
            sides: [SpeedMeans::default(); 2],
            sum_rad: [0.0; 2],
            time_s: 0.0,
            open: (0.0, 0.0),
            blocks: RecentBlocks::new(),
            added: AddedNoise {
                bits: 0x9e37_79b9,
                before_rad_s: [0.0; 2],
                now_rad_s: [0.0; 2],
                after_rad_s: [0.0; 2],
            },
            is_noise_added: false,
        }
    }

    /// Begins anew after a gap; the density stays.
    pub(super) fn interrupt(&mut self) {
        self.sides = [SpeedMeans::default(); 2];
        self.sum_rad = [0.0; 2];
        self.time_s = 0.0;
        self.open = (0.0, 0.0);
    }

    /// Adds a sample, whose mean speeds are those of `time_s` seconds.
    pub(super) fn add(&mut self, wheels_rad_s: [f64; 2], time_s: f64) {
        let density = self.density().unwrap_or(0.0);
        self.added.next((density / time_s.max(SAMPLE_MIN_S)).sqrt());
        self.time_s += time_s;
        for (sum_rad, wheel_rad_s) in self.sum_rad.iter_mut().zip(wheels_rad_s) {
            *sum_rad += wheel_rad_s * time_s;
        }
        if self.time_s < MEAN_S - 1.0e-3 {
            return;
        }
        let time_s = std::mem::take(&mut self.time_s);
        for (side, sum_rad) in self.sides.iter_mut().zip(&mut self.sum_rad) {
            let mean_rad_s = std::mem::take(sum_rad) / time_s;
            if let Some(variance) = side.add(mean_rad_s) {
                self.open.0 += variance * time_s;
                self.open.1 += 1.0;
            }
        }
    }

    /// Ends a block; one in which the robot stood is not used.
    pub(super) fn end_block(&mut self, is_moving: bool) {
        let (sum, count) = std::mem::take(&mut self.open);
        if !is_moving || count < 1.0 {
            return;
        }
        self.blocks.add(sum / count);
    }

    /// Returns the power density of the noise, (rad/s)²·s, if all fast changes are noise; None
    /// before it is known, and if the speeds have no such noise.
    fn density(&self) -> Option<f64> {
        let known = self
            .blocks
            .median()
            .filter(|_| self.blocks.count() >= BLOCKS_MIN);
        known.filter(|density| *density > 0.0)
    }

    /// Returns that density if it is more than chance: of smooth speeds and of differences of
    /// encoder counts, whose noise cancels in sums, it is as often below 0 as above.
    pub(super) fn significant_density(&self) -> Option<f64> {
        let least = SIGNIFICANT * self.blocks.std_error();
        self.density().filter(|density| *density > least)
    }

    /// Returns noise of the sample before the newest, left and right: of its wheel speeds, radians
    /// per second, and of their central difference over `apart_s` seconds, radians per second
    /// squared. None without noise.
    pub(super) fn added_noise(&self, apart_s: f64) -> Option<([f64; 2], [f64; 2])> {
        let (before, after) = (self.added.before_rad_s, self.added.after_rad_s);
        self.density().filter(|_| self.is_noise_added).map(|_| {
            let rise = |side: usize| (after[side] - before[side]) / apart_s;
            (self.added.now_rad_s, [rise(0), rise(1)])
        })
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Feeds forty seconds of a drive with turns, as a sensor gives its speeds.
    fn fed(period_s: f64, mut sensor: impl FnMut(f64, f64) -> f64) -> WheelNoise {
        let mut noise = WheelNoise::new();
        let (mut time_s, mut block_s) = (0.0, 0.0);
        while time_s < 40.0 {
            let speed = |time_s: f64| 6.0 + 2.0 * (0.7 * time_s).sin() + 0.8 * (2.3 * time_s).cos();
            let speeds = [
                sensor(time_s, speed(time_s)),
                sensor(time_s, speed(time_s + 3.0)),
            ];
            noise.add(speeds, period_s);
            (time_s, block_s) = (time_s + period_s, block_s + period_s);
            if block_s > 0.999 {
                noise.end_block(true);
                block_s = 0.0;
            }
        }
        noise
    }

    #[test]
    fn the_density_of_white_noise_is_measured_at_any_rate() {
        for (seed, period_s) in (0..).zip([0.005, 0.01, 0.02, 0.04]) {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let std_dev = 0.02;
            let mut of_12 = || (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>();
            let noise = fed(period_s, |_, speed| speed + std_dev * of_12());
            let density = noise.density().expect("noise is there");
            let ratio = density / (std_dev * std_dev * period_s);
            assert!((0.75..1.3).contains(&ratio), "{period_s} s: {ratio}");
        }
    }

    #[test]
    fn differences_of_encoder_counts_and_smooth_speeds_have_next_to_no_noise() {
        // Of white noise of one tenth of a count.
        for (period_s, counts_per_turn) in [(0.005, 80_000.0), (0.01, 4_096.0), (0.02, 1_000.0)] {
            let per_rad = counts_per_turn / std::f64::consts::TAU;
            let mut sides = [(0.0_f64, 0.0_f64); 2];
            let mut next = 0;
            let noise = fed(period_s, |_, speed| {
                let (turned, counted) = &mut sides[next];
                next = 1 - next;
                *turned += speed * period_s;
                let before = std::mem::replace(counted, (*turned * per_rad).floor());
                (*counted - before) / per_rad / period_s
            });
            let count_rad_s = 1.0 / per_rad / period_s;
            let most = (0.1 * count_rad_s).powi(2) * period_s;
            let density = noise.density().unwrap_or(0.0);
            assert!(density < most, "{counts_per_turn}: {density}, {most}");
        }
        let smooth = fed(0.01, |_, speed| speed).density().unwrap_or(0.0);
        assert!(smooth < 1.0e-3_f64.powi(2) * 0.01, "{smooth}");
    }

    #[test]
    fn the_added_noise_has_the_same_density_and_no_mean() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let mut noise = fed(0.01, |_, speed| {
            speed + 0.1 * (random.random::<f64>() - 0.5)
        });
        noise.is_noise_added = true;
        let density = noise.density().expect("noise is there");
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..10_000 {
            noise.add([6.0; 2], 0.01);
            let ([left, right], _) = noise.added_noise(0.02).expect("noise is there");
            sum += left + right;
            square += left * left + right * right;
        }
        let variance = density / 0.01;
        assert!((square / 20_000.0 / variance - 1.0).abs() < 0.02);
        assert!(sum.abs() < 4.0 * (20_000.0 * variance).sqrt());
    }
}
