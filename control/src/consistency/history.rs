//! Recent measurements of wheels, gyro and odometry as integrals over time: the mean over a span is
//! the difference of two of them.

use std::time::Duration;

use crate::geometry::{Point, Twist};

/// Time between two edges, seconds.
pub(super) const BIN_S: f64 = 0.05;
/// Number of edges kept: 3.2 s, the longest span and the oldest fix together.
const EDGES: usize = 64;
/// Maximum age of odometry that is used, seconds.
const ODOMETRY_AGE_MAX_S: f64 = 0.25;
/// Minimum fraction of a span in which there was odometry, for a mean of odometry over it.
const ODOMETRY_SHARE_MIN: f64 = 0.8;

/// Integrals of the measurements from the last restart up to one time, the edge of a bin.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Edge {
    pub(super) at_s: f64,
    /// Heading by gyro and by wheels.
    gyro_rad: f64,
    wheels_rad: f64,
    /// Distance by wheels and by odometry.
    wheels_m: f64,
    odometry_m: f64,
    /// Time with odometry.
    odometry_s: f64,
    /// Position by dead reckoning with wheels and gyro, metres.
    pub(super) at: Point,
    /// Commanded twist at this time.
    command: Twist,
}

impl Edge {
    /// Returns the heading by gyro, radians, not wrapped.
    pub(super) fn heading_rad(&self) -> f64 {
        self.gyro_rad
    }

    /// Returns the heading by wheels minus the heading by gyro, radians.
    pub(super) fn wheels_lead_rad(&self) -> f64 {
        self.wheels_rad - self.gyro_rad
    }

    /// Returns the distance by odometry minus the distance by wheels, metres.
    pub(super) fn odometry_lead_m(&self) -> f64 {
        self.odometry_m - self.wheels_m
    }

    /// Interpolates linearly to a time between this edge and a later one.
    fn interpolated(&self, later: &Self, at_s: f64) -> Self {
        let span_s = later.at_s - self.at_s;
        let share = if span_s > 0.0 {
            ((at_s - self.at_s) / span_s).clamp(0.0, 1.0)
        } else {
            1.0
        };
        let mix = |from: f64, to: f64| from + share * (to - from);
        Self {
            at_s: mix(self.at_s, later.at_s),
            gyro_rad: mix(self.gyro_rad, later.gyro_rad),
            wheels_rad: mix(self.wheels_rad, later.wheels_rad),
            wheels_m: mix(self.wheels_m, later.wheels_m),
            odometry_m: mix(self.odometry_m, later.odometry_m),
            odometry_s: mix(self.odometry_s, later.odometry_s),
            at: Point {
                x_m: mix(self.at.x_m, later.at.x_m),
                y_m: mix(self.at.y_m, later.at.y_m),
            },
            command: later.command,
        }
    }
}

/// A span of time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Span {
    pub(super) from_s: f64,
    pub(super) to_s: f64,
}

/// Means over a span.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Means {
    pub(super) gyro_rad_s: f64,
    pub(super) wheels: Twist,
    pub(super) odometry_m_s: Option<f64>,
}

/// Minimum and maximum of the commanded twists, per component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Commanded {
    pub(super) least: Twist,
    pub(super) most: Twist,
}

/// Integrals of wheels, gyro and odometry at the edges of the last bins, in a ring buffer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct History {
    now: Edge,
    edges: [Edge; EDGES],
    /// Number of edges, and index of the newest.
    count: usize,
    newest: usize,
    /// Last odometry, metres per second, and its time, seconds.
    odometry: Option<(f64, f64)>,
}

impl Default for History {
    fn default() -> Self {
        Self {
            now: Edge::default(),
            edges: [Edge::default(); EDGES],
            count: 0,
            newest: 0,
            odometry: None,
        }
    }
}

impl History {
    /// Clears all integrals and starts at a time; keeps the command.
    pub(super) fn restart(&mut self, at: Duration) {
        let command = self.now.command;
        *self = Self::default();
        self.now.at_s = at.as_secs_f64();
        self.now.command = command;
        self.push();
    }

    /// Ends the bin: keeps the present integrals as its edge.
    fn push(&mut self) {
        self.newest = (self.newest + 1) % EDGES;
        self.edges[self.newest] = self.now;
        self.count = (self.count + 1).min(EDGES);
    }

