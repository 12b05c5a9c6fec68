//! Which statements were executed, against those that the server has.

use std::collections::BTreeSet;
use std::fmt::Debug;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use tracing::field::{Field, Visit};
use tracing_subscriber::layer::{Context, SubscriberExt as _};
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer};

/// Statements, each on one line.
pub(crate) type Statements = Arc<Mutex<BTreeSet<String>>>;

/// Collects what SQLite executes from now on.
pub(crate) fn record() -> Statements {
    let statements = Statements::default();
    let recorder = Recorder(Arc::clone(&statements));
    tracing_subscriber::registry()
        .with(EnvFilter::new("off,sqlx::query=debug"))
        .with(recorder)
        .init();
    statements
}

/// Writing statements of the server that were not executed.
pub(crate) fn not_in(executed: &Statements) -> Vec<String> {
    let executed = executed.lock().unwrap();
    let all = all_writes();
    assert!(all.len() > 50, "found only {} writes", all.len());
    all.into_iter()
        .filter(|one| !executed.contains(one))
        .collect()
}

fn all_writes() -> Vec<String> {
    let folder = PathBuf::from(std::env::var_os("CARGO_MANIFEST_DIR").unwrap())
        .join("../store-sqlite/.sqlx");
    let mut writes = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
        let kept: serde_json::Value = serde_json::from_str(&text).unwrap();
        let query = on_one_line(kept["query"].as_str().unwrap());
        let verb = query.split(' ').next().unwrap_or_default();
        if ["INSERT", "UPDATE", "DELETE", "REPLACE"].contains(&verb) {
            writes.push(query);
        }
    }
    writes
}

fn on_one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

struct Recorder(Statements);

#[derive(Default)]
struct Found {
    summary: String,
    statement: String,
}

impl Visit for Found {
    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            "summary" => self.summary = on_one_line(value),
            "db.statement" => self.statement = on_one_line(value),
            _ => {}
        }
    }

    fn record_debug(&mut self, _field: &Field, _value: &dyn Debug) {}
}

impl<S: tracing::Subscriber> Layer<S> for Recorder {
    fn on_event(&self, event: &tracing::Event<'_>, _context: Context<'_, S>) {
        let mut found = Found::default();
        event.record(&mut found);
        // A short statement is its own summary.
        let whole = if found.statement.is_empty() {
            found.summary
        } else {
            found.statement
        };
        self.0.lock().unwrap().insert(whole);
    }
}
