//! Teleoperation on the robot: the lease, and the acceptance of drive commands. Pure.
//!
//! ```text
//!            acquire, take                 release, silence of 5 s
//! nobody ─────────────────► leased (epoch) ───────────────────────► nobody
//!                            │         ▲
//!                            └─────────┘ take: another driver, the next epoch
//! ```
//! A command is accepted if it names this run and the epoch of the lease, has a higher sequence
//! number than all before, is finite, and expires within the coming second. Any other is counted
//! and changes nothing. The commanded twist applies until the expiry of the last accepted command.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};
use tread_api::ids::BootId;
use tread_api::safety::{
    BY_LENGTH_MAX, DriveCounts, DriveStatus, Driver, LEASE_SILENCE_MAX_US, Lease,
};
use tread_api::wire::safety::{AcquireLease, DriveCommand, ReleaseLease};
use tread_control::gate::teleoperation::{AgeMeter, STEADY_BEFORE_END_S, within_limits};
use tread_control::geometry::Twist;
use tread_control::robot::RobotModel;
use uuid::Uuid;

/// Number of answered lease requests that are remembered, to answer a repetition alike.
const ANSWERED_MAX: usize = 64;

/// Why a lease is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum LeaseRefusal {
    /// Another driver has the lease.
    Taken(Driver),
    /// The same request was granted before, and that lease has ended.
    Over,
}

/// Result of the check of a drive command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    Accepted,
    Foreign,
    OutOfOrder,
    Expired,
    NotFinite,
}

/// What was granted to a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Granted {
    /// The lease of this epoch.
    Lease(u64),
    /// The end of the lease.
    Release,
}

#[derive(Debug, Clone)]
struct ActiveLease {
    lease: Lease,
    last_message_us: u64,
    last_seq: Option<u64>,
}

/// State of teleoperation as the loop reads it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct TeleoperationView {
    /// Epoch of the lease, and its end without another command, microseconds.
    pub(crate) lease: Option<(u64, u64)>,
    /// Commanded twist, and its expiry, microseconds.
    pub(crate) wanted: Option<(Twist, u64)>,
    /// Fraction of the maximum speed that the age of the commands allows, 0 to 1.
    // Older records name the field `speed_share`.
    #[serde(alias = "speed_share")]
    pub(crate) speed_ratio: f64,
}

impl TeleoperationView {
    /// Whether the lease is in force at `now_us`.
    pub(crate) fn is_leased(&self, now_us: u64) -> bool {
        self.lease.is_some_and(|(_, until_us)| now_us < until_us)
    }

    /// Returns the commanded twist; `None` after its expiry.
    pub(crate) fn wanted_at(&self, now_us: u64) -> Option<Twist> {
        let (twist, until_us) = self.wanted?;
        (now_us < until_us && self.is_leased(now_us)).then_some(twist)
    }

    /// Whether the commanded twist expires so soon that the robot must not accelerate any more.
    pub(crate) fn ends_soon(&self, now_us: u64) -> bool {
        let left = |(_, until_us): (Twist, u64)| seconds_of(until_us.saturating_sub(now_us));
        self.wanted
            .is_none_or(|wanted| left(wanted) < STEADY_BEFORE_END_S)
    }
}

/// The state of teleoperation.
#[derive(Debug, Clone)]
pub(crate) struct Operator {
    boot: BootId,
    model: RobotModel,
    epoch: u64,
    active: Option<ActiveLease>,
    wanted: Option<(Twist, u64)>,
    meter: AgeMeter,
    counts: DriveCounts,
    answered: VecDeque<(Uuid, Granted)>,
}

impl Operator {
    pub(crate) fn new(boot: BootId, model: RobotModel) -> Self {
        Self {
            boot,
            model,
            epoch: 0,
            active: None,
            wanted: None,
            meter: AgeMeter::default(),
            counts: DriveCounts::default(),
            answered: VecDeque::with_capacity(ANSWERED_MAX),
        }
    }

    fn expire_if_silent(&mut self, now_us: u64) {
        let is_silent = self.active.as_ref().is_some_and(|active| {
            now_us >= active.last_message_us.saturating_add(LEASE_SILENCE_MAX_US)
        });
        if is_silent {
            self.clear_lease();
        }
    }

