//! Whether a robot that is to stand does: seen in wheels, odometry, gyro and position, not in commands.
//!
//! ```text
//!            rest is commanded              measured at rest for STANDS_FOR
//! driving ───────────────────────► stopping ────────────────────────────────► standing
//!    ▲                                │ braking time and MARGIN are over          │ moves for MOVES_FOR
//!    │                                ▼                                          ▼
//!    └─── rest is over ──── does not stand ◄──────────────────────────── moves while stopped
//! ```
//! Both alerts end when it stands, or when it may drive again.

use std::time::Duration;

use tread_control::geometry::Point;

/// Slowest wheel, odometry and position that count as motion, metres per second; encoders count and
/// odometry is noisy.
const SPEED_MIN_M_S: f64 = 0.1;
/// Slowest turn by the gyro, radians per second, above its offset.
const TURN_MIN_RAD_S: f64 = 0.15;
/// Distance from where it came to stand that shows motion in position fixes, metres.
const DISTANCE_MIN_M: f64 = 0.3;
/// Fixes in a row that must show it.
const FIXES: u32 = 3;
/// How long it must be at rest until it counts as standing.
const STANDS_FOR: Duration = Duration::from_millis(300);
/// How long fixes alone must stay at one place: a robot that creeps leaves it meanwhile.
const FIXES_STAY_FOR: Duration = Duration::from_secs(3);
/// How long it must move until it counts as moving.
const MOVES_FOR: Duration = Duration::from_millis(300);
/// Weakest braking that is expected, metres per second squared: half of what unknown ground gives.
const BRAKING_M_S2: f64 = 0.7;
/// Longest braking that is waited for.
const EXPECTED_BRAKING_MAX: Duration = Duration::from_secs(4);
/// Added to it: lag of the base, and ramps with a jerk limit.
const MARGIN: Duration = Duration::from_millis(700);

/// What was measured in a tick; absent where nothing trustworthy was said of late.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Motion {
    /// Fastest rim, metres per second.
    pub(crate) wheels_m_s: Option<f64>,
    /// Odometry over ground, metres per second.
    pub(crate) odometry_m_s: Option<f64>,
    /// Gyro, radians per second.
    pub(crate) turn_rad_s: Option<f64>,
    /// A position fix of this tick.
    pub(crate) fix: Option<Point>,
}

impl Motion {
    /// The faster one of wheels and odometry.
    fn speed_m_s(&self) -> Option<f64> {
        let odometry_m_s = self.odometry_m_s.map(f64::abs);
        self.wheels_m_s
            .into_iter()
            .chain(odometry_m_s)
            .reduce(f64::max)
    }
}

/// Which channel shows motion, and how fast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Shown {
    /// Wheels or odometry, metres per second.
    Speed(f64),
    /// Gyro, radians per second.
    Turn(f64),
    /// Position, metres from where it was.
    Distance(f64),
}

/// What is said of it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct StandingReport {
    /// Whether rest is commanded.
    pub(crate) is_to_stand: bool,
    /// Since when it stands, and how long after the command of rest that was.
    pub(crate) stands: Option<(Duration, Duration)>,
    /// It should stand and does not.
    pub(crate) does_not_stand: Option<Shown>,
    /// It stood and moves again.
    pub(crate) moves: Option<Shown>,
}

/// Watches it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct StandingWatch {
    /// When rest was commanded, and when it should be met.
    commanded: Option<(Duration, Duration)>,
    still_since: Option<Duration>,
    /// The first of the fixes that stay at one place.
    first_fix: Option<(Duration, Point)>,
    moving_since: Option<Duration>,
    stands: Option<(Duration, Duration)>,
    anchor: Option<Point>,
    away: u32,
    does_not_stand: Option<Shown>,
    moves: Option<Shown>,
}

