//! `tread authority`: the fleet's authority and its rotation.

use std::process::ExitCode;

use tread_api::enrolment::{FinishRotation, FleetAuthority};

use crate::args::AuthorityAction;
use crate::client::Client;
use crate::output::{Output, render, table};

pub(super) async fn run(
    action: Option<&AuthorityAction>,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let authority = match action {
        None | Some(AuthorityAction::Status) => client.authority().await?,
        Some(AuthorityAction::Start) => client.start_rotation().await?,
        Some(AuthorityAction::Finish { force }) => {
            let request = FinishRotation { force: *force };
            client.finish_rotation(&request).await?
        }
    };
    output.show(&authority, described)?;
    Ok(ExitCode::SUCCESS)
}

fn described(authority: &FleetAuthority) -> String {
    let signing = format!("certificates are signed by {}", authority.signing);
    let Some(rotation) = &authority.rotation else {
        return format!("{signing}\nno rotation is under way");
    };
    let mut lines = vec![
        signing,
        format!(
            "rotation since {:.0}, started by {}; {} is trusted until it is finished",
            rotation.started_at, rotation.started_by, rotation.retiring
        ),
        format!("robots brought over: {}", rotation.robots_moved),
        format!("robots left: {}", rotation.robots_left),
    ];
    if rotation.left.is_empty() {
        lines.push("it can be finished: `tread authority finish`".to_owned());
        return lines.join("\n");
    }
    let mut table = table(["SITE", "ROBOT", "CERTIFICATE OF", "ON THE NETWORK"]);
    for left in &rotation.left {
        table.add_row([
            left.site.to_string(),
            left.robot.to_string(),
            format!("{:.0}", left.renewed_at),
            if left.online { "yes" } else { "no" }.to_owned(),
        ]);
    }
    lines.push(render(&table));
    lines.join("\n")
}
