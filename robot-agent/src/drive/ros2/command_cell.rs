//! Passes the newest command from the loop to the thread that writes it on the bus.
//!
//! The loop stores it without blocking, and the thread writes each command once. If the loop stores
//! none for [`COMMAND_SILENCE_MAX`], it is assumed to be stuck and the thread writes zero; no
//! command is ever repeated.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::Thread;
use std::time::Duration;

use tread_control::measured::WheelSpeeds;

/// Longest time without a new command; after it the base is commanded to zero.
pub const COMMAND_SILENCE_MAX: Duration = Duration::from_millis(100);

/// Cell of the newest command.
#[derive(Debug, Default)]
pub struct CommandCell {
    /// Left and right speed as single-precision numbers in one word, so that both are read
    /// consistently.
    speeds: AtomicU64,
    number: AtomicU64,
    is_closed: AtomicBool,
    thread: OnceLock<Thread>,
}

impl CommandCell {
    /// Makes each command wake the calling thread.
    pub fn register_thread(&self) {
        // A second thread would be a programming error; the first one stays registered.
        let _ = self.thread.set(std::thread::current());
    }

    /// Stores a command.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a wheel's speed needs no more than seven digits"
    )]
    pub fn store(&self, command: WheelSpeeds) {
        let left = u64::from((command.left_rad_s as f32).to_bits());
        let right = u64::from((command.right_rad_s as f32).to_bits());
        self.speeds.store(left << 32 | right, Ordering::Relaxed);
        self.number.fetch_add(1, Ordering::Release);
        self.wake();
    }

    /// Closes the cell: no more commands follow.
    pub fn close(&self) {
        self.is_closed.store(true, Ordering::Release);
        self.wake();
    }

    fn wake(&self) {
        if let Some(thread) = self.thread.get() {
            thread.unpark();
        }
    }

    /// Whether the cell is closed.
    pub fn is_closed(&self) -> bool {
        self.is_closed.load(Ordering::Acquire)
    }

    /// Returns the newest command with its number, unless that is `number`.
    pub fn newer_than(&self, number: u64) -> Option<(u64, WheelSpeeds)> {
        let newest = self.number.load(Ordering::Acquire);
        if newest == number {
            return None;
        }
        let speeds = self.speeds.load(Ordering::Relaxed);
        let half = |bits: u64| f64::from(f32::from_bits(u32::try_from(bits).unwrap_or_default()));
        let command = WheelSpeeds {
            left_rad_s: half(speeds >> 32),
            right_rad_s: half(speeds & u64::from(u32::MAX)),
        };
        Some((newest, command))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_command_is_found_once() {
        let command_cell = CommandCell::default();
        assert!(command_cell.newer_than(0).is_none());
        for speed in [1.0, -2.5] {
            command_cell.store(WheelSpeeds {
                left_rad_s: speed,
                right_rad_s: 0.5,
            });
        }
        let (number, command) = command_cell.newer_than(0).unwrap();
        assert_eq!(
            (number, command.left_rad_s, command.right_rad_s),
            (2, -2.5, 0.5)
        );
        assert!(command_cell.newer_than(number).is_none());
        assert!(!command_cell.is_closed());
        command_cell.close();
        assert!(command_cell.is_closed());
    }
}
