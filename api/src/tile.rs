//! Compact binary form of a section of the friction map: 4 bytes per square.
//!
//! All numbers are little-endian. The header is followed by three planes, each row by row from the
//! lowest y, each row from the lowest x:
//!
//! | offset | type | content |
//! |---|---|---|
//! | 0 | 4 bytes | `TRFM` |
//! | 4 | u16 | version, 1 |
//! | 6 | u16 | length of the header in bytes, at least 64 |
//! | 8 | u32 | number of columns |
//! | 12 | u32 | number of rows |
//! | 16 | i32 | index of the first column, in squares from the origin |
//! | 20 | i32 | index of the first row |
//! | 24 | f64 | side of a square, metres |
//! | 32 | i64 | time at which ages are counted, microseconds since 1970 |
//! | 40 | u32 | revision of the grid |
//! | 44 | u32 | 0 |
//! | 48 | 16 bytes | configuration (robot model and tyres), a UUID; zeros without any measurement |
//! | 64 | UTF-8 | name of the applied normalisation, up to the end of the header; may be empty |
//! | header | u16 × n | mean: 0 is unknown, else `θ = 10⁻⁶ · 10^(8·(code − 1)/65 534)` |
//! | + 2n | u8 × n | standard deviation: `σ = 10⁻⁵ · 10^(6·code/255)`, rounded up |
//! | + 3n | u8 × n | count: `segments = 2^(code/8)`, rounded; code 0 is one segment |
//!
//! The encoding changes a mean by at most 0.015 %, increases a standard deviation by at most 5.6 %,
//! and changes a count by at most 4.5 %. Values beyond the range of a code are encoded as its end.

use std::f64::consts::LOG10_E;

use uuid::Uuid;

use crate::ids::ConfigurationId;
use crate::site::Cell;

/// Media type of a tile.
pub const MEDIA_TYPE: &str = "application/vnd.tread.friction-tile";
/// First bytes of a tile.
const MAGIC: [u8; 4] = *b"TRFM";
/// Version of the format that this module writes and reads.
const VERSION: u16 = 1;
/// Length of the header without the name of the normalisation, bytes.
const HEADER: usize = 64;
/// Size of one square, bytes.
const SQUARE: usize = 4;
/// Maximum number of squares that are read: 4 096 by 4 096.
pub const SQUARES_MAX: usize = 1 << 24;

/// Decimal logarithm of the lowest θ that can be encoded.
const THETA_LOW_LOG: f64 = -6.0;
/// Range of θ that can be encoded, in decades.
const THETA_SPAN_LOG: f64 = 8.0;
/// Decimal logarithm of the lowest standard deviation that can be encoded.
const STD_DEV_LOW_LOG: f64 = -5.0;
/// Range of the standard deviation that can be encoded, in decades.
const STD_DEV_SPAN_LOG: f64 = 6.0;
/// Number of codes per doubling of the count.
const COUNT_STEPS: f64 = 8.0;

/// Friction of one square of a tile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileSquare {
    /// Mean of θ.
    pub theta: f64,
    /// Standard deviation of θ.
    pub std_dev: f64,
    /// Number of all segments measured here so far.
    pub segments: u32,
}

/// Section of the friction map, for one configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Tile {
    /// Number of columns.
    pub columns: u32,
    /// Number of rows.
    pub rows: u32,
    /// Indices of the first column and row, in squares from the origin.
    pub first: Cell,
    /// Side of a square, metres.
    pub size_m: f64,
    /// Time at which ages are counted, microseconds since 1970.
    pub as_of_us: i64,
    /// Revision of the grid.
    pub grid_revision: u32,
    /// Configuration for which θ holds; `None` without any measurement.
    pub configuration: Option<ConfigurationId>,
    /// Name of the applied normalisation; `None` if there was none.
    pub normalisation: Option<String>,
    /// Squares row by row from the lowest y, each row from the lowest x; `None` where θ is unknown.
    pub squares: Vec<Option<TileSquare>>,
}

