//! Pictures of the map in several formats, cached as long as the map is unchanged.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tread_api::ids::SiteId;

use super::raster::{Blocks, PictureRequest, raster};
use super::{App, AppError, MapReader, Reading};
use crate::db::sites::SiteRow;
use crate::friction::Raster;
use crate::friction::index::{Block, Stamp};

/// Maximum number of bytes of cached pictures.
const KEPT_BYTES_MAX: usize = 64 * 1024 * 1024;
/// Maximum number of cached pictures.
const KEPT_MAX: usize = 1_024;

/// An encoded picture with a description of its content.
#[derive(Debug, Clone)]
pub struct Picture {
    /// The picture itself.
    pub bytes: Arc<[u8]>,
    /// The raster that it was made from, without its squares.
    pub of: Arc<Raster>,
}

/// State of the map; a picture is up to date if its state is the present one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct State {
    /// Number of the newest change in the cells shown.
    change: u64,
    terrain_revision: u64,
    now_us: i64,
    /// Number of measurements of the epoch that a past time divides, and what tells that none of
    /// them has gone: they were read before `change`.
    divided: Option<(usize, Stamp)>,
}

#[derive(Debug, Clone)]
struct CachedPicture {
    state: State,
    picture: Picture,
    used: u64,
}

#[derive(Debug, Default)]
struct PictureCache {
    clock: u64,
    bytes: usize,
    kept: HashMap<String, CachedPicture>,
}

/// Cache of pictures and of fused blocks.
#[derive(Debug, Default)]
pub(in crate::app) struct Pictures {
    pub(super) blocks: Blocks,
    cache: Mutex<PictureCache>,
}

impl Pictures {
    fn find(&self, key: &str, state: State) -> Option<Picture> {
        let mut held = self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        held.clock += 1;
        let now = held.clock;
        let found = held.kept.get_mut(key)?;
        found.used = now;
        (found.state == state).then(|| found.picture.clone())
    }

    fn insert(&self, key: String, state: State, picture: Picture) {
        let size = picture.bytes.len();
        if size > KEPT_BYTES_MAX / 4 {
            return;
        }
        let mut held = self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        let used = held.clock;
        let kept = CachedPicture {
            state,
            picture,
            used,
        };
        if let Some(before) = held.kept.insert(key, kept) {
            held.bytes -= before.picture.bytes.len();
        }
        held.bytes += size;
        while held.bytes > KEPT_BYTES_MAX || held.kept.len() > KEPT_MAX {
            let oldest = held.kept.iter().min_by_key(|(_, kept)| kept.used);
            let Some(oldest) = oldest.map(|(key, _)| key.clone()) else {
                break;
            };
            if let Some(gone) = held.kept.remove(&oldest) {
                held.bytes -= gone.picture.bytes.len();
            }
        }
    }
}

impl App {
    /// Returns a picture of a site's map. `format` identifies the encoding by `write`, with
    /// everything besides the map that `write` depends on.
    ///
    /// # Errors
    /// The site is not known, or the request is invalid.
    pub async fn picture(
        &self,
        site: &SiteId,
        request: PictureRequest,
        format: String,
        write: impl Fn(&Raster) -> Result<Vec<u8>, AppError> + Send + Sync + 'static,
    ) -> Result<Picture, AppError> {
        let reading = Reading::new(self, &request.parameters)?;
        let view = self.site_view(site).await?;
        let row = view.row.clone();
        let drawing = move |reader: &MapReader<'_>, [reading]: &[Reading; 1]| {
            let app = reader.app();
            let key = format!("{}/{format}/{request:?}", view.row.pk);
            // Read before the squares are made, so that a change meanwhile makes the picture stale.
            let state = app.state_of(&view.row, reading, &request);
            if let Some(picture) = app.pictures().find(&key, state) {
                return Ok(picture);
            }
            let mut raster = raster(reader, &view, reading, &request)?;
            let bytes: Arc<[u8]> = write(&raster)?.into();
            raster.squares = Vec::new();
            let of = Arc::new(raster);
            let picture = Picture { bytes, of };
            app.pictures().insert(key, state, picture.clone());
            Ok(picture)
        };
        self.read_map(&row, [reading], drawing).await
    }

    pub(super) fn state_of(
        &self,
        row: &SiteRow,
        reading: &Reading,
        request: &PictureRequest,
    ) -> State {
        let grid = row.site.grid;
        let bounds = request.area.and_then(|area| area.cells(&grid).ok());
        let bounds = bounds.map(|cells| Block::of(cells.min)..=Block::of(cells.max));
        self.maps().with_map(row, |map| State {
            change: match bounds {
                // The default model, the one driven most, depends on the whole map.
                Some(blocks) if reading.reference().is_some() => map.changes().newest_in(blocks),
                Some(_) | None => map.changes().newest(),
            },
            terrain_revision: row.site.terrain_revision,
            now_us: reading.now_us,
            divided: reading
                .measurements_of_epoch()
                .map(|count| (count, map.stamp())),
        })
    }
}
