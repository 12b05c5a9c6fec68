//! `tread geofence`: shows and replaces the geofence of a site.

use std::process::ExitCode;

use anyhow::Context;
use tread_api::geometry::Polygon;
use tread_api::safety::{Geofence, ReplaceGeofence};

use crate::args::GeofenceArguments;
use crate::client::Client;
use crate::output::{Output, fixed, render, table};

pub(super) async fn run(
    arguments: &GeofenceArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &arguments.connection.site;
    let geofence = match &arguments.set {
        None => client.geofence(site).await?,
        Some(file) => {
            let read = if file.as_os_str() == "-" {
                std::io::read_to_string(std::io::stdin())
            } else {
                std::fs::read_to_string(file)
            };
            let text = read.with_context(|| format!("cannot read {}", file.display()))?;
            let geofence: ReplaceGeofence = serde_json::from_str(&text)
                .with_context(|| format!("{} is no geofence", file.display()))?;
            client
                .replace_geofence(site, &geofence, arguments.revision)
                .await?
        }
    };
    output.show(&geofence, describe)?;
    Ok(ExitCode::SUCCESS)
}

fn describe(geofence: &Geofence) -> String {
    if geofence.is_empty() {
        return format!(
            "revision {}: no geofence, robots may drive anywhere",
            geofence.revision
        );
    }
    let mut table = table(["ROBOTS", "CORNERS", "AREA M2", "FIRST CORNER"]);
    let mut add = |may: &str, polygon: &Polygon| {
        let first = polygon.corners().first();
        let first =
            first.map(|corner| format!("{}, {}", fixed(corner.x_m, 2), fixed(corner.y_m, 2)));
        table.add_row([
            may.to_owned(),
            polygon.corners().len().to_string(),
            format!("{:.1}", polygon.area_m2()),
            first.unwrap_or_default(),
        ]);
    };
    for polygon in &geofence.keep_in {
        add("stay in", polygon);
    }
    for polygon in &geofence.keep_out {
        add("stay out of", polygon);
    }
    format!("revision {}\n{}", geofence.revision, render(&table))
}
