//! `tread alerts`: lists and acknowledges alerts.

use std::process::ExitCode;

use tread_api::robot::Alert;

use crate::args::{AlertsAction, AlertsArguments};
use crate::client::Client;
use crate::output::{Output, or_dash, render, table};

pub(super) async fn run(
    arguments: AlertsArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    if let Some(AlertsAction::Acknowledge { alert }) = arguments.action {
        let alert = client.acknowledge(alert).await?;
        output.show(&alert, |alert| {
            format!(
                "alert `{}` of {} is acknowledged; it stays until its cause ends",
                alert.code,
                alert.about()
            )
        })?;
        return Ok(ExitCode::SUCCESS);
    }
    let site = &arguments.connection.site;
    let of = (arguments.robot.as_ref(), arguments.kind.as_ref());
    let page = client
        .alerts(site, of, !arguments.all, arguments.limit)
        .await?;
    output.show(&page.items, |alerts| list(alerts))?;
    Ok(ExitCode::SUCCESS)
}

fn list(alerts: &[Alert]) -> String {
    if alerts.is_empty() {
        return "there are no alerts".to_owned();
    }
    let mut table = table([
        "ALERT", "ABOUT", "SEVERITY", "CODE", "RAISED", "SEEN", "CLEARED", "TEXT",
    ]);
    for alert in alerts {
        table.add_row([
            alert.id.to_string(),
            alert.about().to_owned(),
            alert.severity.as_str().to_owned(),
            alert.code.to_string(),
            format!("{:.0}", alert.raised_at),
            or_dash(alert.acknowledged_at.map(|at| format!("{at:.0}"))),
            or_dash(alert.cleared_at.map(|at| format!("{at:.0}"))),
            alert.text.clone(),
        ]);
    }
    render(&table)
}
