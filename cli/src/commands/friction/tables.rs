//! Tables of the friction map's answers.

use comfy_table::Table;
use jiff::Timestamp;
use tread_api::friction::{
    CellDifference, CellFriction, FrictionAt, FusedFriction, ModelFriction, PathFriction,
    PointFriction, PointHistory, RobotContribution, TerrainFriction, TerrainHistory,
    VisitSuggestion, Withdrawal,
};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use crate::client::{MapTimes, TimedEntries};
use crate::commands::terrains::class_name;
use crate::output::{age, fixed, or_dash, render, signed, table};

/// Columns of the friction of an area.
const FRICTION_COLUMNS: [&str; 7] = [
    "THETA",
    "95 % INTERVAL",
    "K",
    "MU PEAK >=",
    "MEASURED",
    "ROBOTS",
    "AGE",
];

/// Puts the times to which a table refers above it; the server rounds them to the ends of epochs.
fn of_time(of: MapTimes, table: &str) -> String {
    let as_of = of.as_of.map(|at| format!("{at:.0}"));
    match (of.from, as_of) {
        (None, None) => table.to_owned(),
        (None, Some(as_of)) => format!("as of {as_of}\n{table}"),
        (Some(from), as_of) => {
            let to = as_of.unwrap_or_else(|| "now".to_owned());
            format!("from {from:.0} to {to}\n{table}")
        }
    }
}

/// Returns an empty table with the given columns, followed by [`FRICTION_COLUMNS`].
fn friction_table(first: &[&str]) -> Table {
    let mut all = table::<0>([]);
    all.set_header(first.iter().chain(&FRICTION_COLUMNS));
    all
}

fn number(value: Option<f64>, digits: usize) -> String {
    or_dash(value.map(|value| format!("{value:.digits$}")))
}

fn seconds(age_s: Option<f64>) -> String {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "an age is not negative, and one beyond any clock is cut"
    )]
    or_dash(age_s.map(|age_s| age((age_s * 1e3) as u64)))
}

fn columns(friction: Option<&FusedFriction>) -> [String; 7] {
    let disputed = friction.is_some_and(|friction| friction.disputed);
    let theta = number(friction.map(|friction| friction.theta), 4);
    [
        if disputed {
            format!("{theta} (disputed)")
        } else {
            theta
        },
        or_dash(friction.map(|friction| {
            format!(
                "{:.4} to {:.4}",
                friction.theta_low_95, friction.theta_high_95
            )
        })),
        number(friction.map(|friction| friction.stiffness), 2),
        number(
            friction.and_then(|friction| friction.mu_peak_lower_bound),
            2,
        ),
        or_dash(friction.map(|friction| friction.segments)),
        or_dash(friction.map(|friction| friction.robots)),
        seconds(friction.map(|friction| friction.age_s)),
    ]
}

/// Returns the row of a robot model; a θ that is expected from the terrain class is marked as such.
fn model_row(model: &ModelFriction) -> Vec<String> {
    let mut row = vec![model.model.clone()];
    row.extend(columns(model.friction.as_ref()));
    if let (None, Some(prior)) = (&model.friction, &model.prior) {
        row[1] = format!("{:.4} expected", prior.theta);
    }
    row
}

fn terrain_name(terrain: Option<&TerrainRef>) -> String {
    or_dash(terrain.map(|terrain| &terrain.id))
}

fn place(cell: Cell) -> [String; 2] {
    [cell.ix.to_string(), cell.iy.to_string()]
}

pub(super) fn terrains(terrains: &[TerrainFriction]) -> String {
    if terrains.is_empty() {
        return "this site has no terrains yet: create one with `tread terrains create`".to_owned();
    }
    let mut table = friction_table(&["TERRAIN", "CLASS", "MODEL"]);
    for terrain in terrains {
        let first = [terrain.terrain.id.to_string(), class_name(terrain.class)];
        if terrain.models.is_empty() {
            let nothing = columns(None);
            let row = first.iter().cloned();
            table.add_row(row.chain(["not driven yet".to_owned()]).chain(nothing));
        }
        for model in &terrain.models {
            table.add_row(first.iter().cloned().chain(model_row(model)));
        }
    }
    let as_of = terrains.first().and_then(|terrain| terrain.as_of);
    of_time(MapTimes::as_of(as_of), &render(&table))
}

pub(super) fn terrain_history(history: &TerrainHistory) -> String {
    format!(
        "terrain {}, revision {}\n{}",
        history.terrain.id,
        history.terrain.revision,
        history_table(&history.items)
    )
}

