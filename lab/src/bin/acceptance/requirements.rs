//! Requirements, and which checks of the report programs belong to each.

use serde::Serialize;
use tread_lab::report::Check;

use crate::programs::Run;

/// A requirement on figures of one program.
struct Requirement {
    name: &'static str,
    program: &'static str,
    /// Whether a check of the program belongs to it, by its name. A check belongs to the first one that takes
    /// it.
    takes: fn(&str) -> bool,
}

/// Requirements by program; the last one of each program takes all that is left.
const REQUIREMENTS: [Requirement; 20] = [
    Requirement {
        name: "population: coverage of 95 % intervals",
        program: "rough",
        takes: |name| {
            name.starts_with("population, with") && name.ends_with("coverage of the 95 % intervals")
        },
    },
    Requirement {
        name: "strata of the population: coverage",
        program: "rough",
        takes: |name| {
            name.starts_with("population, ") && name.ends_with("coverage of the 95 % intervals")
        },
    },
    Requirement {
        name: "each single difference: coverage",
        program: "rough",
        takes: |name| name.ends_with("coverage of the 95 % intervals"),
    },
    Requirement {
        name: "half-width over that of the bound",
        program: "rough",
        takes: |name| name.ends_with("median half-width over the bound's"),
    },
    Requirement {
        name: "median half-width over the single differences",
        program: "rough",
        takes: |name| name.starts_with("median half-width over"),
    },
    Requirement {
        name: "no estimate after 60 s of figure-8s of the population",
        program: "rough",
        takes: |name| name.ends_with(": none after 60 s"),
    },
    Requirement {
        name: "no estimate after 60 s though the bound is useful",
        program: "rough",
        takes: |name| name.ends_with("though the bound is useful"),
    },
    Requirement {
        name: "the robot's own parameters: coverage",
        program: "rough",
        takes: |_| true,
    },
    Requirement {
        name: "fused cells: coverage",
        program: "scenario",
        takes: |_| true,
    },
    Requirement {
        name: "false alarms per hour",
        program: "ground_change",
        takes: |name| name.starts_with("false alarms"),
    },
    Requirement {
        name: "changes of the ground detected within 2 s",
        program: "ground_change",
        takes: |_| true,
    },
    Requirement {
        name: "tracking over the best peer, each line",
        program: "tracking",
        takes: |name| name.ends_with(": ours over the best peer"),
    },
    Requirement {
        name: "tracking with its own θ over without, each line",
        program: "tracking",
        takes: |name| name.ends_with("with its own θ over without"),
    },
    Requirement {
        name: "tracking over the best peer, mean above the localisation's error",
        program: "tracking",
        takes: |_| true,
    },
    Requirement {
        name: "faults: commands over a limit",
        program: "robustness",
        takes: |name| name.ends_with("ticks over a limit"),
    },
    Requirement {
        name: "faults: drives that are confidently wrong",
        program: "robustness",
        takes: |name| name.ends_with("confidently wrong"),
    },
    Requirement {
        name: "faults: coverage",
        program: "robustness",
        takes: |_| true,
    },
    Requirement {
        name: "another simulator, distributions 1.3 times as wide: coverage",
        program: "held_out",
        takes: |_| true,
    },
    Requirement {
        name: "our own simulator",
        program: "accuracy",
        takes: |_| true,
    },
    Requirement {
        name: "duration of a tick and speed of the plant",
        program: "cost",
        takes: |_| true,
    },
];

/// How far a requirement is reached.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Summary {
    pub(crate) requirement: &'static str,
    pub(crate) program: &'static str,
    /// Its goals; those of a requirement with more than three are left out.
    pub(crate) goals: Vec<String>,
    pub(crate) figures: usize,
    pub(crate) reached: usize,
    /// Lowest and highest of its figures; none if nothing was measured.
    pub(crate) lowest: Option<f64>,
    pub(crate) highest: Option<f64>,
}

/// Maximum number of goals that are stated.
const GOALS_MAX: usize = 3;

