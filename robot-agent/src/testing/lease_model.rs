//! Model-based test of the teleoperation lease: random drivers on a random network.
//!
//! Messages are lost, delayed, duplicated and reordered. Drivers acquire leases, take them over,
//! fall silent and return; messages of old boots and old leases arrive. A reference model derives
//! from the messages alone which commands have to be accepted.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tread_api::geometry::Twist;
use tread_api::ids::BootId;
use tread_api::safety::{DRIVE_AHEAD_MAX_US, DriveCounts, Driver, LEASE_SILENCE_MAX_US, Lease};
use tread_api::wire::safety::{AcquireLease, DriveCommand, LeaseCommand, ReleaseLease};
use tread_control::robot::RobotModel;
use uuid::Uuid;

use crate::safety::operator::{LeaseRefusal, Operator, Verdict};

/// Number of competing drivers.
const DRIVERS: usize = 4;
/// Maximum number of messages in flight.
const UNDER_WAY_MAX: usize = 64;

fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

fn driver(number: usize) -> Driver {
    Driver {
        client: Uuid::from_u128(100 + number as u128),
        name: format!("driver {number}"),
    }
}

/// Result of a run of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LeaseModelReport {
    /// Number of steps.
    pub steps: u64,
    /// Number of leases granted.
    pub leases: u64,
    /// Number of commands accepted that the reference refuses.
    pub wrongly_accepted: u64,
    /// Number of commands refused that the reference accepts.
    pub wrongly_refused: u64,
    /// Number of commands in effect beyond their end time.
    pub outlived: u64,
    /// Number of leases granted while another driver held one, or with a decreasing epoch.
    pub stolen: u64,
    /// Counts of the robot's verdicts on commands.
    pub counts: DriveCounts,
}

/// Parameters of a run of the model.
#[derive(Debug, Clone, Copy)]
pub struct LeaseModelRun {
    /// Number of steps.
    pub steps: u64,
    /// Seed of the random numbers.
    pub seed: u64,
}

/// Runs the model and compares the robot with the reference.
pub fn run(LeaseModelRun { steps, seed }: LeaseModelRun) -> LeaseModelReport {
    let mut world = World::new(seed);
    for _ in 0..steps {
        world.step();
    }
    let counts = world.operator.status().map(|status| status.counts);
    LeaseModelReport {
        steps,
        counts: counts.unwrap_or_default(),
        ..world.report
    }
}

#[derive(Debug, Clone)]
enum Message {
    Lease(LeaseCommand, usize),
    Drive(DriveCommand, usize),
}

/// State of a driver: the lease that it assumes to hold.
#[derive(Debug, Clone, Copy, Default)]
struct Side {
    epoch: Option<u64>,
    seq: u64,
}

/// Reference state, derived from the messages alone.
#[derive(Debug, Default)]
struct Truth {
    /// Granted epochs, each with the number of its driver.
    granted: Vec<(u64, usize)>,
    /// Largest accepted sequence number of the newest lease.
    last_seq: Option<u64>,
    /// End time of the last accepted command, microseconds.
    until_us: u64,
    /// Time of the driver's last message, microseconds; `None` after the release of the lease.
    heard_us: Option<u64>,
}

impl Truth {
    fn is_leased(&self, now_us: u64) -> bool {
        self.heard_us
            .is_some_and(|heard_us| now_us < heard_us + LEASE_SILENCE_MAX_US)
    }
}

struct World {
    random: ChaCha8Rng,
    operator: Operator,
    sides: [Side; DRIVERS],
    under_way: Vec<(u64, Message)>,
    truth: Truth,
    now_us: u64,
    requests: u128,
    /// Requests that released a lease.
    released: Vec<Uuid>,
    report: LeaseModelReport,
}

impl World {
    fn new(seed: u64) -> Self {
        Self {
            random: ChaCha8Rng::seed_from_u64(seed),
            operator: Operator::new(boot(1), RobotModel::yi2007()),
            sides: [Side::default(); DRIVERS],
            under_way: Vec::new(),
            truth: Truth::default(),
            now_us: 1_000_000,
            requests: 0,
            released: Vec::new(),
            report: LeaseModelReport::default(),
        }
    }

    fn chance(&mut self, share: f64) -> bool {
        self.random.random_bool(share)
    }

    fn post(&mut self, message: &Message) {
        if self.chance(0.1) || self.under_way.len() >= UNDER_WAY_MAX {
            return;
        }
        let copies = if self.chance(0.1) { 2 } else { 1 };
        for _ in 0..copies {
            let delay_us = if self.chance(0.05) {
                self.random.random_range(0..8_000_000)
            } else {
                self.random.random_range(0..200_000)
            };
            self.under_way
                .push((self.now_us + delay_us, message.clone()));
        }
    }

    fn act(&mut self) {
        let number = self.random.random_range(0..DRIVERS);
        if self.chance(0.03) {
            let choice = self.random.random_range(0..4);
            self.requests += 1;
            let request = Uuid::from_u128(self.requests);
            let holder = driver(number);
            let command = match choice {
                0..3 => LeaseCommand::Acquire(AcquireLease {
                    request,
                    holder,
                    take: choice == 2,
                }),
                _ => LeaseCommand::Release(ReleaseLease { request, holder }),
            };
            self.post(&Message::Lease(command, number));
            return;
        }
        let side = &mut self.sides[number];
        side.seq += 1;
        let (epoch, seq) = (side.epoch.unwrap_or(0), side.seq);
        let old = self.chance(0.05);
        let odd = self.random.random_range(0..40);
        let ahead_us = match odd {
            0 => 0,
            1 => DRIVE_AHEAD_MAX_US + 1_000_000,
            _ => self.random.random_range(50_000..600_000),
        };
        let linear_m_s = match odd {
            2 => f64::NAN,
            3 => f64::INFINITY,
            4 => 50.0,
            _ => self.random.random_range(-1.0..1.0),
        };
        let command = DriveCommand {
            boot: boot(if odd == 5 { 2 } else { 1 }),
            epoch: if old { epoch.saturating_sub(1) } else { epoch },
            seq,
            sent_us: self.now_us,
            until_us: self.now_us + ahead_us,
            twist: Twist {
                linear_m_s,
                angular_rad_s: 0.1,
            },
        };
        self.post(&Message::Drive(command, number));
    }