    /// Sets the twist commanded from now on.
    pub(super) fn command(&mut self, command: Twist) {
        self.now.command = command;
    }

    /// Sets the forward speed by odometry, which applies for [`ODOMETRY_AGE_MAX_S`].
    pub(super) fn odometry(&mut self, forward_m_s: f64) {
        self.odometry = Some((forward_m_s, self.now.at_s));
    }

    /// Adds measurements of gyro and wheels at a time; returns whether a bin has ended.
    pub(super) fn add(&mut self, at: Duration, gyro_rad_s: f64, wheels: Twist) -> bool {
        let now = &mut self.now;
        let dt_s = (at.as_secs_f64() - now.at_s).max(0.0);
        let middle_rad = now.gyro_rad + 0.5 * dt_s * gyro_rad_s;
        let (sin, cos) = middle_rad.sin_cos();
        now.at.x_m += dt_s * wheels.linear_m_s * cos;
        now.at.y_m += dt_s * wheels.linear_m_s * sin;
        now.at_s += dt_s;
        now.gyro_rad += dt_s * gyro_rad_s;
        now.wheels_rad += dt_s * wheels.angular_rad_s;
        now.wheels_m += dt_s * wheels.linear_m_s;
        if let Some((forward_m_s, heard_s)) = self.odometry
            && now.at_s - heard_s <= ODOMETRY_AGE_MAX_S
        {
            now.odometry_m += dt_s * forward_m_s;
            now.odometry_s += dt_s;
        }
        let is_due = now.at_s - self.edges[self.newest].at_s >= BIN_S - 1.0e-6;
        if is_due {
            self.push();
        }
        is_due
    }

    /// Returns the integrals up to the last measurement.
    pub(super) fn now(&self) -> Edge {
        self.now
    }

    /// Returns the span of a length in seconds that ends now.
    pub(super) fn last(&self, length_s: f64) -> Span {
        let to_s = self.now.at_s;
        Span {
            from_s: to_s - length_s,
            to_s,
        }
    }

    /// Returns the edge `places` before the newest.
    fn before(&self, places: usize) -> Option<&Edge> {
        (places < self.count).then(|| &self.edges[(self.newest + EDGES - places) % EDGES])
    }

    /// Returns the integrals at a time, interpolated; None before the oldest edge.
    pub(super) fn at(&self, at_s: f64) -> Option<Edge> {
        let mut later = self.now;
        // At most the number of edges.
        for places in 0..self.count {
            let edge = self.before(places)?;
            if edge.at_s <= at_s {
                return Some(edge.interpolated(&later, at_s));
            }
            later = *edge;
        }
        None
    }

    /// Returns the means between two times; None if the history does not reach back or the span is
    /// shorter than half a bin.
    pub(super) fn means(&self, span: Span) -> Option<Means> {
        let (from, to) = (self.at(span.from_s)?, self.at(span.to_s)?);
        let span_s = to.at_s - from.at_s;
        if span_s < 0.5 * BIN_S {
            return None;
        }
        let heard_s = to.odometry_s - from.odometry_s;
        Some(Means {
            gyro_rad_s: (to.gyro_rad - from.gyro_rad) / span_s,
            wheels: Twist {
                linear_m_s: (to.wheels_m - from.wheels_m) / span_s,
                angular_rad_s: (to.wheels_rad - from.wheels_rad) / span_s,
            },
            odometry_m_s: (heard_s >= ODOMETRY_SHARE_MIN * span_s)
                .then(|| (to.odometry_m - from.odometry_m) / heard_s),
        })
    }

    /// Returns the range of commands between two times.
    pub(super) fn commanded(&self, span: Span) -> Commanded {
        let (mut least, mut most) = (self.now.command, self.now.command);
        for places in 0..self.count {
            let Some(edge) = self.before(places) else {
                break;
            };
            if edge.at_s > span.to_s + BIN_S {
                continue;
            }
            if edge.at_s < span.from_s {
                break;
            }
            let command = edge.command;
            least.linear_m_s = least.linear_m_s.min(command.linear_m_s);
            least.angular_rad_s = least.angular_rad_s.min(command.angular_rad_s);
            most.linear_m_s = most.linear_m_s.max(command.linear_m_s);
            most.angular_rad_s = most.angular_rad_s.max(command.angular_rad_s);
        }
        Commanded { least, most }
    }
}
