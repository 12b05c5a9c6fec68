//! A ROS 2 robot behind the drive interface: read and commanded over zenoh, with no ROS on this
//! side.
//!
//! ```text
//! bus ─callback─► topic_receiver (key, attachment, CDR, values, stamp) ─channel─► assemble ─► loop
//! bus ◄─thread─── command ◄──────────── command_cell ◄─────────────────────────── loop
//! bus ◄─thread─── published_topics (plan, driven path, θ, diagnostics) ◄── newest snapshot ◄── loop
//! ```
//! A message that is not entirely valid is dropped and counted by its reason. A base without a
//! valid sample for [`Timing::silent_after`](settings::Timing) is commanded to zero at once, and
//! until the loop itself commands zero, so that the command does not jump.

pub mod assemble;
pub mod bus;
pub mod bus_config;
mod command;
pub mod command_cell;
pub mod command_compliance;
mod command_watch;
pub mod frames;
pub mod notices;
pub(crate) mod published_topics;
pub mod reading;
pub mod refusal;
pub mod settings;
pub mod stamps;
pub mod topic_receiver;
pub mod writer_watch;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

use tread_control::measured::WheelSpeeds;

use self::assemble::{Assembler, QueuedMessage};
use self::bus::Bus;
use self::command_cell::CommandCell;
use self::command_compliance::{CommandCompliance, Verdict};
use self::command_watch::ForeignCommandWatch;
use self::refusal::{Counts, Refusal, Source};
use self::settings::Ros2Settings;
use self::topic_receiver::{MessageObserver, TopicReceiver, WAITING_MAX, topic_of};
use super::{Arrivals, Battery, Drive, Feedback, StatedNoise};
use crate::clock::SharedClock;
use crate::fleet::LinkError;

#[cfg(test)]
pub(crate) mod tests;

/// A ROS 2 base, seen from the loop.
#[derive(Debug)]
pub struct Ros2Drive {
    settings: Arc<Ros2Settings>,
    arrived: Receiver<QueuedMessage>,
    arrivals: Arc<Arrivals>,
    assembler: Assembler,
    command_compliance: CommandCompliance,
    counts: Arc<Counts>,
    command_cell: Arc<CommandCell>,
    now: Duration,
    /// When the last whole sample was measured.
    last_sample_at: Option<Duration>,
    /// The base was silent, and the loop has not come to rest since.
    is_rest_required: bool,
    /// Whether wheels are believed whatever they do.
    is_examined: bool,
    foreign_command_watch: ForeignCommandWatch,
    /// Whether the newest command was to move.
    drives: bool,
}

impl Ros2Drive {
    /// A drive, and the bus to be run in a thread of its own.
    ///
    /// # Errors
    /// [`LinkError::Endpoint`].
    pub fn new(settings: Ros2Settings, clock: &SharedClock) -> Result<(Self, Bus), LinkError> {
        Self::with_observer(settings, clock, None)
    }

    /// A drive of a base that is being examined: somebody else hears every message, and wheels that
    /// do not follow their command are believed all the same.
    ///
    /// # Errors
    /// As [`Ros2Drive::new`].
    pub fn examined(
        settings: Ros2Settings,
        clock: &SharedClock,
        observer: &Arc<dyn MessageObserver>,
    ) -> Result<(Self, Bus), LinkError> {
        Self::with_observer(settings, clock, Some(observer))
    }

