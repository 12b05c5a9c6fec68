//! `tread friction`: how the ground grips, and how sure that is.

use std::process::ExitCode;

use tread_api::friction::{CellFriction, FusedFriction, TerrainFriction};

use super::terrains::class_name;
use crate::args::FrictionArguments;
use crate::client::Client;
use crate::output::{Output, or_dash, render, table};

pub(super) async fn run(
    arguments: &FrictionArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &arguments.connection.site;
    if arguments.cells {
        let cells = client.cell_friction(site).await?;
        output.show(&cells, |cells| cell_list(cells))?;
    } else {
        let terrains = client
            .terrain_friction(site, arguments.terrain.as_ref())
            .await?;
        output.show(&terrains, |terrains| terrain_list(terrains))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// A table of terrains, a row for each robot model.
pub(crate) fn terrain_list(terrains: &[TerrainFriction]) -> String {
    if terrains.is_empty() {
        return "no terrain is drawn on this site yet".to_owned();
    }
    let mut table = table([
        "TERRAIN",
        "CLASS",
        "MODEL",
        "THETA",
        "95 % INTERVAL",
        "K",
        "MU PEAK >=",
        "SEGMENTS",
        "ROBOTS",
        "NEWEST",
    ]);
    for terrain in terrains {
        let name = terrain.terrain.id.to_string();
        let class = class_name(terrain.class);
        if terrain.models.is_empty() {
            let mut row = vec![name.clone(), class.clone(), "not driven yet".to_owned()];
            row.resize(10, "-".to_owned());
            table.add_row(row);
        }
        for model in &terrain.models {
            let mut row = vec![name.clone(), class.clone(), model.model.clone()];
            row.extend(friction_columns(model.friction.as_ref()));
            table.add_row(row);
        }
    }
    render(&table)
}

fn cell_list(cells: &[CellFriction]) -> String {
    if cells.is_empty() {
        return "no cell has been measured on this site yet".to_owned();
    }
    let mut table = table([
        "IX",
        "IY",
        "TERRAIN",
        "THETA",
        "95 % INTERVAL",
        "K",
        "MU PEAK >=",
        "SEGMENTS",
        "ROBOTS",
        "NEWEST",
    ]);
    for cell in cells {
        let mut row = vec![
            cell.cell.ix.to_string(),
            cell.cell.iy.to_string(),
            or_dash(cell.terrain.as_ref().map(|terrain| terrain.id.to_string())),
        ];
        row.extend(friction_columns(Some(&cell.friction)));
        table.add_row(row);
    }
    render(&table)
}

fn friction_columns(friction: Option<&FusedFriction>) -> [String; 7] {
    let number =
        |value: Option<f64>, digits: usize| or_dash(value.map(|value| format!("{value:.digits$}")));
    [
        number(friction.map(|friction| friction.theta), 4),
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
        or_dash(friction.map(|friction| friction.newest_at)),
    ]
}
