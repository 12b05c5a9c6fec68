//! Detects wheels that do not follow their command: stuck encoders, swapped sides, a drive that was
//! switched off, another node that commands the base too.
//!
//! A wheel's speed must lie between the smallest and the largest command of the last [`MEMORY`],
//! widened by a tolerance, so that a lag within that time is accepted. Slip has no effect on the
//! check: it changes the motion of the robot, not that of the wheels. Wheels are not checked while
//! only zero was commanded, because somebody may push the robot then.
//!
//! The commands of two nodes for one base alternate, so its wheels follow those of the agent part of
//! the time. The time of non-compliance is therefore summed, less [`COMPLIANCE_CREDIT`] of the time of
//! compliance. Wheels with stuck encoders, or with a drive that is off, stand still without
//! interruption; the duration of this standstill is measured separately.

use std::time::Duration;

use tread_control::measured::WheelSpeeds;

/// Time for which a command is remembered.
const MEMORY: Duration = Duration::from_millis(600);
/// Number of spans into which [`MEMORY`] is divided.
const SPANS: usize = 12;
/// Summed time without compliance after which the wheels are refused.
const NONCOMPLIANCE_MAX: Duration = Duration::from_millis(500);
/// Fraction of the time of compliance that is subtracted: the wheels may disobey a third of the
/// time.
const COMPLIANCE_CREDIT: f64 = 0.5;
/// Longest time that one sample of the wheels accounts for.
const SAMPLE_SPAN_MAX: Duration = Duration::from_millis(100);
/// Time for which wheels must stand still without interruption to count as stuck; longer than the
/// interruptions by another node that halts the drive now and then.
const STANDSTILL_MIN: Duration = Duration::from_millis(350);
/// Ratio to its command below which a wheel's speed counts as standstill.
const STANDING_SHARE: f64 = 0.1;
/// Time of compliance after which the wheels are accepted again.
const RECOVERY_TIME: Duration = Duration::from_secs(1);
/// Tolerance of a wheel's speed: absolute, rad/s, and relative to the command.
const TOLERANCE: (f64, f64) = (1.0, 0.25);

/// Smallest and largest command within a span.
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

    /// Whether both sides stand still although commanded to turn.
    fn is_standing(&self, measured: WheelSpeeds) -> bool {
        let stands = |measured: f64, least: f64, most: f64| {
            measured.abs() <= STANDING_SHARE * least.abs().max(most.abs())
        };
        stands(
            measured.left_rad_s,
            self.least.left_rad_s,
            self.most.left_rad_s,
        ) && stands(
            measured.right_rad_s,
            self.least.right_rad_s,
            self.most.right_rad_s,
        )
    }

    /// Whether the envelope contains only zero commands or none.
    fn is_rest(&self) -> bool {
        let fastest = self
            .least
            .magnitude_max_rad_s()
            .max(self.most.magnitude_max_rad_s());
        !fastest.is_finite() || fastest < f64::EPSILON
    }
}

/// Result of the check of the wheels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// They follow their command, as far as known.
    Obeys,
    /// They report standstill: their encoders are stuck, or the drive is off.
    Stands,
    /// They turn differently from their command: another node commands them, or the sides are
    /// swapped.
    MovesOtherwise,
}

/// State of the check.
#[derive(Debug, Clone, Copy)]
pub struct CommandCompliance {
    spans: [Envelope; SPANS],
    /// Index and begin of the span that is being filled.
    present: (usize, Duration),
    /// Summed time without compliance, reduced by compliance.
    disobeyed: Duration,
    /// Time of uninterrupted standstill.
    stood: Duration,
    /// Time since which the wheels obey again.
    obeys_since: Option<Duration>,
    judged_at: Option<Duration>,
    verdict: Verdict,
}

impl Default for CommandCompliance {
    fn default() -> Self {
        Self {
            spans: [Envelope::NONE; SPANS],
            present: (0, Duration::ZERO),
            disobeyed: Duration::ZERO,
            stood: Duration::ZERO,
            obeys_since: None,
            judged_at: None,
            verdict: Verdict::Obeys,
        }
    }
}

