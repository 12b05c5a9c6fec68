//! Whether the wheels do what they are told, or somebody lies: stuck encoders, swapped sides, a
//! drive that was switched off.
//!
//! A wheel's speed must lie between the least and the greatest command of the last
//! [`MEMORY`], widened by a tolerance: no lag within that time is taken for disobedience.
//! Nothing is judged while the robot is to stand, for others may move it then.

use std::time::Duration;

use tread_control::measured::WheelSpeeds;

/// How long a command counts.
const MEMORY: Duration = Duration::from_millis(600);
/// Spans into which it is parted.
const SPANS: usize = 12;
/// How long the wheels must disobey.
const FOR: Duration = Duration::from_millis(500);
/// How long they must obey again.
const AGAIN_FOR: Duration = Duration::from_secs(1);
/// Tolerance: a part of its own, radians per second, and a share of the command.
const TOLERANCE: (f64, f64) = (1.0, 0.25);

/// Least and greatest command within a span.
#[derive(Debug, Clone, Copy)]
struct Envelope {
    least: WheelSpeeds,
    most: WheelSpeeds,
}

impl Envelope {
    const NONE: Self = Self {
        least: WheelSpeeds {
            left_rad_s: f64::INFINITY,
            right_rad_s: f64::INFINITY,
        },
        most: WheelSpeeds {
            left_rad_s: f64::NEG_INFINITY,
            right_rad_s: f64::NEG_INFINITY,
        },
    };

    fn with(self, other: &Self) -> Self {
        let least = |left: WheelSpeeds, right: WheelSpeeds| WheelSpeeds {
            left_rad_s: left.left_rad_s.min(right.left_rad_s),
            right_rad_s: left.right_rad_s.min(right.right_rad_s),
        };
        let most = |left: WheelSpeeds, right: WheelSpeeds| WheelSpeeds {
            left_rad_s: left.left_rad_s.max(right.left_rad_s),
            right_rad_s: left.right_rad_s.max(right.right_rad_s),
        };
        Self {
            least: least(self.least, other.least),
            most: most(self.most, other.most),
        }
    }

    fn holds(&self, measured: WheelSpeeds) -> bool {
        let (own, share) = TOLERANCE;
        let is_within = |measured: f64, least: f64, most: f64| {
            let tolerance = own + share * least.abs().max(most.abs());
            (least - tolerance..=most + tolerance).contains(&measured)
        };
        is_within(
            measured.left_rad_s,
            self.least.left_rad_s,
            self.most.left_rad_s,
        ) && is_within(
            measured.right_rad_s,
            self.least.right_rad_s,
            self.most.right_rad_s,
        )
    }

    /// Whether all of it is rest, or there is nothing.
    fn is_rest(&self) -> bool {
        let fastest = self
            .least
            .magnitude_max_rad_s()
            .max(self.most.magnitude_max_rad_s());
        !fastest.is_finite() || fastest < f64::EPSILON
    }
}

/// The wheels' obedience.
#[derive(Debug, Clone, Copy)]
pub struct Obedience {
    spans: [Envelope; SPANS],
    /// The span that is being filled, and when it began.
    present: (usize, Duration),
    /// Since when the wheels do not do as told, or do again.
    since: Option<Duration>,
    is_trusted: bool,
}

impl Default for Obedience {
    fn default() -> Self {
        Self {
            spans: [Envelope::NONE; SPANS],
            present: (0, Duration::ZERO),
            since: None,
            is_trusted: true,
        }
    }
}

impl Obedience {
    /// Notes a command that was given.
    pub fn command(&mut self, now: Duration, command: WheelSpeeds) {
        let span = MEMORY / u32::try_from(SPANS).unwrap_or(1);
        let (mut index, mut began) = self.present;
        // Bounded: after a longer pause every span has been emptied.
        for _ in 0..SPANS {
            if now < began + span {
                break;
            }
            index = (index + 1) % SPANS;
            began += span;
            self.spans[index] = Envelope::NONE;
        }
        if now >= began + span {
            began = now;
        }
        self.present = (index, began);
        let one = Envelope {
            least: command,
            most: command,
        };
        self.spans[index] = self.spans[index].with(&one);
    }

    /// Whether what the wheels are said to do can be believed.
    pub fn judge(&mut self, now: Duration, measured: WheelSpeeds) -> bool {
        let spans = self.spans.iter();
        let all = spans.fold(Envelope::NONE, Envelope::with);
        let obeys = all.is_rest() || all.holds(measured);
        if obeys == self.is_trusted {
            self.since = None;
        } else {
            let since = *self.since.get_or_insert(now);
            let bound = if self.is_trusted { FOR } else { AGAIN_FOR };
            if now.saturating_sub(since) >= bound {
                self.is_trusted = obeys;
                self.since = None;
            }
        }
        self.is_trusted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(10);

    fn speeds(left_rad_s: f64, right_rad_s: f64) -> WheelSpeeds {
        WheelSpeeds {
            left_rad_s,
            right_rad_s,
        }
    }

    /// Drives for so many ticks; when the wheels are no longer trusted.
    fn run(
        ticks: u32,
        commanded: impl Fn(f64) -> WheelSpeeds,
        measured: impl Fn(f64) -> WheelSpeeds,
    ) -> Option<Duration> {
        let mut obedience = Obedience::default();
        (0..ticks).map(|tick| tick * STEP).find(|&now| {
            obedience.command(now, commanded(now.as_secs_f64()));
            !obedience.judge(now, measured(now.as_secs_f64()))
        })
    }

    fn wave(at_s: f64) -> WheelSpeeds {
        speeds(
            6.0 + 4.0 * (2.0 * at_s).sin(),
            6.0 - 4.0 * (2.0 * at_s).sin(),
        )
    }

    #[test]
    fn a_lagging_and_slipping_base_is_trusted() {
        let lagging = |at_s: f64| {
            let told = wave((at_s - 0.3).max(0.0));
            speeds(0.9 * told.left_rad_s, 1.1 * told.right_rad_s)
        };
        assert_eq!(run(2_000, wave, lagging), None);
        assert_eq!(
            run(500, |_| speeds(0.0, 0.0), |_| speeds(5.0, 5.0)),
            None,
            "it is pushed"
        );
    }

    #[test]
    fn stuck_encoders_and_swapped_sides_are_seen() {
        let stuck = run(500, |_| speeds(8.0, 8.0), |_| speeds(0.0, 0.0)).unwrap();
        assert!(stuck <= FOR + 2 * STEP, "{stuck:?}");
        let swapped = run(500, |_| speeds(2.0, 8.0), |_| speeds(8.0, 2.0)).unwrap();
        assert!(swapped <= FOR + 2 * STEP, "{swapped:?}");
    }

    #[test]
    fn wheels_that_obey_again_are_trusted_again() {
        let mut obedience = Obedience::default();
        let mut trusted = Vec::new();
        for tick in 0..400 {
            let now = tick * STEP;
            let is_stuck = tick < 100;
            let told = speeds(5.0, 5.0);
            obedience.command(now, told);
            let measured = if is_stuck { speeds(0.0, 0.0) } else { told };
            trusted.push(obedience.judge(now, measured));
        }
        assert!(!trusted[99] && !trusted[199 - 5] && trusted[205]);
    }
}
