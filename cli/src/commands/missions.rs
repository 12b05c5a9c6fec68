//! `tread missions`: lists, shows, awaits and controls missions.

use std::process::ExitCode;

use tread_api::mission::{Mission, MissionDetail};

use super::history::history_table;
use super::mission_text::{state, summary, trajectory};
use super::naming::mission_id;
use super::robots::percent;
use super::waiting::{have_succeeded, wait};
use crate::args::{MissionsAction, MissionsArguments};
use crate::client::Client;
use crate::output::{Output, or_dash, render, table};

pub(super) async fn run(
    arguments: &MissionsArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &arguments.connection.site;
    match &arguments.action {
        None => {
            let page = client
                .missions(
                    site,
                    arguments.robot.as_ref(),
                    arguments.state,
                    arguments.limit,
                )
                .await?;
            output.show(&page.items, |missions| list(missions))?;
        }
        Some(MissionsAction::Show { mission }) => {
            let mission_id = mission_id(client, site, mission).await?;
            let detail = client.mission(mission_id).await?;
            output.show(&detail, history)?;
        }
        Some(MissionsAction::Wait { missions, timeout }) => {
            let mut mission_ids = Vec::with_capacity(missions.len());
            for mission in missions {
                mission_ids.push(mission_id(client, site, mission).await?);
            }
            let ended = wait(client, &mission_ids, *timeout, output).await?;
            output.show(&ended, |ended| list(ended))?;
            if !have_succeeded(&ended) {
                return Ok(ExitCode::FAILURE);
            }
        }
        Some(MissionsAction::Pause { mission }) => {
            let mission_id = mission_id(client, site, mission).await?;
            output.show(&client.act(mission_id, "pause").await?, summary)?;
        }
        Some(MissionsAction::Resume { mission }) => {
            let mission_id = mission_id(client, site, mission).await?;
            output.show(&client.act(mission_id, "resume").await?, summary)?;
        }
        Some(MissionsAction::Cancel { mission }) => {
            let mission_id = mission_id(client, site, mission).await?;
            output.show(&client.act(mission_id, "cancel").await?, summary)?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Returns a table of missions.
pub(super) fn list(missions: &[Mission]) -> String {
    if missions.is_empty() {
        return "no missions here yet: send one with `tread send`".to_owned();
    }
    let mut table = table([
        "MISSION",
        "ROBOT",
        "STATE",
        "DONE",
        "TRAJECTORY",
        "CREATED",
        "REASON",
    ]);
    for mission in missions {
        table.add_row([
            mission.id.to_string(),
            mission.robot.to_string(),
            state(mission),
            or_dash(mission.progress.map(percent)),
            trajectory(&mission.trajectory),
            format!("{:.0}", mission.created_at),
            mission.reason.clone().unwrap_or_default(),
        ]);
    }
    render(&table)
}

fn history(detail: &MissionDetail) -> String {
    let plan = detail.mission.plan.map(|plan| {
        format!(
            "planned {:.1} m in {:.0} s\n",
            plan.length_m, plan.duration_s
        )
    });
    let quality = detail.quality.as_ref().map(|quality| {
        format!(
            "off the path {:.0} mm rms, {:.0} mm at most; saturated {:.1} %, {} slips, {} stops of the gate\n",
            1e3 * quality.cross_track_rms_m,
            1e3 * quality.cross_track_max_m,
            1e2 * quality.saturated_ratio,
            quality.slip_events,
            quality.gate_stops
        )
    });
    format!(
        "{}\n{}{}{}",
        summary(&detail.mission),
        plan.unwrap_or_default(),
        quality.unwrap_or_default(),
        history_table(&detail.events)
    )
}