/// Reason why bytes are not a tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidTile {
    /// The bytes do not begin with the magic number, end within the header, or contain an invalid
    /// name.
    #[error("this is not a friction tile")]
    NotATile,
    /// The version of the format is unknown.
    #[error("version {0} of friction tiles is not supported")]
    Version(u16),
    /// The number of bytes differs from the one that the header implies.
    #[error("a tile of this size has {expected} bytes, not {found}")]
    Length {
        /// Number of bytes by the header.
        expected: usize,
        /// Number of bytes found.
        found: usize,
    },
    /// The tile has more than [`SQUARES_MAX`] squares.
    #[error("a tile has at most {SQUARES_MAX} squares")]
    TooLarge,
}

/// Codes of a square, one of each plane.
#[derive(Clone, Copy)]
struct Codes {
    mean: u16,
    std_dev: u8,
    count: u8,
}

/// Resolution of a code before rounding, in parts of its step. Quantising first keeps rounding
/// errors of a logarithm from moving a value to the neighbouring code.
const PARTS_OF_A_STEP: f64 = 1.0e6;

/// Converts a fraction of a range of `steps` steps to parts of a step, clamped to the range. Rounds
/// by casts for speed: a picture has a million squares.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to numbers of 37 bits"
)]
fn parts(share: f64, steps: u16) -> u64 {
    let steps = f64::from(steps);
    ((share * steps).clamp(0.0, steps) * PARTS_OF_A_STEP + 0.5) as u64
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to the steps of the type"
)]
fn codes(square: &TileSquare) -> Codes {
    const STEP: u64 = PARTS_OF_A_STEP as u64;
    let share = |value: f64, low: f64, span: f64| (value.ln() * LOG10_E - low) / span;
    let theta = share(square.theta, THETA_LOW_LOG, THETA_SPAN_LOG);
    let std_dev = share(square.std_dev, STD_DEV_LOW_LOG, STD_DEV_SPAN_LOG);
    let count = f64::from(square.segments.max(1)).log2() * COUNT_STEPS;
    Codes {
        mean: ((parts(theta, 65_534) + STEP / 2) / STEP) as u16 + 1,
        std_dev: parts(std_dev, 255).div_ceil(STEP) as u8,
        count: ((parts(count / 255.0, 255) + STEP / 2) / STEP) as u8,
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "at most 2^31.9"
)]
fn square(codes: Codes) -> Option<TileSquare> {
    let power = |low: f64, span: f64, share: f64| 10_f64.powf(low + span * share);
    let share = f64::from(codes.mean.checked_sub(1)?) / 65_534.0;
    Some(TileSquare {
        theta: power(THETA_LOW_LOG, THETA_SPAN_LOG, share),
        std_dev: power(
            STD_DEV_LOW_LOG,
            STD_DEV_SPAN_LOG,
            f64::from(codes.std_dev) / 255.0,
        ),
        segments: (f64::from(codes.count) / COUNT_STEPS).exp2().round() as u32,
    })
}

impl Tile {
    /// Returns the tile in its binary form.
    pub fn encode(&self) -> Vec<u8> {
        self.encode_with(self.squares.iter().copied())
    }

