//! `tread status` and `tread sites`: show the server, list and change sites.

use std::process::ExitCode;

use serde_json::Value;
use tread_api::site::{CreateSite, GeoOrigin, Site};

use crate::args::{SitesAction, SitesArguments};
use crate::client::{Client, ClientError};
use crate::output::{Output, age, or_dash, render, table};

pub(super) async fn status(client: &Client, output: Output) -> anyhow::Result<ExitCode> {
    output.show(&client.status().await?, |status| {
        describe(status, client.address())
    })?;
    Ok(ExitCode::SUCCESS)
}

/// Formats the status of a server of any version: unknown counters are shown, missing fields left
/// out.
fn describe(status: &Value, address: &str) -> String {
    let mut lines = vec![format!("server          {address}")];
    let mut add = |name: &str, value: Option<String>| {
        lines.extend(value.map(|value| format!("{name:15} {value}")));
    };
    let text = |name: &str| status[name].as_str().map(str::to_owned);
    add("version", text("version"));
    add("commit", text("commit"));
    let schema = status["schema"].as_i64();
    add("schema", schema.map(|schema| schema.to_string()));
    add("up for", status["uptime_ms"].as_u64().map(age));
    let database = &status["database"];
    let engine = database["engine"]
        .as_str()
        .zip(database["version"].as_str());
    add(
        "database",
        engine.map(|(engine, version)| format!("{engine} {version}")),
    );
    let present = status["robots_present"].as_u64();
    add("robots present", present.map(|count| count.to_string()));
    let backup = &status["backup"];
    add("last backup", backup["last_at"].as_str().map(str::to_owned));
    add("no backup", backup["failure"].as_str().map(str::to_owned));
    let restoration = &status["restoration"];
    let awaiting = restoration["robots_awaiting_release"].as_u64();
    add(
        "restored",
        restoration["restored_at"].as_str().map(|at| {
            let of = restoration["backup_taken_at"].as_str().unwrap_or_default();
            let awaiting = awaiting.unwrap_or_default();
            format!("{at} from a backup of {of}; {awaiting} robots await their release")
        }),
    );
    let counters = status["counters"].as_object();
    let counted: Vec<(&String, u64)> = counters
        .into_iter()
        .flatten()
        .filter_map(|(name, value)| Some((name, value.as_u64()?)))
        .filter(|(_, count)| *count > 0)
        .collect();
    if counted.is_empty() {
        return lines.join("\n");
    }
    let mut counters = table(["COUNTED SINCE THE START", "TIMES"]);
    for (name, count) in counted {
        counters.add_row([name.replace('_', " "), count.to_string()]);
    }
    format!("{}\n\n{}", lines.join("\n"), render(&counters))
}

pub(super) async fn run(
    arguments: SitesArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    match arguments.action {
        None => output.show(&client.sites().await?, |sites| list(sites))?,
        Some(action) => {
            let site = change(action, client).await?;
            output.show(&site, |site| list(std::slice::from_ref(site)))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

async fn change(action: SitesAction, client: &Client) -> Result<Site, ClientError> {
    match action {
        SitesAction::Create {
            id,
            name,
            cell,
            origin,
            x_axis,
        } => {
            let request = CreateSite {
                id,
                name,
                cell_m: cell,
                origin: origin.map(|place| turned(place, x_axis)),
            };
            client.create_site(&request).await
        }
        SitesAction::SetOrigin { id, origin, x_axis } => {
            client.set_site_origin(&id, &turned(origin, x_axis)).await
        }
        SitesAction::RemoveOrigin { id } => client.remove_site_origin(&id).await,
    }
}

fn turned(place: GeoOrigin, x_axis_deg: f64) -> GeoOrigin {
    GeoOrigin {
        x_axis_deg,
        ..place
    }
}

/// Returns position in WGS 84, to about a decimetre, and orientation of a site.
fn on_earth(origin: GeoOrigin) -> String {
    let GeoOrigin {
        latitude_deg,
        longitude_deg,
        x_axis_deg,
    } = origin;
    format!("{latitude_deg:.6},{longitude_deg:.6} x axis {x_axis_deg}°")
}

fn list(sites: &[Site]) -> String {
    if sites.is_empty() {
        return "there is no site yet: an admin creates one with `tread sites create`".to_owned();
    }
    let mut table = table([
        "SITE", "NAME", "CELL M", "TERRAINS", "GEOFENCE", "ORIGIN", "CREATED",
    ]);
    for site in sites {
        table.add_row([
            site.id.to_string(),
            site.name.clone(),
            site.grid.cell_m.to_string(),
            format!("revision {}", site.terrain_revision),
            format!("revision {}", site.geofence_revision),
            or_dash(site.origin.map(on_earth)),
            format!("{:.0}", site.created_at),
        ]);
    }
    render(&table)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_shown_with_what_was_counted_and_without_what_never_happened() {
        let status = serde_json::json!({
            "version": "0.1.0", "uptime_ms": 90_000, "robots_present": 3,
            "counters": {"requests_refused": 2, "messages_dropped": 0},
        });
        let text = describe(&status, "http://here");
        assert!(text.contains("up for          90.0 s"), "{text}");
        assert!(text.contains("requests refused"), "{text}");
        assert!(!text.contains("messages dropped"), "{text}");
    }
}
