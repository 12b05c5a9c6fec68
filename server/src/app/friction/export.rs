//! Exports of the friction map and of raw measurements, in chunks; only one chunk is in memory.

use std::hash::Hash;

use jiff::Timestamp;
use tread_api::friction::{CellBox, CellFriction, StoredSegment};
use tread_api::ids::SiteId;
use tread_api::site::{Cell, Grid, Site};

use super::area::Area;
use super::cells::{factor, of_square, squares};
use super::map_reader::smaller;
use super::raster::PictureRequest;
use super::{App, AppError, MOVED, MapReader, Reading};
use crate::app::segments::Batch;
use crate::app::site_row;
use crate::db;
use crate::db::segments::SegmentFilter;
use crate::db::sites::SiteRow;
use crate::formats::table::{TableError, Writer};
use crate::friction::index::{SiteMap, Stamp};

/// Maximum number of cells per chunk.
const CELLS_PIECE: usize = 4_096;
/// Number of measurements per chunk, which is a row group of a Parquet file.
const SEGMENTS_PIECE: u32 = 4_096;

impl From<TableError> for AppError {
    fn from(error: TableError) -> Self {
        Self::Unwritable(format!("{error}: {:?}", std::error::Error::source(&error)))
    }
}

/// Progress of an export.
enum Stage {
    Begin,
    Entries,
    End,
    Over,
}

/// Export of all cells of a box, in one table format.
pub struct CellExport {
    app: App,
    row: SiteRow,
    reading: Reading,
    factor: i32,
    bounds: CellBox,
    /// State of the map for which `reading` was made.
    stamp: Stamp,
    after: Option<Cell>,
    /// Maximum number of cells of the next chunk.
    at_once: usize,
    stage: Stage,
    state: (String, String),
    writer: Box<dyn Writer<CellFriction>>,
}

impl App {
    /// Begins an export of the measured cells of a site, row by row. Each chunk holds the values
    /// known when it is made; ages refer to the beginning of the export.
    ///
    /// # Errors
    /// The site is not known, or the request is invalid.
    pub async fn export_cells(
        &self,
        site: &SiteId,
        request: &PictureRequest,
        writer_of: impl FnOnce(
            &Site,
            Option<Timestamp>,
        ) -> Result<Box<dyn Writer<CellFriction>>, TableError>,
    ) -> Result<CellExport, AppError> {
        let mut reading = Reading::new(self, &request.parameters)?;
        let row = self.site_view(site).await?.row.clone();
        let grid = row.site.grid;
        let factor = factor(&grid, request.resolution_m)?;
        let area = request.area.unwrap_or(Area::WHOLE);
        let coarse = Grid {
            cell_m: grid.cell_m * f64::from(factor),
            ..grid
        };
        let bounds = area.cells(&coarse)?;
        let stamp = self.maps().with_map(&row, SiteMap::stamp);
        reading.of_site(self, &row).await?;
        // Read before any chunk is made, so that later changes give another state.
        let state = self.state_of(&row, &reading, request);
        let state = (
            self.run_id(),
            format!("{state:?} {:?} {request:?}", row.site),
        );
        let as_of = reading.as_of;
        Ok(CellExport {
            app: self.clone(),
            state,
            reading,
            factor,
            bounds,
            stamp,
            after: None,
            at_once: CELLS_PIECE,
            stage: Stage::Begin,
            writer: writer_of(&row.site, as_of)?,
            row,
        })
    }

    /// Begins an export of a site's raw measurements, in the order of their commits.
    ///
    /// # Errors
    /// The site is not known.
    pub async fn export_segments(
        &self,
        site: &SiteId,
        filter: SegmentFilter,
        writer: Box<dyn Writer<StoredSegment>>,
    ) -> Result<SegmentExport, AppError> {
        let mut tx = self.db().read("friction").await?;
        let row = site_row(&mut tx, site).await?;
        let extent = db::segments::extent(&mut tx, row.pk, &filter).await?;
        let ends = db::segment_ranges::ends(&mut tx).await?;
        drop(tx);
        let archived = match ends {
            Some((first, _)) if filter.after < first - 1 => self.archive_extent().await?,
            Some(_) | None => String::new(),
        };
        let state = format!("{extent:?} {archived} {filter:?} {site}");
        Ok(SegmentExport {
            app: self.clone(),
            site: site.clone(),
            state,
            filter,
            stage: Stage::Begin,
            writer,
        })
    }
}

