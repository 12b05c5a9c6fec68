//! The tables of a run.

use std::fmt::{self, Display, Formatter, Write as _};

use tread_lab::report::{Table, percent};
use tread_tests::scenario::cells;
use tread_tests::scenario::report::{Arrival, FleetMap, Report};

/// Tables with what is said above each, and lines below them.
#[derive(Debug, Default)]
pub(super) struct Tables {
    tables: Vec<(String, Table)>,
    notes: Vec<String>,
}

impl Tables {
    /// The tables in Markdown.
    pub(super) fn markdown(&self) -> String {
        let mut text = String::new();
        for (title, table) in &self.tables {
            let _ = writeln!(text, "{title}:\n\n{}", table.markdown());
        }
        for note in &self.notes {
            let _ = writeln!(text, "* {note}");
        }
        text
    }

    /// The lines of fused cells.
    pub(super) fn of_cells(report: &cells::Report) -> Self {
        let mut table = Table::new([
            "cells of",
            "cells",
            "estimates",
            "coverage",
            "error",
            "half-width",
        ]);
        for line in report.lines() {
            table.row([
                line.name,
                line.cells.to_string(),
                line.estimates.to_string(),
                percent(line.coverage),
                format!("{:+.1} %", 100.0 * line.error_ratio),
                percent(line.half_width),
            ]);
        }
        Self {
            tables: vec![("Fused cells".to_owned(), table)],
            notes: Vec::new(),
        }
    }

    /// What a map is worth.
    pub(super) fn of_map(report: &Report) -> Self {
        let mut all = Self::default();
        for learned in &report.learned {
            all.learned(learned);
        }
        all.arrivals(&report.arrivals);
        all
    }

    fn learned(&mut self, learned: &FleetMap) {
        let how = if learned.torque { "With" } else { "Without" };
        let title = format!(
            "{how} wheel torque, {:.0} s of driving, {} false alarms",
            learned.driven_s,
            learned.false_alarms.len()
        );
        let mut table = Table::new([
            "terrain",
            "model",
            "true θ",
            "θ",
            "low 95 %",
            "high 95 %",
            "cells",
            "intervals that hold",
            "half-width",
            "RMS error",
        ]);
        for line in learned.before.lines.iter().chain(&learned.frozen.lines) {
            let part =
                |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |it| format!("{it:.3}"));
            table.row([
                line.terrain.clone(),
                line.model.to_owned(),
                format!("{:.3}", line.truth),
                part(line.theta),
                part(line.low_95),
                part(line.high_95),
                line.cells.to_string(),
                percent(f64::from(line.held) / f64::from(line.cells)),
                percent(line.half_width_ratio),
                percent(line.error_rms_ratio),
            ]);
        }
        self.tables.push((title, table));
        let alarms = learned.false_alarms.iter();
        self.notes
            .extend(alarms.map(|alarm| format!("false alarm of {alarm}")));
        for passes in &learned.ice {
            for (number, pass) in (1..).zip(passes) {
                self.notes.push(format!(
                    "{} after pass {number} over the ice: {} of {} cells show it, {} disputed, \
                     alert: {}",
                    pass.model, pass.shown, pass.cells, pass.disputed, pass.alert
                ));
            }
        }
    }

    fn arrivals(&mut self, arrivals: &[Arrival]) {
        let mut courses = Table::new([
            "robot",
            "farthest with the map, m",
            "RMS, m",
            "fastest, m/s",
            "farthest without, m",
            "RMS, m",
            "fastest, m/s",
            "traction limit μ",
            "end",
        ]);
        let mut stops = Table::new([
            "robot",
            "stops with the map in, m",
            "from, m/s",
            "without in, m",
            "from, m/s",
        ]);
        for arrival in arrivals {
            if let Some([with, without]) = &arrival.course {
                let mut cells = vec![arrival.robot.to_string()];
                for course in [with, without] {
                    cells.push(format!("{:.3}", course.farthest_m));
                    cells.push(format!("{:.3}", course.rms_m));
                    cells.push(format!("{:.2}", course.fastest_m_s));
                }
                let mu = |mu: f64| format!("{mu:.3}");
                cells.push(arrival.traction_limit_mu.map_or("unknown".to_owned(), mu));
                cells.push(format!("{:?}", arrival.ends));
                courses.row(cells);
            }
            if let Some([with, without]) = &arrival.stop {
                let mut cells = vec![arrival.robot.to_string()];
                for stop in [with, without] {
                    cells.push(format!("{:.2}", stop.distance_m));
                    cells.push(format!("{:.2}", stop.from_m_s));
                }
                stops.row(cells);
            }
        }
        let title = "Robots that arrive on ice".to_owned();
        self.tables.push((title, courses));
        self.tables.push(("Stops on ice".to_owned(), stops));
    }
}

impl Display for Tables {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        for (title, table) in &self.tables {
            writeln!(out, "{title}:\n{table}")?;
        }
        for note in &self.notes {
            writeln!(out, "{note}")?;
        }
        Ok(())
    }
}
