//! Present terrains, and all their revisions.

use std::collections::HashMap;
use tread_api::ids::TerrainId;
use tread_api::terrain::Terrain;

use super::{DbError, Tx, forward};

forward! {
    terrains;
    fn list(site_pk: i64) -> Vec<Terrain>;
    fn find(site_pk: i64, id: &TerrainId) -> Option<Terrain>;
    fn count(site_pk: i64) -> usize;
    fn last_revision(site_pk: i64, id: &TerrainId) -> u32;
    fn same_ground(site_pk: i64) -> HashMap<TerrainId, Vec<u32>>;
    fn put(site_pk: i64, terrain: &Terrain) -> ();
    fn delete(site_pk: i64, id: &TerrainId) -> bool;
}