    /// Returns the tile in its binary form, with `squares` in place of its own; their number must
    /// be columns × rows. For a writer that stores the squares in another form.
    pub fn encode_with(
        &self,
        squares: impl ExactSizeIterator<Item = Option<TileSquare>>,
    ) -> Vec<u8> {
        let name = self.normalisation.as_deref().unwrap_or_default().as_bytes();
        // A name is far shorter; a longer one would be cut off.
        let name = &name[..name.len().min(usize::from(u16::MAX) - HEADER)];
        let header = HEADER + name.len();
        let count = squares.len();
        let mut bytes = Vec::with_capacity(header + SQUARE * count);
        bytes.extend(MAGIC);
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(u16::try_from(header).unwrap_or(u16::MAX).to_le_bytes());
        bytes.extend(self.columns.to_le_bytes());
        bytes.extend(self.rows.to_le_bytes());
        bytes.extend(self.first.ix.to_le_bytes());
        bytes.extend(self.first.iy.to_le_bytes());
        bytes.extend(self.size_m.to_le_bytes());
        bytes.extend(self.as_of_us.to_le_bytes());
        bytes.extend(self.grid_revision.to_le_bytes());
        bytes.extend([0; 4]);
        let configuration = self.configuration.map(|found| found.as_uuid());
        bytes.extend(configuration.unwrap_or(Uuid::nil()).as_bytes());
        bytes.extend(name);
        bytes.resize(header + SQUARE * count, 0);
        let (means, rest) = bytes[header..].split_at_mut(2 * count);
        let (std_devs, counts) = rest.split_at_mut(count);
        let planes = means.chunks_exact_mut(2).zip(std_devs).zip(counts);
        for (found, ((mean, std_dev), segments)) in squares.zip(planes) {
            let Some(found) = found else { continue };
            let codes = codes(&found);
            mean.copy_from_slice(&codes.mean.to_le_bytes());
            (*std_dev, *segments) = (codes.std_dev, codes.count);
        }
        bytes
    }