    fn clear_lease(&mut self) {
        self.active = None;
        self.wanted = None;
    }

    fn grant(&mut self, driver: &Driver, now_us: u64) -> u64 {
        self.clear_lease();
        self.epoch += 1;
        let driver = Driver {
            client: driver.client,
            name: driver.name.chars().take(BY_LENGTH_MAX).collect(),
        };
        self.active = Some(ActiveLease {
            lease: Lease {
                epoch: self.epoch,
                driver,
            },
            last_message_us: now_us,
            last_seq: None,
        });
        self.meter = AgeMeter::default();
        self.epoch
    }

    /// Returns the driver who has the lease, if it is another one.
    fn other_driver(&self, own: &Driver) -> Option<&Driver> {
        let driver = self.active.as_ref().map(|active| &active.lease.driver);
        driver.filter(|driver| driver.client != own.client)
    }

    fn remember(&mut self, request: Uuid, granted: Granted) {
        if self.answered.len() >= ANSWERED_MAX {
            self.answered.pop_front();
        }
        self.answered.push_back((request, granted));
    }

    /// Grants the lease and returns its epoch.
    ///
    /// # Errors
    /// [`LeaseRefusal`]: another driver has the lease, or the lease granted to this request is
    /// over.
    pub(crate) fn acquire(
        &mut self,
        command: &AcquireLease,
        now_us: u64,
    ) -> Result<u64, LeaseRefusal> {
        self.expire_if_silent(now_us);
        let own = self.active.as_ref().map(|active| active.lease.epoch);
        let known = self.answered.iter().find_map(|(request, granted)| {
            let epoch = match granted {
                Granted::Lease(epoch) => Some(*epoch),
                Granted::Release => None,
            };
            epoch.filter(|_| *request == command.request)
        });
        if let Some(epoch) = known {
            return if own == Some(epoch) {
                Ok(epoch)
            } else {
                Err(LeaseRefusal::Over)
            };
        }
        let epoch = match (own, self.other_driver(&command.holder)) {
            _ if command.take => self.grant(&command.holder, now_us),
            (_, Some(other)) => return Err(LeaseRefusal::Taken(other.clone())),
            (Some(own), None) => own,
            (None, None) => self.grant(&command.holder, now_us),
        };
        self.remember(command.request, Granted::Lease(epoch));
        Ok(epoch)
    }

    /// Ends the lease.
    ///
    /// # Errors
    /// The driver who has the lease, if it is another one.
    pub(crate) fn release(&mut self, command: &ReleaseLease, now_us: u64) -> Result<(), Driver> {
        self.expire_if_silent(now_us);
        let answer = (command.request, Granted::Release);
        if self.answered.contains(&answer) {
            return Ok(());
        }
        if let Some(other) = self.other_driver(&command.holder) {
            return Err(other.clone());
        }
        self.clear_lease();
        self.remember(command.request, Granted::Release);
        Ok(())
    }

    /// Checks a drive command, and applies it if accepted.
    pub(crate) fn drive(&mut self, command: &DriveCommand, now_us: u64) -> Verdict {
        self.expire_if_silent(now_us);
        let verdict = self.judge(command, now_us);
        let count = match verdict {
            Verdict::Accepted => &mut self.counts.accepted,
            Verdict::Foreign => &mut self.counts.foreign,
            Verdict::OutOfOrder => &mut self.counts.out_of_order,
            Verdict::Expired => &mut self.counts.expired,
            Verdict::NotFinite => &mut self.counts.malformed,
        };
        *count += 1;
        if verdict != Verdict::Accepted {
            return verdict;
        }
        let requested = Twist {
            linear_m_s: command.twist.linear_m_s,
            angular_rad_s: command.twist.angular_rad_s,
        };
        let (within, is_over) = within_limits(requested, &self.model);
        self.counts.over_limit += u64::from(is_over);
        self.wanted = Some((within, command.until_us));
        let age_us = now_us.saturating_sub(command.sent_us);
        self.meter.record(seconds_of(age_us));
        if let Some(active) = &mut self.active {
            active.last_message_us = now_us;
            active.last_seq = Some(command.seq);
        }
        verdict
    }

