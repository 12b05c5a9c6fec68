//! Watermarks: up to which raw measurement those of a robot are in the stored sums.

use std::collections::HashMap;
pub use tread_store::watermarks::WatermarkStep;

use super::{DbError, Tx, forward};

forward! {
    watermarks;
    fn advance(step: WatermarkStep) -> ();
    fn all() -> HashMap<i64, i64>;
}
