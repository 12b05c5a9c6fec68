//! The words of the commands about sites and their ground.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use jiff::Timestamp;
use tread_api::geometry::Point;
use tread_api::ids::{ConfigurationId, RobotId, SiteId, TerrainId};
use tread_api::site::GeoOrigin;
use tread_api::terrain::TerrainClass;

use super::Connection;
use super::values::{area, duration, earth, finite, moment, point, positive, terrain_class};
use crate::client::{Area, Reading};

#[derive(Debug, Args)]
pub(crate) struct SitesArguments {
    #[command(subcommand)]
    pub(crate) action: Option<SitesAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum SitesAction {
    /// Make a site
    Create {
        /// Its identifier: a-z, 0-9 and `-`
        id: SiteId,
        /// Name for people; the identifier when absent
        #[arg(long)]
        name: Option<String>,
        /// Side of the squares in which friction is kept, metres; it never changes
        #[arg(long, value_name = "M", value_parser = positive)]
        cell: Option<f64>,
        /// Where on the earth its origin lies, WGS 84 degrees north and east; it may be said later
        #[arg(long, value_name = "LAT,LON", value_parser = earth)]
        origin: Option<GeoOrigin>,
        /// Angle from east to its x axis, counter-clockwise, degrees
        #[arg(long, value_name = "DEG", value_parser = finite, allow_hyphen_values = true)]
        #[arg(default_value_t = 0.0, requires = "origin")]
        x_axis: f64,
    },
    /// Say where on the earth a site lies, so that its map can be given in WGS 84
    Tie {
        /// The site
        id: SiteId,
        /// Where its origin lies, degrees north and east
        #[arg(value_name = "LAT,LON", value_parser = earth)]
        origin: GeoOrigin,
        /// Angle from east to its x axis, counter-clockwise, degrees
        #[arg(long, value_name = "DEG", value_parser = finite, allow_hyphen_values = true)]
        #[arg(default_value_t = 0.0)]
        x_axis: f64,
    },
    /// Take back where on the earth a site lies
    Untie {
        /// The site
        id: SiteId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct TerrainsArguments {
    #[command(subcommand)]
    pub(crate) action: Option<TerrainsAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

/// What can be said of a terrain; what is absent stays as it is.
#[derive(Debug, Args)]
pub(crate) struct Drawing {
    /// Name for people
    #[arg(long)]
    pub(crate) name: Option<String>,
    /// Where terrains overlap the higher layer counts
    #[arg(long, allow_hyphen_values = true)]
    pub(crate) layer: Option<i32>,
    /// Corners of its border, metres, in order
    #[arg(value_name = "X,Y", value_parser = point)]
    pub(crate) corners: Vec<Point>,
    /// Read the corners from a file: a line `x,y` each, or a JSON list of `{"x_m": …, "y_m": …}`
    #[arg(long, value_name = "FILE", conflicts_with = "corners")]
    pub(crate) file: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TerrainsAction {
    /// Show a terrain with its corners
    Show {
        /// The terrain
        terrain: TerrainId,
    },
    /// Draw a terrain
    Create {
        /// Its identifier: a-z, 0-9 and `-`
        terrain: TerrainId,
        /// Kind of ground
        #[arg(long, value_parser = terrain_class())]
        class: TerrainClass,
        #[command(flatten)]
        drawing: Drawing,
    },
    /// Change a terrain; what is not said stays
    Change {
        /// The terrain
        terrain: TerrainId,
        /// Kind of ground
        #[arg(long, value_parser = terrain_class())]
        class: Option<TerrainClass>,
        #[command(flatten)]
        drawing: Drawing,
    },
    /// Remove a terrain; what was measured on it stays
    Delete {
        /// The terrain
        terrain: TerrainId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct FrictionArguments {
    #[command(subcommand)]
    pub(crate) action: Option<FrictionAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

/// As of when, and whose measurements.
#[derive(Debug, Args)]
pub(crate) struct ReadingArguments {
    /// As it was known then: RFC 3339, or how long ago, such as `2h`
    #[arg(long, value_name = "WHEN", value_parser = moment)]
    as_of: Option<Timestamp>,
    #[command(flatten)]
    models: ModelArguments,
}

/// Whose measurements.
#[derive(Debug, Args)]
pub(crate) struct ModelArguments {
    /// Only measurements of this robot model and tyres; `--json` shows the identifiers
    #[arg(long, value_name = "ID")]
    configuration: Option<ConfigurationId>,
    /// Join robot models by this normalisation of the server's configuration
    #[arg(long, value_name = "NAME")]
    normalisation: Option<String>,
}

impl ReadingArguments {
    pub(crate) fn reading(&self) -> Reading {
        Reading {
            as_of: self.as_of,
            ..self.models.reading()
        }
    }
}

impl ModelArguments {
    pub(crate) fn reading(&self) -> Reading {
        Reading {
            as_of: None,
            configuration: self.configuration,
            normalisation: self.normalisation.clone(),
        }
    }
}

/// A box of the map, or all of it.
#[derive(Debug, Args)]
pub(crate) struct BoxArgument {
    /// Only this box: its lowest and highest x and y, metres; the whole map when absent
    #[arg(long = "box", value_name = "X0,Y0,X1,Y1", value_parser = area)]
    pub(crate) area: Option<Area>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum FrictionAction {
    /// What is known of each terrain, or of one
    Terrains {
        /// Only this one
        terrain: Option<TerrainId>,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// A terrain as it was known at equally spaced times
    History {
        /// The terrain
        terrain: TerrainId,
        /// The oldest time: RFC 3339, or how long ago
        #[arg(long, value_name = "WHEN", default_value = "24h", value_parser = moment)]
        from: Timestamp,
        /// The newest time; now when absent
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        to: Option<Timestamp>,
        /// From one time to the next, at least a minute
        #[arg(long, value_name = "TIME", default_value = "1h", value_parser = duration)]
        step: Duration,
        #[command(flatten)]
        models: ModelArguments,
    },
    /// Cells of a box or of the whole map
    Cells {
        #[command(flatten)]
        area: BoxArgument,
        /// Put cells together to squares of this side, metres
        #[arg(long, value_name = "M", value_parser = positive)]
        resolution: Option<f64>,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// What is known at a point, of the terrain under it
    Point {
        /// The point, metres
        #[arg(value_name = "X,Y", value_parser = point)]
        point: Point,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// Along a path, with the speed that follows for a robot
    Path {
        /// Corners of the path, metres, in order
        #[arg(value_name = "X,Y", value_parser = point, required_unless_present = "file")]
        points: Vec<Point>,
        /// Read the corners from a file: a line `x,y` each, or a JSON list
        #[arg(long, value_name = "FILE", conflicts_with = "points")]
        file: Option<PathBuf>,
        /// Who is to drive it
        #[arg(long)]
        robot: RobotId,
        /// As it was known then: RFC 3339, or how long ago, such as `2h`
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        as_of: Option<Timestamp>,
        /// Join robot models by this normalisation of the server's configuration
        #[arg(long, value_name = "NAME")]
        normalisation: Option<String>,
    },
    /// Cells that were measured between two times, before and after
    Difference {
        /// The first time: RFC 3339, or how long ago
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        from: Timestamp,
        /// The second time; now when absent
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        to: Option<Timestamp>,
        #[command(flatten)]
        area: BoxArgument,
        #[command(flatten)]
        models: ModelArguments,
    },
    /// Where a visit would teach most, the best first
    Visits {
        /// The box to look in: its lowest and highest x and y, metres
        #[arg(long = "box", value_name = "X0,Y0,X1,Y1", value_parser = area)]
        area: Area,
        /// At most so many
        #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
        limit: u32,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// The map of one robot model as a picture with its legend
    Map {
        /// Write it to this file; `-` is standard output
        #[arg(long, value_name = "FILE")]
        png: PathBuf,
        #[command(flatten)]
        area: BoxArgument,
        /// Put cells together to squares of this side, metres
        #[arg(long, value_name = "M", value_parser = positive)]
        resolution: Option<f64>,
        /// Pixels of a square's side; as many as make a picture of usual size when absent
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=32))]
        scale: Option<u32>,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// What each robot has put in, and its bias as far as it shows
    Robots,
    /// What was taken off the map
    Withdrawals,
    /// Take what a robot measured in some hours off the map, for good
    Withdraw {
        /// Whose measurements
        robot: RobotId,
        /// Why, for people
        #[arg(long)]
        reason: String,
        /// A time of the first hour; from the beginning when absent
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        from: Option<Timestamp>,
        /// A time of the last hour; the present one when absent
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        to: Option<Timestamp>,
    },
}
