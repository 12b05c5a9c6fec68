//! The audit log: written by one task beside the requests, so that none of them waits for it.
//!
//! ```text
//!                   ┌─ within the author's share ─► an entry of its own ─┐
//!  request answered ┤                                                    ├─► one transaction, chained
//!                   └─ beyond it ─► counted with its repeats ─ in time ──┘
//! ```
//!
//! Nobody pushes what others did out of the log, and nobody fills the disk with it: each author has a
//! share of entries, by the token or the person; what is beyond it is not lost but counted, in one entry for all
//! repeats of the same request in the same way answered. What is the same depends on what it is: of
//! tokens, robots that join and sites each body is another request; of all else that succeeded each
//! path is; refusals and sign-ins are the same when their route is.

use std::collections::{HashMap, VecDeque};
use std::fmt::Write as _;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};
use tread_api::audit::AuditChain;
use tread_api::identity::AuditEntry;
use tread_api::ids::{PersonId, SessionId, TokenId};
use tread_api::page::Page;

use crate::app::{App, AppError, page};
use crate::db;
pub use crate::db::audit::AuditFilter;
use crate::rate_limit::{Bucket, RateLimit};

/// Entries that may wait for the writer.
pub const WAITING_MAX: usize = 2_048;
/// Most of them of one author.
const WAITING_PER_AUTHOR_MAX: usize = 512;
/// Entries that are written at once.
const BATCH_MAX: usize = 256;
/// How long the writer waits for more before it writes.
const GATHER: Duration = Duration::from_millis(100);
/// How often the writer looks for repeats that are due.
const LOOK_FOR_REPEATS: Duration = Duration::from_secs(1);
/// How long the last entries may take when the server stops.
const FINISH_MAX: Duration = Duration::from_secs(5);
/// Rest after the database failed.
const RETRY_REST: Duration = Duration::from_secs(1);
/// Entries that are kept. Somebody who asks for as much as possible all the time has 2 880 of his
/// own in a day, and needs half a year to push out what others did.
pub const ENTRIES_MAX: u32 = 500_000;
/// How long entries are kept.
pub const KEPT: SignedDuration = SignedDuration::from_hours(400 * 24);
/// Old entries that are forgotten with each batch.
const FORGET_MAX: u32 = 1_000;
/// Entries of its own that an author may have at once.
pub const SHARE_BURST: u32 = 600;
/// The same of all who have shown nothing valid, together.
const STRANGERS_BURST: u32 = 60;
/// The interval in which each may have one more.
const SHARE_INTERVAL: Duration = Duration::from_secs(30);
/// Authors whose shares are remembered; those beyond have what the ones forgotten had.
const AUTHORS_MAX: usize = 4_096;
/// How long repeats are counted before they are written, at first; then twice as long each time.
pub const REPEATS_FIRST: Duration = Duration::from_mins(1);
/// How long they are counted at the most.
pub const REPEATS_MAX: Duration = Duration::from_hours(1);
/// Kinds of requests of one author whose repeats are counted apart; of more only the route counts.
const KINDS_PER_AUTHOR_MAX: usize = 256;
/// Kinds of requests in all whose repeats are counted.
const KINDS_MAX: usize = 16_384;

/// Who is behind an entry, as far as shares are concerned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Author {
    Token(TokenId),
    Person(PersonId),
    /// Robots that join or renew: they have shown something valid.
    Joining,
    Stranger,
}

impl Author {
    fn of(entry: &AuditEntry) -> Self {
        match (entry.token, &entry.person) {
            (Some(token), _) => Self::Token(token),
            (None, Some(person)) => Self::Person(person.id),
            (None, None) if entry.status < 400 => Self::Joining,
            (None, None) => Self::Stranger,
        }
    }

    const fn limit(self) -> RateLimit {
        let burst = match self {
            Self::Token(_) | Self::Person(_) | Self::Joining => SHARE_BURST,
            Self::Stranger => STRANGERS_BURST,
        };
        RateLimit {
            burst,
            interval: SHARE_INTERVAL,
        }
    }
}

