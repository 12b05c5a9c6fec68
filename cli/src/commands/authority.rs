//! `tread authority`: shows, rotates and replaces the fleet's authority.

use std::io::{self, IsTerminal as _};
use std::process::ExitCode;

use anyhow::ensure;
use tread_api::enrolment::{
    AuthorityRotation, Enrolment, FinishRotation, FleetAuthority, ReplaceAuthority, RobotLeft,
};

use crate::args::AuthorityAction;
use crate::client::{Client, ClientError};
use crate::output::{Output, print_note, render, table};

/// Word that confirms the replacement when typed.
const CONFIRMED: &str = "replace";

pub(super) async fn run(
    action: Option<&AuthorityAction>,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let authority = match action {
        None | Some(AuthorityAction::Status) => client.authority().await?,
        Some(AuthorityAction::Start) => client.start_rotation().await?,
        Some(AuthorityAction::Finish { rotation, force }) => {
            let request = FinishRotation {
                rotation: *rotation,
                force: *force,
            };
            client.finish_rotation(&request).await?
        }
        Some(AuthorityAction::Replace { yes }) => replace(*yes, client).await?,
    };
    output.show(&authority, described)?;
    Ok(ExitCode::SUCCESS)
}

async fn replace(is_confirmed: bool, client: &Client) -> anyhow::Result<FleetAuthority> {
    let present = client.authority().await?;
    if !is_confirmed {
        let robots = enrolled(client).await?;
        confirm(&present, &robots).await?;
    }
    let request = ReplaceAuthority {
        signing: present.signing,
    };
    Ok(client.replace_authority(&request).await?)
}

/// Lists the valid enrolments of the robots of all sites.
async fn enrolled(client: &Client) -> Result<Vec<Enrolment>, ClientError> {
    let mut enrolled = Vec::new();
    for site in client.sites().await? {
        enrolled.extend(client.enrolments(&site.id).await?);
    }
    enrolled.retain(|enrolment| enrolment.revoked_at.is_none());
    Ok(enrolled)
}

async fn confirm(present: &FleetAuthority, robots: &[Enrolment]) -> anyhow::Result<()> {
    let names: Vec<String> = robots
        .iter()
        .map(|enrolment| format!("{}/{}", enrolment.site, enrolment.robot))
        .collect();
    print_note(&format!(
        "Nothing that {} has signed counts any more, from this moment on. {} robots lose their link, keep \
         to their link policy, and must join again, each by a join token: {}",
        present.signing,
        names.len(),
        if names.is_empty() {
            "none".to_owned()
        } else {
            names.join(", ")
        }
    ));
    ensure!(
        io::stdin().is_terminal(),
        "confirmation needs a terminal: give --yes"
    );
    print_note(&format!("Type `{CONFIRMED}` to go on:"));
    let typed = tokio::task::spawn_blocking(|| {
        let mut typed = String::new();
        io::stdin().read_line(&mut typed).map(|_length| typed)
    });
    let typed = typed.await??;
    ensure!(typed.trim() == CONFIRMED, "nothing was replaced");
    Ok(())
}

fn described(authority: &FleetAuthority) -> String {
    let mut lines = vec![format!("certificates are signed by {}", authority.signing)];
    match &authority.rotation {
        Some(rotation) => lines.extend(of_rotation(rotation)),
        None => lines.push("no rotation is under way".to_owned()),
    }
    if !authority.on_disk {
        lines.push(
            "the disk has not confirmed yet that the former authority is retired: a power cut may undo \
             it; the server asks it again"
                .to_owned(),
        );
    }
    if !authority.to_join.is_empty() {
        lines.push(format!(
            "robots that must join again: {}; `tread robots join-token --all` makes a join token for each",
            authority.robots_to_join
        ));
        lines.push(robots(&authority.to_join));
    }
    lines.join("\n")
}

fn of_rotation(rotation: &AuthorityRotation) -> Vec<String> {
    let mut lines = vec![
        format!(
            "rotation {} since {:.0}, started by {}; {} is trusted until it is finished",
            rotation.id, rotation.started_at, rotation.started_by, rotation.retiring
        ),
        format!(
            "robots with certificates of the new authority: {}",
            rotation.robots_moved
        ),
        format!(
            "robots with certificates of the former authority: {}",
            rotation.robots_left
        ),
    ];
    lines.push(if rotation.left.is_empty() {
        format!(
            "it can be finished: `tread authority finish {}`",
            rotation.id
        )
    } else {
        robots(&rotation.left)
    });
    lines
}

fn robots(left: &[RobotLeft]) -> String {
    let mut table = table(["SITE", "ROBOT", "CERTIFICATE OF", "ON THE NETWORK"]);
    for left in left {
        table.add_row([
            left.site.to_string(),
            left.robot.to_string(),
            format!("{:.0}", left.renewed_at),
            if left.online { "yes" } else { "no" }.to_owned(),
        ]);
    }
    render(&table)
}