impl StandingWatch {
    /// Takes one tick.
    pub(crate) fn step(&mut self, now: Duration, is_to_stand: bool, motion: &Motion) {
        if !is_to_stand {
            *self = Self::default();
            return;
        }
        let (commanded_at, due) = *self.commanded.get_or_insert_with(|| {
            let speed_m_s = motion.speed_m_s().unwrap_or(0.0);
            let braking = Duration::try_from_secs_f64(speed_m_s / BRAKING_M_S2);
            let braking = braking.map_or(EXPECTED_BRAKING_MAX, |braking| {
                braking.min(EXPECTED_BRAKING_MAX)
            });
            (now, now + braking + MARGIN)
        });
        let Some(shown) = self.shown(motion) else {
            self.moving_since = None;
            // Without wheels or odometry that can be believed only fixes show that it stands.
            let since = if motion.speed_m_s().is_some() {
                *self.still_since.get_or_insert(now)
            } else {
                self.still_since = None;
                let Some(since) = self.stays_since(now, motion.fix) else {
                    return;
                };
                since
            };
            if now.saturating_sub(since) >= STANDS_FOR {
                let took = since.saturating_sub(commanded_at);
                self.stands.get_or_insert((since, took));
                if self.anchor.is_none() {
                    self.anchor = motion.fix;
                }
                (self.does_not_stand, self.moves) = (None, None);
            }
            return;
        };
        (self.still_since, self.first_fix) = (None, None);
        let since = *self.moving_since.get_or_insert(now);
        let lasts = now.saturating_sub(since) >= MOVES_FOR;
        if self.stands.is_some() {
            if lasts {
                self.moves = Some(shown);
            }
        } else if now >= due && lasts {
            self.does_not_stand = Some(shown);
        }
    }

    /// Since when position fixes have stayed at one place, if that is long enough.
    fn stays_since(&mut self, now: Duration, fix: Option<Point>) -> Option<Duration> {
        let fix = fix?;
        let (since, first) = *self.first_fix.get_or_insert((now, fix));
        if first.distance_m(fix) > DISTANCE_MIN_M {
            self.first_fix = Some((now, fix));
            return None;
        }
        (now.saturating_sub(since) >= FIXES_STAY_FOR).then_some(since)
    }

    /// Nothing is heard of the robot any more: whether it stands is not known until it is.
    pub(crate) fn forget(&mut self) {
        *self = Self {
            commanded: self.commanded,
            ..Self::default()
        };
    }

    /// What shows motion.
    fn shown(&mut self, motion: &Motion) -> Option<Shown> {
        if let (Some(anchor), Some(fix)) = (self.anchor, motion.fix) {
            let is_away = anchor.distance_m(fix) > DISTANCE_MIN_M;
            self.away = if is_away { self.away + 1 } else { 0 };
        }
        if let Some(speed_m_s) = motion.speed_m_s()
            && speed_m_s > SPEED_MIN_M_S
        {
            return Some(Shown::Speed(speed_m_s));
        }
        if let Some(turn_rad_s) = motion.turn_rad_s
            && turn_rad_s.abs() > TURN_MIN_RAD_S
        {
            return Some(Shown::Turn(turn_rad_s));
        }
        if self.away >= FIXES {
            // From here on it is where it is now; otherwise a robot that was pushed once moved for ever.
            let distance_m = self
                .anchor
                .zip(motion.fix)
                .map(|(anchor, fix)| anchor.distance_m(fix));
            if let Some(distance_m) = distance_m {
                self.anchor = motion.fix;
                self.away = 0;
                self.moves = Some(Shown::Distance(distance_m));
                return Some(Shown::Distance(distance_m));
            }
        }
        None
    }