/// What repeats have in common.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct RequestKind {
    author: Author,
    method: String,
    route: String,
    status: u16,
    /// The path, where it says what was changed.
    path: Option<String>,
    /// A hash of the body, where it does.
    what: Option<u64>,
}

/// Routes whose bodies say who may do what.
fn is_of_rights(route: &str) -> bool {
    let begins = [
        "/v1/tokens",
        "/v1/join-tokens",
        "/v1/enrolments",
        "/v1/sessions",
    ];
    begins.iter().any(|begin| route.starts_with(begin)) || route == "/v1/sites"
}

/// Routes by which people sign in and out.
fn is_sign_in(route: &str) -> bool {
    route == "/v1/session" || route.starts_with("/v1/sign-in")
}

impl RequestKind {
    /// As much as tells requests of this kind apart.
    fn of(entry: &AuditEntry) -> Self {
        let is_change = entry.status < 400 && !is_sign_in(&entry.route);
        let what = (is_change && is_of_rights(&entry.route)).then(|| {
            let mut hasher = DefaultHasher::new();
            let text = entry.what.as_ref().map(ToString::to_string);
            text.hash(&mut hasher);
            hasher.finish()
        });
        Self {
            path: is_change.then(|| entry.path.clone()),
            what,
            ..Self::of_route(entry)
        }
    }

    /// The author, the route, and how it was answered.
    fn of_route(entry: &AuditEntry) -> Self {
        Self {
            author: Author::of(entry),
            method: entry.method.clone(),
            route: entry.route.clone(),
            status: entry.status,
            path: None,
            what: None,
        }
    }
}

/// Repeats that are being counted.
#[derive(Debug)]
struct Repeats {
    /// The newest of them.
    newest: AuditEntry,
    since: Timestamp,
    count: u64,
    /// When they are written.
    due_at: Duration,
    /// How long they are counted.
    span: Duration,
}

/// What an author may still have of its own, and has waiting.
#[derive(Debug, Default)]
struct Share {
    bucket: Bucket,
    waiting: usize,
    kinds: usize,
}

impl Share {
    fn take(&mut self, limit: RateLimit, now: Duration) -> bool {
        self.waiting < WAITING_PER_AUTHOR_MAX && self.bucket.take(limit, now)
    }
}

/// What notes when it was used last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Used {
    Token(TokenId),
    Session(SessionId),
}

/// What waits for the writer, and what is counted.
#[derive(Debug, Default)]
struct Waiting {
    entries: VecDeque<AuditEntry>,
    repeats: HashMap<RequestKind, Repeats>,
    shares: HashMap<Author, Share>,
    uses: HashMap<Used, Timestamp>,
}

/// What became of an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Taken {
    Own,
    Counted,
    Dropped,
}

impl Waiting {
    fn share(&mut self, author: Author) -> &mut Share {
        if self.shares.len() >= AUTHORS_MAX && !self.shares.contains_key(&author) {
            let has_none = |share: &Share| share.waiting == 0 && share.kinds == 0;
            let idle = self.shares.iter().filter(|(_, share)| has_none(share));
            let oldest = idle.min_by_key(|(_, share)| share.bucket.full_at());
            if let Some(oldest) = oldest.map(|(author, _)| *author) {
                self.shares.remove(&oldest);
            }
        }
        self.shares.entry(author).or_default()
    }

    fn add(&mut self, entry: AuditEntry, now: Duration) -> Taken {
        let author = Author::of(&entry);
        let has_room = self.entries.len() < WAITING_MAX;
        let share = self.share(author);
        if has_room && share.take(author.limit(), now) {
            share.waiting += 1;
            self.entries.push_back(entry);
            return Taken::Own;
        }
        self.count(entry, author, now)
    }

