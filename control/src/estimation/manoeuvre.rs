//! How a robot moves, as far as θ depends on it, and why there is no estimate of θ.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Half-width of the 95 % interval of θ, relative to θ, above which there is no estimate.
pub const ESTIMATE_HALF_WIDTH_MAX_RATIO: f64 = 0.6;

/// Rim speed of the faster side above which the robot moves, metres per second.
pub const MOVING_M_S: f64 = 0.05;
/// Rim speed of the slower side above which the robot rolls rather than turns on the spot, metres
/// per second.
const ROLLING_M_S: f64 = 0.1;
/// Turn rate above which the robot turns, radians per second.
const TURNING_RAD_S: f64 = 0.15;
/// Time over which rim speeds are averaged to tell an acceleration, seconds.
const AVERAGED_S: f64 = 0.5;
/// Change of the mean rim speed over that time, as an acceleration, above which the robot
/// accelerates, metres per second squared.
const ACCELERATING_M_S2: f64 = 0.15;
/// Shortest driving in which θ can be found, seconds.
const DRIVING_MIN_S: f64 = 8.0;
/// Share of the driving that has to be turns, or acceleration, to count as excitation.
const EXCITED_SHARE: f64 = 0.08;
/// Share of a turning robot's turns to the rarer side, below which they count as one-sided.
const ONE_SIDED_SHARE: f64 = 0.2;
/// Share of blocks beyond the linear range of slip, above which hardly any is within it. The slope at
/// zero slip is found from much slip too, but not from much slip alone.
const SATURATED_SHARE: f64 = 0.9;
/// Time constant with which an estimator forgets manoeuvres.
const REMEMBERED: Duration = Duration::from_mins(1);

/// Why there is no estimate of θ, or none whose 95 % interval is narrower than ± 60 %. The first reason
/// that applies is stated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoEstimate {
    /// The residuals are too large for the model, or much larger than before.
    Misfit,
    /// Gyro or accelerometer is later, or earlier, than can be identified, or its delay has changed.
    LateSensor,
    /// The robot has not driven for long enough.
    Short,
    /// The wheels slip beyond the range in which friction follows from slip nearly all the time.
    Slip,
    /// The robot drives hardly any arcs: it rolls straight on, or turns on the spot.
    NoTurns,
    /// Nearly all turns are to one side, so that different wheel radii look like slip.
    OneSided,
    /// The speed hardly changes.
    NoAcceleration,
    /// Turns and accelerations were as they should be; it takes more of them.
    Uncertain,
}

/// Times of manoeuvres, seconds.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ManoeuvreTimes {
    /// Time in which the wheels turned.
    pub moving_s: f64,
    /// Time of turning to the left while rolling.
    pub left_s: f64,
    /// Time of turning to the right while rolling.
    pub right_s: f64,
    /// Time of turning on the spot.
    pub on_the_spot_s: f64,
    /// Time of accelerating or braking.
    pub accelerating_s: f64,
}

impl ManoeuvreTimes {
    /// Returns whether the robot drove for too short a time for an estimate.
    pub fn is_too_short(&self) -> bool {
        self.moving_s < DRIVING_MIN_S
    }

    /// Returns whether the robot drove hardly any arcs.
    pub fn has_no_turns(&self) -> bool {
        self.left_s + self.right_s < EXCITED_SHARE * self.moving_s
    }

    /// Returns whether the robot turned, and nearly always to one side.
    pub fn is_one_sided(&self) -> bool {
        let turns_s = self.left_s + self.right_s;
        !self.has_no_turns() && self.left_s.min(self.right_s) < ONE_SIDED_SHARE * turns_s
    }

    /// Returns whether the robot turned on the spot often enough to mention it.
    pub fn turns_on_the_spot(&self) -> bool {
        self.on_the_spot_s > EXCITED_SHARE * self.moving_s
    }

    /// Returns whether the speed hardly changed.
    pub fn has_no_acceleration(&self) -> bool {
        self.accelerating_s < EXCITED_SHARE * self.moving_s
    }

