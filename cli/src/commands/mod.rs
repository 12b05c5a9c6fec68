//! Commands that connect to a running server, one file for each group.

mod alerts;
mod audit;
mod authority;
mod doctor;
mod drive;
mod enrolment;
mod friction;
mod geofence;
mod history;
mod identity;
mod keys;
mod limits;
mod mission_text;
mod missions;
mod naming;
mod points;
mod robots;
mod send;
mod sites;
mod stops;
mod terrains;
mod waiting;
mod watch;
mod webhooks;

use std::process::ExitCode;

use crate::args::RemoteCommand;
use crate::client::{Client, address_of};
use crate::credentials;
use crate::output::Output;

/// Runs one command.
pub(crate) async fn run(command: RemoteCommand, output: Output) -> anyhow::Result<ExitCode> {
    let connection = command.connection().clone();
    if let RemoteCommand::Login(_) = command {
        return identity::login(&connection, output).await;
    }
    let authentication = &connection.authentication;
    let server = connection.server()?;
    let address = address_of(&server);
    let token = credentials::find(address, authentication.token_file.as_deref())?;
    let trusted = authentication.trusted(credentials::fingerprint(address)?);
    let client = Client::new(address, token.as_deref(), trusted)?;
    let client = client.for_people(!output.is_json());
    let site = &connection.site;
    match command {
        RemoteCommand::Login(_) | RemoteCommand::Whoami(_) => {
            identity::whoami(&client, output).await
        }
        RemoteCommand::Logout(_) => identity::logout(&client, output),
        RemoteCommand::Token(_) => identity::token(&client),
        RemoteCommand::Tokens(arguments) => identity::tokens(arguments, &client, output).await,
        RemoteCommand::Sessions(arguments) => {
            identity::sessions(arguments.action, &client, output).await
        }
        RemoteCommand::Authority(arguments) => {
            authority::run(arguments.action.as_ref(), &client, output).await
        }
        RemoteCommand::Audit(arguments) => audit::run(&arguments, &client, output).await,
        RemoteCommand::Status(_) => sites::status(&client, output).await,
        RemoteCommand::Doctor(_) => doctor::run(site, &client, output).await,
        RemoteCommand::Sites(arguments) => sites::run(arguments, &client, output).await,
        RemoteCommand::Robots(arguments) => match &arguments.action {
            None => robots::run(&arguments, &client, output).await,
            Some(action) => enrolment::run(action, &client, output).await,
        },
        RemoteCommand::Send(arguments) => send::run(*arguments, &client, output).await,
        RemoteCommand::Missions(arguments) => missions::run(&arguments, &client, output).await,
        RemoteCommand::Terrains(arguments) => terrains::run(arguments, &client, output).await,
        RemoteCommand::Friction(arguments) => friction::run(*arguments, &client, output).await,
        RemoteCommand::Stop(arguments) => stops::stop(arguments, &client, output).await,
        RemoteCommand::Stops(arguments) => stops::history(&arguments, &client, output).await,
        RemoteCommand::Clear(arguments) => stops::clear(arguments, &client, output).await,
        RemoteCommand::Alerts(arguments) => alerts::run(arguments, &client, output).await,
        RemoteCommand::Webhooks(arguments) => webhooks::run(arguments, &client, output).await,
        RemoteCommand::Drive(arguments) => drive::run(&arguments, &client).await,
        RemoteCommand::Leases(_) => robots::leases(site, &client, output).await,
        RemoteCommand::Limits(arguments) => limits::run(arguments, &client, output).await,
        RemoteCommand::Geofence(arguments) => geofence::run(&arguments, &client, output).await,
        RemoteCommand::Watch(arguments) => watch::run(&arguments, &client, output).await,
    }
}
