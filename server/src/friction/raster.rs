//! The map of one robot model as squares, row by row: what pictures and tiles are made from.

use tread_api::friction::NORMAL_90;
use tread_api::geometry::Point;
use tread_api::ids::ConfigurationId;
use tread_api::site::{Cell, Site};

use super::index::{CellSummary, KnownCell};
use super::traction_limit::traction_limit_mu;

/// The map as squares.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    /// The site.
    pub site: Site,
    /// The robot model whose θ this is; `None` while nobody has measured anything.
    pub configuration: Option<ConfigurationId>,
    /// The model's name.
    pub model: String,
    /// The normalisation that joined other models' measurements, if any.
    pub normalisation: Option<String>,
    /// The time at which ages are counted, microseconds since 1970.
    pub as_of_us: i64,
    /// Number of the lowest column and row, in squares from the origin.
    pub first: Cell,
    /// How many columns.
    pub columns: usize,
    /// How many rows.
    pub rows: usize,
    /// Side of a square, metres.
    pub size_m: f64,
    /// Row by row from the lowest y, each from the lowest x.
    pub squares: Vec<CellSummary>,
}

impl Raster {
    /// What is known of each row from the lowest y up.
    pub fn rows(&self) -> impl DoubleEndedIterator<Item = &[CellSummary]> {
        self.squares.chunks_exact(self.columns.max(1))
    }

    /// Where the lower left corner lies.
    pub fn corner(&self) -> Point {
        Point {
            x_m: f64::from(self.first.ix) * self.size_m,
            y_m: f64::from(self.first.iy) * self.size_m,
        }
    }

    /// Leaves out rows and columns at the rim of which nothing is known.
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
    /// Friction coefficient to plan with; the cautious one where nothing is known.
    pub fn traction_limit_mu(known: Option<&Self>) -> f64 {
        let upper = |known: &Self| known.theta + NORMAL_90 * known.std_dev;
        traction_limit_mu(known.and_then(|known| known.mu_peak), known.map(upper))
    }
}