pub(super) fn point_history(history: &PointHistory) -> String {
    format!(
        "{}\n{}",
        ground_at(history.cell, history.terrain.as_ref()),
        history_table(&history.items)
    )
}

fn history_table(items: &[FrictionAt]) -> String {
    let mut table = friction_table(&["AT", "AS OF", "MODEL"]);
    for item in items {
        let times = [item.at, item.as_of].map(|at| format!("{at:.0}"));
        if item.models.is_empty() {
            let row = times.clone().into_iter().chain(["-".to_owned()]);
            table.add_row(row.chain(columns(None)));
        }
        for model in &item.models {
            table.add_row(times.clone().into_iter().chain(model_row(model)));
        }
    }
    render(&table)
}

fn ground_at(Cell { ix, iy }: Cell, terrain: Option<&TerrainRef>) -> String {
    let ground = match terrain {
        Some(terrain) => format!("terrain {}, revision {}", terrain.id, terrain.revision),
        None => "no terrain is drawn there".to_owned(),
    };
    format!("cell {ix}, {iy}; {ground}")
}

pub(super) fn cells(TimedEntries { items, of }: &TimedEntries<CellFriction>) -> String {
    if items.is_empty() {
        return of_time(*of, "no cell has been measured there yet");
    }
    let mut table = friction_table(&["IX", "IY", "SIDE M", "TERRAIN"]);
    for cell in items {
        let first = [cell.size_m.to_string(), terrain_name(cell.terrain.as_ref())];
        let row = place(cell.cell).into_iter().chain(first);
        table.add_row(row.chain(columns(Some(&cell.friction))));
    }
    of_time(*of, &render(&table))
}

pub(super) fn point(point: &PointFriction) -> String {
    let head = of_time(
        MapTimes::as_of(point.as_of),
        &ground_at(point.cell, point.terrain.as_ref()),
    );
    if point.models.is_empty() {
        return format!(
            "{head}\nno robot has measured this place yet: `tread friction` shows its terrain"
        );
    }
    let mut table = friction_table(&["MODEL"]);
    for model in &point.models {
        table.add_row(model_row(model));
    }
    format!("{head}\n{}", render(&table))
}

pub(super) fn path(path: &PathFriction) -> String {
    let mut table = table([
        "FROM M",
        "IX",
        "IY",
        "THETA",
        "± SD",
        "95 % BELOW",
        "AGE",
        "MU LIMIT",
        "SPEED M/S",
    ]);
    for piece in &path.pieces {
        let disputed = if piece.disputed { " (disputed)" } else { "" };
        let [ix, iy] = place(piece.cell);
        table.add_row([
            format!("{:.2}", piece.from_m),
            ix,
            iy,
            format!("{}{disputed}", number(piece.theta, 4)),
            number(piece.std_dev, 4),
            number(piece.theta_upper_95, 4),
            seconds(piece.age_s),
            format!("{:.2}", piece.traction_limit_mu),
            format!("{:.2}", piece.speed_m_s),
        ]);
    }
    let text = format!(
        "{:.1} m, {:.0} % of it measured\n{}",
        path.length_m,
        1e2 * path.known_ratio,
        render(&table)
    );
    of_time(MapTimes::as_of(path.as_of), &text)
}

/// Whether the standard deviation is below θ itself.
fn is_sure(friction: &FusedFriction) -> bool {
    friction.std_dev < friction.theta
}

pub(super) fn differences(TimedEntries { items, of }: &TimedEntries<CellDifference>) -> String {
    if items.is_empty() {
        return of_time(*of, "no measurements there between these times");
    }
    let mut table = table([
        "IX",
        "IY",
        "TERRAIN",
        "THETA BEFORE",
        "THETA AFTER",
        "CHANGE",
        "Z SCORE",
    ]);
    let theta = |friction: &Option<FusedFriction>| match friction {
        Some(known) if is_sure(known) => format!("{:.4} ± {:.4}", known.theta, known.std_dev),
        Some(_) => "unsure".to_owned(),
        None => "-".to_owned(),
    };
    for cell in items {
        let change = match (&cell.before, &cell.after) {
            (Some(before), Some(after)) if !(is_sure(before) && is_sure(after)) => {
                "unsure".to_owned()
            }
            (Some(before), Some(after)) => {
                format!("{} %", signed(1e2 * (after.theta / before.theta - 1.0), 1))
            }
            (None, Some(_)) => "new".to_owned(),
            (Some(_), None) => "gone".to_owned(),
            (None, None) => "-".to_owned(),
        };
        let [ix, iy] = place(cell.cell);
        table.add_row([
            ix,
            iy,
            terrain_name(cell.terrain.as_ref()),
            theta(&cell.before),
            theta(&cell.after),
            change,
            or_dash(cell.z_score.map(|many| signed(many, 1))),
        ]);
    }
    of_time(*of, &render(&table))
}

