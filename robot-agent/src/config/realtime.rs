//! Checks `[realtime]` of `robot.toml`.

use super::ConfigError;
use super::file::RealtimeFile;
use crate::realtime::{PRIORITY_RANGE, RealtimeConfig};

/// Returns the settings of the scheduler.
///
/// # Errors
/// [`ConfigError::OutOfRange`] for a priority that is not permitted.
pub(super) fn checked(file: RealtimeFile) -> Result<RealtimeConfig, ConfigError> {
    if let Some(priority) = file.priority.filter(|it| !PRIORITY_RANGE.contains(it)) {
        let (least, most) = (PRIORITY_RANGE.start(), PRIORITY_RANGE.end());
        return Err(ConfigError::OutOfRange {
            key: "realtime.priority",
            problem: format!(
                "{priority} is not within {least} to {most}; leave it out for no real-time \
                 priority"
            ),
        });
    }
    Ok(RealtimeConfig {
        priority: file.priority,
        lock_memory: file.lock_memory.unwrap_or(false),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_asked_of_the_scheduler_unless_it_is_wanted_and_the_priority_is_checked() {
        let default = checked(RealtimeFile::default()).unwrap();
        assert_eq!(default, RealtimeConfig::default());
        let on = RealtimeFile {
            priority: Some(40),
            lock_memory: Some(true),
        };
        let expected = RealtimeConfig {
            priority: Some(40),
            lock_memory: true,
        };
        assert_eq!(checked(on).unwrap(), expected);
        for priority in [0, 50, 99, 255] {
            let file = RealtimeFile {
                priority: Some(priority),
                lock_memory: None,
            };
            let refused = checked(file).unwrap_err().to_string();
            assert!(
                refused.contains("`realtime.priority`") && refused.contains("1 to 49"),
                "{refused}"
            );
        }
    }
}
