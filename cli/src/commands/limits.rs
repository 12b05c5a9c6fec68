//! `tread limits`: lists, sets and ends the external limits of a robot.

use std::process::ExitCode;

use tread_api::safety::{LimitStatus, SetLimit};

use crate::args::{LimitsAction, LimitsArguments};
use crate::client::Client;
use crate::output::{Output, age, or_dash, render, table};

pub(super) async fn run(
    arguments: LimitsArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let (site, robot) = (&arguments.connection.site, &arguments.robot);
    match arguments.action {
        None => {
            let limits = client.limits(site, robot).await?;
            output.show(&limits.items, |limits| list(limits))?;
        }
        Some(LimitsAction::Set {
            owner,
            hold,
            speed,
            lasting,
        }) => {
            let limit = SetLimit {
                hold,
                linear_max_m_s: speed,
                for_ms: u64::try_from(lasting.as_millis())?,
            };
            client
                .change_limit(site, robot, &owner, Some(&limit))
                .await?;
            output.show(&limit, |_| {
                format!("{robot} has applied the limit of {owner}")
            })?;
        }
        Some(LimitsAction::End { owner }) => {
            client.change_limit(site, robot, &owner, None).await?;
            output.show(&owner, |_| {
                format!("{robot} has ended the limit of {owner}")
            })?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn list(limits: &[LimitStatus]) -> String {
    if limits.is_empty() {
        return "no program limits the robot".to_owned();
    }
    let mut table = table(["OWNER", "HOLDS", "SPEED M/S", "ENDS IN", "REQUIRED"]);
    let yes_or_no = |is: bool| if is { "yes" } else { "no" }.to_owned();
    for limit in limits {
        table.add_row([
            limit.owner.to_string(),
            yes_or_no(limit.hold),
            or_dash(limit.linear_max_m_s),
            or_dash(limit.ends_in_ms.map(age)),
            yes_or_no(limit.required),
        ]);
    }
    render(&table)
}