    /// Returns what these manoeuvres lack for an estimate of θ; the share of blocks beyond the linear
    /// range of slip is `saturation_share`, 0 to 1.
    pub fn lacks(&self, saturation_share: f64) -> NoEstimate {
        if self.is_too_short() {
            NoEstimate::Short
        } else if is_saturated(saturation_share) {
            NoEstimate::Slip
        } else if self.has_no_turns() {
            NoEstimate::NoTurns
        } else if self.is_one_sided() {
            NoEstimate::OneSided
        } else if self.has_no_acceleration() {
            NoEstimate::NoAcceleration
        } else {
            NoEstimate::Uncertain
        }
    }

    fn times(&mut self) -> [&mut f64; 5] {
        [
            &mut self.moving_s,
            &mut self.left_s,
            &mut self.right_s,
            &mut self.on_the_spot_s,
            &mut self.accelerating_s,
        ]
    }
}

/// Returns whether hardly any block is within the linear range of slip, given the share of those beyond
/// it, 0 to 1.
pub fn is_saturated(saturation_share: f64) -> bool {
    saturation_share > SATURATED_SHARE
}

/// Motion of a robot during one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RimMotion {
    /// Rim speeds, left and right, metres per second.
    pub rims_m_s: [f64; 2],
    /// Turn rate, radians per second, positive to the left.
    pub turn_rad_s: f64,
}

/// Adds up times of manoeuvres from samples.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Manoeuvres {
    times: ManoeuvreTimes,
    /// Distance and time of the open mean of the rim speeds, metres and seconds.
    open: (f64, f64),
    /// The mean before, metres per second.
    before_m_s: Option<f64>,
    /// Time in which the wheels turned since the last decay, seconds.
    moved_s: f64,
}

impl Manoeuvres {
    /// Returns the times so far.
    pub fn times(&self) -> ManoeuvreTimes {
        self.times
    }

    /// Adds `time_s` seconds of a motion.
    pub fn add(&mut self, motion: RimMotion, time_s: f64) {
        let RimMotion {
            rims_m_s,
            turn_rad_s,
        } = motion;
        let [left, right] = rims_m_s.map(f64::abs);
        if left.max(right) > MOVING_M_S {
            self.times.moving_s += time_s;
            self.moved_s += time_s;
        }
        let is_rolling = rims_m_s[0] * rims_m_s[1] > 0.0 && left.min(right) > ROLLING_M_S;
        if turn_rad_s.abs() > TURNING_RAD_S {
            let turned_s = match (is_rolling, turn_rad_s > 0.0) {
                (false, _) => &mut self.times.on_the_spot_s,
                (true, true) => &mut self.times.left_s,
                (true, false) => &mut self.times.right_s,
            };
            *turned_s += time_s;
        }
        let (distance_m, open_s) = &mut self.open;
        *distance_m += 0.5 * (rims_m_s[0] + rims_m_s[1]) * time_s;
        *open_s += time_s;
        if *open_s < AVERAGED_S - 1.0e-9 {
            return;
        }
        let mean_m_s = *distance_m / *open_s;
        self.open = (0.0, 0.0);
        let before = self.before_m_s.replace(mean_m_s).unwrap_or(mean_m_s);
        if (mean_m_s - before).abs() > ACCELERATING_M_S2 * AVERAGED_S {
            self.times.accelerating_s += AVERAGED_S;
        }
    }

    /// Reduces the times of old manoeuvres by the driving since the last call.
    pub(super) fn decay(&mut self) {
        let moved_s = std::mem::take(&mut self.moved_s);
        let kept = (-moved_s / REMEMBERED.as_secs_f64()).exp();
        for time_s in self.times.times() {
            *time_s *= kept;
        }
    }

