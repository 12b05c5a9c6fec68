//! Whether the wheels take the robot anywhere.
//!
//! Each [`WINDOW_M`] of wheel travel ahead or back is held against how far position fixes say that
//! the robot came. Time plays no part, so that a slow robot is judged like a quick one. Fixes are
//! taken as they come: the fused position follows the wheels while these spin.
//!
//! ```text
//!        WINDOWS in a row with less than DUG_IN_RATIO of the distance
//! fine ──────────────────────────────────────────────────────────► dug in
//!   ▲ └────── WINDOWS in a row with more than FREE_RATIO of it ──────┘
//! ```

use tread_control::geometry::Point;

/// Wheel travel that is judged at a time, metres: far more than the noise of a fix.
const WINDOW_M: f64 = 0.5;
/// Share of the wheels' distance below which they dig.
const DUG_IN_RATIO: f64 = 0.3;
/// Share above which they do not.
const FREE_RATIO: f64 = 0.6;
/// Windows in a row that must agree: one wild fix spoils two, the one it ends and the next.
const WINDOWS: u8 = 3;

/// Remembers whether the robot has dug itself in.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ProgressWatch {
    from: Option<Point>,
    wheels_m: f64,
    dug_in_at: Option<Point>,
    /// Windows in a row that say otherwise.
    against: u8,
}

impl ProgressWatch {
    /// Where the wheels turn without progress, or have stood still since they did.
    pub(crate) fn dug_in_at(&self) -> Option<Point> {
        self.dug_in_at
    }

    /// The wheels have turned: their mean forward distance, metres, below zero for back.
    pub(crate) fn note_wheels(&mut self, forward_m: f64) {
        if self.from.is_some() && forward_m.is_finite() {
            self.wheels_m += forward_m;
        }
    }

    /// A position fix has come.
    pub(crate) fn note_fix(&mut self, at: Point) {
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
            watch.note_wheels(0.03);
            at.x_m += 0.03 * share;
            watch.note_fix(*at);
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
            watch.note_fix(at);
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
            watch.note_wheels(WINDOW_M);
            watch.note_fix(wild);
            assert_eq!(watch.dug_in_at().is_some(), was);
            drive(&mut watch, &mut at, WINDOW_M, share);
            assert_eq!(watch.dug_in_at().is_some(), was);
        }
    }
}
