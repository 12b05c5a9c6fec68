//! Randomised trials of teleoperation over a bad network: how soon silence brings the robot to
//! rest, and over which distance.
//!
//! A driver sends a command every 50 ms, each with an end a little ahead; messages are lost,
//! delayed, doubled and reordered, and the loop stalls now and then. At a random moment the driver
//! falls silent, and what is still under way arrives. All on the bench's clock, so a seed repeats
//! to the bit.

use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tread_agent::sim::scenario::Scenario;
use tread_agent::testing::{Bench, BenchError, PERIOD, boot};
use tread_api::geometry::Twist;
use tread_api::safety::Driver;
use tread_api::wire;
use tread_api::wire::safety::{AcquireLease, DriveCommand};
use tread_control::gate::GateLimits;
use tread_control::geometry::Pose;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};
use uuid::Uuid;

/// Longest time from the last valid end until the target is zero.
pub const ZERO_WITHIN: Duration = Duration::from_millis(250);
/// Commands are sent this often.
const SEND_EVERY_US: u64 = 50_000;
/// Longest trial after the driver has fallen silent.
const SETTLE_MAX: Duration = Duration::from_secs(6);

/// Result of the trials.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TeleoperationReport {
    /// Trials that were run.
    pub trials: u64,
    /// Ends of commands after which the target had to become zero.
    pub silences: u64,
    /// Number of these after which the target was not zero within [`ZERO_WITHIN`].
    pub misses: u64,
    /// Maximum time from the end of a command to a target of zero, milliseconds.
    pub worst_zero_ms: f64,
    /// Maximum speed of the robot at the end of a trial's last command, metres per second.
    pub fastest_m_s: f64,
    /// Trials in which the robot needed a longer distance to stop than `v²/2a + v·0.25 s`, or did not rest;
    /// `a` is the braking ramp, or what the ground gives where that is less.
    pub overruns: u64,
    /// Maximum ratio of a trial's stopping distance to that distance.
    pub worst_distance_share: f64,
}

struct PendingCommand {
    arrives_us: u64,
    until_us: u64,
    payload: Vec<u8>,
}

struct Trial<'bench> {
    bench: &'bench mut Bench,
    random: &'bench mut ChaCha8Rng,
    report: &'bench mut TeleoperationReport,
    under_way: Vec<PendingCommand>,
    /// Number of the last command.
    seq: u64,
    /// The end of the command that was taken last, and whether its silence was counted.
    last_end: Option<(u64, bool)>,
}

