//! A short run of `examples/mutate`: mutated messages neither panic nor allocate.

use std::alloc::System;

use stats_alloc::{INSTRUMENTED_SYSTEM, StatsAlloc};

#[path = "../examples/mutate/mutants.rs"]
mod mutants;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

#[test]
fn mutated_messages_neither_panic_nor_allocate() {
    let outcome = mutants::run(7, 100_000, || ALLOCATOR.stats().bytes_allocated);
    assert_eq!(
        (outcome.panics, outcome.allocated_above_size),
        (0, 0),
        "{outcome:?}"
    );
    assert_eq!(outcome.allocated_max_bytes, 0);
    // Otherwise nothing but the first bytes would be tried.
    assert!(
        (outcome.inputs / 20..outcome.inputs * 2).contains(&outcome.accepted),
        "{outcome:?}"
    );
}