    fn with_observer(
        settings: Ros2Settings,
        clock: &SharedClock,
        observer: Option<&Arc<dyn MessageObserver>>,
    ) -> Result<(Self, Bus), LinkError> {
        let settings = Arc::new(settings);
        let topic = |source| Some(topic_of(&settings, source)?.to_string());
        let (counts, command_cell) = (
            Arc::new(Counts::of(topic)),
            Arc::new(CommandCell::default()),
        );
        let arrivals = Arc::new(Arrivals::default());
        let (to_loop, arrived) = sync_channel(WAITING_MAX);
        let receivers = TopicReceiver::all(&settings, &counts, &to_loop, &arrivals, clock);
        let is_examined = observer.is_some();
        let receivers = receivers
            .into_iter()
            .map(|receiver| receiver.with_observer(observer.cloned()))
            .collect();
        let drive = Self {
            is_examined,
            foreign_command_watch: ForeignCommandWatch::default(),
            drives: false,
            assembler: Assembler::new(&settings),
            command_compliance: CommandCompliance::default(),
            arrived,
            arrivals,
            counts,
            command_cell: Arc::clone(&command_cell),
            now: Duration::ZERO,
            last_sample_at: None,
            is_rest_required: false,
            settings: Arc::clone(&settings),
        };
        let counts = Arc::clone(&drive.counts);
        let bus = Bus::new(settings, receivers, command_cell, Arc::clone(clock), counts)?;
        Ok((drive, bus))
    }

    /// How many messages came and were dropped.
    pub fn counts(&self) -> Arc<Counts> {
        Arc::clone(&self.counts)
    }

    /// Whether the base is commanded to rest, whatever the loop commands.
    pub fn is_rest_required(&self) -> bool {
        self.is_rest_required
    }

    fn pace_source(&self) -> Source {
        if self.settings.joints.is_some() {
            Source::Joints
        } else {
            Source::Odometry
        }
    }
}

impl Drive for Ros2Drive {
    fn read(&mut self, now: Duration) -> Feedback {
        self.now = now;
        let mut feedback = Feedback::default();
        let (foreign, drives) = (self.counts.foreign_commands(), self.drives);
        let is_contested = self.foreign_command_watch.check(now, foreign, drives);
        // Bounded by the channel's room.
        for _ in 0..WAITING_MAX {
            let Ok(arrived) = self.arrived.try_recv() else {
                break;
            };
            let Some(measured) = self.assembler.take(&arrived, &mut feedback) else {
                continue;
            };
            let refusal = match self.command_compliance.judge(now, measured) {
                _ if is_contested => Some(Refusal::Contested),
                Verdict::Obeys => None,
                Verdict::Stands => Some(Refusal::Disobedient),
                Verdict::MovesOtherwise => Some(Refusal::OtherMotion),
            };
            if let Some(refusal) = refusal.filter(|_| !self.is_examined) {
                self.counts.refuse(self.pace_source(), refusal);
                feedback.pop();
                continue;
            }
            let is_whole = feedback
                .samples()
                .last()
                .is_some_and(|sample| sample.yaw_rate_rad_s.is_some());
            if is_whole {
                // The base is as old as the older half of its word.
                let turned_at = self.assembler.turned_at().unwrap_or(arrived.at);
                self.last_sample_at = Some(arrived.at.min(turned_at));
            }
        }
        feedback
    }

    fn write(&mut self, command: WheelSpeeds) {
        let rest = WheelSpeeds::default();
        self.is_rest_required = self.is_silent() || (self.is_rest_required && command != rest);
        let written = if self.is_rest_required { rest } else { command };
        self.drives = written != rest;
        self.command_compliance.command(self.now, written);
        self.command_cell.store(written);
    }

    fn battery(&self) -> Option<Battery> {
        self.assembler.battery()
    }

    fn noise(&self) -> StatedNoise {
        self.assembler.noise()
    }

    fn is_silent(&self) -> bool {
        let silent_after = self.settings.timing.silent_after;
        self.last_sample_at
            .is_none_or(|last_sample_at| self.now.saturating_sub(last_sample_at) > silent_after)
    }

    fn silent_after(&self) -> Duration {
        self.settings.timing.silent_after
    }

    fn arrivals(&self) -> Option<Arc<Arrivals>> {
        Some(Arc::clone(&self.arrivals))
    }
}

impl Drop for Ros2Drive {
    /// The bus's thread tells the base to rest, and ends.
    fn drop(&mut self) {
        self.command_cell.close();
    }
}
