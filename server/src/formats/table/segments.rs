//! Table of raw measurements, the segments.

use tread_api::friction::{Information, StoredSegment};

use super::{Column, Kind, Row, Value, each, some};

/// Columns of the table, in the order of [`row`].
pub const COLUMNS: &[Column] = &[
    each("id", Kind::Integer),
    each("robot", Kind::Text),
    each("boot", Kind::Text),
    each("seq", Kind::Integer),
    each("received_at", Kind::Time),
    each("started_at", Kind::Time),
    each("ended_at", Kind::Time),
    each("configuration", Kind::Text),
    some("mission", Kind::Text),
    each("grid_revision", Kind::Integer),
    each("ix", Kind::Integer),
    each("iy", Kind::Integer),
    some("terrain", Kind::Text),
    some("terrain_revision", Kind::Integer),
    each("theta_information", Kind::Number),
    each("theta_weighted", Kind::Number),
    some("theta_independent_information", Kind::Number),
    some("theta_robot_error_ratio", Kind::Number),
    some("theta_tyre_error_ratio", Kind::Number),
    some("effective_track_ratio_information", Kind::Number),
    some("effective_track_ratio_weighted", Kind::Number),
    some("rolling_resistance_information", Kind::Number),
    some("rolling_resistance_weighted", Kind::Number),
    some("mu_peak_lower_bound", Kind::Number),
    each("samples", Kind::Integer),
    each("distance_m", Kind::Number),
    each("saturation_ratio", Kind::Number),
];

/// Returns the row of one segment.
pub fn row(entry: &StoredSegment) -> Row {
    let segment = &entry.segment;
    let terrain = segment.terrain.as_ref();
    let pair = |pair: Option<Information>| {
        [
            Value::optional(pair, |pair| Value::Number(pair.information)),
            Value::optional(pair, |pair| Value::Number(pair.weighted)),
        ]
    };
    let mut row = vec![
        Value::Integer(entry.id),
        Value::Text(entry.robot.to_string()),
        Value::Text(entry.boot.to_string()),
        Value::count(entry.seq),
        Value::Time(entry.received_at.as_microsecond()),
        Value::Time(segment.started_at.as_microsecond()),
        Value::Time(segment.ended_at.as_microsecond()),
        Value::Text(segment.configuration.to_string()),
        Value::optional(segment.mission, |mission| Value::Text(mission.to_string())),
        Value::Integer(segment.grid_revision.into()),
        Value::Integer(segment.cell.ix.into()),
        Value::Integer(segment.cell.iy.into()),
        Value::optional(terrain, |terrain| Value::Text(terrain.id.to_string())),
        Value::optional(terrain, |terrain| Value::Integer(terrain.revision.into())),
    ];
    row.extend(pair(Some(segment.theta)));
    let errors = segment.theta_errors;
    row.extend([
        Value::optional(errors, |errors| {
            Value::Number(errors.independent_information)
        }),
        Value::optional(errors, |errors| Value::Number(errors.robot_ratio)),
        Value::optional(errors, |errors| Value::Number(errors.tyre_ratio)),
    ]);
    row.extend(pair(segment.effective_track_ratio));
    row.extend(pair(segment.rolling_resistance));
    row.extend([
        Value::optional(segment.mu_peak_lower_bound, Value::Number),
        Value::Integer(segment.samples.into()),
        Value::Number(segment.distance_m),
        Value::Number(segment.saturation_ratio),
    ]);
    row
}
