//! A run for people.

use std::fmt::{self, Display, Formatter, Write};

use tread_tests::scenario::cells;
use tread_tests::scenario::report::{Arrival, Learned, Report};

/// The lines of fused cells.
pub(super) struct CellTable<'a>(pub(super) &'a cells::Report);

impl Display for CellTable<'_> {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        writeln!(
            out,
            "{:<24} {:>7} {:>10} {:>9} {:>8} {:>12}",
            "", "cells", "estimates", "coverage", "error", "half-width"
        )?;
        for line in self.0.lines() {
            writeln!(
                out,
                "{:<24} {:>7} {:>10} {:>8.1}% {:>+7.1}% {:>11.1}%",
                line.name,
                line.cells,
                line.estimates,
                100.0 * line.coverage,
                100.0 * line.error_ratio,
                100.0 * line.half_width,
            )?;
        }
        Ok(())
    }
}

/// All tables of a run.
pub(super) struct Tables<'a>(pub(super) &'a Report);

impl Display for Tables<'_> {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        tables(out, self.0)
    }
}

fn tables(out: &mut impl Write, report: &Report) -> fmt::Result {
    for learned in &report.learned {
        grounds(out, learned)?;
    }
    writeln!(
        out,
        "\narriving on ice       with the map            without\n\
         {:<20} {:>9} {:>7} {:>6} | {:>7} {:>7} {:>6}",
        "robot", "farthest", "rms m", "m/s", "farthest", "rms m", "m/s"
    )?;
    for Arrival {
        robot,
        course,
        stop,
        traction_limit_mu,
        ends,
    } in &report.arrivals
    {
        if let Some([with, without]) = course {
            writeln!(
                out,
                "{robot:<20} {:>9.3} {:>7.3} {:>6.2} | {:>8.3} {:>7.3} {:>6.2}  μ {}, {ends:?}",
                with.farthest_m,
                with.rms_m,
                with.fastest_m_s,
                without.farthest_m,
                without.rms_m,
                without.fastest_m_s,
                traction_limit_mu.map_or_else(|| "unknown".to_owned(), |mu| format!("{mu:.3}"))
            )?;
        }
        if let Some([with, without]) = stop {
            writeln!(
                out,
                "{robot:<20} stops in {:.2} m from {:.2} m/s | {:.2} m from {:.2} m/s",
                with.distance_m, with.from_m_s, without.distance_m, without.from_m_s
            )?;
        }
    }
    writeln!(out)
}

fn grounds(out: &mut impl Write, learned: &Learned) -> fmt::Result {
    let how = if learned.torque { "with" } else { "without" };
    writeln!(
        out,
        "\n{how} wheel torque, {:.0} s of driving, {} false alarms\n\
         {:<10} {:<6} {:>7} {:>7} {:>17} {:>6} {:>7} {:>7} {:>7}",
        learned.driven_s,
        learned.false_alarms.len(),
        "terrain",
        "model",
        "truth",
        "theta",
        "95 %",
        "cells",
        "held %",
        "± %",
        "rms %"
    )?;
    for line in learned.before.lines.iter().chain(&learned.frozen.lines) {
        let part =
            |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |it| format!("{it:.3}"));
        writeln!(
            out,
            "{:<10} {:<6} {:>7.3} {:>7} {:>8} {:>8} {:>6} {:>7.1} {:>7.1} {:>7.1}",
            line.terrain,
            line.model,
            line.truth,
            part(line.theta),
            part(line.low_95),
            part(line.high_95),
            line.cells,
            100.0 * f64::from(line.held) / f64::from(line.cells),
            100.0 * line.half_width_ratio,
            100.0 * line.error_rms_ratio
        )?;
    }
    for alarm in &learned.false_alarms {
        writeln!(out, "false alarm of {alarm}")?;
    }
    for passes in &learned.ice {
        for (number, pass) in (1..).zip(passes) {
            writeln!(
                out,
                "{} after pass {number} over the ice: {} of {} cells show it, {} disputed, alert: {}",
                pass.model, pass.shown, pass.cells, pass.disputed, pass.alert
            )?;
        }
    }
    Ok(())
}
