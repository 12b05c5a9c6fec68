//! The audit log, written by a background task so that no request waits for it.
//!
//! ```text
//!                   ┌─ within the author's share ─► an entry of its own ─┐
//!  request answered ┤                                                    ├─► one transaction, chained
//!                   └─ beyond it ─► counted with its repeats ─ in time ──┘
//! ```
//!
//! No author can push others' entries out of the log or fill the disk: each author, a token or a
//! person, has an allowance of entries. Requests beyond it are not lost but counted, in one entry
//! for all repeats of the same kind with the same status. Successful requests are of the same kind
//! if their paths are equal, and for tokens, joining and sites also their bodies; refusals and
//! sign-ins if their routes are equal.

use std::collections::{HashMap, VecDeque};
use std::fmt::Write as _;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
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
use crate::config::AuditConfig;
use crate::db;
pub use crate::db::audit::AuditFilter;
use crate::db::audit::AuditRetention;
use crate::rate_limit::{Bucket, RateLimit};

/// Maximum number of entries that wait for the writer.
pub const WAITING_MAX: usize = 2_048;
/// Maximum number of waiting entries of one author.
const WAITING_PER_AUTHOR_MAX: usize = 512;
/// Maximum number of entries written at once.
const BATCH_MAX: usize = 256;
/// Time for which the writer collects entries before it writes.
const GATHER: Duration = Duration::from_millis(100);
/// Interval at which the writer checks for repeats that are due.
const LOOK_FOR_REPEATS: Duration = Duration::from_secs(1);
/// Maximum time for writing the last entries when the server stops.
const FINISH_MAX: Duration = Duration::from_secs(5);
/// Delay before the next attempt after the database failed.
const RETRY_REST: Duration = Duration::from_secs(1);
/// Maximum number of entries stored. An author who sends as many requests as possible gets 2 880
/// entries of its own per day, and needs half a year to push out those of others.
pub const ENTRIES_MAX: u32 = 500_000;
/// Time for which entries are stored.
pub const KEPT: SignedDuration = SignedDuration::from_hours(400 * 24);
/// Maximum number of old entries deleted with each batch.
const FORGET_MAX: u32 = 1_000;
/// Number of own entries that an author may write in a burst.
pub const SHARE_BURST: u32 = 600;
/// The same number for all requests without a valid credential, together.
const UNAUTHENTICATED_BURST: u32 = 60;
/// Interval after which an author may write one more entry.
const SHARE_INTERVAL: Duration = Duration::from_secs(30);
/// Maximum number of authors whose allowances are tracked; beyond it the one with the fullest
/// allowance is forgotten.
const AUTHORS_MAX: usize = 4_096;
/// Time for which repeats are first counted before they are written; it doubles each time.
pub const REPEATS_FIRST: Duration = Duration::from_mins(1);
/// Maximum time for which repeats are counted before they are written.
pub const REPEATS_MAX: Duration = Duration::from_hours(1);
/// Maximum number of kinds of requests counted separately per author; further ones are counted by
/// route alone.
const KINDS_PER_AUTHOR_MAX: usize = 256;
/// Maximum number of kinds of requests whose repeats are counted, of all authors.
const KINDS_MAX: usize = 16_384;

/// Author of an entry, to whom its allowance belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Author {
    Token(TokenId),
    Person(PersonId),
    /// Robots that joined or renewed a certificate, all together.
    Joining,
    Unauthenticated,
}

impl Author {
    fn of(entry: &AuditEntry) -> Self {
        match (entry.token, &entry.person) {
            (Some(token), _) => Self::Token(token),
            (None, Some(person)) => Self::Person(person.id),
            (None, None) if entry.status < 400 => Self::Joining,
            (None, None) => Self::Unauthenticated,
        }
    }

    const fn limit(self) -> RateLimit {
        let burst = match self {
            Self::Token(_) | Self::Person(_) | Self::Joining => SHARE_BURST,
            Self::Unauthenticated => UNAUTHENTICATED_BURST,
        };
        RateLimit {
            burst,
            interval: SHARE_INTERVAL,
        }
    }
}

/// What repeats of a request have in common.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct RequestKind {
    author: Author,
    method: String,
    route: String,
    status: u16,
    /// The path, for a successful change.
    path: Option<String>,
    /// A hash of the body, for a successful change on a route that concerns rights.
    what: Option<u64>,
}

/// Returns whether the bodies of a route concern rights.
fn is_of_rights(route: &str) -> bool {
    let begins = [
        "/v1/tokens",
        "/v1/join-tokens",
        "/v1/enrolments",
        "/v1/sessions",
    ];
    begins.iter().any(|begin| route.starts_with(begin)) || route == "/v1/sites"
}

/// Returns whether people sign in or out by a route.
fn is_sign_in(route: &str) -> bool {
    route == "/v1/session" || route.starts_with("/v1/sign-in")
}

impl RequestKind {
    /// Returns the kind of this request.
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

    /// Returns the coarser kind of this request: author, method, route and status alone.
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

/// Repeats of one kind that are being counted.
#[derive(Debug)]
struct Repeats {
    /// The newest repeat.
    newest: AuditEntry,
    since: Timestamp,
    count: u64,
    /// Time at which the count is written, since the start of the server.
    due_at: Duration,
    /// Period for which repeats are counted.
    span: Duration,
}

/// Allowance of an author, with the number of its waiting entries and counted kinds.
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

/// Identifier of a credential, as key of the time of its last use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum UsedCredential {
    Token(TokenId),
    Session(SessionId),
}

