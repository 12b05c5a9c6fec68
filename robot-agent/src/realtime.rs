//! Real-time priority of the control loop's thread, and memory that is never paged out.
//!
//! Both need permission, which the packaged unit gives by `LimitRTPRIO=` and `LimitMEMLOCK=`. An agent
//! that was configured for them and may not have them does not start, since it would run later
//! than whoever configured it expects.

use std::io;

use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::sys::resource::{RLIM_INFINITY, Resource, getrlimit};
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

/// Permitted priority of the loop. On a real-time kernel the threads of interrupts have 50, and
/// the loop depends on them.
pub const PRIORITY_RANGE: std::ops::RangeInclusive<u8> = 1..=49;

/// `[realtime]`: priority of the loop, and whether memory is locked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RealtimeConfig {
    /// Priority of the loop's thread by `SCHED_FIFO`, within [`PRIORITY_RANGE`]; `None` for the
    /// usual scheduling.
    pub priority: Option<u8>,
    /// Whether all memory of the process is kept from being paged out.
    pub lock_memory: bool,
}

/// Why the operating system refuses the priority or the locked memory.
#[derive(Debug, thiserror::Error)]
pub enum RealtimeError {
    /// The priority is not permitted.
    #[error(
        "the control loop may not have the real-time priority {priority}: give the service \
         `LimitRTPRIO={priority}`, or leave `realtime.priority` out"
    )]
    Priority {
        /// The configured priority.
        priority: u8,
        /// Error of the operating system.
        #[source]
        source: io::Error,
    },
    /// The memory may not be locked.
    #[error(
        "the agent may not lock its memory: give the service `LimitMEMLOCK=infinity`, or set \
         `realtime.lock_memory` to false"
    )]
    Memory(#[source] io::Error),
    /// The limit on locked memory would fail later allocations.
    #[error(
        "the agent may lock {0} bytes of memory only, and would fail beyond: give the service \
         `LimitMEMLOCK=infinity`, or set `realtime.lock_memory` to false"
    )]
    MemoryLimit(u64),
}

/// Gives the calling thread a real-time priority.
///
/// # Errors
/// [`RealtimeError::Priority`] if the process may not have it.
pub(crate) fn raise_priority(priority: u8) -> Result<(), RealtimeError> {
    let failed = |source| RealtimeError::Priority { priority, source };
    let value = ThreadPriorityValue::try_from(priority)
        .map_err(|reason| failed(io::Error::other(reason)))?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let set = set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Crossplatform(value),
        policy,
    );
    set.map_err(|refused| {
        failed(if let thread_priority::Error::OS(code) = refused {
            io::Error::from_raw_os_error(code)
        } else {
            io::Error::other(format!("{refused:?}"))
        })
    })
}

/// Keeps all present and future memory of the process from being paged out.
///
/// # Errors
/// The process may lock none, or too little for what it will allocate.
pub(crate) fn lock_memory() -> Result<(), RealtimeError> {
    let failed = |errno: nix::Error| RealtimeError::Memory(errno.into());
    let (limit, _) = getrlimit(Resource::RLIMIT_MEMLOCK).map_err(failed)?;
    if limit != RLIM_INFINITY {
        return Err(RealtimeError::MemoryLimit(limit));
    }
    mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_on_locked_memory_is_refused_before_an_allocation_can_fail() {
        let (limit, _) = getrlimit(Resource::RLIMIT_MEMLOCK).unwrap();
        if limit == RLIM_INFINITY {
            return;
        }
        let refused = lock_memory().unwrap_err();
        assert!(
            matches!(refused, RealtimeError::MemoryLimit(_)),
            "{refused}"
        );
        assert!(refused.to_string().contains("LimitMEMLOCK=infinity"));
    }

    #[test]
    fn the_priority_is_that_of_the_calling_thread_or_the_error_says_which_limit_it_needs() {
        let thread = std::thread::spawn(|| {
            raise_priority(7).map(|()| thread_priority::unix::thread_schedule_policy().unwrap())
        });
        match thread.join().unwrap() {
            Ok(policy) => {
                let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
                assert_eq!(policy, fifo);
                let own = thread_priority::unix::thread_schedule_policy().unwrap();
                assert_ne!(own, fifo, "only the loop's thread has it");
            }
            Err(refused) => assert!(refused.to_string().contains("LimitRTPRIO=7"), "{refused}"),
        }
    }
}
