//! The commands that talk to a running server, a file each.

mod drive;
mod friction;
mod geofence;
mod limits;
mod missions;
mod robots;
mod send;
mod stops;
mod terrains;
mod watch;

use std::process::ExitCode;

use crate::args::RemoteCommand;
use crate::client::Client;
use crate::output::Output;

/// Runs one command.
pub(crate) async fn run(command: RemoteCommand) -> anyhow::Result<ExitCode> {
    let connection = command.connection().clone();
    let client = Client::new(&connection.server)?;
    let output = Output::new(connection.json);
    match command {
        RemoteCommand::Robots(arguments) => robots::run(&arguments, &client, output).await,
        RemoteCommand::Send(arguments) => send::run(arguments, &client, output).await,
        RemoteCommand::Missions(arguments) => missions::run(&arguments, &client, output).await,
        RemoteCommand::Terrains(arguments) => terrains::run(&arguments, &client, output).await,
        RemoteCommand::Friction(arguments) => friction::run(&arguments, &client, output).await,
        RemoteCommand::Stop(arguments) => stops::stop(arguments, &client, output).await,
        RemoteCommand::Clear(arguments) => stops::clear(arguments, &client, output).await,
        RemoteCommand::Drive(arguments) => drive::run(&arguments, &client).await,
        RemoteCommand::Limits(arguments) => limits::run(arguments, &client, output).await,
        RemoteCommand::Geofence(arguments) => geofence::run(&arguments, &client, output).await,
        RemoteCommand::Watch(arguments) => watch::run(&arguments, &client, output).await,
    }
}
