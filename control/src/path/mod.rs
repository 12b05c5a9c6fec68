//! Geometry of a path by arc length, without timing.
//!
//! A path is a sequence of pieces: arcs (exact) and polynomials. Joins are C⁴ in the parameter,
//! whose speed is never zero, so position, heading, curvature and the slope of curvature are
//! continuous along the path. (Where a waypoint's heading is given the join is C³, which suffices
//! for that.) Sampling does not allocate.

#![expect(clippy::cast_precision_loss, reason = "counts stay far below 2^52")]

mod join;
mod leg_time;
mod polynomial;
mod route;
mod spline;

use std::ops::Range;

use thiserror::Error;

use crate::geometry::{Point, Pose};

pub(crate) use join::{CircleTarget, join_circle};
pub(crate) use polynomial::Polynomial;
pub(crate) use route::{leg_and_spline, spline_from_robot};
pub(crate) use spline::Knot;

/// Minimum radius of curvature of a path, metres.
pub const RADIUS_MIN_M: f64 = 0.05;
/// Minimum number of parameter intervals per polynomial piece in the table of arc lengths.
const INTERVALS_MIN: usize = 8;
/// Maximum number of parameter intervals per polynomial piece.
const INTERVALS_MAX: usize = 256;
/// Desired parameter interval, about metres.
const INTERVAL_M: f64 = 0.1;
/// Maximum number of Newton steps from arc length to parameter.
const NEWTON_STEPS: usize = 4;
/// Minimum parameter speed of a polynomial, metres per parameter unit; below it the path has a
/// cusp.
const PARAMETER_SPEED_MIN: f64 = 1.0e-3;

/// Maximum turn of the heading over a quarter of a parameter interval, radians; more counts as a
/// cusp.
const TURN_MAX_RAD: f64 = 1.5;

/// One piece of a path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Piece {
    /// Arc of a circle.
    Arc {
        /// Centre in the site frame.
        center: Point,
        /// Radius, metres.
        radius_m: f64,
        /// Polar angle of the start seen from the centre, radians.
        start_rad: f64,
        /// +1 counter-clockwise, −1 clockwise.
        sign: f64,
        /// Arc length, metres.
        length_m: f64,
    },
    /// Polynomial curve.
    Polynomial(Polynomial),
}

/// Parameter interval in the table of arc lengths, with the arc length at its start.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    arc_m: f64,
    piece: usize,
    parameter: f64,
    parameter_end: f64,
}

/// Pose and curvature of a path at one arc length.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PathSample {
    /// Position, and heading tangential to the path, site frame.
    pub pose: Pose,
    /// Curvature, per metre, positive to the left.
    pub curvature_1_m: f64,
    /// Derivative of the curvature with respect to arc length, per metre squared.
    pub curvature_slope_1_m2: f64,
}

/// Reason why a geometry is invalid; `piece` counts from zero along the path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub(crate) enum PathError {
    /// The path turns tighter than [`RADIUS_MIN_M`], or has a cusp.
    #[error("the path turns too sharply in its piece {piece}")]
    TooTight {
        /// Index of the piece.
        piece: usize,
    },
}

/// Path parametrised by arc length.
#[derive(Debug, Clone, PartialEq)]
pub struct Path {
    pieces: Vec<Piece>,
    nodes: Vec<Node>,
    /// Arc length at the start of each piece, then the total length.
    starts_m: Vec<f64>,
}

impl Path {
    /// Joins pieces in order and computes their arc lengths.
    ///
    /// # Errors
    /// [`PathError::TooTight`] if a polynomial turns too tightly or has a cusp.
    pub(crate) fn new(pieces: Vec<Piece>) -> Result<Self, PathError> {
        let mut nodes = Vec::with_capacity(pieces.len() * INTERVALS_MIN);
        let mut starts_m = Vec::with_capacity(pieces.len() + 1);
        let mut arc_m = 0.0;
        for (piece, shape) in pieces.iter().enumerate() {
            starts_m.push(arc_m);
            match shape {
                Piece::Arc { length_m, .. } => {
                    nodes.push(Node {
                        arc_m,
                        piece,
                        parameter: 0.0,
                        parameter_end: *length_m,
                    });
                    arc_m += length_m;
                }
                Piece::Polynomial(polynomial) => {
                    let span = polynomial.span();
                    let count = interval_count(span);
                    for interval in 0..count {
                        let parameter = span * interval as f64 / count as f64;
                        let parameter_end = span * (interval + 1) as f64 / count as f64;
                        check_turn(polynomial, parameter..parameter_end, piece)?;
                        nodes.push(Node {
                            arc_m,
                            piece,
                            parameter,
                            parameter_end,
                        });
                        arc_m += polynomial.length_m(parameter..parameter_end);
                    }
                }
            }
        }
        starts_m.push(arc_m);
        Ok(Self {
            pieces,
            nodes,
            starts_m,
        })
    }