    fn judge(&self, command: &DriveCommand, now_us: u64) -> Verdict {
        let Some(active) = self
            .active
            .as_ref()
            .filter(|active| command.boot == self.boot && command.epoch == active.lease.epoch)
        else {
            return Verdict::Foreign;
        };
        if active.last_seq.is_some_and(|last| command.seq <= last) {
            Verdict::OutOfOrder
        } else if !command.is_in_time(now_us) {
            Verdict::Expired
        } else if !(command.twist.linear_m_s.is_finite() && command.twist.angular_rad_s.is_finite())
        {
            Verdict::NotFinite
        } else {
            Verdict::Accepted
        }
    }

    /// Counts a drive command that does not parse or is too large.
    pub(crate) fn count_malformed(&mut self) {
        self.counts.malformed += 1;
    }

    /// Returns the state as the loop reads it.
    pub(crate) fn view(&self) -> TeleoperationView {
        TeleoperationView {
            lease: self.active.as_ref().map(|active| {
                let until_us = active.last_message_us.saturating_add(LEASE_SILENCE_MAX_US);
                (active.lease.epoch, until_us)
            }),
            wanted: self.wanted,
            speed_ratio: self.meter.speed_ratio(),
        }
    }

    /// Returns the lease in force at `now_us`.
    pub(crate) fn lease_at(&self, now_us: u64) -> Option<&Lease> {
        let active = self.active.as_ref()?;
        let until_us = active.last_message_us.saturating_add(LEASE_SILENCE_MAX_US);
        (now_us < until_us).then_some(&active.lease)
    }

    /// Returns the state for the robot's state message; `None` before the first lease or command.
    pub(crate) fn status(&self) -> Option<DriveStatus> {
        let is_silent = self.counts == DriveCounts::default();
        (self.epoch > 0 || !is_silent).then(|| DriveStatus {
            command_age_ms: self.meter.worst_s().map(|age_s| 1_000.0 * age_s),
            speed_ratio: self.meter.speed_ratio(),
            counts: self.counts,
        })
    }
}

/// Converts microseconds to seconds.
fn seconds_of(time_us: u64) -> f64 {
    std::time::Duration::from_micros(time_us).as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn boot(number: u128) -> BootId {
        BootId::from_uuid(Uuid::from_u128(number))
    }

    fn driver(number: u128) -> Driver {
        Driver {
            client: Uuid::from_u128(100 + number),
            name: format!("driver {number}"),
        }
    }

    fn acquire(number: u128, who: u128) -> AcquireLease {
        AcquireLease {
            request: Uuid::from_u128(number),
            holder: driver(who),
            take: false,
        }
    }

    fn take(number: u128, who: u128) -> AcquireLease {
        AcquireLease {
            take: true,
            ..acquire(number, who)
        }
    }

    #[test]
    fn a_refusal_names_the_holder_and_a_taken_lease_is_gone_for_good() {
        let mut operator = Operator::new(boot(1), RobotModel::yi2007());
        assert_eq!(operator.acquire(&acquire(1, 0), 0), Ok(1));
        let refused = operator.acquire(&acquire(2, 1), 0);
        assert_eq!(refused, Err(LeaseRefusal::Taken(driver(0))));
        assert_eq!(operator.acquire(&take(3, 1), 0), Ok(2));
        // The first one's request comes twice; it must not steal the lease back, nor get an answer that
        // it has it.
        let again = operator.acquire(&acquire(1, 0), 0);
        assert_eq!(again, Err(LeaseRefusal::Over));
        let release = ReleaseLease {
            request: Uuid::from_u128(4),
            holder: driver(0),
        };
        assert_eq!(operator.release(&release, 0), Err(driver(1)));
        assert_eq!(operator.lease_at(0).unwrap().driver, driver(1));
    }

    #[test]
    fn a_lease_whose_driver_is_silent_frees_itself() {
        let mut operator = Operator::new(boot(1), RobotModel::yi2007());
        operator.acquire(&acquire(1, 0), 0).unwrap();
        assert!(operator.lease_at(LEASE_SILENCE_MAX_US - 1).is_some());
        assert!(operator.lease_at(LEASE_SILENCE_MAX_US).is_none());
        let next = operator.acquire(&acquire(2, 1), LEASE_SILENCE_MAX_US);
        assert_eq!(next, Ok(2));
    }
}