    /// Counts an entry with its repeats.
    fn count(&mut self, entry: AuditEntry, author: Author, now: Duration) -> Taken {
        let mut kind = RequestKind::of(&entry);
        let is_new = !self.repeats.contains_key(&kind);
        if is_new && self.share(author).kinds >= KINDS_PER_AUTHOR_MAX {
            kind = RequestKind::of_route(&entry);
        }
        if let Some(repeats) = self.repeats.get_mut(&kind) {
            if repeats.count == 0 {
                repeats.since = entry.at;
            }
            repeats.count += entry.count;
            repeats.newest = entry;
            return Taken::Counted;
        }
        if self.repeats.len() >= KINDS_MAX {
            return Taken::Dropped;
        }
        self.share(author).kinds += 1;
        let repeats = Repeats {
            since: entry.at,
            count: entry.count,
            newest: entry,
            due_at: now + REPEATS_FIRST,
            span: REPEATS_FIRST,
        };
        self.repeats.insert(kind, repeats);
        Taken::Counted
    }

    /// The next entries to write: those that wait, then repeats that are due, or all of them.
    fn next(&mut self, now: Duration, all: bool) -> Vec<AuditEntry> {
        let mut next: Vec<AuditEntry> = Vec::new();
        while next.len() < BATCH_MAX {
            let Some(entry) = self.entries.pop_front() else {
                break;
            };
            if let Some(share) = self.shares.get_mut(&Author::of(&entry)) {
                share.waiting -= 1;
            }
            next.push(entry);
        }
        let due = self.repeats.iter();
        let due = due.filter(|(_, repeats)| repeats.due_at <= now || (all && repeats.count > 0));
        let room = BATCH_MAX - next.len();
        let due: Vec<RequestKind> = due.map(|(kind, _)| kind.clone()).take(room).collect();
        for kind in due {
            let Some(repeats) = self.repeats.get_mut(&kind) else {
                continue;
            };
            if repeats.count > 0 {
                let since = (repeats.count > 1).then_some(repeats.since);
                next.push(AuditEntry {
                    since,
                    count: repeats.count,
                    ..repeats.newest.clone()
                });
                repeats.count = 0;
                repeats.span = (2 * repeats.span).min(REPEATS_MAX);
                repeats.due_at = now + repeats.span;
            } else if repeats.due_at <= now {
                self.repeats.remove(&kind);
                if let Some(share) = self.shares.get_mut(&kind.author) {
                    share.kinds -= 1;
                }
            }
        }
        next
    }
}

/// Where entries wait for the writer.
#[derive(Debug, Default)]
pub(super) struct AuditLog {
    waiting: Mutex<Waiting>,
    added: Notify,
    is_logged: AtomicBool,
}

impl AuditLog {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl App {
    /// Puts an entry into the audit log, soon and without waiting.
    pub fn audit(&self, entry: AuditEntry) {
        let log = &self.identity().audit;
        let taken = log.lock().add(entry, self.clock().elapsed());
        match taken {
            Taken::Own => log.added.notify_one(),
            Taken::Counted => self.counters().audit_repeats.one(),
            Taken::Dropped => self.counters().audit_dropped.one(),
        }
    }

    pub(super) fn note_use(&self, used: Used, at: Timestamp) {
        let log = &self.identity().audit;
        log.lock().uses.insert(used, at);
        log.added.notify_one();
    }

    /// Whether each entry that is written from now on is a line of the server's log too.
    pub fn log_audit(&self, is_logged: bool) {
        let log = &self.identity().audit;
        log.is_logged.store(is_logged, Ordering::Relaxed);
    }

    /// Entries of the audit log.
    pub async fn audit_log(
        &self,
        filter: &AuditFilter,
        limit: u32,
    ) -> Result<Page<AuditEntry>, AppError> {
        let mut tx = self.db().read("identity").await?;
        let entries = db::audit::list(&mut tx, filter, limit + 1).await?;
        Ok(page(entries, limit, |entry| entry.id.to_string()))
    }

