//! Figures with their goals, and how they are printed.

/// A figure with its goal, and whether it reaches it.
pub(crate) struct Check {
    pub(crate) name: &'static str,
    pub(crate) goal: String,
    pub(crate) value: f64,
    pub(crate) holds: bool,
}

/// A figure before it is held against its limit, so that the two cannot be swapped.
#[derive(Clone, Copy)]
pub(crate) struct Figure {
    name: &'static str,
    value: f64,
}

impl Figure {
    pub(crate) fn of(name: &'static str, value: f64) -> Self {
        Self { name, value }
    }

    pub(crate) fn at_most(self, most: f64) -> Check {
        self.check(format!("<= {most}"), self.value <= most)
    }

    pub(crate) fn at_least(self, least: f64) -> Check {
        self.check(format!(">= {least}"), self.value >= least)
    }

    fn check(self, goal: String, holds: bool) -> Check {
        let Self { name, value } = self;
        Check {
            name,
            goal,
            value,
            holds,
        }
    }
}

pub(crate) fn writeln_out(line: &str) -> std::io::Result<()> {
    use std::io::Write as _;
    writeln!(std::io::stdout(), "{line}")
}