    /// What is said of it.
    pub(crate) fn report(&self) -> StandingReport {
        StandingReport {
            is_to_stand: self.commanded.is_some(),
            stands: self.stands.filter(|_| self.moves.is_none()),
            does_not_stand: self.does_not_stand,
            moves: self.moves,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TICK: Duration = Duration::from_millis(10);

    fn rolling(wheels_m_s: f64) -> Motion {
        Motion {
            wheels_m_s: Some(wheels_m_s),
            ..Motion::default()
        }
    }

    /// Ticks until something is true.
    fn until(
        watch: &mut StandingWatch,
        from: u32,
        motion: impl Fn(f64) -> Motion,
        is_so: impl Fn(&StandingReport) -> bool,
    ) -> Option<u32> {
        (0..2_000).find(|tick| {
            let now = TICK * (from + tick);
            watch.step(now, true, &motion(f64::from(*tick) * 0.01));
            is_so(&watch.report())
        })
    }

    #[test]
    fn a_robot_that_brakes_stands_and_the_time_it_took_is_said() {
        let mut watch = StandingWatch::default();
        let braking = |at_s: f64| rolling((0.9 - 1.2 * at_s).max(0.0));
        until(&mut watch, 0, braking, |report| report.stands.is_some()).unwrap();
        let report = watch.report();
        let (_, took) = report.stands.unwrap();
        assert!((600..800).contains(&took.as_millis()), "{took:?}");
        assert_eq!(report.does_not_stand, None);
    }

    #[test]
    fn a_base_that_ignores_rest_is_noticed_after_its_braking_time_and_no_sooner() {
        let mut watch = StandingWatch::default();
        let ticks = until(
            &mut watch,
            0,
            |_| rolling(0.59),
            |report| report.does_not_stand.is_some(),
        );
        let ticks = ticks.unwrap();
        assert!((120..200).contains(&ticks), "after {ticks} ticks");
        assert_eq!(watch.report().stands, None);
        let stands = until(
            &mut watch,
            ticks,
            |_| rolling(0.0),
            |report| report.stands.is_some(),
        );
        assert!(stands.unwrap() <= 31);
        assert_eq!(watch.report().does_not_stand, None);
    }

    #[test]
    fn a_robot_that_stood_and_is_pushed_moves_while_stopped_until_it_is_left_alone() {
        let mut watch = StandingWatch::default();
        until(
            &mut watch,
            0,
            |_| rolling(0.0),
            |report| report.stands.is_some(),
        )
        .unwrap();
        let pushed = until(
            &mut watch,
            100,
            |_| rolling(0.3),
            |report| report.moves.is_some(),
        );
        assert!(pushed.unwrap() <= 31);
        let report = watch.report();
        assert_eq!((report.does_not_stand, report.stands), (None, None));
        until(
            &mut watch,
            200,
            |_| rolling(0.0),
            |report| report.moves.is_none(),
        )
        .unwrap();
    }

    #[test]
    fn wheels_that_say_nothing_do_not_hide_a_turn_or_a_distance() {
        for motion in [
            Motion {
                turn_rad_s: Some(0.4),
                ..Motion::default()
            },
            Motion {
                odometry_m_s: Some(-0.5),
                ..Motion::default()
            },
        ] {
            let mut watch = StandingWatch::default();
            until(
                &mut watch,
                0,
                |_| motion,
                |report| report.does_not_stand.is_some(),
            )
            .unwrap();
        }
        let mut watch = StandingWatch::default();
        let at = |x_m| Motion {
            fix: Some(Point { x_m, y_m: 0.0 }),
            ..Motion::default()
        };
        until(
            &mut watch,
            0,
            |_| at(0.01),
            |report| report.stands.is_some(),
        )
        .unwrap();
        let wild = |at_s: f64| at(if at_s < 0.015 { 4.0 } else { 0.02 });
        assert_eq!(
            until(&mut watch, 100, wild, |report| report.moves.is_some()),
            None,
            "two wild fixes are no motion"
        );
        let gone = |at_s: f64| at(0.5 * at_s);
        until(&mut watch, 3_000, gone, |report| report.moves.is_some()).unwrap();
    }

    #[test]
    fn without_anything_that_shows_it_a_robot_is_not_said_to_stand() {
        let nothing = |_| Motion::default();
        let creeping = |at_s: f64| Motion {
            fix: Some(Point {
                x_m: 0.3 * at_s,
                y_m: 0.0,
            }),
            ..Motion::default()
        };
        let mut watch = StandingWatch::default();
        let stands = |report: &StandingReport| report.stands.is_some();
        assert_eq!(until(&mut watch, 0, nothing, stands), None);
        let mut watch = StandingWatch::default();
        assert_eq!(until(&mut watch, 0, creeping, stands), None);
    }

    #[test]
    fn a_robot_that_is_not_heard_is_no_longer_said_to_stand() {
        let mut watch = StandingWatch::default();
        let stands = |report: &StandingReport| report.stands.is_some();
        until(&mut watch, 0, |_| rolling(0.0), stands).unwrap();
        watch.forget();
        let report = watch.report();
        assert!(report.is_to_stand && report.stands.is_none());
        let again = until(&mut watch, 9_000, |_| rolling(0.0), stands);
        assert!(again.unwrap() >= 30, "rest counts from when it is heard");
    }

    #[test]
    fn noise_of_a_standing_robot_is_no_motion_and_driving_ends_it_all() {
        let mut watch = StandingWatch::default();
        for tick in 0..20_000_u32 {
            let noise = f64::from(tick % 13) - 6.0;
            let motion = Motion {
                wheels_m_s: Some(0.005 * noise.abs()),
                odometry_m_s: Some(0.01 * noise),
                turn_rad_s: Some(0.015 * noise),
                fix: Some(Point {
                    x_m: 0.015 * noise,
                    y_m: -0.01 * noise,
                }),
            };
            watch.step(TICK * tick, true, &motion);
            let report = watch.report();
            assert_eq!(
                (report.does_not_stand, report.moves),
                (None, None),
                "{tick}"
            );
        }
        watch.step(TICK * 20_000, false, &rolling(0.5));
        assert_eq!(watch.report(), StandingReport::default());
    }
}
