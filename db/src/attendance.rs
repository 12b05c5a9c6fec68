//! Attendance of robots: which ones were on the network and have not left by themselves.

pub use tread_store::attendance::Expected;

use super::{DbError, Tx, forward};

forward! {
    attendance;
    fn all(code: &str) -> Vec<Expected>;
    fn set_present(robot_pk: i64, is_present: bool) -> ();
}
