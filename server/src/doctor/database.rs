//! Examines the schema of the database, and whether the database is readable.

use tread_api::diagnosis::{Finding, NextStep};

use super::DoctorInput;
use crate::db::failure::StorageFailure;
use crate::db::inspection::{InspectError, InspectOptions, Inspection, Schema, inspect};
use crate::error_text::chain;

const RESTORE: &str = "stop the server, keep the file, and restore a backup; or bring what can be \
                       read into a new file: `sqlite3 FILE .recover | sqlite3 NEW`";

/// Returns the findings, and what the database says.
pub(super) async fn findings(examined: &DoctorInput) -> (Vec<Finding>, Option<Inspection>) {
    let location = &examined.config.database;
    let shown = location;
    let options = InspectOptions {
        is_in_use: examined.server_process.is_some(),
        is_deep: examined.is_deep,
    };
    let inspection = match inspect(location, options).await {
        Ok(Some(inspection)) => inspection,
        Ok(None) => {
            let text = format!("`{shown}` does not exist yet; the server makes it");
            return (vec![Finding::on("database").skipped(text)], None);
        }
        Err(error) => return (vec![unreadable(&shown.to_string(), &error)], None),
    };
    let mut findings = vec![schema(&shown.to_string(), &inspection)];
    match (&inspection.damage, examined.is_deep) {
        (Some(damage), _) => findings.push(
            Finding::on("database content")
                .problem(format!("`{shown}` is damaged: {damage}"), NextStep(RESTORE)),
        ),
        (None, true) => {
            findings.push(Finding::on("database content").ok("all of it can be read"));
        }
        (None, false) => findings.push(
            Finding::on("database content").ok("every table can be read; --deep reads all of it"),
        ),
    }
    (findings, Some(inspection))
}

fn schema(shown: &str, inspection: &Inspection) -> Finding {
    match inspection.schema {
        Schema::Current(version) => {
            Finding::on("database").ok(format!("`{shown}` has the present schema, {version}"))
        }
        Schema::Empty => {
            Finding::on("database").ok(format!("`{shown}` is empty; the server makes its tables"))
        }
        Schema::Older { pending } => Finding::on("database").warning(
            format!("`{shown}` is of an older version: {pending} migrations are pending"),
            NextStep(
                "back it up; the next start of this version migrates it, and older versions then \
                 refuse it",
            ),
        ),
        Schema::Newer(version) => Finding::on("database").problem(
            format!("`{shown}` was opened by a newer version: its schema is {version}"),
            NextStep("install that version again, or restore the backup of before the upgrade"),
        ),
        Schema::Differs(version) => Finding::on("database").problem(
            format!("`{shown}` has another migration {version} than this program"),
            NextStep(
                "a build that was never released made it: use that build, or restore a backup",
            ),
        ),
    }
}

fn unreadable(shown: &str, error: &InspectError) -> Finding {
    let text = format!("`{shown}` cannot be read: {}", chain(error));
    let step = match error.failure() {
        Some(StorageFailure::Damaged) => RESTORE,
        Some(StorageFailure::Busy) => "another process holds it: end that one, and try again",
        Some(
            StorageFailure::Full
            | StorageFailure::Io
            | StorageFailure::Memory
            | StorageFailure::Connection,
        )
        | None => {
            "run this as the user that the server runs as; see `dmesg` for what the disk answers"
        }
    };
    Finding::on("database").problem(text, NextStep(step))
}
