//! Geofences of sites; every revision is kept.

use jiff::Timestamp;
use tread_api::safety::Geofence;

use super::{DbError, Tx, forward};

forward! {
    geofences;
    fn present(site_pk: i64) -> Geofence;
    fn insert(site_pk: i64, geofence: &Geofence, at: Timestamp) -> bool;
}
