//! Rebuilds the crate when a migration appears: the compiler does not look into that folder.

fn main() {
    println!("cargo:rerun-if-changed=migrations");
}
