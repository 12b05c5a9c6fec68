//! Sites and the horizons of their maps.

use tread_api::ids::SiteId;
use tread_api::rights::Scope;
use tread_api::site::{GeoOrigin, Site};
use tread_store::friction::Horizons;
pub use tread_store::sites::SiteRow;

use super::{DbError, Tx, forward};

forward! {
    sites;
    fn insert(site: &Site) -> bool;
    fn set_origin(pk: i64, origin: Option<GeoOrigin>) -> ();
    fn find(id: &SiteId) -> Option<SiteRow>;
    fn list(within: &Scope, after: &str, limit: u32) -> Vec<SiteRow>;
    fn count_terrain_change(pk: i64) -> ();
    fn set_horizons(pk: i64, horizons: Horizons) -> ();
}