    /// Parses a tile from its binary form.
    ///
    /// # Errors
    /// [`InvalidTile`] if the bytes are not a tile of this version.
    pub fn decode(bytes: &[u8]) -> Result<Self, InvalidTile> {
        let field = |at: usize| -> Result<[u8; 8], InvalidTile> {
            let found = bytes
                .get(at..at + 8)
                .and_then(|found| found.try_into().ok());
            found.ok_or(InvalidTile::NotATile)
        };
        let short = |at: usize| -> Result<[u8; 4], InvalidTile> {
            let found = bytes
                .get(at..at + 4)
                .and_then(|found| found.try_into().ok());
            found.ok_or(InvalidTile::NotATile)
        };
        if short(0)? != MAGIC {
            return Err(InvalidTile::NotATile);
        }
        let [low, high, length_low, length_high] = short(4)?;
        let version = u16::from_le_bytes([low, high]);
        if version != VERSION {
            return Err(InvalidTile::Version(version));
        }
        let header = usize::from(u16::from_le_bytes([length_low, length_high]));
        let (columns, rows) = (
            u32::from_le_bytes(short(8)?),
            u32::from_le_bytes(short(12)?),
        );
        let size = |count: u32| usize::try_from(count).unwrap_or(usize::MAX);
        let count = size(columns).saturating_mul(size(rows));
        if count > SQUARES_MAX {
            return Err(InvalidTile::TooLarge);
        }
        let expected = header + SQUARE * count;
        if header < HEADER || bytes.len() != expected {
            let found = bytes.len();
            return Err(InvalidTile::Length { expected, found });
        }
        let uuid = Uuid::from_slice(&bytes[48..HEADER]).unwrap_or(Uuid::nil());
        let name = std::str::from_utf8(&bytes[HEADER..header]);
        let name = name.map_err(|_text| InvalidTile::NotATile)?;
        let (means, rest) = bytes[header..].split_at(2 * count);
        let (std_devs, counts) = rest.split_at(count);
        let squares = means.chunks_exact(2).zip(std_devs).zip(counts);
        Ok(Self {
            columns,
            rows,
            first: Cell {
                ix: i32::from_le_bytes(short(16)?),
                iy: i32::from_le_bytes(short(20)?),
            },
            size_m: f64::from_le_bytes(field(24)?),
            as_of_us: i64::from_le_bytes(field(32)?),
            grid_revision: u32::from_le_bytes(short(40)?),
            configuration: (!uuid.is_nil()).then(|| ConfigurationId::from_uuid(uuid)),
            normalisation: (!name.is_empty()).then(|| name.to_owned()),
            squares: squares
                .map(|((mean, &std_dev), &count)| {
                    square(Codes {
                        mean: u16::from_le_bytes([mean[0], mean[1]]),
                        std_dev,
                        count,
                    })
                })
                .collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn tile(squares: Vec<Option<TileSquare>>, normalisation: Option<&str>) -> Tile {
        Tile {
            columns: u32::try_from(squares.len()).unwrap(),
            rows: 1,
            first: Cell { ix: -70, iy: 12 },
            size_m: 0.5,
            as_of_us: 1_793_000_000_000_000,
            grid_revision: 3,
            configuration: Some(ConfigurationId::from_uuid(Uuid::from_u128(5))),
            normalisation: normalisation.map(str::to_owned),
            squares,
        }
    }

    proptest! {
        #[test]
        fn a_tile_reads_back_within_what_it_promises(
            known in prop::collection::vec(
                prop::option::of((-5.9_f64..1.9, -4.9_f64..0.9, 0.0_f64..30.0)), 0..50),
        ) {
            let squares: Vec<_> = known.iter().map(|known| known.map(|(theta, std_dev, count)| {
                #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "below 2^30")]
                let segments = count.exp2() as u32;
                TileSquare { theta: 10_f64.powf(theta), std_dev: 10_f64.powf(std_dev), segments }
            })).collect();
            let tile = tile(squares, Some("to the largest"));
            let read = Tile::decode(&tile.encode()).unwrap();
            prop_assert_eq!(&Tile { squares: tile.squares.clone(), ..read.clone() }, &tile);
            for (read, was) in read.squares.iter().zip(&tile.squares) {
                let (Some(read), Some(was)) = (read, was) else {
                    prop_assert_eq!(read, was);
                    continue;
                };
                prop_assert!((read.theta / was.theta - 1.0).abs() < 1.5e-4);
                prop_assert!((1.0 - 1e-6..1.057).contains(&(read.std_dev / was.std_dev)));
                let count = f64::from(read.segments) / f64::from(was.segments);
                prop_assert!((count - 1.0).abs() < 0.045 + 0.5 / f64::from(was.segments));
            }
        }

        #[test]
        fn whatever_is_no_tile_is_refused_and_breaks_nothing(
            at in 0_usize..80, value in any::<u8>(), cut in 0_usize..90,
        ) {
            let mut bytes = tile(vec![None; 4], Some("x")).encode();
            if let Some(byte) = bytes.get_mut(at) {
                *byte = value;
            }
            bytes.truncate(cut);
            if let Ok(read) = Tile::decode(&bytes) {
                prop_assert_eq!(Tile::decode(&read.encode()), Ok(read));
            }
        }
    }

    #[test]
    fn what_lies_beyond_the_range_is_at_its_end() {
        let beyond = |theta: f64, std_dev: f64| TileSquare {
            theta,
            std_dev,
            segments: u32::MAX,
        };
        let tile = tile(
            vec![Some(beyond(1.0e-9, 1.0e-9)), Some(beyond(1.0e4, 1.0e4))],
            None,
        );
        let read = Tile::decode(&tile.encode()).unwrap();
        let close = |left: f64, right: f64| (left / right - 1.0).abs() < 1e-9;
        let [Some(low), Some(high)] = read.squares[..] else {
            panic!("both are known: {read:?}");
        };
        assert!(
            close(low.theta, 1.0e-6) && close(low.std_dev, 1.0e-5),
            "{low:?}"
        );
        assert!(
            close(high.theta, 100.0) && close(high.std_dev, 10.0),
            "{high:?}"
        );
    }

    #[test]
    fn a_length_that_is_not_the_headers_is_refused() {
        let bytes = tile(vec![None; 4], None).encode();
        assert_eq!(bytes.len(), 64 + 16);
        for wrong in [&bytes[..79], &bytes[..3], b"PNG and so on"] {
            assert!(Tile::decode(wrong).is_err());
        }
        let mut newer = bytes;
        newer[4] = 9;
        assert_eq!(Tile::decode(&newer), Err(InvalidTile::Version(9)));
    }
}
