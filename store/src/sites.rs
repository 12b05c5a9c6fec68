//! Sites.

use tread_api::site::Site;

use crate::friction::Horizons;

/// A site with its key in the database.
#[derive(Debug, Clone, PartialEq)]
pub struct SiteRow {
    /// Its database key.
    pub pk: i64,
    /// The site.
    pub site: Site,
    /// Horizons before which the epochs of its map are merged.
    pub horizons: Horizons,
}