    /// Requests the lease. Returns the holder named in a refusal.
    fn acquire(
        &mut self,
        command: &AcquireLease,
        number: usize,
        before: Option<&Lease>,
    ) -> Option<Driver> {
        let epoch = match self.operator.acquire(command, self.now_us) {
            Ok(epoch) => epoch,
            Err(LeaseRefusal::Taken(other)) => return Some(other),
            Err(LeaseRefusal::Over) => return None,
        };
        let newest = self.truth.granted.last().map_or(0, |&(epoch, _)| epoch);
        self.report.stolen += u64::from(epoch < newest);
        if epoch > newest {
            self.report.leases += 1;
            self.truth.granted.push((epoch, number));
            self.truth.last_seq = None;
            self.truth.until_us = 0;
            self.truth.heard_us = Some(self.now_us);
            self.report.stolen += u64::from(before.is_some() && !command.take);
        }
        let present = self.operator.lease_at(self.now_us);
        let is_its_own = present.is_some_and(|lease| lease.driver == driver(number));
        self.report.stolen += u64::from(!is_its_own);
        // The answer reaches the driver with a probability of 0.9.
        if self.chance(0.9) {
            self.sides[number] = Side {
                epoch: Some(epoch),
                seq: self.sides[number].seq,
            };
        }
        None
    }

    /// Releases the lease. Returns the holder named in a refusal.
    fn release(&mut self, command: &ReleaseLease) -> Option<Driver> {
        let is_known = self.released.contains(&command.request);
        match self.operator.release(command, self.now_us) {
            Ok(()) if is_known => None,
            Ok(()) => {
                self.truth.heard_us = None;
                self.released.push(command.request);
                None
            }
            Err(other) => Some(other),
        }
    }

    fn arrive(&mut self, message: Message) {
        match message {
            Message::Lease(command, number) => {
                let before = self.operator.lease_at(self.now_us).cloned();
                if before.is_some() != self.truth.is_leased(self.now_us) {
                    self.report.stolen += 1;
                }
                let other = match command {
                    LeaseCommand::Acquire(acquire) => {
                        self.acquire(&acquire, number, before.as_ref())
                    }
                    LeaseCommand::Release(release) => self.release(&release),
                };
                if let Some(other) = other {
                    let is_named = before.is_some_and(|lease| lease.driver == other);
                    self.report.stolen += u64::from(!is_named);
                }
                if !self.truth.is_leased(self.now_us) {
                    self.truth.until_us = 0;
                }
            }
            Message::Drive(command, number) => {
                let is_leased = self.truth.is_leased(self.now_us);
                let newest = self.truth.granted.last().copied();
                let is_good = command.boot == boot(1)
                    && is_leased
                    && newest == Some((command.epoch, number))
                    && self.truth.last_seq.is_none_or(|last| command.seq > last)
                    && command.until_us > self.now_us
                    && command.until_us <= self.now_us + DRIVE_AHEAD_MAX_US
                    && command.twist.linear_m_s.is_finite();
                let is_taken = self.operator.drive(&command, self.now_us) == Verdict::Accepted;
                self.report.wrongly_accepted += u64::from(is_taken && !is_good);
                self.report.wrongly_refused += u64::from(is_good && !is_taken);
                if is_taken {
                    self.truth.last_seq = Some(command.seq);
                    self.truth.until_us = command.until_us;
                    self.truth.heard_us = Some(self.now_us);
                }
            }
        }
    }

    fn step(&mut self) {
        self.now_us += self.random.random_range(0..20_000);
        if self.chance(0.0005) {
            // All drivers are silent for a while.
            self.now_us += 6_000_000;
        }
        self.act();
        let now_us = self.now_us;
        while let Some(place) = self
            .under_way
            .iter()
            .position(|(at_us, _)| *at_us <= now_us)
        {
            let (_, message) = self.under_way.swap_remove(place);
            self.arrive(message);
        }
        let wanted = self.operator.view().wanted_at(now_us);
        if let Some(wanted) = wanted {
            let is_sane = wanted.is_finite() && wanted.linear_m_s.abs() <= 1.0;
            self.report.outlived += u64::from(now_us >= self.truth.until_us || !is_sane);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_stale_expired_old_or_foreign_command_is_ever_taken_and_no_good_one_refused() {
        let report = run(LeaseModelRun {
            steps: 100_000,
            seed: 5,
        });
        assert_eq!(report.wrongly_accepted, 0, "{report:?}");
        assert_eq!(report.wrongly_refused, 0, "{report:?}");
        assert_eq!((report.outlived, report.stolen), (0, 0), "{report:?}");
        let counts = report.counts;
        for (what, count) in [
            ("accepted", counts.accepted),
            ("over the limit", counts.over_limit),
            ("malformed", counts.malformed),
            ("foreign", counts.foreign),
            ("out of order", counts.out_of_order),
            ("expired", counts.expired),
            ("leases", report.leases),
        ] {
            assert!(
                count > 20,
                "only {count} {what}: the model tries too little"
            );
        }
    }
}
