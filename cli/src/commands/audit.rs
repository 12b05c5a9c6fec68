//! `tread audit`: shows, exports and verifies the audit log.

use std::io::{BufRead as _, BufReader, BufWriter, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context as _, bail, ensure};
use serde_json::json;
use tread_api::audit::{AuditChain, Broken, Verifier};
use tread_api::identity::AuditEntry;
use tread_api::page::Page;

use crate::args::{AuditAction, AuditArguments, RecordedEntry};
use crate::client::Client;
use crate::output::{Output, or_dash, print_note, render, table};

/// Maximum number of attempts to verify the log while its oldest entries are being removed.
const TRIES: u32 = 3;

pub(super) async fn run(
    arguments: &AuditArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    match &arguments.action {
        None => {
            let who = arguments.who.as_deref();
            let page = client.audit(who, arguments.refused, arguments.limit);
            output.show(&page.await?.items, |entries| audited(entries))?;
        }
        Some(AuditAction::Export {
            output: file,
            after,
        }) => {
            // Entries must stay unchanged, because they are hashed.
            export(&client.exactly(), file.as_deref(), *after).await?;
        }
        Some(AuditAction::Verify { file, noted }) => {
            let verified = match file {
                Some(file) => verify_file(file, noted.as_ref())?,
                None => verify(&client.exactly(), noted.as_ref()).await?,
            };
            let (last_id, last_hash) = verified.verifier.last();
            let count = verified.verifier.count();
            let value = json!({
                "verified": count, "before_id": verified.before_id,
                "last_id": last_id, "last_hash": last_hash,
            });
            output.show(&value, |_| {
                let first = verified.before_id + 1;
                let held = match count {
                    0 => format!("there are no entries after {}", verified.before_id),
                    _ => format!("{count} entries hold, {first} to {last_id}"),
                };
                format!(
                    "{held}\nrecord this for the next verification: --noted {last_id}:{last_hash}"
                )
            })?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn audited(entries: &[AuditEntry]) -> String {
    let mut table = table([
        "AT", "COUNT", "WHO", "ROLE", "FROM", "REQUEST", "STATUS", "BODY",
    ]);
    for entry in entries {
        let what = entry
            .what
            .as_ref()
            .map(ToString::to_string)
            .unwrap_or_default();
        table.add_row([
            format!("{:.0}", entry.at),
            entry.count.to_string(),
            or_dash(entry.who.as_ref()),
            or_dash(entry.role),
            entry.address.clone(),
            format!("{} {}", entry.method, entry.path),
            entry.status.to_string(),
            what,
        ]);
    }
    render(&table)
}

/// Returns the number of a page's last entry, the cursor of the next page; `None` for the last
/// page.
fn end_of(page: &Page<AuditEntry>) -> Option<u64> {
    let is_last = page.next_cursor.is_none();
    page.items.last().filter(|_| !is_last).map(|entry| entry.id)
}

/// Writes entries as JSON Lines, the oldest first, to standard output or to a new file that only
/// its owner can read.
async fn export(client: &Client, file: Option<&Path>, after: Option<u64>) -> anyhow::Result<()> {
    let mut to: Box<dyn Write> = match file {
        Some(file) => {
            let mut options = std::fs::OpenOptions::new();
            options.write(true).create_new(true).mode(0o600);
            let named = || format!("cannot write {}", file.display());
            Box::new(BufWriter::new(options.open(file).with_context(named)?))
        }
        None => Box::new(BufWriter::new(std::io::stdout().lock())),
    };
    let mut after = after;
    let mut count = 0_usize;
    loop {
        let page = client.audit_after(after).await?;
        for entry in &page.items {
            serde_json::to_writer(&mut to, entry).context("cannot write an entry")?;
            to.write_all(b"\n").context("cannot write an entry")?;
        }
        count += page.items.len();
        after = end_of(&page);
        if after.is_none() {
            break;
        }
    }
    to.flush().context("cannot write the entries")?;
    print_note(&format!("{count} entries"));
    Ok(())
}

/// Result of a successful verification.
struct Verified {
    before_id: u64,
    verifier: Verifier,
}

/// Computes the hashes of all entries on the server and verifies the chain.
async fn verify(client: &Client, noted: Option<&RecordedEntry>) -> anyhow::Result<Verified> {
    for _ in 0..TRIES {
        let chain = client.audit_chain().await?;
        match follow(client, &chain, noted).await {
            Ok(verifier) => {
                let before_id = chain.before_id;
                return Ok(Verified {
                    before_id,
                    verifier,
                });
            }
            Err(error) => {
                let is_missing = matches!(error.downcast_ref(), Some(Broken::Missing { .. }));
                let now = client.audit_chain().await?;
                if !is_missing || now.before_id == chain.before_id {
                    return Err(error);
                }
            }
        }
    }
    bail!("old entries are being removed; verify again in a minute")
}

async fn follow(
    client: &Client,
    chain: &AuditChain,
    noted: Option<&RecordedEntry>,
) -> anyhow::Result<Verifier> {
    let mut verifier = Verifier::after(chain.before_id, &chain.before_hash);
    let mut is_found = noted.map(|noted| is_noted(noted, chain.before_id, &chain.before_hash));
    let mut after = Some(chain.before_id);
    while let Some(from) = after {
        let page = client.audit_after(Some(from)).await?;
        for entry in &page.items {
            if entry.id > chain.last_id {
                break;
            }
            take(&mut verifier, entry, noted, &mut is_found)?;
        }
        after = end_of(&page).filter(|id| *id < chain.last_id);
    }
    verifier.end(chain)?;
    found(noted, is_found)?;
    Ok(verifier)
}

fn take(
    verifier: &mut Verifier,
    entry: &AuditEntry,
    noted: Option<&RecordedEntry>,
    is_found: &mut Option<bool>,
) -> anyhow::Result<()> {
    verifier.take(entry)?;
    if let Some(noted) = noted.filter(|noted| noted.id == entry.id) {
        let (id, hash) = verifier.last();
        ensure!(
            is_noted(noted, id, hash),
            "entry {id} differs from the recorded one: the log was written anew"
        );
        *is_found = Some(true);
    }
    Ok(())
}

fn is_noted(noted: &RecordedEntry, id: u64, hash: &str) -> bool {
    (noted.id, noted.hash.as_str()) == (id, hash)
}

fn found(noted: Option<&RecordedEntry>, is_found: Option<bool>) -> anyhow::Result<()> {
    if let (Some(noted), Some(false)) = (noted, is_found) {
        bail!(
            "entry {} is not in the log, so it cannot be compared with the recorded one",
            noted.id
        );
    }
    Ok(())
}

/// Verifies the chain of exported entries.
fn verify_file(file: &Path, noted: Option<&RecordedEntry>) -> anyhow::Result<Verified> {
    let named = || format!("cannot read {}", file.display());
    let lines = BufReader::new(std::fs::File::open(file).with_context(named)?).lines();
    let mut verified: Option<Verified> = None;
    let mut is_found = noted.map(|_| false);
    for (index, line) in lines.enumerate() {
        let line = line.with_context(named)?;
        let entry: AuditEntry = serde_json::from_str(&line)
            .with_context(|| format!("line {} is no entry", index + 1))?;
        if entry.hash.is_none() && verified.is_none() {
            // Written before the introduction of the hash chain.
            continue;
        }
        let verified = verified.get_or_insert_with(|| {
            let before_id = entry.id.saturating_sub(1);
            let before = entry.previous_hash.as_deref().unwrap_or_default();
            Verified {
                before_id,
                verifier: Verifier::after(before_id, before),
            }
        });
        take(&mut verified.verifier, &entry, noted, &mut is_found)?;
    }
    found(noted, is_found)?;
    verified.context("no entry of it has a hash")
}
