//! `tread login`, `logout`, `whoami`, `token`, `tokens` and `sessions`.

use std::io::{IsTerminal as _, Read as _};
use std::process::ExitCode;

use anyhow::{Context as _, ensure};
use serde_json::json;
use tread_api::identity::{CreateToken, PersonSession, Role, Session, Token};
use tread_api::rights::{Grant, Rights, Scope};

use crate::args::{Connection, SessionsAction, TokensAction, TokensArguments};
use crate::client::{Client, address_of};
use crate::credentials::{self, Entry, Store};
use crate::output::{Output, line, or_dash, print_note, render, table};

/// Maximum length of a token that is read, bytes.
const TOKEN_MAX: u64 = 1_024;

fn store() -> anyhow::Result<Store> {
    Store::of_user()
        .context("there is no home folder for stored tokens: set HOME or TREAD_CREDENTIALS")
}

/// Reads a token, verifies it at the server, and stores it for that server.
pub(super) async fn login(connection: &Connection, output: Output) -> anyhow::Result<ExitCode> {
    let token = match &connection.authentication.token_file {
        Some(file) => credentials::read_token(file)?,
        None => tokio::task::spawn_blocking(read_from_input).await??,
    };
    let authentication = &connection.authentication;
    let server = connection.server()?;
    let kept = credentials::fingerprint(address_of(&server))?;
    let client = Client::new(&server, Some(&token), authentication.trusted(kept))?;
    let client = client.for_people(!output.is_json());
    let session = client.session().await?;
    let store = store()?;
    let key = client.address();
    store.save(Entry { key, value: &token })?;
    if let Some(fingerprint) = authentication.ca_fingerprint {
        let value = &fingerprint.to_string();
        store.fingerprints().save(Entry { key, value })?;
    }
    store.keep_last_server(client.address())?;
    print_note(&format!(
        "stored in {}; commands without --server use {} from now on",
        store.path().display(),
        client.address()
    ));
    output.show(&session, subject_text)?;
    Ok(ExitCode::SUCCESS)
}

fn read_from_input() -> anyhow::Result<String> {
    let input = std::io::stdin();
    if input.is_terminal() {
        print_note("paste the token, then press Enter and Ctrl-D:");
    }
    let mut text = String::new();
    input
        .take(TOKEN_MAX)
        .read_to_string(&mut text)
        .context("cannot read the token")?;
    let token = text.trim();
    ensure!(!token.is_empty(), "no token was given");
    Ok(token.to_owned())
}

/// Deletes the stored token of a server; the token stays valid.
pub(super) fn logout(client: &Client, output: Output) -> anyhow::Result<ExitCode> {
    let store = store()?;
    store.remove(client.address(), None)?;
    store.fingerprints().remove(client.address(), None)?;
    store.delete_last_server(client.address())?;
    output.show(&json!({"server": client.address()}), |_| {
        format!(
            "deleted the stored token of {}; it stays valid until it is revoked",
            client.address()
        )
    })?;
    Ok(ExitCode::SUCCESS)
}

pub(super) async fn whoami(client: &Client, output: Output) -> anyhow::Result<ExitCode> {
    output.show(&client.session().await?, subject_text)?;
    Ok(ExitCode::SUCCESS)
}

/// Prints the token in use, for other programs.
pub(super) fn token(client: &Client) -> anyhow::Result<ExitCode> {
    let token = client
        .token()
        .context("there is no token for this server: use `tread login`")?;
    line(token)?;
    Ok(ExitCode::SUCCESS)
}

fn subject_text(session: &Session) -> String {
    let (granted, place) = (rights_text(session.role, session.rights), &session.sites);
    format!(
        "{}, {granted}, {place}, until {}",
        session.name, session.expires_at
    )
}

/// Returns the role, or the rights if there is no role.
fn rights_text(role: Option<Role>, rights: Rights) -> String {
    role.map_or_else(|| rights.to_string(), |role| role.to_string())
}

pub(super) async fn tokens(
    arguments: TokensArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    match arguments.action {
        None | Some(TokensAction::List) => {
            output.show(&client.tokens().await?, |tokens| list(tokens))?;
        }
        Some(TokensAction::Create {
            name,
            role,
            rights,
            places,
            valid_days,
        }) => {
            let sites = match places.as_slice() {
                [] => Scope::EVERYWHERE,
                places => Scope::from_names(places.iter().map(String::as_str))?,
            };
            let request = CreateToken {
                name,
                role,
                rights,
                sites: sites.into(),
                valid_days: Some(valid_days),
            };
            let created = client.create_token(&request).await?;
            if !output.is_json() {
                let Token {
                    name,
                    role,
                    rights,
                    sites,
                    expires_at,
                    ..
                } = &created.token;
                let granted = rights_text(*role, *rights);
                print_note(&format!(
                    "token `{name}`: {granted}, {sites}, valid until {expires_at}; it is shown only once:"
                ));
            }
            output.show(&created, |created| created.secret.clone())?;
        }
        Some(TokensAction::Revoke { token }) => {
            let revoked = client.revoke_token(token).await?;
            output.show(&revoked, |token| format!("`{}` is revoked", token.name))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn list(tokens: &[Token]) -> String {
    let mut table = table([
        "TOKEN",
        "NAME",
        "ROLE OR RIGHTS",
        "FOR",
        "MADE BY",
        "EXPIRES",
        "LAST USED",
        "REVOKED",
    ]);
    for token in tokens {
        table.add_row([
            token.id.to_string(),
            token.name.clone(),
            rights_text(token.role, token.rights),
            token.sites.to_string(),
            token.created_by.clone(),
            format!("{:.0}", token.expires_at),
            or_dash(token.last_used_at.map(|at| format!("{at:.0}"))),
            or_dash(token.revoked_at.map(|at| format!("{at:.0}"))),
        ]);
    }
    render(&table)
}

/// Lists or ends the sessions of people.
pub(super) async fn sessions(
    action: Option<SessionsAction>,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    match action {
        None | Some(SessionsAction::List) => {
            output.show(&client.sessions().await?, |sessions| signed_in(sessions))?;
        }
        Some(SessionsAction::End { sessions }) => {
            for &session in &sessions {
                client.end_session(session).await?;
            }
            output.show(&json!({"ended": sessions}), |_| {
                "ended; people whom the provider still admits can sign in again".to_owned()
            })?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn signed_in(sessions: &[PersonSession]) -> String {
    let mut table = table([
        "SESSION",
        "NAME",
        "SUBJECT",
        "GROUPS",
        "MAY",
        "SINCE",
        "UNTIL",
        "LAST USED",
    ]);
    for session in sessions {
        let may = session.grants.iter().map(|Grant { rights, sites }| {
            let role = Role::ALL
                .into_iter()
                .find(|&role| Rights::from(role) == *rights);
            format!("{} for {sites}", rights_text(role, *rights))
        });
        table.add_row([
            session.id.to_string(),
            session.name.clone(),
            session.person.subject.clone(),
            session.groups.join(", "),
            may.collect::<Vec<_>>().join("; "),
            format!("{:.0}", session.created_at),
            format!("{:.0}", session.expires_at),
            or_dash(session.last_used_at.map(|at| format!("{at:.0}"))),
        ]);
    }
    render(&table)
}