pub(super) fn visits(as_of: Option<Timestamp>, visits: &[VisitSuggestion]) -> String {
    let of = MapTimes::as_of(as_of);
    if visits.is_empty() {
        return of_time(
            of,
            "no cell of this box would reduce the uncertainty of the map",
        );
    }
    let mut table = table([
        "X M",
        "Y M",
        "TERRAIN",
        "KNOWN TO",
        "SHRINKS BY",
        "DISPUTED",
    ]);
    for visit in visits {
        let known = visit.relative_std_dev;
        table.add_row([
            fixed(visit.center.x_m, 2),
            fixed(visit.center.y_m, 2),
            terrain_name(visit.terrain.as_ref()),
            or_dash(known.map(|share| format!("{:.1} %", 1e2 * share))),
            format!("{:.2} times", visit.gain.exp()),
            if visit.disputed { "yes" } else { "no" }.to_owned(),
        ]);
    }
    of_time(of, &render(&table))
}

pub(super) fn contributions(robots: &[RobotContribution]) -> String {
    if robots.is_empty() {
        return "no robot has measured anything on this site yet".to_owned();
    }
    let mut table = table(["ROBOT", "CELLS", "SEGMENTS", "FIRST", "NEWEST", "BIAS"]);
    for robot in robots {
        let bias = robot.bias_ratio;
        table.add_row([
            robot.robot.to_string(),
            robot.cells.to_string(),
            robot.segments.to_string(),
            format!("{:.0}", robot.first_at),
            format!("{:.0}", robot.newest_at),
            or_dash(bias.map(|ratio| format!("{} %", signed(1e2 * (ratio - 1.0), 1)))),
        ]);
    }
    render(&table)
}

pub(super) fn withdrawals(withdrawals: &[Withdrawal]) -> String {
    if withdrawals.is_empty() {
        return "no measurements were withdrawn".to_owned();
    }
    let mut table = table(["ROBOT", "FROM", "BEFORE", "BY", "AT", "REASON"]);
    for withdrawal in withdrawals {
        table.add_row([
            withdrawal.robot.to_string(),
            format!("{:.0}", withdrawal.from),
            format!("{:.0}", withdrawal.before),
            withdrawal.by.clone(),
            format!("{:.0}", withdrawal.at),
            withdrawal.reason.clone(),
        ]);
    }
    render(&table)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn known(theta: f64, std_dev: f64) -> Value {
        json!({
            "theta": theta, "std_dev": std_dev, "theta_low_95": 0.0, "theta_high_95": 9.0,
            "stiffness": 1.0, "segments": 1, "robots": 1, "age_s": 1.0, "disputed": false,
            "newest_at": "2026-11-21T08:00:00Z",
            "bounds": {"theta_lower_5": 0.0, "theta_upper_95": 9.0, "stiffness_lower_5": 0.1},
        })
    }

    fn row(before: &Value, after: &Value) -> String {
        let cell: CellDifference = serde_json::from_value(json!({
            "cell": {"ix": 4, "iy": 2}, "terrain": null, "before": before, "after": after,
            "configuration": "8c8722f3-7240-59d0-bde2-495b2d9205b8", "z_score": null,
        }))
        .unwrap();
        let known = TimedEntries {
            items: vec![cell],
            of: MapTimes::default(),
        };
        differences(&known).lines().last().unwrap().to_owned()
    }

    #[test]
    fn a_change_is_said_in_percent_only_where_both_times_are_sure() {
        let sure = row(&known(0.2, 0.01), &known(0.3, 0.01));
        assert!(sure.contains("0.3000 ± 0.0100"), "{sure}");
        assert!(sure.contains("+50.0 %"), "{sure}");
        for before in [known(0.0, 46_340.95), known(0.1, 0.2)] {
            let unsure = row(&before, &known(0.3, 0.01));
            assert_eq!(unsure.matches("unsure").count(), 2, "{unsure}");
            assert!(!unsure.contains('%'), "{unsure}");
        }
        let new = row(&Value::Null, &known(0.3, 0.01));
        assert!(new.contains("new"), "{new}");
    }
}