impl Trial<'_> {
    fn send(&mut self, epoch: u64, twist: Twist) {
        self.seq += 1;
        let now_us = self.bench.now_us();
        let until_us = now_us + self.random.random_range(100_000..600_000_u64);
        let command = DriveCommand {
            boot: boot(),
            epoch,
            seq: self.seq,
            sent_us: now_us,
            until_us,
            twist,
        };
        let Ok(payload) = wire::encode(&command) else {
            return;
        };
        if self.random.random_bool(0.2) {
            return;
        }
        let copies = if self.random.random_bool(0.1) { 2 } else { 1 };
        for _ in 0..copies {
            self.under_way.push(PendingCommand {
                arrives_us: now_us + self.random.random_range(1_000..400_000_u64),
                until_us,
                payload: payload.clone(),
            });
        }
    }

    fn deliver(&mut self) {
        let now_us = self.bench.now_us();
        while let Some(place) = self
            .under_way
            .iter()
            .position(|message| message.arrives_us <= now_us)
        {
            let message = self.under_way.swap_remove(place);
            if self.bench.teleoperate(&message.payload) {
                self.last_end = Some((message.until_us, false));
            }
        }
    }

    fn tick(&mut self) {
        if self.random.random_bool(0.002) {
            // The loop gets no time for a while.
            let stall = Duration::from_millis(self.random.random_range(20..60_u64));
            self.bench.pass_time(stall);
        }
        self.deliver();
        self.bench.tick();
        let now_us = self.bench.now_us();
        if let Some((until_us, is_counted)) = self.last_end
            && !is_counted
            && now_us >= until_us
        {
            let late = Duration::from_micros(now_us - until_us);
            if self.bench.target_rests() {
                self.report.silences += 1;
                let late_ms = 1_000.0 * late.as_secs_f64();
                self.report.worst_zero_ms = self.report.worst_zero_ms.max(late_ms);
                self.last_end = Some((until_us, true));
            } else if late > ZERO_WITHIN {
                self.report.silences += 1;
                self.report.misses += 1;
                self.last_end = Some((until_us, true));
            }
        }
    }

    fn run(&mut self, number: u128) {
        let request = AcquireLease {
            request: Uuid::from_u128(number + 1),
            take: true,
            holder: Driver {
                client: Uuid::from_u128(7),
                name: "trial".to_owned(),
            },
        };
        let Ok(epoch) = self.bench.lease(&request) else {
            self.report.misses += 1;
            return;
        };
        let twist = Twist {
            linear_m_s: self.random.random_range(-1.2..1.2),
            angular_rad_s: self.random.random_range(-1.5..1.5),
        };
        let began_us = self.bench.now_us();
        let silent_from_us = began_us + self.random.random_range(300_000..2_000_000_u64);
        let mut next_us = began_us;
        while self.bench.now_us() < silent_from_us {
            if self.bench.now_us() >= next_us {
                self.send(epoch, twist);
                next_us += SEND_EVERY_US;
            }
            self.tick();
        }
        self.settle();
    }

    /// From the driver's silence until the robot stands.
    fn settle(&mut self) {
        let until = self.bench.now() + SETTLE_MAX;
        let model = RobotModel::yi2007();
        let ramp_m_s2 = GateLimits::of(&model).wheel_braking_max_rad_s2 * model.wheel_radius_m();
        let mut braking_m_s2 = ramp_m_s2;
        // Distance since the last end, and the speed then; begins anew with every end.
        let mut since: Option<(u64, f64, f64)> = None;
        while self.bench.now() < until {
            let before = *self.bench.drive().truth();
            let before_us = self.bench.now_us();
            self.tick();
            // Where locked wheels give less than the ramp asks for, that is the ground's matter.
            let ground = self.bench.drive().ground_truth().curve();
            let ground_m_s2 = ground.map_or(0.0, |curve| curve.mu(1.0) * GRAVITY_M_S2);
            braking_m_s2 = braking_m_s2.min(ground_m_s2);
            let truth = self.bench.drive().truth();
            let step_m = before.pose.point().distance_m(truth.pose.point());
            let (now_us, after) = (self.bench.now_us(), *truth);
            match self.last_end {
                Some((end_us, _)) if now_us >= end_us => match &mut since {
                    Some((known_us, _, distance_m)) if *known_us == end_us => *distance_m += step_m,
                    Some(_) | None => {
                        // Of this tick's distance only what came after the end, and the speed then.
                        let rest = Duration::from_micros(now_us - end_us.max(before_us));
                        let whole = Duration::from_micros(now_us - before_us);
                        let share = rest.as_secs_f64() / whole.as_secs_f64();
                        let speed_m_s = share * before.twist().linear_m_s
                            + (1.0 - share) * after.twist().linear_m_s;
                        since = Some((end_us, speed_m_s.abs(), share * step_m));
                    }
                },
                Some(_) | None => {}
            }
            if self.under_way.is_empty() && self.bench.target_rests() && self.bench.is_standing() {
                if let Some((_, speed_m_s, distance_m)) = since {
                    let allowed_m = speed_m_s * speed_m_s / (2.0 * braking_m_s2) + speed_m_s * 0.25;
                    let report = &mut *self.report;
                    report.fastest_m_s = report.fastest_m_s.max(speed_m_s);
                    if distance_m > 0.0 {
                        report.worst_distance_share =
                            report.worst_distance_share.max(distance_m / allowed_m);
                    }
                    report.overruns += u64::from(distance_m > allowed_m);
                }
                return;
            }
        }
        self.report.overruns += 1;
    }
}

/// Number and seed of the trials.
#[derive(Debug, Clone, Copy)]
pub struct TrialRun {
    /// Number of trials.
    pub trials: u64,
    /// Seed of their random numbers.
    pub seed: u64,
}

/// Runs the trials on one robot.
///
/// # Errors
/// [`BenchError`] when the bench cannot be made; the built-in scenario always can.
pub fn run(TrialRun { trials, seed }: TrialRun) -> Result<TeleoperationReport, BenchError> {
    let impossible = |cause: String| BenchError::Impossible(cause);
    let scenario = Scenario::built_in().map_err(|cause| impossible(cause.to_string()))?;
    let start = Pose {
        x_m: 4.0,
        y_m: 3.0,
        heading_rad: 0.0,
    };
    let mut bench =
        Bench::new(&scenario, start, seed).map_err(|cause| impossible(cause.to_string()))?;
    bench.run_for(10 * PERIOD);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut report = TeleoperationReport::default();
    for number in 0..trials {
        let mut trial = Trial {
            bench: &mut bench,
            random: &mut random,
            report: &mut report,
            under_way: Vec::new(),
            seq: 0,
            last_end: None,
        };
        trial.run(u128::from(number));
        report.trials += 1;
    }
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_brings_the_robot_to_rest_in_time_and_within_its_braking_distance() {
        let report = run(TrialRun {
            trials: 150,
            seed: 9,
        })
        .unwrap();
        assert_eq!((report.misses, report.overruns), (0, 0), "{report:?}");
        assert!(
            report.silences >= 150 && report.fastest_m_s > 0.7,
            "{report:?}"
        );
        assert!(report.worst_zero_ms <= 250.0, "{report:?}");
        assert!(report.worst_distance_share <= 1.0, "{report:?}");
    }

    #[test]
    fn a_seed_repeats_to_the_bit() {
        let short = TrialRun { trials: 5, seed: 3 };
        assert_eq!(run(short).unwrap(), run(short).unwrap());
    }
}