    /// Ends the open mean before a gap.
    pub(super) fn interrupt(&mut self) {
        self.open = (0.0, 0.0);
        self.before_m_s = None;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SAMPLE_S: f64 = 0.02;

    /// Drives for so many seconds with rim speeds and a turn rate by the time.
    fn driven(time_s: u32, motion: impl Fn(f64) -> ([f64; 2], f64)) -> ManoeuvreTimes {
        let mut manoeuvres = Manoeuvres::default();
        for step in 0..time_s * 50 {
            let (rims_m_s, turn_rad_s) = motion(f64::from(step) * SAMPLE_S);
            let motion = RimMotion {
                rims_m_s,
                turn_rad_s,
            };
            manoeuvres.add(motion, SAMPLE_S);
        }
        manoeuvres.times()
    }

    #[test]
    fn what_a_drive_lacks_is_the_first_thing_that_is_missing() {
        let speed = |time_s: f64| 0.6 + 0.3 * time_s.sin();
        let figure_8 = |time_s: f64| if time_s % 20.0 < 10.0 { 0.5 } else { -0.5 };
        for (times, lacks) in [
            (driven(5, |_| ([0.5; 2], 0.0)), NoEstimate::Short),
            (driven(60, |_| ([0.0; 2], 0.0)), NoEstimate::Short),
            (driven(60, |_| ([0.5; 2], 0.0)), NoEstimate::NoTurns),
            (driven(60, |_| ([-0.5, 0.5], 0.9)), NoEstimate::NoTurns),
            (driven(60, |_| ([0.4, 0.6], 0.5)), NoEstimate::OneSided),
            (
                driven(60, |time_s| ([0.5; 2], figure_8(time_s))),
                NoEstimate::NoAcceleration,
            ),
            (
                driven(60, |time_s| ([speed(time_s); 2], figure_8(time_s))),
                NoEstimate::Uncertain,
            ),
        ] {
            assert_eq!(times.lacks(0.0), lacks, "{times:?}");
        }
        let sliding = driven(60, |_| ([0.4, 0.6], 0.5));
        assert_eq!(sliding.lacks(0.95), NoEstimate::Slip);
    }

    #[test]
    fn turns_on_the_spot_are_no_arcs() {
        let times = driven(30, |_| ([-0.3, 0.3], 0.8));
        assert!(times.turns_on_the_spot() && times.has_no_turns());
    }

    #[test]
    fn long_turns_on_the_spot_do_not_hide_the_arcs_that_follow() {
        let mut manoeuvres = Manoeuvres::default();
        let mut drive = |rims_m_s, turn_rad_s, time_s: u32| {
            for _ in 0..time_s * 50 {
                let motion = RimMotion {
                    rims_m_s,
                    turn_rad_s,
                };
                manoeuvres.add(motion, SAMPLE_S);
                manoeuvres.decay();
            }
            manoeuvres.times().has_no_turns()
        };
        assert!(drive([-0.1, 0.1], 0.4, 600));
        assert!(!drive([0.4, 0.6], 0.5, 30));
    }

    #[test]
    fn manoeuvres_of_several_minutes_ago_no_longer_count() {
        let mut manoeuvres = Manoeuvres::default();
        let mut drive = |turn_rad_s: f64, time_s: u32| {
            for _ in 0..time_s * 50 {
                let rims_m_s = [0.5; 2];
                let motion = RimMotion {
                    rims_m_s,
                    turn_rad_s,
                };
                manoeuvres.add(motion, SAMPLE_S);
                manoeuvres.decay();
            }
            manoeuvres.times().has_no_turns()
        };
        assert!(!drive(0.5, 60));
        assert!(!drive(0.0, 30));
        assert!(drive(0.0, 240));
    }

    proptest! {
        #[test]
        fn times_are_at_most_the_time_of_the_drive(
            samples in prop::collection::vec((-2.0..2.0, -2.0..2.0, -2.0..2.0, 0.0..0.1), 1..300),
        ) {
            let mut manoeuvres = Manoeuvres::default();
            let mut driven_s = 0.0;
            for (left_m_s, right_m_s, turn_rad_s, time_s) in samples {
                let rims_m_s = [left_m_s, right_m_s];
                let motion = RimMotion {
                    rims_m_s,
                    turn_rad_s,
                };
                manoeuvres.add(motion, time_s);
                driven_s += time_s;
            }
            let times = manoeuvres.times();
            let turned_s = times.left_s + times.right_s + times.on_the_spot_s;
            for time_s in [times.moving_s, turned_s, times.accelerating_s] {
                prop_assert!((0.0..=driven_s + 1.0e-9).contains(&time_s));
            }
        }
    }
}
