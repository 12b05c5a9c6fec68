//! `tread robots join-token`, `enrolments`, `rename`, `tag`, `retire`,
//! `release`, `restore` and `revoke`.

use std::process::ExitCode;

use tread_api::enrolment::{CreateJoinToken, CreatedJoinToken, Enrolment, JoinToken};
use tread_api::robot::{Robot, UpdateRobot};

use crate::args::{
    JoinTokenAction, JoinTokenArguments, ReleaseArguments, RobotArguments, RobotsAction,
};
use crate::client::{Client, ClientError};
use crate::output::{Output, joined, or_dash, print_note, render, table};

pub(super) async fn run(
    action: &RobotsAction,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &action.connection().site;
    match action {
        RobotsAction::JoinToken(arguments) => join_token(arguments, client, output).await?,
        RobotsAction::Enrolments(_) => {
            let enrolments = client.enrolments(site).await?;
            output.show(&enrolments, |enrolments| list(enrolments))?;
        }
        RobotsAction::Rename(arguments) => {
            let change = UpdateRobot {
                name: Some(arguments.name.clone()),
                ..UpdateRobot::default()
            };
            let robot = client.update_robot(site, &arguments.robot, &change).await?;
            output.show(&robot, |it| {
                format!("the name of `{}` is now {}", it.id, it.name)
            })?;
        }
        RobotsAction::Tag(arguments) => {
            let change = UpdateRobot {
                tags: Some(arguments.tags.clone()),
                ..UpdateRobot::default()
            };
            let robot = client.update_robot(site, &arguments.robot, &change).await?;
            output.show(&robot, |it| {
                if it.tags.is_empty() {
                    return format!("`{}` has no tags", it.id);
                }
                format!("`{}` has the tags {}", it.id, joined(&it.tags))
            })?;
        }
        RobotsAction::Retire(arguments) => {
            let retired = set_retired(client, arguments, true).await?;
            output.show(&retired, |it| {
                format!("`{}` is retired; its measurements stay", it.id)
            })?;
        }
        RobotsAction::Release(arguments) => {
            let released = release(client, arguments).await?;
            output.show(&released, |released| {
                if released.is_empty() {
                    return "no robot awaits its release".to_owned();
                }
                let names: Vec<_> = released.iter().map(|robot| &robot.id).collect();
                format!("missions are sent again to {}", joined(&names))
            })?;
        }
        RobotsAction::Restore(arguments) => {
            let back = set_retired(client, arguments, false).await?;
            output.show(&back, |it| format!("`{}` is restored", it.id))?;
        }
        RobotsAction::Revoke(arguments) => {
            let revoked = client.revoke_robot(site, &arguments.robot).await?;
            output.show(&revoked, |it| {
                format!("the enrolment of `{}` is revoked", it.robot)
            })?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Releases robots: those that are named, or all of the site that await it.
async fn release(client: &Client, arguments: &ReleaseArguments) -> Result<Vec<Robot>, ClientError> {
    let site = &arguments.connection.site;
    let names = if arguments.all {
        let robots = client.robots(site, false).await?;
        let awaiting = robots
            .into_iter()
            .filter(|robot| robot.awaits_release_since.is_some());
        awaiting.map(|robot| robot.id).collect()
    } else {
        arguments.robots.clone()
    };
    let mut released = Vec::with_capacity(names.len());
    for robot in &names {
        released.push(client.release_robot(site, robot).await?);
    }
    Ok(released)
}

async fn set_retired(
    client: &Client,
    arguments: &RobotArguments,
    is_retired: bool,
) -> Result<Robot, ClientError> {
    let change = UpdateRobot {
        retired: Some(is_retired),
        ..UpdateRobot::default()
    };
    let site = &arguments.connection.site;
    client.update_robot(site, &arguments.robot, &change).await
}

async fn join_token(
    arguments: &JoinTokenArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<()> {
    match &arguments.action {
        None if arguments.all => join_tokens_of_all(arguments.expires, client, output).await?,
        None => {
            let request = CreateJoinToken {
                site: arguments.connection.site.clone(),
                robot: arguments.name.clone(),
                valid_minutes: Some(arguments.expires),
            };
            let created = client.create_join_token(&request).await?;
            if !output.is_json() {
                let token = &created.join_token;
                let whom = token.robot.as_ref().map_or_else(
                    || "a new robot".to_owned(),
                    |robot| format!("robot `{robot}`"),
                );
                print_note(&format!(
                    "join token for {whom} of site `{}`, valid until {}; it is shown only once:",
                    token.site, token.expires_at
                ));
            }
            output.show(&created, |created| created.secret.clone())?;
        }
        Some(JoinTokenAction::List) => {
            let tokens = client.join_tokens().await?;
            output.show(&tokens, |tokens| listed(tokens))?;
        }
        Some(JoinTokenAction::Revoke { join_token }) => {
            let revoked = client.revoke_join_token(*join_token).await?;
            output.show(&revoked, |token| format!("`{}` is revoked", token.id))?;
        }
    }
    Ok(())
}

/// Creates a join token for each robot that must join again.
async fn join_tokens_of_all(
    valid_minutes: u32,
    client: &Client,
    output: Output,
) -> anyhow::Result<()> {
    let authority = client.authority().await?;
    let mut made = Vec::new();
    for robot in &authority.to_join {
        let request = CreateJoinToken {
            site: robot.site.clone(),
            robot: Some(robot.robot.clone()),
            valid_minutes: Some(valid_minutes),
        };
        match client.create_join_token(&request).await {
            Ok(created) => made.push(created),
            Err(failed) => {
                // The secrets created so far are not shown anywhere else.
                output.show(&made, |made| secrets(made))?;
                return Err(failed.into());
            }
        }
    }
    if made.is_empty() && !output.is_json() {
        print_note("no robot must join again");
        return Ok(());
    }
    output.show(&made, |made| secrets(made))?;
    let listed = u32::try_from(made.len()).unwrap_or(u32::MAX);
    let more = authority.robots_to_join.saturating_sub(listed);
    if more > 0 && !output.is_json() {
        print_note(&format!(
            "{more} more robots must join again: repeat this when these have joined"
        ));
    }
    Ok(())
}

fn secrets(made: &[CreatedJoinToken]) -> String {
    let mut table = table(["SITE", "ROBOT", "UNTIL", "JOIN TOKEN"]);
    for created in made {
        let token = &created.join_token;
        table.add_row([
            token.site.to_string(),
            or_dash(token.robot.as_ref()),
            format!("{:.0}", token.expires_at),
            created.secret.clone(),
        ]);
    }
    render(&table)
}

fn listed(tokens: &[JoinToken]) -> String {
    let mut table = table([
        "JOIN TOKEN",
        "SITE",
        "FOR",
        "MADE BY",
        "EXPIRES",
        "USED BY",
        "REVOKED",
    ]);
    for token in tokens {
        table.add_row([
            token.id.to_string(),
            token.site.to_string(),
            or_dash(token.robot.as_ref()),
            token.created_by.clone(),
            format!("{:.0}", token.expires_at),
            or_dash(token.used_by.as_ref()),
            or_dash(token.revoked_at.map(|at| format!("{at:.0}"))),
        ]);
    }
    render(&table)
}

fn list(enrolments: &[Enrolment]) -> String {
    let mut table = table([
        "ROBOT", "TIMES", "JOINED", "RENEWED", "EXPIRES", "PUT OUT", "BY",
    ]);
    for enrolment in enrolments {
        table.add_row([
            enrolment.robot.to_string(),
            enrolment.number.to_string(),
            format!("{:.0}", enrolment.enrolled_at),
            format!("{:.0}", enrolment.renewed_at),
            format!("{:.0}", enrolment.expires_at),
            or_dash(enrolment.revoked_at.map(|at| format!("{at:.0}"))),
            or_dash(enrolment.revoked_by.as_ref()),
        ]);
    }
    render(&table)
}
