//! What the documentation says is held against what there is: where its links lead, whether its
//! JSON is what the API takes and gives, whether its settings are read, whether its Python parses, and
//! whether its book is whole. `cli/tests/cli/documentation.rs` runs its commands.

#![expect(
    clippy::unwrap_used,
    reason = "what the helpers of a test cannot do fails the test"
)]

mod alerts;
mod book;
mod data;
mod links;
mod python;
mod routes;
mod runbook;
mod schema;
mod settings;