/// Entries that wait for the writer, and repeats that are being counted.
#[derive(Debug, Default)]
struct AuditQueue {
    entries: VecDeque<AuditEntry>,
    repeats: HashMap<RequestKind, Repeats>,
    shares: HashMap<Author, Share>,
    uses: HashMap<UsedCredential, Timestamp>,
}

/// What was done with an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EntryOutcome {
    Own,
    Counted,
    Dropped,
}

impl AuditQueue {
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

    fn add(&mut self, entry: AuditEntry, now: Duration) -> EntryOutcome {
        let author = Author::of(&entry);
        let has_room = self.entries.len() < WAITING_MAX;
        let share = self.share(author);
        if has_room && share.take(author.limit(), now) {
            share.waiting += 1;
            self.entries.push_back(entry);
            return EntryOutcome::Own;
        }
        self.count(entry, author, now)
    }

    /// Counts an entry as a repeat of its kind.
    fn count(&mut self, entry: AuditEntry, author: Author, now: Duration) -> EntryOutcome {
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
            return EntryOutcome::Counted;
        }
        if self.repeats.len() >= KINDS_MAX {
            return EntryOutcome::Dropped;
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
        EntryOutcome::Counted
    }

    /// Takes the next entries to write: those waiting, then repeats that are due, or with `all`
    /// every counted one.
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

/// Queue of entries for the writer.
#[derive(Debug, Default)]
pub(super) struct AuditLog {
    waiting: Mutex<AuditQueue>,
    added: Notify,
    /// Whether each written entry is also a line of the server's log.
    is_logged: bool,
}

impl AuditLog {
    pub(super) fn new(config: AuditConfig) -> Self {
        Self {
            is_logged: config.log,
            ..Self::default()
        }
    }

    fn lock(&self) -> MutexGuard<'_, AuditQueue> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl App {
    /// Queues an entry for the audit log without waiting.
    pub fn audit(&self, entry: AuditEntry) {
        // What a standby refuses it forwards, so the other server notes it.
        if self.is_standby() {
            return;
        }
        let log = &self.identity().audit;
        let taken = log.lock().add(entry, self.clock().elapsed());
        match taken {
            EntryOutcome::Own => log.added.notify_one(),
            EntryOutcome::Counted => self.counters().audit_repeats.one(),
            EntryOutcome::Dropped => self.counters().audit_dropped.one(),
        }
    }

    pub(super) fn record_use(&self, used: UsedCredential, at: Timestamp) {
        let log = &self.identity().audit;
        log.lock().uses.insert(used, at);
        log.added.notify_one();
    }

    /// Returns a page of the audit log.
    pub async fn audit_log(
        &self,
        filter: &AuditFilter,
        limit: u32,
    ) -> Result<Page<AuditEntry>, AppError> {
        let mut tx = self.db().read("identity").await?;
        let entries = db::audit::list(&mut tx, filter, limit + 1).await?;
        Ok(page(entries, limit, |entry| entry.id.to_string()))
    }

    /// Returns the data that anchors the chain of the audit log; `None` if it was removed.
    pub async fn audit_chain(&self) -> Result<Option<AuditChain>, AppError> {
        let mut tx = self.db().read("identity").await?;
        Ok(db::audit::chain(&mut tx).await?)
    }

    async fn write_audit(
        &self,
        entries: &[AuditEntry],
        uses: &HashMap<UsedCredential, Timestamp>,
    ) -> Result<(), AppError> {
        let mut tx = self.db().write_uncounted("identity").await?;
        let mut written = Vec::new();
        if !entries.is_empty() {
            written = db::audit::append(&mut tx, entries).await?;
        }
        for (used, at) in uses {
            match *used {
                UsedCredential::Token(token) => db::tokens::touch(&mut tx, token, *at).await?,
                UsedCredential::Session(session) => {
                    db::sessions::touch(&mut tx, session, *at).await?;
                }
            }
        }
        if let Ok(since) = self.clock().now().checked_sub(KEPT) {
            let kept = AuditRetention {
                since,
                newest_max: ENTRIES_MAX,
            };
            db::audit::prune(&mut tx, kept, FORGET_MAX).await?;
        }
        tx.commit().await?;
        if self.identity().audit.is_logged {
            written.iter().for_each(log_entry);
        }
        Ok(())
    }
}

/// Logs an entry as one line of the server's log.
fn log_entry(entry: &AuditEntry) {
    let hash = entry.hash.as_deref().unwrap_or_default();
    info!(target: "tread_audit", entry = entry.id, hash, "{}", ascii_json(entry));
}

/// Formats an entry as JSON in printable ASCII, so that it cannot contain control sequences of
/// terminals.
fn ascii_json(entry: &AuditEntry) -> String {
    let text = serde_json::to_string(entry).unwrap_or_default();
    let mut ascii = String::with_capacity(text.len());
    for letter in text.chars() {
        if matches!(letter, ' '..='~') {
            ascii.push(letter);
        } else {
            for unit in letter.encode_utf16(&mut [0; 2]) {
                // Writing to a string cannot fail.
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

/// Writes the remaining entries and counts, after the last request was answered.
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

/// Writes waiting entries and due repeats; after the stop everything, unless the database fails.
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
