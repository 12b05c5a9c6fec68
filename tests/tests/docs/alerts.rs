//! The table of alerts in the documentation has the kinds that servers and agents raise.

use std::collections::BTreeSet;

use tread_api::alert_kind::ALERT_KINDS;
use tread_tests::markdown::documents;
use tread_tests::repository::root;

/// Kinds that the table names beside those of the list: examples of a prefix.
const EXAMPLES: [&str; 2] = ["base-late", "base-value"];

#[test]
fn the_table_of_alerts_has_every_kind_and_no_other() {
    let documents = documents();
    let rest = documents
        .iter()
        .find(|document| document.name.ends_with("rest.md"));
    let path = rest.map(|rest| rest.name.clone()).unwrap();
    let text = std::fs::read_to_string(root().join(path)).unwrap();
    let after = text.split("\n## Alerts\n").nth(1).unwrap();
    let section = after.split("\n## ").next().unwrap();
    let rows = section.lines().filter(|line| line.starts_with("| `"));
    let named: BTreeSet<&str> = rows
        .filter_map(|row| row.split('|').nth(1))
        .flat_map(|codes| codes.split('`').skip(1).step_by(2))
        .filter(|code| !EXAMPLES.contains(code))
        .collect();
    assert_eq!(named, BTreeSet::from(ALERT_KINDS));
    assert!(ALERT_KINDS.is_sorted());
}