impl CellExport {
    /// Returns a hashable state of what is exported. It differs after a change of the map, in
    /// another minute (ages are rounded to minutes) and in another run of the server.
    pub fn state(&self) -> impl Hash + use<> {
        self.state.clone()
    }

    /// Returns the time before which all exported measurements were made; `None` when the request
    /// gave no time.
    pub fn as_of(&self) -> Option<Timestamp> {
        self.reading.as_of
    }

    /// Returns the next chunk and the rest of the export; `None` at the end.
    ///
    /// # Errors
    /// A chunk cannot be encoded.
    pub async fn next(self) -> Result<Option<(Vec<u8>, Self)>, AppError> {
        let app = self.app.clone();
        app.with_map_reader(move |reader| self.step(reader)).await
    }

    fn step(mut self, reader: &MapReader<'_>) -> Result<Option<(Vec<u8>, Self)>, AppError> {
        let bytes = match self.stage {
            Stage::Begin => {
                self.stage = Stage::Entries;
                self.writer.begin()?
            }
            Stage::Entries => {
                let size_m = self.row.site.grid.cell_m * f64::from(self.factor);
                // Summed again for each chunk, so that a slow client keeps no sums in memory.
                let mut reading = self.reading.clone();
                reading.sum(reader.app());
                let mut at_once = self.at_once;
                let (entries, last) = smaller(&mut at_once, |at_once| {
                    reader.cells(&self.row, |map| {
                        let found = squares(map, self.factor, self.bounds, self.after, at_once);
                        let last = found.last().map(|(cell, _)| *cell);
                        let found = found.into_iter();
                        let entries =
                            found.flat_map(|square| of_square(map, &reading, square, size_m));
                        (entries.collect::<Vec<_>>(), last)
                    })
                })?;
                self.at_once = at_once;
                let stamp = reader.map(&self.row, SiteMap::stamp);
                if self.reading.as_of.is_some() && stamp != self.stamp {
                    return Err(AppError::Unwritable(MOVED.to_owned()));
                }
                match last {
                    Some(_) => self.after = last,
                    None => self.stage = Stage::End,
                }
                self.writer.piece(&entries)?
            }
            Stage::End => {
                self.stage = Stage::Over;
                self.writer.end()?
            }
            Stage::Over => return Ok(None),
        };
        Ok(Some((bytes, self)))
    }
}

/// Export of all raw measurements of a site, in one table format.
pub struct SegmentExport {
    app: App,
    site: SiteId,
    state: String,
    filter: SegmentFilter,
    stage: Stage,
    writer: Box<dyn Writer<StoredSegment>>,
}

impl SegmentExport {
    /// Returns what an `ETag` is made of: it differs for another site or filter, and after segments are
    /// added or removed.
    pub fn state(&self) -> impl Hash + use<> {
        self.state.clone()
    }

    /// Returns the next chunk and the rest of the export; `None` at the end.
    ///
    /// # Errors
    /// The database failed, or a chunk cannot be encoded.
    pub async fn next(self) -> Result<Option<(Vec<u8>, Self)>, AppError> {
        let found = match self.stage {
            Stage::Entries => {
                let reading = self
                    .app
                    .some_segments(&self.site, &self.filter, SEGMENTS_PIECE);
                reading.await?
            }
            Stage::Begin | Stage::End | Stage::Over => Batch::default(),
        };
        let app = self.app.clone();
        app.compute(move || self.step(&found)).await
    }

    fn step(mut self, found: &Batch) -> Result<Option<(Vec<u8>, Self)>, AppError> {
        let bytes = match self.stage {
            Stage::Begin => {
                self.stage = Stage::Entries;
                self.writer.begin()?
            }
            Stage::Entries => {
                match found.next {
                    Some(next) => self.filter.after = next,
                    None => self.stage = Stage::End,
                }
                self.writer.piece(&found.segments)?
            }
            Stage::End => {
                self.stage = Stage::Over;
                self.writer.end()?
            }
            Stage::Over => return Ok(None),
        };
        Ok(Some((bytes, self)))
    }
}