    /// Returns the total length, metres.
    pub fn length_m(&self) -> f64 {
        self.starts_m.last().copied().unwrap_or_default()
    }

    /// Returns the number of pieces.
    pub(crate) fn piece_count(&self) -> usize {
        self.pieces.len()
    }

    /// Returns the arc length at which a piece starts, metres; the total length for an index beyond
    /// the last.
    pub(crate) fn piece_start_m(&self, piece: usize) -> f64 {
        self.starts_m
            .get(piece)
            .copied()
            .unwrap_or_else(|| self.length_m())
    }

    /// Returns the path at an arc length in metres, clamped to the path's ends.
    pub fn sample(&self, arc_m: f64) -> PathSample {
        let arc_m = arc_m.clamp(0.0, self.length_m());
        let after = self.nodes.partition_point(|node| node.arc_m <= arc_m);
        let Some(node) = self.nodes.get(after.saturating_sub(1)) else {
            return PathSample::default();
        };
        let beyond_m = arc_m - node.arc_m;
        match &self.pieces[node.piece] {
            Piece::Arc {
                center,
                radius_m,
                start_rad,
                sign,
                ..
            } => {
                let angle_rad = start_rad + sign * beyond_m / radius_m;
                let (sin, cos) = angle_rad.sin_cos();
                PathSample {
                    pose: Pose {
                        x_m: center.x_m + radius_m * cos,
                        y_m: center.y_m + radius_m * sin,
                        heading_rad: crate::geometry::wrap_angle_rad(
                            angle_rad + sign * std::f64::consts::FRAC_PI_2,
                        ),
                    },
                    curvature_1_m: sign / radius_m,
                    curvature_slope_1_m2: 0.0,
                }
            }
            Piece::Polynomial(polynomial) => {
                let next_m = self
                    .nodes
                    .get(after)
                    .map_or(self.length_m(), |next| next.arc_m);
                let width = node.parameter_end - node.parameter;
                let whole_m = (next_m - node.arc_m).max(f64::MIN_POSITIVE);
                let mut parameter = node.parameter + width * (beyond_m / whole_m).min(1.0);
                for _ in 0..NEWTON_STEPS {
                    let excess_m = polynomial.length_m(node.parameter..parameter) - beyond_m;
                    parameter -= excess_m
                        / polynomial
                            .parameter_speed(parameter)
                            .max(PARAMETER_SPEED_MIN);
                    parameter = parameter.clamp(node.parameter, node.parameter_end);
                    if excess_m.abs() < 1.0e-12 {
                        break;
                    }
                }
                polynomial.sample(parameter)
            }
        }
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a ceiling of a length, clamped to a small range"
)]
fn interval_count(span: f64) -> usize {
    ((span / INTERVAL_M).ceil() as usize).clamp(INTERVALS_MIN, INTERVALS_MAX)
}

fn check_turn(
    polynomial: &Polynomial,
    parameters: Range<f64>,
    piece: usize,
) -> Result<(), PathError> {
    let Range { start, end } = parameters;
    let mut before_rad = None;
    for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let parameter = start + share * (end - start);
        let PathSample {
            pose,
            curvature_1_m,
            ..
        } = polynomial.sample(parameter);
        // Between two samples around a cusp the heading reverses, however small the curvature at
        // both.
        let turned_rad = before_rad.replace(pose.heading_rad).map_or(0.0, |before| {
            crate::geometry::wrap_angle_rad(pose.heading_rad - before)
        });
        let cusp = polynomial.parameter_speed(parameter) < PARAMETER_SPEED_MIN
            || turned_rad.abs() > TURN_MAX_RAD;
        if cusp || !curvature_1_m.is_finite() || curvature_1_m.abs() > RADIUS_MIN_M.recip() {
            return Err(PathError::TooTight { piece });
        }
    }
    Ok(())
}
