//! `tread terrains`: what ground is drawn where.

use std::process::ExitCode;

use tread_api::terrain::{Terrain, TerrainClass};

use crate::args::TerrainsArguments;
use crate::client::Client;
use crate::output::{Output, render, table};

pub(super) async fn run(
    arguments: &TerrainsArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let terrains = client.terrains(&arguments.connection.site).await?;
    output.show(&terrains, |terrains| list(terrains))?;
    Ok(ExitCode::SUCCESS)
}

fn list(terrains: &[Terrain]) -> String {
    if terrains.is_empty() {
        return "no terrain is drawn on this site yet".to_owned();
    }
    let mut table = table([
        "TERRAIN", "NAME", "CLASS", "LAYER", "AREA M2", "CORNERS", "REVISION",
    ]);
    for terrain in terrains {
        table.add_row([
            terrain.id.to_string(),
            terrain.name.clone(),
            class_name(terrain.class),
            terrain.layer.to_string(),
            format!("{:.1}", terrain.polygon.area_m2()),
            terrain.polygon.corners().len().to_string(),
            terrain.revision.to_string(),
        ]);
    }
    render(&table)
}

/// The class as the API names it.
pub(super) fn class_name(class: TerrainClass) -> String {
    let name = serde_json::to_value(class).ok();
    let name = name.as_ref().and_then(serde_json::Value::as_str);
    name.unwrap_or("other").to_owned()
}
