//! Detects wheels that turn without moving the robot.
//!
//! Each [`WINDOW_M`] of net wheel travel is compared with the distance between position fixes. Time
//! plays no part, so that slow and fast robots are judged alike. Raw fixes are used, since the
//! fused position follows the wheels while these spin.
//!
//! ```text
//!        WINDOWS in a row with less than DUG_IN_RATIO of the distance
//! fine ──────────────────────────────────────────────────────────► dug in
//!   ▲ └────── WINDOWS in a row with more than FREE_RATIO of it ──────┘
//! ```

use tread_control::geometry::Point;

/// Wheel travel per comparison, metres: far above the noise of a fix.
const WINDOW_M: f64 = 0.5;
/// Ratio of distance by fixes to wheel travel below which a window indicates digging in.
const DUG_IN_RATIO: f64 = 0.3;
/// Ratio of distance by fixes to wheel travel above which a window indicates progress.
const FREE_RATIO: f64 = 0.6;
/// Consecutive windows that change the state: one outlying fix spoils two, the one that it ends and
/// the next.
const WINDOWS: u8 = 3;

/// State of the detection.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ProgressWatch {
    from: Option<Point>,
    wheels_m: f64,
    dug_in_at: Option<Point>,
    /// Consecutive windows that contradict the present state.
    against: u8,
}

impl ProgressWatch {
    /// Returns the position at which digging in was detected, until progress is detected.
    pub(crate) fn dug_in_at(&self) -> Option<Point> {
        self.dug_in_at
    }

    /// Forgets the comparison that has begun, since wheels or position are known to be wrong. The next one
    /// begins with the next fix; what was detected stays.
    pub(crate) fn suspend(&mut self) {
        self.from = None;
        self.wheels_m = 0.0;
        self.against = 0;
    }

    /// Adds the mean distance of the wheels, metres, negative for backward travel.
    pub(crate) fn add_wheel_distance(&mut self, forward_m: f64) {
        if self.from.is_some() && forward_m.is_finite() {
            self.wheels_m += forward_m;
        }
    }

    /// Adds a position fix, in the site frame; non-finite fixes are ignored.
    pub(crate) fn add_fix(&mut self, at: Point) {
        if !at.is_finite() {
            return;
        }
        let Some(from) = self.from else {
            self.from = Some(at);
            return;
        };
        if self.wheels_m.abs() < WINDOW_M {
            return;
        }
        let share = from.distance_m(at) / self.wheels_m.abs();
        let says_otherwise = if self.dug_in_at.is_some() {
            share > FREE_RATIO
        } else {
            share < DUG_IN_RATIO
        };
        self.against = if says_otherwise { self.against + 1 } else { 0 };
        if self.against >= WINDOWS {
            self.dug_in_at = match self.dug_in_at {
                Some(_) => None,
                None => Some(at),
            };
            self.against = 0;
        }
        self.from = Some(at);
        self.wheels_m = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Drives so far by the wheels, of which the robot makes a share; fixes each 3 cm of wheels.
    fn drive(watch: &mut ProgressWatch, at: &mut Point, wheels_m: f64, share: f64) {
        let mut left_m = wheels_m;
        while left_m > 0.0 {
            watch.add_wheel_distance(0.03);
            at.x_m += 0.03 * share;
            watch.add_fix(*at);
            left_m -= 0.03;
        }
    }

    #[test]
    fn wheels_that_dig_are_noticed_within_four_windows_and_only_progress_ends_it() {
        let (mut watch, mut at) = (ProgressWatch::default(), Point::default());
        drive(&mut watch, &mut at, 5.0, 0.9);
        assert!(watch.dug_in_at().is_none());
        drive(&mut watch, &mut at, 4.0 * WINDOW_M + 0.1, 0.05);
        assert!(watch.dug_in_at().is_some());
        for _ in 0..100 {
            watch.add_fix(at);
        }
        drive(&mut watch, &mut at, 5.0, 0.45);
        assert!(
            watch.dug_in_at().is_some(),
            "it still slips more than it drives"
        );
        drive(&mut watch, &mut at, 4.0 * WINDOW_M + 0.1, 0.95);
        assert!(watch.dug_in_at().is_none());
    }

    #[test]
    fn a_channel_that_is_known_to_be_wrong_neither_raises_nor_ends_it() {
        let (mut watch, mut at) = (ProgressWatch::default(), Point::default());
        drive(&mut watch, &mut at, 2.0 * WINDOW_M + 0.1, 0.0);
        // The wheels are frozen at the speed that they had, and the robot stands.
        for _ in 0..100 {
            watch.add_wheel_distance(0.03);
            watch.suspend();
        }
        drive(&mut watch, &mut at, 5.0, 0.9);
        assert!(watch.dug_in_at().is_none());
        drive(&mut watch, &mut at, 4.0 * WINDOW_M + 0.1, 0.0);
        assert!(watch.dug_in_at().is_some());
        for _ in 0..100 {
            watch.add_wheel_distance(0.03);
            at.x_m += 1.0;
            watch.add_fix(at);
            watch.suspend();
        }
        assert!(watch.dug_in_at().is_some());
    }

    #[test]
    fn one_wild_fix_neither_raises_nor_ends_it() {
        let (mut watch, mut at) = (ProgressWatch::default(), Point::default());
        drive(&mut watch, &mut at, 2.0, 1.0);
        for share in [1.0, 0.0] {
            for _ in 0..4 {
                drive(&mut watch, &mut at, WINDOW_M, share);
            }
            let was = watch.dug_in_at().is_some();
            assert_eq!(was, share < 0.5);
            let wild = Point {
                x_m: if was { at.x_m + 40.0 } else { at.x_m - 0.5 },
                ..at
            };
            watch.add_wheel_distance(WINDOW_M);
            watch.add_fix(wild);
            assert_eq!(watch.dug_in_at().is_some(), was);
            drive(&mut watch, &mut at, WINDOW_M, share);
            assert_eq!(watch.dug_in_at().is_some(), was);
        }
    }
}
