//! Encoders of the friction map: JSON, GeoJSON, CSV, Parquet, PNG, Nav2 speed mask, binary tile.
//! Pure.

pub mod geodesy;
pub mod json;
pub mod nav2;
pub mod palette;
pub mod png;
pub mod table;
pub mod tile;
