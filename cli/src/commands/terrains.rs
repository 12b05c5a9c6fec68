//! `tread terrains`: lists, shows, creates, changes and deletes terrains.

use std::process::ExitCode;

use anyhow::Context as _;
use serde_json::json;
use tread_api::geometry::{Point, Polygon};
use tread_api::terrain::{CreateTerrain, ReplaceTerrain, Terrain, TerrainClass};

use super::points::read_corners;
use crate::args::{TerrainsAction, TerrainsArguments};
use crate::client::Client;
use crate::output::{Output, fixed, render, table};

pub(super) async fn run(
    arguments: TerrainsArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &arguments.connection.site;
    match arguments.action {
        None => {
            let terrains = client.terrains(site).await?;
            output.show(&terrains, |terrains| list(terrains))?;
        }
        Some(TerrainsAction::Show { terrain }) => {
            output.show(&client.terrain(site, &terrain).await?, details)?;
        }
        Some(TerrainsAction::Create {
            terrain,
            class,
            drawing,
        }) => {
            let request = CreateTerrain {
                id: terrain,
                name: drawing.name,
                class,
                polygon: polygon(read_corners(drawing.file.as_deref(), drawing.corners)?)?,
                layer: drawing.layer.unwrap_or_default(),
            };
            output.show(&client.create_terrain(site, &request).await?, details)?;
        }
        Some(TerrainsAction::Change {
            terrain,
            class,
            drawing,
        }) => {
            let present = client.terrain(site, &terrain).await?;
            let corners = read_corners(drawing.file.as_deref(), drawing.corners)?;
            let request = ReplaceTerrain {
                name: Some(drawing.name.unwrap_or(present.name)),
                class: class.unwrap_or(present.class),
                polygon: if corners.is_empty() {
                    present.polygon
                } else {
                    polygon(corners)?
                },
                layer: drawing.layer.unwrap_or(present.layer),
            };
            let changed = client.replace_terrain(site, &terrain, &request).await?;
            output.show(&changed, details)?;
        }
        Some(TerrainsAction::Delete { terrain }) => {
            client.delete_terrain(site, &terrain).await?;
            output.show(&json!({ "deleted": terrain }), |_| {
                format!("{terrain} is deleted; its measurements stay")
            })?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn polygon(corners: Vec<Point>) -> anyhow::Result<Polygon> {
    Polygon::new(corners).context("these corners form no valid polygon")
}

fn list(terrains: &[Terrain]) -> String {
    if terrains.is_empty() {
        return "this site has no terrains yet: create one with `tread terrains create`".to_owned();
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

fn details(terrain: &Terrain) -> String {
    let mut corners = table(["X M", "Y M"]);
    for corner in terrain.polygon.corners() {
        corners.add_row([fixed(corner.x_m, 2), fixed(corner.y_m, 2)]);
    }
    format!(
        "{}\n\n{}",
        list(std::slice::from_ref(terrain)),
        render(&corners)
    )
}

/// Returns the class as the API names it.
pub(super) fn class_name(class: TerrainClass) -> String {
    let name = serde_json::to_value(class).ok();
    let name = name.as_ref().and_then(serde_json::Value::as_str);
    name.unwrap_or("other").to_owned()
}
