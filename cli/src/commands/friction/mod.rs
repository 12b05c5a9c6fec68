//! `tread friction`: shows the friction of the ground and its uncertainty.

mod tables;

use std::io::Write as _;
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;
use serde_json::json;
use tread_api::friction::{CreateWithdrawal, PathFrictionRequest};
use tread_api::ids::SiteId;

use super::points::read_corners;
use crate::args::{FrictionAction, FrictionArguments, HistoryArguments, HistoryPlace};
use crate::client::{Client, Reading};
use crate::output::Output;

/// Writes a picture to a file, or to standard output for `-`.
fn save(picture: &[u8], file: &Path, output: Output) -> anyhow::Result<()> {
    if file.as_os_str() == "-" {
        let mut out = std::io::stdout().lock();
        out.write_all(picture).context("cannot print")?;
        return out.flush().context("cannot print");
    }
    let name = file.display();
    std::fs::write(file, picture).with_context(|| format!("cannot write {name}"))?;
    let bytes = picture.len();
    output.show(&json!({ "file": file, "bytes": bytes }), |_| {
        format!("wrote the map to {name}, {bytes} bytes")
    })
}

async fn history(
    (client, output): (&Client, Output),
    site: &SiteId,
    arguments: &HistoryArguments,
) -> anyhow::Result<()> {
    let (times, reading) = (arguments.times(), arguments.models.reading());
    match &arguments.place {
        HistoryPlace::Terrain(terrain) => {
            let read = client.terrain_history((site, terrain), times, reading);
            output.show(&read.await?, tables::terrain_history)
        }
        HistoryPlace::Point(point) => {
            let read = client.point_history((site, *point), times, reading);
            output.show(&read.await?, tables::point_history)
        }
    }
}

pub(super) async fn run(
    arguments: FrictionArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &arguments.connection.site;
    match arguments.action {
        None => {
            let read = client.terrain_friction(site, None, Reading::default());
            output.show(&read.await?, |terrains| tables::terrains(terrains))?;
        }
        Some(FrictionAction::Terrains { terrain, reading }) => {
            let read = client.terrain_friction(site, terrain.as_ref(), reading.reading());
            output.show(&read.await?, |terrains| tables::terrains(terrains))?;
        }
        Some(FrictionAction::History(arguments)) => {
            history((client, output), site, &arguments).await?;
        }
        Some(FrictionAction::Cells {
            area,
            resolution,
            reading,
        }) => {
            let read = client.cell_friction(site, area.area, resolution, reading.reading());
            output.show(&read.await?, tables::cells)?;
        }
        Some(FrictionAction::Point { point, reading }) => {
            let read = client.point_friction(site, point, reading.reading());
            output.show(&read.await?, tables::point)?;
        }
        Some(FrictionAction::Path {
            points,
            file,
            robot,
            as_of,
            normalisation,
        }) => {
            let request = PathFrictionRequest {
                points: read_corners(file.as_deref(), points)?,
                robot,
                as_of,
                normalisation,
            };
            let read = client.path_friction(site, &request);
            output.show(&read.await?, tables::path)?;
        }
        Some(FrictionAction::Difference {
            from,
            to,
            area,
            models,
        }) => {
            let read = client.friction_difference(site, (from, to), area.area, models.reading());
            output.show(&read.await?, tables::differences)?;
        }
        Some(FrictionAction::Visits {
            area,
            limit,
            reading,
        }) => {
            let page = client.visits(site, area, limit, reading.reading()).await?;
            output.show(&page.items, |visits| tables::visits(page.as_of, visits))?;
        }
        Some(FrictionAction::Map {
            png,
            area,
            resolution,
            scale,
            reading,
        }) => {
            let reading = reading.reading();
            let drawn = client.friction_picture(site, area.area, resolution, scale, reading);
            save(&drawn.await?, &png, output)?;
        }
        Some(FrictionAction::Robots) => {
            let read = client.contributions(site);
            output.show(&read.await?, |robots| tables::contributions(robots))?;
        }
        Some(FrictionAction::Withdrawals) => {
            let read = client.withdrawals(site);
            output.show(&read.await?, |done| tables::withdrawals(done))?;
        }
        Some(FrictionAction::Withdraw {
            robot,
            reason,
            from,
            to,
        }) => {
            let request = CreateWithdrawal { from, to, reason };
            let done = [client.withdraw(site, &robot, &request).await?];
            output.show(&done, |done| tables::withdrawals(done))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}
