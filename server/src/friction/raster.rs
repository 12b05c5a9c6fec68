//! Raster of the map for one robot model, from which images, tiles and speed masks are encoded.

use tread_api::friction::NORMAL_90;
use tread_api::geometry::Point;
use tread_api::ids::ConfigurationId;
use tread_api::site::{Cell, Site};

use super::index::{CellSummary, KnownCell};
use super::traction_limit::{TractionEstimate, traction_limit_mu};

/// Raster of the map in squares of one or more cells.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    /// Site of the map.
    pub site: Site,
    /// Configuration for which θ is stated; `None` without any measurement.
    pub configuration: Option<ConfigurationId>,
    /// Name of the robot model.
    pub model: String,
    /// Name of the normalisation that includes measurements of other models, if any.
    pub normalisation: Option<String>,
    /// Time to which ages refer, microseconds since 1970.
    pub as_of_us: i64,
    /// Index of the lowest column and row, in squares from the origin.
    pub first: Cell,
    /// Number of columns.
    pub columns: usize,
    /// Number of rows.
    pub rows: usize,
    /// Side of a square, in metres.
    pub size_m: f64,
    /// Squares row by row from the lowest y, each row from the lowest x.
    pub squares: Vec<CellSummary>,
}

impl Raster {
    /// Returns an iterator of the rows, from the lowest y up.
    pub fn rows(&self) -> impl DoubleEndedIterator<Item = &[CellSummary]> {
        self.squares.chunks_exact(self.columns.max(1))
    }

    /// Returns the corner with the lowest x and y, in the site frame.
    pub fn corner(&self) -> Point {
        Point {
            x_m: f64::from(self.first.ix) * self.size_m,
            y_m: f64::from(self.first.iy) * self.size_m,
        }
    }

    /// Removes outer rows and columns without any estimate.
    #[must_use]
    pub fn trimmed(mut self) -> Self {
        let is_known = |square: &CellSummary| square.known().is_some();
        let (mut low, mut high) = ((usize::MAX, usize::MAX), (0, 0));
        for (row, squares) in self.rows().enumerate() {
            let Some(first) = squares.iter().position(is_known) else {
                continue;
            };
            let last = squares.iter().rposition(is_known).unwrap_or(first);
            low = (low.0.min(first), low.1.min(row));
            high = (high.0.max(last), row);
        }
        if low.0 > high.0 || low.1 > high.1 {
            return Self {
                columns: 0,
                rows: 0,
                squares: Vec::new(),
                ..self
            };
        }
        let kept = self.rows().skip(low.1).take(high.1 - low.1 + 1);
        let squares: Vec<CellSummary> =
            kept.flat_map(|row| &row[low.0..=high.0]).copied().collect();
        let index = |place: usize| i32::try_from(place).unwrap_or(i32::MAX);
        self.first.ix = self.first.ix.saturating_add(index(low.0));
        self.first.iy = self.first.iy.saturating_add(index(low.1));
        (self.columns, self.rows) = (high.0 - low.0 + 1, high.1 - low.1 + 1);
        self.squares = squares;
        self
    }
}

impl KnownCell {
    /// Returns the friction coefficient up to which a plan may use traction; the cautious default
    /// for `None`.
    pub fn traction_limit_mu(known: Option<&Self>) -> f64 {
        traction_limit_mu(TractionEstimate {
            mu_peak: known.and_then(|known| known.mu_peak),
            theta_upper_95: known.map(|known| known.theta + NORMAL_90 * known.std_dev),
        })
    }
}
