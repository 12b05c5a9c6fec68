//! Work on all processors.

use rayon::prelude::*;

/// Applies a function to all items on all threads; results in the items' order. Each item is a task
/// of its own: drives take a second, and some take much longer than others.
pub fn in_parallel<T: Sync, R: Send>(items: &[T], work: impl Fn(&T) -> R + Sync + Send) -> Vec<R> {
    items.par_iter().with_max_len(1).map(work).collect()
}
