//! Fuses friction measurements of many robots and times to one estimate per piece of ground. Pure.
//!
//! The server stores additive statistics ([`sums`]) in fixed point ([`fixed`]). Estimates are
//! computed from them for each request ([`fuse()`]), with the age of the measurements at that time.
//! Ageing therefore changes no stored value, and estimates do not depend on the order or number of
//! uploads. [`index`] holds the statistics in memory.

mod epoch_measurement;
pub mod fuse;
pub mod index;
mod joined;
pub mod raster;
pub mod traction_limit;
pub mod weights;

use jiff::Timestamp;
use tread_api::friction::{FrictionBounds, FusedFriction, NORMAL_90, ValueEstimate};
pub use tread_store::friction::{Epoch, Horizons, Sums, epoch_h, epoch_h_at, epochs, fixed, sums};

pub use self::epoch_measurement::{EpochMeasurement, Estimate, Ground};
pub use self::fuse::{Fused, Fuser, fuse};
pub use self::raster::Raster;

impl Fused {
    /// Converts the estimate to its API type, with its age at `now_us`, microseconds since 1970.
    pub fn to_api(self, now_us: i64) -> FusedFriction {
        let theta = self.theta;
        let (theta_low_95, theta_high_95) = theta.interval_95();
        let lower = theta.quantile(-NORMAL_90).max(0.0);
        let upper = theta.quantile(NORMAL_90).max(fuse::THETA_MIN);
        let layer = |estimate: Estimate| ValueEstimate {
            value: estimate.value,
            std_dev: estimate.std_dev,
        };
        let time = |at_us| Timestamp::from_microsecond(at_us).unwrap_or(Timestamp::MAX);
        FusedFriction {
            theta: theta.value,
            std_dev: theta.std_dev,
            theta_low_95,
            theta_high_95,
            stiffness: theta.value.recip(),
            bounds: FrictionBounds {
                theta_lower_5: lower,
                theta_upper_95: upper,
                stiffness_lower_5: upper.recip(),
                stiffness_upper_95: (lower >= fuse::THETA_MIN).then(|| lower.recip()),
            },
            mu_peak_lower_bound: self.mu_peak,
            effective_track_ratio: self.track.map(layer),
            rolling_resistance: self.rolling.map(layer),
            segments: self.passes,
            robots: self.robots,
            newest_at: time(self.newest_at_us),
            age_s: epoch_measurement::seconds(now_us - self.newest_at_us).max(0.0),
            disputed: self.is_disputed,
            changed_at: self.changed_at_us.map(time),
        }
    }
}

#[cfg(test)]
mod common;
#[cfg(test)]
mod coverage;
#[cfg(test)]
mod faulty_robot_tests;
#[cfg(test)]
mod tests;
