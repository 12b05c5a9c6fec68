//! Decodes the rows of a row group, column by column.

use std::collections::HashSet;
use std::ops::Range;
use std::str::FromStr;

use jiff::Timestamp;
use parquet::data_type::{ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::file::reader::RowGroupReader;
use tread_api::friction::{Information, Segment, StoredSegment, ThetaErrors};
use tread_api::ids::{RobotId, SiteId, TerrainId};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use super::fault::{Fault, fault};
use super::{ArchivedSegment, Selection};

/// The columns of filters of some rows.
pub(super) struct Names {
    sites: Vec<ByteArray>,
    robots: Vec<ByteArray>,
    terrains: Vec<Option<ByteArray>>,
}

impl Names {
    /// Reads the columns after that of the keys.
    pub(super) fn read(columns: &mut Columns<'_>) -> Result<Self, Fault> {
        Ok(Self {
            sites: columns.each::<ByteArrayType>()?,
            robots: columns.each::<ByteArrayType>()?,
            terrains: columns.some::<ByteArrayType>()?,
        })
    }

    /// Returns the selected rows.
    pub(super) fn chosen(&self, selection: &Selection) -> Vec<usize> {
        let is = |name: Option<&str>, found: Option<&ByteArray>| {
            name.is_none_or(|name| found.is_some_and(|found| found.data() == name.as_bytes()))
        };
        let site = selection.site.as_ref().map(SiteId::as_str);
        let robot = selection.robot.as_ref().map(RobotId::as_str);
        let terrain = selection.terrain.as_ref().map(TerrainId::as_str);
        let robots = selection.robots.as_ref();
        let robots: Option<HashSet<&[u8]>> = robots.map(|robots| {
            robots
                .iter()
                .map(|robot| robot.as_str().as_bytes())
                .collect()
        });
        let is_chosen = |row: &usize| {
            let found = self.robots.get(*row);
            is(site, self.sites.get(*row))
                && is(robot, found)
                && is(terrain, self.terrains.get(*row).and_then(Option::as_ref))
                && robots
                    .as_ref()
                    .is_none_or(|robots| found.is_some_and(|found| robots.contains(found.data())))
        };
        (0..self.sites.len()).filter(is_chosen).collect()
    }

    /// Returns the measurement of a row.
    pub(super) fn segment(
        &self,
        row: usize,
        id: i64,
        values: &Values,
    ) -> Result<ArchivedSegment, Fault> {
        let of = row - values.first_row;
        let terrain = self.terrains[row]
            .as_ref()
            .zip(values.terrain_revisions[of]);
        let terrain = terrain.map(|(terrain, revision)| {
            Ok::<_, Fault>(TerrainRef {
                id: parse(terrain)?,
                revision: number(revision)?,
            })
        });
        Ok(ArchivedSegment {
            site: parse(&self.sites[row])?,
            stored: StoredSegment {
                id,
                robot: parse(&self.robots[row])?,
                boot: parse(&values.boots[of])?,
                seq: number(values.seqs[of])?,
                received_at: Timestamp::from_microsecond(values.received_at_us[of])
                    .map_err(|_range| fault("a time is impossible"))?,
                segment: values.segment(of, terrain.transpose()?)?,
            },
        })
    }
}

/// The other columns of some rows, in the order of the schema.
pub(super) struct Values {
    /// Index of their first row among those of [`Names`].
    first_row: usize,
    terrain_revisions: Vec<Option<i64>>,
    boots: Vec<ByteArray>,
    seqs: Vec<i64>,
    received_at_us: Vec<i64>,
    started_at_ns: Vec<i64>,
    ended_at_ns: Vec<i64>,
    configurations: Vec<ByteArray>,
    missions: Vec<Option<ByteArray>>,
    grid_revisions: Vec<i64>,
    ix: Vec<i64>,
    iy: Vec<i64>,
    theta: (Vec<f64>, Vec<f64>),
    independent: Vec<Option<f64>>,
    robot_errors: Vec<Option<f64>>,
    tyre_errors: Vec<Option<f64>>,
    track: Pairs,
    rolling: Pairs,
    mu_peak_lower_bounds: Vec<Option<f64>>,
    samples: Vec<i64>,
    distances_m: Vec<f64>,
    saturation_ratios: Vec<f64>,
}

/// Information and weighted value of optional statistics.
type Pairs = (Vec<Option<f64>>, Vec<Option<f64>>);

impl Values {
    /// Reads the columns after those of [`Names`], of some of their rows.
    pub(super) fn read(columns: &mut Columns<'_>, rows: Range<usize>) -> Result<Self, Fault> {
        let first_row = rows.start;
        columns.narrow(rows);
        Ok(Self {
            first_row,
            terrain_revisions: columns.some::<Int64Type>()?,
            boots: columns.each::<ByteArrayType>()?,
            seqs: columns.each::<Int64Type>()?,
            received_at_us: columns.each::<Int64Type>()?,
            started_at_ns: columns.each::<Int64Type>()?,
            ended_at_ns: columns.each::<Int64Type>()?,
            configurations: columns.each::<ByteArrayType>()?,
            missions: columns.some::<ByteArrayType>()?,
            grid_revisions: columns.each::<Int64Type>()?,
            ix: columns.each::<Int64Type>()?,
            iy: columns.each::<Int64Type>()?,
            theta: (columns.each::<DoubleType>()?, columns.each::<DoubleType>()?),
            independent: columns.some::<DoubleType>()?,
            robot_errors: columns.some::<DoubleType>()?,
            tyre_errors: columns.some::<DoubleType>()?,
            track: columns.pairs()?,
            rolling: columns.pairs()?,
            mu_peak_lower_bounds: columns.some::<DoubleType>()?,
            samples: columns.each::<Int64Type>()?,
            distances_m: columns.each::<DoubleType>()?,
            saturation_ratios: columns.each::<DoubleType>()?,
        })
    }

    fn segment(&self, of: usize, terrain: Option<TerrainRef>) -> Result<Segment, Fault> {
        let time = |ns: i64| {
            Timestamp::from_nanosecond(ns.into()).map_err(|_range| fault("a time is impossible"))
        };
        let pair = |(information, weighted): &Pairs| {
            let (information, weighted) = information[of].zip(weighted[of])?;
            Some(Information {
                information,
                weighted,
            })
        };
        let errors = self.independent[of].zip(self.robot_errors[of]);
        let errors = errors.zip(self.tyre_errors[of]);
        Ok(Segment {
            configuration: parse(&self.configurations[of])?,
            mission: self.missions[of].as_ref().map(parse).transpose()?,
            started_at: time(self.started_at_ns[of])?,
            ended_at: time(self.ended_at_ns[of])?,
            grid_revision: number(self.grid_revisions[of])?,
            cell: Cell {
                ix: number(self.ix[of])?,
                iy: number(self.iy[of])?,
            },
            terrain,
            theta: Information {
                information: self.theta.0[of],
                weighted: self.theta.1[of],
            },
            theta_errors: errors.map(|((independent_information, robot_ratio), tyre_ratio)| {
                ThetaErrors {
                    independent_information,
                    robot_ratio,
                    tyre_ratio,
                }
            }),
            effective_track_ratio: pair(&self.track),
            rolling_resistance: pair(&self.rolling),
            mu_peak_lower_bound: self.mu_peak_lower_bounds[of],
            samples: number(self.samples[of])?,
            distance_m: self.distances_m[of],
            saturation_ratio: self.saturation_ratios[of],
        })
    }
}

fn number<T: TryFrom<i64>>(value: i64) -> Result<T, Fault> {
    T::try_from(value).map_err(|_range| fault(format!("the number {value} is impossible")))
}

fn parse<T: FromStr>(name: &ByteArray) -> Result<T, Fault> {
    let text = std::str::from_utf8(name.data()).ok();
    let parsed = text.and_then(|text| text.parse().ok());
    parsed.ok_or_else(|| fault("a name is impossible"))
}

/// Reads the columns of a row group one after the other, each from the same rows.
pub(super) struct Columns<'group> {
    group: &'group dyn RowGroupReader,
    next: usize,
    rows: Range<usize>,
}

