//! What a restoration changes in the database, and what people must review after it.

use std::io::{self, Write};

use anyhow::Context as _;
use serde_json::json;
use tread_api::enrolment::Enrolment;
use tread_api::identity::{AuditEntry, Token};
use tread_api::rights::{Right, Scope};

use crate::db::restorations::{Changed, Restoration};
use crate::db::{self, Db, DbError, Location};

/// Maximum number of tokens that are listed; also the size of the page that is read.
const TOKENS_MAX: u32 = 10_000;

/// Entries of a restored database that people must review.
pub(super) struct Review {
    changed: Changed,
    tokens: Vec<Token>,
    enrolments: Vec<Enrolment>,
}

/// Applies migrations, and adapts the database to robots and people that continued after the
/// backup of this name.
///
/// # Errors
/// The database cannot be opened or written.
pub(super) async fn prepare(
    location: &Location,
    restoration: &Restoration,
    backup: &str,
) -> anyhow::Result<Review> {
    let database = Db::open(location).await?;
    let prepared = prepare_in(&database, restoration, backup).await;
    database.close().await;
    prepared.context("cannot prepare the database")
}

async fn prepare_in(
    database: &Db,
    restoration: &Restoration,
    backup: &str,
) -> Result<Review, DbError> {
    let mut tx = database.write("restore").await?;
    let changed = db::restorations::begin(&mut tx, restoration).await?;
    let entry = audit_entry(restoration, backup, changed);
    db::audit::append(&mut tx, &[entry]).await?;
    let tokens = db::tokens::list(&mut tx, &Scope::EVERYWHERE, None, TOKENS_MAX).await?;
    let enrolments = db::enrolments::all_newest(&mut tx).await?;
    tx.commit().await?;
    Ok(Review {
        changed,
        tokens,
        enrolments,
    })
}

/// Returns the entry with which the audit log continues from the backup. It names the backup's
/// time.
fn audit_entry(restoration: &Restoration, backup: &str, changed: Changed) -> AuditEntry {
    AuditEntry {
        id: 0,
        at: restoration.restored_at,
        since: None,
        count: 1,
        who: Some("tread-server restore".to_owned()),
        token: None,
        person: None,
        role: None,
        address: "127.0.0.1".to_owned(),
        method: "RESTORE".to_owned(),
        route: "tread-server restore".to_owned(),
        path: backup.to_owned(),
        status: 200,
        request_id: String::new(),
        what: Some(json!({
            "backup_taken_at": restoration.taken_at,
            "backup_version": restoration.version,
            "robots_awaiting_release": changed.robots,
        })),
        previous_hash: None,
        hash: None,
    }
}

impl Review {
    /// Prints what has changed and what people must review.
    ///
    /// # Errors
    /// It cannot be printed.
    pub(super) fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let Changed {
            robots,
            sessions,
            join_tokens,
            deliveries,
            certificates,
        } = self.changed;
        writeln!(
            out,
            "ended: {sessions} sessions, {join_tokens} join tokens, {deliveries} deliveries to webhooks; \
         the server accepts the next certificate of {certificates} robots"
        )?;
        writeln!(
            out,
            "\nreview: what was created or revoked after the backup is unknown to this database"
        )?;
        for token in self
            .tokens
            .iter()
            .filter(|token| token.revoked_at.is_none())
        {
            let rights = token.role.map(|role| role.to_string());
            let rights = rights.unwrap_or_else(|| {
                let rights: Vec<&str> = token.rights.iter().map(Right::as_str).collect();
                rights.join(",")
            });
            let Token {
                id,
                name,
                created_at,
                expires_at,
                ..
            } = token;
            writeln!(
                out,
                "  token `{name}` ({rights}) of {created_at:.0}, until {expires_at:.0}: tread tokens revoke {id}"
            )?;
        }
        let in_force = self.enrolments.iter().filter(|it| it.revoked_at.is_none());
        for enrolment in in_force {
            let Enrolment {
                site,
                robot,
                enrolled_at,
                ..
            } = enrolment;
            writeln!(
                out,
                "  robot `{robot}` of site `{site}`, joined {enrolled_at:.0}: tread robots revoke {robot} --site {site}"
            )?;
        }
        writeln!(
            out,
            "\nno mission is sent to {robots} robots until they are released. Start the server; when the \
         robots are back:\n  tread status\n  tread missions\n  tread robots release --all"
        )
    }
}
