//! Columns of the files, and what else a file contains.

use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::parser::parse_message_type;
use parquet::schema::types::{ColumnPath, Type};

use super::ROW_GROUP_ROWS;

/// The columns, in the order in which they are written and read: first those of filters.
const MESSAGE: &str = "message segments {
    REQUIRED INT64 id;
    REQUIRED BYTE_ARRAY site (STRING);
    REQUIRED BYTE_ARRAY robot (STRING);
    OPTIONAL BYTE_ARRAY terrain (STRING);
    OPTIONAL INT64 terrain_revision;
    REQUIRED BYTE_ARRAY boot (STRING);
    REQUIRED INT64 seq;
    REQUIRED INT64 received_at (TIMESTAMP(MICROS,true));
    REQUIRED INT64 started_at (TIMESTAMP(NANOS,true));
    REQUIRED INT64 ended_at (TIMESTAMP(NANOS,true));
    REQUIRED BYTE_ARRAY configuration (STRING);
    OPTIONAL BYTE_ARRAY mission (STRING);
    REQUIRED INT64 grid_revision;
    REQUIRED INT64 ix;
    REQUIRED INT64 iy;
    REQUIRED DOUBLE theta_information;
    REQUIRED DOUBLE theta_weighted;
    OPTIONAL DOUBLE independent_information;
    OPTIONAL DOUBLE robot_error_ratio;
    OPTIONAL DOUBLE tyre_error_ratio;
    OPTIONAL DOUBLE effective_track_ratio_information;
    OPTIONAL DOUBLE effective_track_ratio_weighted;
    OPTIONAL DOUBLE rolling_resistance_information;
    OPTIONAL DOUBLE rolling_resistance_weighted;
    OPTIONAL DOUBLE mu_peak_lower_bound;
    REQUIRED INT64 samples;
    REQUIRED DOUBLE distance_m;
    REQUIRED DOUBLE saturation_ratio;
}";

/// Indices of the columns of filters.
pub(super) const SITE: usize = 1;
pub(super) const ROBOT: usize = 2;
pub(super) const TERRAIN: usize = 3;

/// Columns that are stored without a dictionary and as differences.
const RISING: [&str; 5] = ["id", "seq", "received_at", "started_at", "ended_at"];
/// Columns of names, stored with a dictionary.
const NAMES: [&str; 6] = [
    "site",
    "robot",
    "terrain",
    "boot",
    "configuration",
    "mission",
];

/// Number of rows of a page, the part of a row group that a reader may skip.
const PAGE_ROWS: usize = 4_096;
/// Level of the compression, zstd's own default.
const ZSTD_LEVEL: i32 = 3;

/// Key of the format in the file's metadata, and its value.
pub(super) const FORMAT_KEY: &str = "tread:format";
pub(super) const FORMAT: &str = "segments 1";
/// Key of the last key of the file before.
pub(super) const FOLLOWS_KEY: &str = "tread:follows";
/// Key of the row groups: the end of each in the file, and its checksum.
pub(super) const ROW_GROUPS_KEY: &str = "tread:row_groups";
/// Key of the checksum of the footer.
pub(super) const CHECKSUM_KEY: &str = "tread:checksum";

/// Returns the columns.
pub(super) fn columns() -> Result<Type, ParquetError> {
    parse_message_type(MESSAGE)
}

/// Returns how files are written that follow a key.
pub(super) fn properties(follows: i64, checksum: String) -> Result<WriterProperties, ParquetError> {
    let metadata = vec![
        KeyValue::new(FORMAT_KEY.to_owned(), FORMAT.to_owned()),
        KeyValue::new(FOLLOWS_KEY.to_owned(), follows.to_string()),
        KeyValue::new(CHECKSUM_KEY.to_owned(), checksum),
    ];
    let mut builder = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(ZSTD_LEVEL)?))
        .set_created_by("tread".to_owned())
        .set_dictionary_enabled(false)
        .set_statistics_enabled(EnabledStatistics::Chunk)
        .set_data_page_row_count_limit(PAGE_ROWS)
        .set_write_batch_size(PAGE_ROWS)
        .set_max_row_group_row_count(Some(ROW_GROUP_ROWS))
        .set_key_value_metadata(Some(metadata));
    for name in RISING {
        let path = ColumnPath::from(name);
        builder = builder.set_column_encoding(path, Encoding::DELTA_BINARY_PACKED);
    }
    for name in NAMES {
        builder = builder.set_column_dictionary_enabled(ColumnPath::from(name), true);
    }
    Ok(builder.build())
}