impl<'group> Columns<'group> {
    pub(super) fn new(group: &'group dyn RowGroupReader, rows: Range<usize>) -> Self {
        Self {
            group,
            next: 0,
            rows,
        }
    }

    /// Reads only some of the rows of the following columns.
    fn narrow(&mut self, within: Range<usize>) {
        let begin = self.rows.start;
        self.rows = begin + within.start..begin + within.end;
    }

    /// Reads the next column: its values, and whether each row has one.
    fn column<D: DataType>(&mut self) -> Result<(Vec<D::T>, Vec<i16>), Fault> {
        let column = self.group.get_column_reader(self.next)?;
        self.next += 1;
        let column = D::get_column_reader(column);
        let mut column = column.ok_or_else(|| fault("a column has another type"))?;
        let count = self.rows.len();
        let (mut values, mut levels) = (Vec::new(), Vec::new());
        let mut read = 0;
        if column.skip_records(self.rows.start)? == self.rows.start {
            while read < count {
                let left = count - read;
                let more = column.read_records(left, Some(&mut levels), None, &mut values)?;
                if more.0 == 0 {
                    break;
                }
                read += more.0;
            }
        }
        if read == count {
            Ok((values, levels))
        } else {
            Err(fault("a column has too few rows"))
        }
    }

    pub(super) fn each<D: DataType>(&mut self) -> Result<Vec<D::T>, Fault> {
        let (values, _) = self.column::<D>()?;
        if values.len() == self.rows.len() {
            Ok(values)
        } else {
            Err(fault("a column has too few values"))
        }
    }

    fn some<D: DataType>(&mut self) -> Result<Vec<Option<D::T>>, Fault> {
        let (values, levels) = self.column::<D>()?;
        let mut values = values.into_iter();
        let mut found = Vec::with_capacity(levels.len());
        for level in levels {
            let value = if level == 0 { None } else { values.next() };
            if level != 0 && value.is_none() {
                return Err(fault("a column has too few values"));
            }
            found.push(value);
        }
        if found.len() == self.rows.len() {
            Ok(found)
        } else {
            Err(fault("a column has too few rows"))
        }
    }

    fn pairs(&mut self) -> Result<Pairs, Fault> {
        Ok((self.some::<DoubleType>()?, self.some::<DoubleType>()?))
    }
}
