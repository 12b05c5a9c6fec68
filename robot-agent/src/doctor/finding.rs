//! Findings of the doctor, each on one question, with the lines of `robot.toml` that correct them.

use std::fmt::Write as _;

use serde::Serialize;

pub(super) use crate::config::Key;

/// A line of `robot.toml`, ready to be copied into its table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Line {
    /// The table, such as `drive.ros2.command`.
    pub(crate) table: &'static str,
    /// The key in it.
    pub(crate) key: &'static str,
    /// The value as TOML.
    pub(crate) value: String,
}

/// Finding on one question.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Finding {
    /// The question.
    pub(crate) name: &'static str,
    /// Whether no problem was found.
    pub(crate) holds: bool,
    /// Whether the question could not be examined.
    pub(crate) is_skipped: bool,
    /// Key of `robot.toml` that is likely wrong, if a problem was found.
    pub(crate) key: Option<&'static str>,
    /// Description for people.
    pub(crate) text: String,
    /// Lines of `robot.toml` that correct the problem, if any.
    pub(crate) lines: Vec<Line>,
}

/// A question that is about to be answered, see [`Finding::on`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Question(&'static str);

impl Question {
    pub(super) fn ok(self, text: impl Into<String>) -> Finding {
        Finding {
            name: self.0,
            holds: true,
            is_skipped: false,
            key: None,
            text: text.into(),
            lines: Vec::new(),
        }
    }

    pub(super) fn wrong(self, Key(key): Key, text: impl Into<String>) -> Finding {
        Finding {
            holds: false,
            key: Some(key),
            ..self.ok(text)
        }
    }

    /// A problem that prevents the examination, and that no single key of `robot.toml` causes.
    pub(super) fn unexaminable(self, text: impl Into<String>) -> Finding {
        Finding {
            holds: false,
            ..self.ok(text)
        }
    }

    /// A question that could not be examined, because of another finding.
    pub(super) fn skipped(self, text: impl Into<String>) -> Finding {
        Finding {
            is_skipped: true,
            ..self.ok(text)
        }
    }
}

impl Finding {
    /// Begins the answer to the question of this name.
    pub(super) fn on(name: &'static str) -> Question {
        Question(name)
    }

    /// Adds a line that corrects the problem.
    pub(super) fn with_line(mut self, Key(path): Key, value: impl Into<String>) -> Self {
        let (table, key) = path.rsplit_once('.').unwrap_or(("", path));
        self.lines.push(Line {
            table,
            key,
            value: value.into(),
        });
        self
    }

    pub(super) fn mark(&self) -> &'static str {
        match (self.holds, self.is_skipped) {
            (false, _) => "WRONG",
            (true, true) => "--   ",
            (true, false) => "ok   ",
        }
    }
}

/// Formats a list of names as TOML.
pub(super) fn list(names: &[String]) -> String {
    let quoted: Vec<String> = names.iter().map(|name| format!("{name:?}")).collect();
    format!("[{}]", quoted.join(", "))
}

/// Formats the lines of all findings as a part of `robot.toml`, each table once.
pub(super) fn robot_toml(findings: &[Finding]) -> String {
    let lines: Vec<&Line> = findings.iter().flat_map(|finding| &finding.lines).collect();
    let mut text = String::new();
    for (index, line) in lines.iter().enumerate() {
        if lines[..index].iter().any(|other| other.table == line.table) {
            continue;
        }
        // Writing to a string cannot fail.
        let _ = writeln!(text, "[{}]", line.table);
        let mut keys = Vec::new();
        for line in lines.iter().filter(|other| other.table == line.table) {
            if !keys.contains(&line.key) {
                keys.push(line.key);
                let _ = writeln!(text, "{} = {}", line.key, line.value);
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_all_findings_are_tables_that_toml_reads() {
        let left = list(&["front \"left\"".to_owned(), "rear".to_owned()]);
        let findings = [
            Finding::on("command")
                .wrong(Key("drive.ros2.command.track_width_m"), "")
                .with_line(Key("drive.ros2.command.track_width_m"), "0.430")
                .with_line(Key("drive.ros2.joints.left"), left),
            Finding::on("imu").ok("all is well"),
            Finding::on("signs")
                .wrong(Key("drive.ros2.command.turn_sign"), "")
                .with_line(Key("drive.ros2.command.turn_sign"), "-1")
                .with_line(Key("drive.ros2.command.track_width_m"), "0.5"),
        ];
        let text = robot_toml(&findings);
        let read: toml::Value = toml::from_str(&text).unwrap();
        let ros2 = &read["drive"]["ros2"];
        let track = ros2["command"]["track_width_m"].as_float().unwrap();
        assert!((track - 0.43).abs() < f64::EPSILON);
        assert_eq!(ros2["command"]["turn_sign"].as_integer(), Some(-1));
        assert_eq!(ros2["joints"]["left"][0].as_str(), Some("front \"left\""));
        assert_eq!(text.matches("[drive.ros2.command]").count(), 1);
        assert_eq!(robot_toml(&findings[1..2]), "");
    }
}