/// Returns the summaries of all requirements on programs that were run.
pub(crate) fn summaries(runs: &[Run]) -> Vec<Summary> {
    let is_run = |requirement: &&Requirement| {
        runs.iter()
            .any(|run| run.program.name == requirement.program)
    };
    REQUIREMENTS
        .iter()
        .filter(is_run)
        .map(|requirement| summary(requirement, runs))
        .collect()
}

/// Returns a check that each requirement has figures, so that a program that renames its checks is noticed.
pub(crate) fn missing_figures_check(summaries: &[Summary]) -> Check {
    let without = summaries.iter().filter(|summary| summary.figures == 0);
    #[expect(clippy::cast_precision_loss, reason = "at most twenty")]
    let count = without.count() as f64;
    Check::of("requirements without figures", count).at_most(0.0)
}

fn summary(requirement: &Requirement, runs: &[Run]) -> Summary {
    let takes_first = |program: &str, name: &str| {
        let mut all = REQUIREMENTS.iter().filter(|other| other.program == program);
        all.find(|other| (other.takes)(name))
            .is_some_and(|first| first.name == requirement.name)
    };
    let own = runs
        .iter()
        .filter(|run| run.program.name == requirement.program);
    let checks: Vec<_> = own
        .flat_map(|run| &run.checks)
        .filter(|check| takes_first(requirement.program, &check.name))
        .collect();
    let mut goals: Vec<String> = checks.iter().map(|check| check.goal.clone()).collect();
    goals.sort();
    goals.dedup();
    if goals.len() > GOALS_MAX {
        goals.clear();
    }
    let values = || checks.iter().filter_map(|check| check.value);
    Summary {
        requirement: requirement.name,
        program: requirement.program,
        goals,
        figures: checks.len(),
        reached: checks.iter().filter(|check| check.holds).count(),
        lowest: values().min_by(f64::total_cmp),
        highest: values().max_by(f64::total_cmp),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::programs::PROGRAMS;

    fn run(program: &str, checks: Vec<Check>) -> Run {
        let program = PROGRAMS.into_iter().find(|own| own.name == program);
        Run {
            program: program.unwrap(),
            minutes: 1.0,
            checks,
        }
    }

    fn coverage(name: &str, value: f64) -> Check {
        Check::of(format!("{name}: coverage of the 95 % intervals"), value).at_least(0.9)
    }

    #[test]
    fn each_check_belongs_to_one_requirement() {
        let checks = vec![
            coverage("population, with torque", 0.96),
            coverage("population, without torque", 0.97),
            coverage("population, K 3, with torque", 0.89),
            coverage("payload 20 %, with torque", 0.99),
            Check::of("mass, kg, with torque: coverage", 0.95).at_least(0.9),
        ];
        let found = summaries(&[run("rough", checks)]);
        assert_eq!(
            found.iter().map(|summary| summary.figures).sum::<usize>(),
            5
        );
        let figures = |part: &str| {
            let of = found
                .iter()
                .find(|summary| summary.requirement.contains(part))
                .unwrap();
            (of.figures, of.reached)
        };
        assert_eq!(figures("population: coverage"), (2, 2));
        assert_eq!(figures("strata"), (1, 0));
        assert_eq!(figures("single difference: coverage"), (1, 1));
        assert_eq!(figures("own parameters"), (1, 1));
        assert_eq!(found[0].lowest.zip(found[0].highest), Some((0.96, 0.97)));
        assert_eq!(found[0].goals, ["≥ 0.9"]);
        let missing = missing_figures_check(&found);
        assert!(!missing.holds && missing.value == Some(4.0), "{missing:?}");
    }

    #[test]
    fn each_program_has_a_requirement_that_takes_what_is_left_and_no_other_program_has_any() {
        for program in PROGRAMS {
            let last = REQUIREMENTS.iter().rfind(|own| own.program == program.name);
            assert!(last.is_some_and(|last| (last.takes)("")), "{program}");
        }
        let of_no_program = |requirement: &&Requirement| {
            !PROGRAMS
                .iter()
                .any(|program| program.name == requirement.program)
        };
        assert_eq!(REQUIREMENTS.iter().filter(of_no_program).count(), 0);
    }
}
