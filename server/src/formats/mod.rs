//! The friction map in the formats of other programs. Pure: what is known goes in, bytes come out.

pub mod geodesy;
pub mod json;
pub mod nav2;
pub mod palette;
pub mod png;
pub mod table;
pub mod tile;