impl CommandCompliance {
    /// Records a command.
    pub fn command(&mut self, now: Duration, command: WheelSpeeds) {
        let span = MEMORY / u32::try_from(SPANS).unwrap_or(1);
        let (mut index, mut began) = self.present;
        // Bounded: after a longer pause all spans are cleared.
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

    /// Checks measured wheel speeds against the recent commands.
    pub fn judge(&mut self, now: Duration, measured: WheelSpeeds) -> Verdict {
        let spans = self.spans.iter();
        let all = spans.fold(Envelope::NONE, Envelope::with);
        let obeys = all.is_rest() || all.holds(measured);
        let judged_at = self.judged_at.replace(now).unwrap_or(now);
        let span = now.saturating_sub(judged_at).min(SAMPLE_SPAN_MAX);
        let stands = !obeys && all.is_standing(measured);
        self.stood = if stands {
            self.stood + span
        } else {
            Duration::ZERO
        };
        if self.verdict != Verdict::Obeys {
            if self.stood >= STANDSTILL_MIN {
                self.verdict = Verdict::Stands;
            }
            let since = obeys.then(|| self.obeys_since.unwrap_or(now));
            self.obeys_since = since;
            if since.is_some_and(|since| now.saturating_sub(since) >= RECOVERY_TIME) {
                self.verdict = Verdict::Obeys;
                (self.disobeyed, self.obeys_since) = (Duration::ZERO, None);
            }
        } else if obeys {
            self.disobeyed = self
                .disobeyed
                .saturating_sub(span.mul_f64(COMPLIANCE_CREDIT));
        } else {
            self.disobeyed += span;
            if self.disobeyed >= NONCOMPLIANCE_MAX {
                self.verdict = if self.stood >= STANDSTILL_MIN {
                    Verdict::Stands
                } else {
                    Verdict::MovesOtherwise
                };
            }
        }
        self.verdict
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

    /// Drives for so many ticks; when the wheels are no longer trusted, and what is thought of them.
    fn run(
        ticks: u32,
        commanded: impl Fn(f64) -> WheelSpeeds,
        mut measured: impl FnMut(f64) -> WheelSpeeds,
    ) -> Option<(Duration, Verdict)> {
        let mut compliance = CommandCompliance::default();
        (0..ticks).map(|tick| tick * STEP).find_map(|now| {
            compliance.command(now, commanded(now.as_secs_f64()));
            let verdict = compliance.judge(now, measured(now.as_secs_f64()));
            (verdict != Verdict::Obeys).then_some((now, verdict))
        })
    }

    /// The wheels of a base with a servo of first order that obeys us and another node, which writes
    /// this every so many of our periods.
    fn shared(
        ours: impl Fn(f64) -> WheelSpeeds,
        theirs: WheelSpeeds,
        every: u32,
    ) -> impl FnMut(f64) -> WheelSpeeds {
        const LAG_S: f64 = 0.05;
        let mut wheels = WheelSpeeds::default();
        let mut tick = 0;
        move |at_s: f64| {
            // Theirs comes in the middle of a period.
            for half in 0..2 {
                let is_theirs = tick % every == 0 && half == 1;
                let target = if is_theirs { theirs } else { ours(at_s) };
                let share = 0.5 * STEP.as_secs_f64() / LAG_S;
                wheels.left_rad_s += share * (target.left_rad_s - wheels.left_rad_s);
                wheels.right_rad_s += share * (target.right_rad_s - wheels.right_rad_s);
            }
            tick += 1;
            wheels
        }
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
            let commanded = wave((at_s - 0.3).max(0.0));
            speeds(0.9 * commanded.left_rad_s, 1.1 * commanded.right_rad_s)
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
        let forward = |_| speeds(8.0, 8.0);
        let (stuck, verdict) = run(500, forward, |_| speeds(0.0, 0.0)).unwrap();
        assert!(stuck <= NONCOMPLIANCE_MAX + 2 * STEP, "{stuck:?}");
        assert_eq!(verdict, Verdict::Stands);
        // A drive that is switched off coasts for a moment.
        let coasting = |at_s: f64| {
            let speed = 8.0 * (-at_s / 0.08).exp();
            speeds(speed, speed)
        };
        let (_, verdict) = run(500, forward, coasting).unwrap();
        assert_eq!(verdict, Verdict::Stands);
        let (swapped, verdict) = run(500, |_| speeds(2.0, 8.0), |_| speeds(8.0, 2.0)).unwrap();
        assert!(swapped <= NONCOMPLIANCE_MAX + 2 * STEP, "{swapped:?}");
        assert_eq!(verdict, Verdict::MovesOtherwise);
    }

    #[test]
    fn encoders_that_get_stuck_are_named_whatever_the_wheels_did_before() {
        for before in [0, 10, 20] {
            let mut compliance = CommandCompliance::default();
            let mut verdict = Verdict::Obeys;
            // They obey, are blocked for a moment, obey for another, and get stuck.
            for tick in 0..100 + before + 16 + 60 {
                let now = tick * STEP;
                let commanded = speeds(6.0, 6.0);
                let measured = match tick {
                    ..100 => commanded,
                    _ if tick < 100 + before => speeds(1.0, 6.0),
                    _ if tick < 100 + before + 16 => commanded,
                    _ => speeds(0.0, 0.0),
                };
                compliance.command(now, commanded);
                verdict = compliance.judge(now, measured);
            }
            assert_eq!(
                verdict,
                Verdict::Stands,
                "after {before} ticks of another motion"
            );
        }
    }

    #[test]
    fn a_base_that_obeys_another_node_too_is_seen_and_named() {
        let ours = |_: f64| speeds(5.0, 7.0);
        for theirs in [speeds(-6.0, -6.0), speeds(0.0, 0.0), speeds(12.0, -12.0)] {
            let found = run(500, ours, shared(ours, theirs, 1));
            let (after, verdict) = found.unwrap_or_else(|| panic!("{theirs:?}"));
            assert!(after <= Duration::from_secs(2), "{theirs:?}: {after:?}");
            assert_eq!(verdict, Verdict::MovesOtherwise, "{theirs:?}");
        }
    }

    #[test]
    fn wheels_that_obey_two_nodes_in_turns_are_seen_though_they_obey_ours_every_other_time() {
        let ours = |_: f64| speeds(6.0, 6.0);
        for theirs in [speeds(1.0, 11.0), speeds(0.0, 0.0)] {
            let in_turns = |at_s: f64| {
                if at_s % 0.4 < 0.2 {
                    speeds(6.0, 6.0)
                } else {
                    theirs
                }
            };
            let (after, verdict) = run(1_000, ours, in_turns).unwrap();
            assert!(after <= Duration::from_secs(3), "{after:?}");
            assert_eq!(verdict, Verdict::MovesOtherwise);
        }
        // A wheel that is blocked now and then for a moment is not another node's.
        let knocked = |at_s: f64| {
            let factor = if at_s % 1.0 < 0.2 { 0.3 } else { 1.0 };
            speeds(6.0 * factor, 6.0)
        };
        assert_eq!(run(3_000, ours, knocked), None);
    }

    #[test]
    fn wheels_that_obey_again_are_trusted_again() {
        let mut compliance = CommandCompliance::default();
        let mut trusted = Vec::new();
        for tick in 0..400 {
            let now = tick * STEP;
            let is_stuck = tick < 100;
            let commanded = speeds(5.0, 5.0);
            compliance.command(now, commanded);
            let measured = if is_stuck {
                speeds(0.0, 0.0)
            } else {
                commanded
            };
            trusted.push(compliance.judge(now, measured) == Verdict::Obeys);
        }
        assert!(!trusted[99] && !trusted[199 - 5] && trusted[205]);
    }
}
