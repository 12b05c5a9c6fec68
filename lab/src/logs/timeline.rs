//! The time of each value, and the samples that the control loop takes.
//!
//! Times are found as on a robot, message by message in the order of recording: by its stamp, if the
//! writer's clock is the recorder's; by its stamp and the smallest delay seen, if it is another
//! clock; by the recorder's time, if stamps do not advance. What is late or came twice is refused.
//! Values are then ordered by these times, so that a recorder which was busy changes nothing, and
//! put together to samples by the agent's own assembler.

use std::time::Duration;

use tread_agent::drive::ros2::assemble::{Assembler, QueuedMessage};
use tread_agent::drive::ros2::reading::{Content, Wheels};
use tread_agent::drive::ros2::refusal::Source;
use tread_agent::drive::ros2::settings::{Ros2Settings, StampClock};
use tread_agent::drive::ros2::stamps::{AHEAD_MAX_NS, Arrival, Stamps};
use tread_agent::drive::{Feedback, SensorSample, StatedNoise};
use tread_control::measured::{WheelSpeeds, WheelTorques};

use super::decode::{Refusals, Timed};
use super::mapping::LATE_AFTER;

/// Time before the first message, so that one that is older than its record has a time.
const LEAD: Duration = Duration::from_secs(10);
/// Interval of wheel speeds that are interpolated, seconds.
const INTERPOLATED_S: f64 = 0.02;
/// Intervals of wheel speeds between which they are interpolated: what the estimator bridges by
/// itself is left as it is, and a longer one is a gap.
const INTERPOLATED_RANGE_S: std::ops::RangeInclusive<f64> = 0.09..=0.35;

/// Where the times of a topic come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// Stamps by the recorder's clock.
    Stamps,
    /// Stamps by another clock, to which the smallest delay is added.
    OtherStamps,
    /// The recorder's own times.
    Recorder,
}

impl Clock {
    /// Returns a name for reports.
    pub fn text(self) -> &'static str {
        match self {
            Self::Stamps => "stamps",
            Self::OtherStamps => "stamps of another clock",
            Self::Recorder => "time of recording, since stamps stand still",
        }
    }
}

/// A sample of the loop, and the noise that covariances state at its time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopInput {
    /// The sample.
    pub sample: SensorSample,
    /// Stated noise.
    pub noise: StatedNoise,
}

/// Samples in the order of their times.
#[derive(Debug, Clone, PartialEq)]
pub struct Timeline {
    /// The samples.
    pub fed: Vec<LoopInput>,
    /// The clock of each topic.
    pub clocks: Vec<(Source, Clock)>,
    /// Wheel speeds that were interpolated.
    pub interpolated: u64,
}

/// Returns a time of [`Timeline`] as seconds since the first message.
pub fn since_begin_s(at: Duration) -> f64 {
    at.as_secs_f64() - LEAD.as_secs_f64()
}

fn clock_of(timed: &[Timed], source: Source) -> Clock {
    let own = || timed.iter().filter(|timed| timed.source == source);
    let pairs = own().zip(own().skip(1));
    let standing = pairs.filter(|(before, after)| before.stamp_ns == after.stamp_ns);
    // A writer that sends each message twice repeats every other stamp.
    let stands = 2 * standing.count() > own().count();
    let delay_ns = own()
        .map(|one| one.logged_ns.saturating_sub(one.stamp_ns))
        .min();
    let late_ns = i64::try_from(LATE_AFTER.as_nanos()).unwrap_or(i64::MAX);
    if stands {
        Clock::Recorder
    } else if delay_ns.is_some_and(|delay_ns| (-AHEAD_MAX_NS..late_ns).contains(&delay_ns)) {
        Clock::Stamps
    } else {
        Clock::OtherStamps
    }
}

