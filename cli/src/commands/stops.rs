//! `tread stop`, `tread stops` and `tread clear`: stop robots, list stops, clear a stop.

use std::process::ExitCode;

use tread_api::stop::{ClearStop, FleetStop, Stop, StopFleet, StopRobot};

use crate::args::{ClearArguments, StopArguments, StopsArguments};
use crate::client::Client;
use crate::output::{Output, line, or_dash, render, table};

pub(super) async fn stop(
    arguments: StopArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let StopArguments {
        robots,
        all,
        by,
        reason,
        connection,
    } = arguments;
    let stopped = if all {
        let site = None;
        client.stop_fleet(&StopFleet { site, by, reason }).await?
    } else {
        // Sent concurrently, so that no robot waits for another.
        let words = StopRobot { by, reason };
        let requests = robots
            .iter()
            .map(|robot| client.stop_robot(&connection.site, robot, &words));
        let (mut stops, mut failed) = (Vec::new(), None);
        for answer in futures_util::future::join_all(requests).await {
            match answer {
                Ok(stop) => stops.push(stop),
                Err(error) => failed = Some(error),
            }
        }
        if let Some(error) = failed {
            if !stops.is_empty() {
                line(&list(&stops))?;
            }
            return Err(error.into());
        }
        let confirmed = stops.iter().filter(|stop| stop.confirmed_at.is_some());
        let confirmed = confirmed.count();
        FleetStop {
            confirmed,
            unconfirmed: stops.len() - confirmed,
            stops,
        }
    };
    output.show(&stopped, |stopped| list(&stopped.stops))?;
    Ok(if stopped.unconfirmed == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn list(stops: &[Stop]) -> String {
    if stops.is_empty() {
        return "there is no robot to stop".to_owned();
    }
    let mut table = table(["ROBOT", "SITE", "CONFIRMED", "STOP"]);
    for stop in stops {
        let confirmed = if stop.confirmed_at.is_some() {
            "yes"
        } else {
            "NOT YET, the stop is sent again"
        };
        table.add_row([
            stop.robot.to_string(),
            stop.site.to_string(),
            confirmed.to_owned(),
            stop.id.to_string(),
        ]);
    }
    render(&table)
}

/// Lists stops with their confirmation and clearing.
pub(super) async fn history(
    arguments: &StopsArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let StopsArguments {
        robot,
        in_force,
        limit,
        connection,
    } = arguments;
    let page = client
        .stops(&connection.site, robot.as_ref(), *in_force, *limit)
        .await?;
    output.show(&page.items, |stops| past(stops))?;
    Ok(ExitCode::SUCCESS)
}

fn past(stops: &[Stop]) -> String {
    if stops.is_empty() {
        return "there is no such stop".to_owned();
    }
    let mut table = table([
        "STOP",
        "ROBOT",
        "REQUESTED",
        "CONFIRMED",
        "STANDSTILL",
        "CLEARED",
        "BY",
        "REASON",
    ]);
    for stop in stops {
        let after = stop.confirmed_at.map(|at| {
            let after = at.duration_since(stop.requested_at);
            format!("after {} ms", after.as_millis())
        });
        table.add_row([
            stop.id.to_string(),
            stop.robot.to_string(),
            format!("{:.0}", stop.requested_at),
            after.unwrap_or_else(|| "NOT YET".to_owned()),
            or_dash(stop.standstill_at.map(|at| {
                let after = at.duration_since(stop.requested_at);
                format!("after {:.1} s", after.as_secs_f64())
            })),
            or_dash(stop.cleared_at.map(|at| format!("{at:.0}"))),
            stop.by.clone(),
            stop.reason.clone(),
        ]);
    }
    render(&table)
}

pub(super) async fn clear(
    arguments: ClearArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let ClearArguments {
        robot,
        stop,
        by,
        connection,
    } = arguments;
    let site = &connection.site;
    if let Some(stop) = stop {
        let cleared = client
            .clear_stop(site, &robot, &ClearStop { stop, by })
            .await?;
        output.show(&cleared, |stop| {
            format!(
                "the stop of {} is cleared; the robot does not start to move by itself",
                stop.robot
            )
        })?;
        return Ok(ExitCode::SUCCESS);
    }
    // Without a stop identifier, only show the stop: nobody clears a stop unseen.
    let live = client.robot(site, &robot).await?.live;
    let latch = live.and_then(|live| live.safety.stop);
    output.show(&latch, |latch| match latch {
        Some(latch) => format!(
            "{robot} was stopped by {}: {}\nclear it with: tread clear {robot} {}",
            latch.by, latch.reason, latch.id
        ),
        None => format!("{robot} shows no stop"),
    })?;
    Ok(if latch.is_some() {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}
