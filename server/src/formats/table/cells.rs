//! Table of the map's cells.

use tread_api::friction::CellFriction;

use super::{Column, Kind, Row, Value, each, some};

/// Columns of the table, in the order of [`row`].
pub const COLUMNS: &[Column] = &[
    each("ix", Kind::Integer),
    each("iy", Kind::Integer),
    each("x_min_m", Kind::Number),
    each("y_min_m", Kind::Number),
    each("size_m", Kind::Number),
    some("terrain", Kind::Text),
    some("terrain_revision", Kind::Integer),
    each("configuration", Kind::Text),
    some("normalisation", Kind::Text),
    each("theta", Kind::Number),
    each("std_dev", Kind::Number),
    each("theta_low_95", Kind::Number),
    each("theta_high_95", Kind::Number),
    each("theta_lower_5", Kind::Number),
    each("theta_upper_95", Kind::Number),
    each("stiffness", Kind::Number),
    some("mu_peak_lower_bound", Kind::Number),
    some("effective_track_ratio", Kind::Number),
    some("effective_track_ratio_std_dev", Kind::Number),
    some("rolling_resistance", Kind::Number),
    some("rolling_resistance_std_dev", Kind::Number),
    each("segments", Kind::Integer),
    each("robots", Kind::Integer),
    each("newest_at", Kind::Time),
    each("age_s", Kind::Number),
    each("disputed", Kind::Flag),
    some("changed_at", Kind::Time),
];

/// Returns the row of one entry: the friction of a cell on one ground for one robot model.
pub fn row(entry: &CellFriction) -> Row {
    let CellFriction {
        cell,
        size_m,
        terrain,
        configuration,
        friction,
        normalisation,
    } = entry;
    let terrain = terrain.as_ref();
    let layer = |layer: Option<tread_api::friction::ValueEstimate>| {
        [
            Value::optional(layer, |layer| Value::Number(layer.value)),
            Value::optional(layer, |layer| Value::Number(layer.std_dev)),
        ]
    };
    let mut row = vec![
        Value::Integer(cell.ix.into()),
        Value::Integer(cell.iy.into()),
        Value::Number(f64::from(cell.ix) * size_m),
        Value::Number(f64::from(cell.iy) * size_m),
        Value::Number(*size_m),
        Value::optional(terrain, |terrain| Value::Text(terrain.id.to_string())),
        Value::optional(terrain, |terrain| Value::Integer(terrain.revision.into())),
        Value::Text(configuration.to_string()),
        Value::optional(normalisation.clone(), Value::Text),
        Value::Number(friction.theta),
        Value::Number(friction.std_dev),
        Value::Number(friction.theta_low_95),
        Value::Number(friction.theta_high_95),
        Value::Number(friction.bounds.theta_lower_5),
        Value::Number(friction.bounds.theta_upper_95),
        Value::Number(friction.stiffness),
        Value::optional(friction.mu_peak_lower_bound, Value::Number),
    ];
    row.extend(layer(friction.effective_track_ratio));
    row.extend(layer(friction.rolling_resistance));
    row.extend([
        Value::count(friction.segments),
        Value::Integer(friction.robots.into()),
        Value::Time(friction.newest_at.as_microsecond()),
        Value::Number(friction.age_s),
        Value::Flag(friction.disputed),
        Value::optional(friction.changed_at, |at| Value::Time(at.as_microsecond())),
    ]);
    row
}