/// Finds the time of each value and makes samples of them. With `interpolates`, wheel speeds that
/// come too seldom for the estimator are interpolated.
pub fn assemble(
    mut timed: Vec<Timed>,
    settings: &Ros2Settings,
    refusals: &mut Refusals,
    interpolates: bool,
) -> Timeline {
    timed.sort_by_key(|timed| timed.logged_ns);
    let first_ns = timed.first().map_or(0, |first| first.logged_ns);
    let (mut arrived, mut clocks) = (Vec::with_capacity(timed.len()), Vec::new());
    for source in Source::ALL {
        if !timed.iter().any(|timed| timed.source == source) {
            continue;
        }
        let clock = clock_of(&timed, source);
        clocks.push((source, clock));
        let mut stamps = Stamps::new(
            match clock {
                Clock::OtherStamps => StampClock::Base,
                Clock::Stamps | Clock::Recorder => StampClock::Host,
            },
            LATE_AFTER,
        );
        for timed in timed.iter().filter(|timed| timed.source == source) {
            let since = Duration::from_nanos(timed.logged_ns.abs_diff(first_ns));
            let stamp_ns = match clock {
                Clock::Recorder => timed.logged_ns,
                Clock::Stamps | Clock::OtherStamps => timed.stamp_ns,
            };
            let arrival = Arrival {
                monotonic: LEAD + since,
                wall_ns: timed.logged_ns,
            };
            match stamps.place(stamp_ns, arrival) {
                Ok(at) => arrived.push(QueuedMessage {
                    at,
                    content: timed.content,
                }),
                Err(refusal) => refusals.count(source, refusal),
            }
        }
    }
    arrived.sort_by_key(|arrived| arrived.at);
    let before = arrived.len();
    if interpolates {
        arrived = interpolate(arrived);
    }
    Timeline {
        interpolated: (arrived.len() - before) as u64,
        fed: samples(&arrived, settings),
        clocks,
    }
}

fn samples(arrived: &[QueuedMessage], settings: &Ros2Settings) -> Vec<LoopInput> {
    let mut assembler = Assembler::new(settings);
    let mut fed = Vec::with_capacity(arrived.len());
    for one in arrived {
        let mut feedback = Feedback::default();
        assembler.take(one, &mut feedback);
        let noise = assembler.noise();
        fed.extend(
            feedback
                .samples()
                .iter()
                .map(|&sample| LoopInput { sample, noise }),
        );
    }
    fed
}

/// Wheel speeds between two messages, on a straight line.
#[derive(Debug, Clone, Copy)]
struct Interpolation {
    before: Wheels,
    after: Wheels,
}

impl Interpolation {
    /// Returns the wheel speeds after a share of the time between the messages.
    fn at(&self, share: f64) -> Wheels {
        let Self { before, after } = self;
        let mix = |before: f64, after: f64| before + share * (after - before);
        let torques = before.torques.zip(after.torques);
        Wheels {
            speeds: WheelSpeeds {
                left_rad_s: mix(before.speeds.left_rad_s, after.speeds.left_rad_s),
                right_rad_s: mix(before.speeds.right_rad_s, after.speeds.right_rad_s),
            },
            torques: torques.map(|(before, after)| WheelTorques {
                left_n_m: mix(before.left_n_m, after.left_n_m),
                right_n_m: mix(before.right_n_m, after.right_n_m),
            }),
        }
    }
}

/// Adds wheel speeds between those that are far apart, on a straight line.
fn interpolate(arrived: Vec<QueuedMessage>) -> Vec<QueuedMessage> {
    let (mut added, mut last): (Vec<QueuedMessage>, Option<(Duration, Wheels)>) =
        (Vec::new(), None);
    for one in &arrived {
        let Content::Wheels(wheels) = one.content else {
            continue;
        };
        if let Some((before_at, before)) = last.replace((one.at, wheels)) {
            let gap = one.at.saturating_sub(before_at);
            let gap_s = gap.as_secs_f64();
            if INTERPOLATED_RANGE_S.contains(&gap_s) {
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "a number of steps within a third of a second"
                )]
                let steps = (gap_s / INTERPOLATED_S).round() as u32;
                let line = Interpolation {
                    before,
                    after: wheels,
                };
                added.extend((1..steps).map(|step| QueuedMessage {
                    at: before_at + gap * step / steps,
                    content: Content::Wheels(line.at(f64::from(step) / f64::from(steps))),
                }));
            }
        }
    }
    let mut all = arrived;
    all.append(&mut added);
    all.sort_by_key(|arrived| arrived.at);
    all
}

#[cfg(test)]
mod tests;
