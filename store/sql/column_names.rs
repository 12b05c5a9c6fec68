//! Names of columns in statements that are made while the program runs.

use tread_store::transfer::Table;

/// Returns the quoted names of some columns.
pub(super) fn quoted(table: &Table, places: &[usize]) -> String {
    let names = places.iter().map(|place| &table.columns[*place].name);
    let quoted: Vec<String> = names.map(|name| format!(r#""{name}""#)).collect();
    quoted.join(", ")
}
