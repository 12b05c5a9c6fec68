//! Detects from wheels, odometry, gyro and position fixes, not from commands, whether the robot has
//! stopped when zero velocity is commanded.
//!
//! ```text
//!            zero is commanded              at zero velocity for STANDSTILL_MIN
//! driving ───────────────────────► stopping ────────────────────────────────► stopped
//!    ▲                                │ braking time and MARGIN are over          │ moves for MOTION_MIN
//!    │                                ▼                                          ▼
//!    └─ zero is not commanded ─ does not stand ◄────────────────────────── moves while stopped
//! ```
//! Both alerts end when the robot has stopped, or when zero velocity is no longer commanded.

use std::time::Duration;

use tread_control::geometry::Point;

/// Smallest speed of wheels or odometry that counts as motion, m/s; above encoder resolution and
/// odometry noise.
const SPEED_MIN_M_S: f64 = 0.1;
/// Smallest yaw rate of the gyro that counts as motion, rad/s; above the gyro's offset.
const TURN_MIN_RAD_S: f64 = 0.15;
/// Smallest distance of a position fix from the position at standstill that counts as motion,
/// metres.
const DISTANCE_MIN_M: f64 = 0.3;
/// Number of consecutive fixes beyond [`DISTANCE_MIN_M`] that shows motion.
const FIXES: u32 = 3;
/// Time without motion after which the robot counts as stopped.
const STANDSTILL_MIN: Duration = Duration::from_millis(300);
/// Time for which fixes must stay within [`DISTANCE_MIN_M`] where they are the only evidence of
/// standstill: a creeping robot leaves that circle meanwhile.
const FIXES_STAY_FOR: Duration = Duration::from_secs(3);
/// Duration of motion from which it is reported.
const MOTION_MIN: Duration = Duration::from_millis(300);
/// Smallest deceleration assumed for the braking time, m/s²: half of that on unknown ground.
const BRAKING_M_S2: f64 = 0.7;
/// Upper bound of the assumed braking time.
const EXPECTED_BRAKING_MAX: Duration = Duration::from_secs(4);
/// Margin on the assumed braking time for the lag of the base and jerk-limited ramps.
const MARGIN: Duration = Duration::from_millis(700);

/// Motion measured in a tick; `None` where there is no recent trustworthy value.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Motion {
    /// Speed of the fastest wheel rim, m/s.
    pub(crate) wheels_m_s: Option<f64>,
    /// Speed over ground by odometry, m/s.
    pub(crate) odometry_m_s: Option<f64>,
    /// Yaw rate by gyro, rad/s.
    pub(crate) turn_rad_s: Option<f64>,
    /// Position fix of this tick, in the site frame.
    pub(crate) fix: Option<Point>,
}

impl Motion {
    /// Returns the larger of the speeds by wheels and odometry, m/s.
    fn speed_m_s(&self) -> Option<f64> {
        let odometry_m_s = self.odometry_m_s.map(f64::abs);
        self.wheels_m_s
            .into_iter()
            .chain(odometry_m_s)
            .reduce(f64::max)
    }
}

/// The channel that shows motion, with its value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum MotionEvidence {
    /// Wheels or odometry, m/s.
    Speed(f64),
    /// Gyro, rad/s.
    Turn(f64),
    /// Position fix, metres from the position at standstill.
    Distance(f64),
}

/// Result of the standstill watch.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct StandingReport {
    /// Whether zero velocity is commanded.
    pub(crate) is_to_stand: bool,
    /// Begin of the standstill by the monotonic clock, and its delay after the command.
    pub(crate) stands: Option<(Duration, Duration)>,
    /// Motion beyond the assumed braking time, if the robot has not stopped.
    pub(crate) does_not_stand: Option<MotionEvidence>,
    /// Motion after the robot had stopped.
    pub(crate) moves: Option<MotionEvidence>,
}

/// Watches a robot that is commanded to zero velocity.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct StandingWatch {
    /// Time of the command of zero velocity, and the time by which the robot shall have stopped.
    commanded: Option<(Duration, Duration)>,
    still_since: Option<Duration>,
    /// First of the fixes that stay within [`DISTANCE_MIN_M`], with its time.
    first_fix: Option<(Duration, Point)>,
    moving_since: Option<Duration>,
    stands: Option<(Duration, Duration)>,
    anchor: Option<Point>,
    away: u32,
    does_not_stand: Option<MotionEvidence>,
    moves: Option<MotionEvidence>,
}

impl StandingWatch {
    /// Processes one tick. `is_to_stand` is whether zero velocity is commanded.
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
        let Some(evidence) = self.detect_motion(motion) else {
            self.moving_since = None;
            // Without trustworthy wheels or odometry only fixes show standstill.
            let since = if motion.speed_m_s().is_some() {
                *self.still_since.get_or_insert(now)
            } else {
                self.still_since = None;
                let Some(since) = self.stays_since(now, motion.fix) else {
                    return;
                };
                since
            };
            if now.saturating_sub(since) >= STANDSTILL_MIN {
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
        let lasts = now.saturating_sub(since) >= MOTION_MIN;
        if self.stands.is_some() {
            if lasts {
                self.moves = Some(evidence);
            }
        } else if now >= due && lasts {
            self.does_not_stand = Some(evidence);
        }
    }

    /// Returns since when position fixes have stayed within [`DISTANCE_MIN_M`], once that has
    /// lasted [`FIXES_STAY_FOR`].
    fn stays_since(&mut self, now: Duration, fix: Option<Point>) -> Option<Duration> {
        let fix = fix?;
        let (since, first) = *self.first_fix.get_or_insert((now, fix));
        if first.distance_m(fix) > DISTANCE_MIN_M {
            self.first_fix = Some((now, fix));
            return None;
        }
        (now.saturating_sub(since) >= FIXES_STAY_FOR).then_some(since)
    }

    /// Resets the watch except for the time of the command, because no sensor is heard: whether the
    /// robot has stopped is unknown until one is.
    pub(crate) fn reset(&mut self) {
        *self = Self {
            commanded: self.commanded,
            ..Self::default()
        };
    }

    /// Returns the channel that shows motion in this tick, if any.
    fn detect_motion(&mut self, motion: &Motion) -> Option<MotionEvidence> {
        if let (Some(anchor), Some(fix)) = (self.anchor, motion.fix) {
            let is_away = anchor.distance_m(fix) > DISTANCE_MIN_M;
            self.away = if is_away { self.away + 1 } else { 0 };
        }
        if let Some(speed_m_s) = motion.speed_m_s()
            && speed_m_s > SPEED_MIN_M_S
        {
            return Some(MotionEvidence::Speed(speed_m_s));
        }
        if let Some(turn_rad_s) = motion.turn_rad_s
            && turn_rad_s.abs() > TURN_MIN_RAD_S
        {
            return Some(MotionEvidence::Turn(turn_rad_s));
        }
        if self.away >= FIXES {
            // The new position becomes the anchor; otherwise one push would count as motion for
            // ever.
            let distance_m = self
                .anchor
                .zip(motion.fix)
                .map(|(anchor, fix)| anchor.distance_m(fix));
            if let Some(distance_m) = distance_m {
                self.anchor = motion.fix;
                self.away = 0;
                self.moves = Some(MotionEvidence::Distance(distance_m));
                return Some(MotionEvidence::Distance(distance_m));
            }
        }
        None
    }

    /// Returns the result of the watch.
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
        watch.reset();
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
