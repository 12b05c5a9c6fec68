//! `tread`.
fn main() {}