    /// What frames the chain of the audit log; `None` if it was removed.
    pub async fn audit_chain(&self) -> Result<Option<AuditChain>, AppError> {
        let mut tx = self.db().read("identity").await?;
        Ok(db::audit::chain(&mut tx).await?)
    }

    async fn write_audit(
        &self,
        entries: &[AuditEntry],
        uses: &HashMap<Used, Timestamp>,
    ) -> Result<(), AppError> {
        let mut tx = self.db().write("identity").await?;
        let mut written = Vec::new();
        if !entries.is_empty() {
            written = db::audit::append(&mut tx, entries).await?;
        }
        for (used, at) in uses {
            match *used {
                Used::Token(token) => db::tokens::touch(&mut tx, token, *at).await?,
                Used::Session(session) => db::sessions::touch(&mut tx, session, *at).await?,
            }
        }
        if let Ok(before) = self.clock().now().checked_sub(KEPT) {
            db::audit::forget(&mut tx, before, ENTRIES_MAX, FORGET_MAX).await?;
        }
        tx.commit().await?;
        if self.identity().audit.is_logged.load(Ordering::Relaxed) {
            written.iter().for_each(log_entry);
        }
        Ok(())
    }
}

/// Writes an entry as one line of the server's log.
fn log_entry(entry: &AuditEntry) {
    let hash = entry.hash.as_deref().unwrap_or_default();
    info!(target: "tread_audit", entry = entry.id, hash, "{}", ascii_json(entry));
}

/// An entry as JSON in printable ASCII alone, so that nothing in it moves a terminal's cursor.
fn ascii_json(entry: &AuditEntry) -> String {
    let text = serde_json::to_string(entry).unwrap_or_default();
    let mut ascii = String::with_capacity(text.len());
    for letter in text.chars() {
        if matches!(letter, ' '..='~') {
            ascii.push(letter);
        } else {
            for unit in letter.encode_utf16(&mut [0; 2]) {
                // Writing into a text cannot fail.
                let _ = write!(ascii, "\\u{unit:04x}");
            }
        }
    }
    ascii
}

/// Writes the audit log until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let log = &app.identity().audit;
    while !stop.is_cancelled() {
        tokio::select! {
            biased;
            () = stop.cancelled() => {}
            () = log.added.notified() => {
                tokio::select! {
                    () = tokio::time::sleep(GATHER) => {}
                    () = stop.cancelled() => {}
                }
            }
            () = tokio::time::sleep(LOOK_FOR_REPEATS) => {}
        }
        write_waiting(&app, &stop).await;
    }
}

/// Writes what still waits and what is being counted, when nothing is answered any more.
pub async fn finish(app: &App) {
    let stop = CancellationToken::new();
    stop.cancel();
    if tokio::time::timeout(FINISH_MAX, write_waiting(app, &stop))
        .await
        .is_err()
    {
        warn!(
            "the end of the audit log could not be written in {} s",
            FINISH_MAX.as_secs()
        );
    }
}

/// Writes what waits and is due; after the stop all that there is, as far as the database takes it.
async fn write_waiting(app: &App, stop: &CancellationToken) {
    let log = &app.identity().audit;
    loop {
        let (entries, uses) = {
            let mut waiting = log.lock();
            let entries = waiting.next(app.clock().elapsed(), stop.is_cancelled());
            (entries, std::mem::take(&mut waiting.uses))
        };
        if entries.is_empty() && uses.is_empty() {
            return;
        }
        while let Err(error) = db::limited(app.write_audit(&entries, &uses)).await {
            app.log_failure("write entries of the audit log", &error);
            if stop.is_cancelled() {
                let lost = entries.iter().map(|entry| entry.count).sum();
                app.counters().audit_dropped.add(lost);
                return;
            }
            tokio::time::sleep(RETRY_REST).await;
        }
    }
}

#[cfg(test)]
mod tests;
