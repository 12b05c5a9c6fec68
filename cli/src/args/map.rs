//! Arguments of the commands about sites, terrains and friction.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use jiff::Timestamp;
use tread_api::geometry::Point;
use tread_api::ids::{ConfigurationId, RobotId, SiteId, TerrainId};
use tread_api::site::GeoOrigin;
use tread_api::terrain::TerrainClass;

use super::Connection;
use super::durations::history_step;
use super::values::{
    HistoryPlace, area, earth, finite, history_place, moment, point, positive, terrain_class,
};
use crate::client::{Area, HistoryTimes, Reading};

#[derive(Debug, Args)]
pub(crate) struct SitesArguments {
    #[command(subcommand)]
    pub(crate) action: Option<SitesAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum SitesAction {
    /// Create a site
    Create {
        /// Identifier: a-z, 0-9 and `-`
        id: SiteId,
        /// Name for people; the identifier if absent
        #[arg(long)]
        name: Option<String>,
        /// Side of a cell of the friction map, metres, 1 if absent; it cannot be changed later
        #[arg(long, value_name = "M", value_parser = positive)]
        cell: Option<f64>,
        /// Position of the origin in WGS 84, degrees north and east; can be set later with
        /// `sites set-origin`
        #[arg(long, value_name = "LAT,LON", value_parser = earth)]
        origin: Option<GeoOrigin>,
        /// Angle from east to the site's x axis, counter-clockwise, degrees
        #[arg(long, value_name = "DEG", value_parser = finite, allow_hyphen_values = true)]
        #[arg(default_value_t = 0.0, requires = "origin")]
        x_axis: f64,
    },
    /// Set the position of a site in WGS 84, which exports of its map in WGS 84 need
    SetOrigin {
        /// Site identifier
        id: SiteId,
        /// Position of the origin in WGS 84, degrees north and east
        #[arg(value_name = "LAT,LON", value_parser = earth)]
        origin: GeoOrigin,
        /// Angle from east to the site's x axis, counter-clockwise, degrees
        #[arg(long, value_name = "DEG", value_parser = finite, allow_hyphen_values = true)]
        #[arg(default_value_t = 0.0)]
        x_axis: f64,
    },
    /// Remove the position of a site in WGS 84
    RemoveOrigin {
        /// Site identifier
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

/// Properties of a terrain; absent ones stay unchanged.
#[derive(Debug, Args)]
pub(crate) struct Drawing {
    /// Name for people
    #[arg(long)]
    pub(crate) name: Option<String>,
    /// Layer; where terrains overlap, the highest layer applies
    #[arg(long, allow_hyphen_values = true)]
    pub(crate) layer: Option<i32>,
    /// Corners of the border in order, metres in the site frame
    #[arg(value_name = "X,Y", value_parser = point)]
    pub(crate) corners: Vec<Point>,
    /// File with the corners: one line `x,y` each, or a JSON list of `{"x_m": …, "y_m": …}`
    #[arg(long, value_name = "FILE", conflicts_with = "corners")]
    pub(crate) file: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TerrainsAction {
    /// Show a terrain with its corners
    Show {
        /// Terrain identifier
        terrain: TerrainId,
    },
    /// Create a terrain
    Create {
        /// Identifier: a-z, 0-9 and `-`
        terrain: TerrainId,
        /// Class of the ground
        #[arg(long, value_parser = terrain_class())]
        class: TerrainClass,
        #[command(flatten)]
        drawing: Drawing,
    },
    /// Change a terrain; absent options leave it unchanged
    Change {
        /// Terrain identifier
        terrain: TerrainId,
        /// Class of the ground
        #[arg(long, value_parser = terrain_class())]
        class: Option<TerrainClass>,
        #[command(flatten)]
        drawing: Drawing,
    },
    /// Delete a terrain; its measurements stay
    Delete {
        /// Terrain identifier
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

/// Time as of which the map is read, and selection of robot models.
#[derive(Debug, Args)]
pub(crate) struct ReadingArguments {
    /// Time as of which the map is read: RFC 3339, or how long ago, such as `2h`
    #[arg(long, value_name = "WHEN", value_parser = moment)]
    as_of: Option<Timestamp>,
    #[command(flatten)]
    models: ModelArguments,
}

/// Selection of robot models.
#[derive(Debug, Args)]
pub(crate) struct ModelArguments {
    /// Include only this configuration (robot model and tyres); `--json` shows the identifiers
    #[arg(long, value_name = "ID")]
    configuration: Option<ConfigurationId>,
    /// Include other robot models too, by this normalisation of the server's configuration
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

/// Box of the map, or the whole map.
#[derive(Debug, Args)]
pub(crate) struct BoxArgument {
    /// Box: lowest and highest x and y, metres in the site frame; the whole map if absent
    #[arg(long = "box", value_name = "X0,Y0,X1,Y1", value_parser = area)]
    pub(crate) area: Option<Area>,
}

/// Place and times of a history.
#[derive(Debug, Args)]
pub(crate) struct HistoryArguments {
    /// Terrain identifier, or point in metres in the site frame
    #[arg(value_name = "TERRAIN|X,Y", value_parser = history_place)]
    pub(crate) place: HistoryPlace,
    /// First time: RFC 3339, or how long ago
    #[arg(long, value_name = "WHEN", default_value = "24h", value_parser = moment)]
    from: Timestamp,
    /// Last time: RFC 3339, or how long ago; now if absent
    #[arg(long, value_name = "WHEN", value_parser = moment)]
    to: Option<Timestamp>,
    /// Time between two rows, at least one minute
    #[arg(long, value_name = "TIME", default_value = "1h", value_parser = history_step)]
    step: Duration,
    #[command(flatten)]
    pub(crate) models: ModelArguments,
}

impl HistoryArguments {
    pub(crate) fn times(&self) -> HistoryTimes {
        HistoryTimes {
            from: self.from,
            to: self.to,
            step_s: self.step.as_secs(),
        }
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum FrictionAction {
    /// Show the friction of each terrain, or of one
    Terrains {
        /// Show only this terrain
        terrain: Option<TerrainId>,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// Show the friction of a terrain or at a point at equally spaced times
    History(HistoryArguments),
    /// Show the friction of the cells in a box or of the whole map
    Cells {
        #[command(flatten)]
        area: BoxArgument,
        /// Merge cells into squares of this side, metres
        #[arg(long, value_name = "M", value_parser = positive)]
        resolution: Option<f64>,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// Show the friction at a point, for the terrain under it
    Point {
        /// Point, metres in the site frame
        #[arg(value_name = "X,Y", value_parser = point)]
        point: Point,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// Show the friction along a path, with the speed that it permits a robot
    Path {
        /// Corners of the path in order, metres in the site frame
        #[arg(value_name = "X,Y", value_parser = point, required_unless_present = "file")]
        points: Vec<Point>,
        /// File with the corners: one line `x,y` each, or a JSON list
        #[arg(long, value_name = "FILE", conflicts_with = "points")]
        file: Option<PathBuf>,
        /// Robot that is to drive the path
        #[arg(long)]
        robot: RobotId,
        /// Time as of which the map is read: RFC 3339, or how long ago, such as `2h`
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        as_of: Option<Timestamp>,
        /// Include other robot models too, by this normalisation of the server's configuration
        #[arg(long, value_name = "NAME")]
        normalisation: Option<String>,
    },
    /// Compare the friction of cells at two times, for cells measured between them
    Difference {
        /// First time: RFC 3339, or how long ago
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        from: Timestamp,
        /// Second time: RFC 3339, or how long ago; now if absent
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        to: Option<Timestamp>,
        #[command(flatten)]
        area: BoxArgument,
        #[command(flatten)]
        models: ModelArguments,
    },
    /// List the cells whose measurement would reduce the uncertainty of the map most, the best
    /// first
    Visits {
        /// Box to search: lowest and highest x and y, metres in the site frame
        #[arg(long = "box", value_name = "X0,Y0,X1,Y1", value_parser = area)]
        area: Area,
        /// Maximum number of cells
        #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
        limit: u32,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// Draw the map of one robot model as a PNG picture with its legend
    Map {
        /// File to write; `-` is standard output
        #[arg(long, value_name = "FILE")]
        png: PathBuf,
        #[command(flatten)]
        area: BoxArgument,
        /// Merge cells into squares of this side, metres
        #[arg(long, value_name = "M", value_parser = positive)]
        resolution: Option<f64>,
        /// Side of a square, pixels; chosen for a picture of about 768 pixels if absent
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=32))]
        scale: Option<u32>,
        #[command(flatten)]
        reading: ReadingArguments,
    },
    /// List each robot's contribution to the map, with its estimated bias
    Robots,
    /// List the measurements that were withdrawn from the map
    Withdrawals,
    /// Withdraw a robot's measurements of some hours from the map; this cannot be undone
    Withdraw {
        /// Robot whose measurements are withdrawn
        robot: RobotId,
        /// Reason, for people
        #[arg(long)]
        reason: String,
        /// Time within the first hour; from the first measurement if absent
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        from: Option<Timestamp>,
        /// Time within the last hour; the present hour if absent
        #[arg(long, value_name = "WHEN", value_parser = moment)]
        to: Option<Timestamp>,
    },
}
