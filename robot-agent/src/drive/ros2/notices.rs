//! Reports events on the bus that need no action: restarted writers, clock jumps, and commands
//! written by other nodes.

use super::refusal::{Counts, Notice, QUIET_CHECKS, Source};

/// Detects recent events by comparing the counts at intervals.
#[derive(Debug, Clone, Copy, Default)]
pub struct RecentNotices {
    before: [[u64; Notice::ALL.len()]; Source::ALL.len()],
    /// Number of further checks for which the event is reported.
    left: [[u32; Notice::ALL.len()]; Source::ALL.len()],
}

impl RecentNotices {
    /// Runs one check; returns a description of the topics with recent events, for people.
    pub fn check(&mut self, counts: &Counts, notice: Notice) -> Option<String> {
        let mut sections = Vec::new();
        for source in Source::ALL {
            let times = counts.noted(source, notice);
            let before = &mut self.before[source as usize][notice as usize];
            let left = &mut self.left[source as usize][notice as usize];
            let is_new = times > std::mem::replace(before, times);
            *left = if is_new {
                QUIET_CHECKS
            } else {
                left.saturating_sub(1)
            };
            if *left > 0 {
                sections.push(format!("{} ({times} so far)", source.section()));
            }
        }
        (!sections.is_empty())
            .then(|| format!("what writes {} {}", sections.join(", "), notice.text()))
    }
}

/// Detects recent commands of other nodes by comparing the count at intervals.
#[derive(Debug, Clone, Copy, Default)]
pub struct ForeignCommands {
    before: u64,
    left: u32,
}

impl ForeignCommands {
    /// Runs one check; returns a description while another node has commanded the base recently.
    pub fn check(&mut self, counts: &Counts) -> Option<String> {
        let times = counts.foreign_commands();
        self.left = if times > std::mem::replace(&mut self.before, times) {
            QUIET_CHECKS
        } else {
            self.left.saturating_sub(1)
        };
        (self.left > 0).then(|| {
            format!("another node writes on the command topic, and the base obeys both ({times} commands so far)")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_happened_is_said_by_topic_until_it_is_over() {
        let (counts, mut recent_notices) = (Counts::default(), RecentNotices::default());
        assert_eq!(recent_notices.check(&counts, Notice::Restarted), None);
        counts.record(Source::Imu, Notice::Restarted);
        counts.record(Source::Joints, Notice::Restarted);
        counts.record(Source::Joints, Notice::ClockLeapt);
        let text = recent_notices.check(&counts, Notice::Restarted).unwrap();
        assert_eq!(
            text,
            "what writes imu (1 so far), joints (1 so far) started again and is heard again"
        );
        let text = recent_notices.check(&counts, Notice::ClockLeapt).unwrap();
        assert!(text.contains("joints (1 so far) set its clock"), "{text}");
        for _ in 1..QUIET_CHECKS {
            assert!(recent_notices.check(&counts, Notice::Restarted).is_some());
        }
        assert_eq!(recent_notices.check(&counts, Notice::Restarted), None);
    }

    #[test]
    fn commands_of_others_are_said_until_they_cease() {
        let (counts, mut foreign) = (Counts::default(), ForeignCommands::default());
        assert_eq!(foreign.check(&counts), None);
        counts.count_foreign_command();
        assert!(
            foreign
                .check(&counts)
                .unwrap()
                .contains("1 commands so far")
        );
        for _ in 1..QUIET_CHECKS {
            assert!(foreign.check(&counts).is_some());
        }
        assert_eq!(foreign.check(&counts), None);
    }
}
