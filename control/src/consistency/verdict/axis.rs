//! The two compared motions, turn and forward, and the tolerated differences between channels.

use super::super::history::Commanded;
use super::super::{Comparison, Finding, Kind, Subject, Unit};
use crate::geometry::Twist;

/// Minimum magnitude of both values for an inverted sign, radians per second or metres per second.
const SIGN_MIN: f64 = 0.12;
/// Tolerated difference from the commands up to which body or wheels follow them.
const FOLLOWS_COMMAND: Tolerance = Tolerance {
    own_rad_s: 0.15,
    own_m_s: 0.08,
    share_turn: 0.2,
    forward_share: 0.2,
};
/// Difference from the commands above which wheels do not follow them, if the body does.
const DEVIATES_FROM_COMMAND: Tolerance = Tolerance {
    own_rad_s: 0.08,
    own_m_s: 0.05,
    share_turn: 0.15,
    forward_share: 0.15,
};
/// Difference above which measured wheel speeds exceed their command.
const ABOVE: Tolerance = Tolerance {
    own_rad_s: 0.1,
    own_m_s: 0.05,
    share_turn: 0.1,
    forward_share: 0.05,
};
/// Maximum excess of the body over the command, as a fraction of the wheels' excess, for a fault of
/// their sensor.
const NEARER_ABOVE: f64 = 0.4;
/// Maximum deviation of the body's forward speed from the command, as a fraction of the wheels'
/// deviation, for a fault of the wheels' sensor.
const NEARER_FORWARD: f64 = 0.9;
/// Ratio of the differences from two values below which the one with the smaller difference is
/// favoured.
pub(super) const NEARER: f64 = 0.6;

/// Tolerated difference of two motions: an absolute part plus a fraction of the larger one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tolerance {
    pub(super) own_rad_s: f64,
    pub(super) own_m_s: f64,
    pub(super) share_turn: f64,
    pub(super) forward_share: f64,
}

/// Speed or turn rate by the wheels and by another channel of the body, m/s or rad/s.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rates {
    pub(super) wheels: f64,
    pub(super) body: f64,
}

/// The compared motion: turn rate, or forward speed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Axis {
    Turn,
    Forward,
}

impl Rates {
    /// Returns the magnitude of the difference.
    pub(super) fn difference(self) -> f64 {
        (self.body - self.wheels).abs()
    }

    /// Returns the comparison with the wheels as the doubtful channel.
    pub(super) fn of_wheels(self) -> Comparison {
        Comparison {
            observed: self.wheels,
            predicted: self.body,
        }
    }

    /// Returns the comparison with the other channel as the doubtful one.
    pub(super) fn of_body(self) -> Comparison {
        self.of_wheels().reversed()
    }
}

impl Axis {
    /// Returns the twist's component on this axis, m/s or rad/s.
    pub(super) fn of(self, twist: Twist) -> f64 {
        match self {
            Self::Turn => twist.angular_rad_s,
            Self::Forward => twist.linear_m_s,
        }
    }

    fn unit(self) -> Unit {
        match self {
            Self::Turn => Unit::RadiansPerSecond,
            Self::Forward => Unit::MetresPerSecond,
        }
    }

    /// Returns the tolerated difference of two values, m/s or rad/s: a constant plus a fraction of
    /// the larger magnitude. The order of the values does not matter.
    pub(super) fn slack(self, tolerance: Tolerance, one: f64, other: f64) -> f64 {
        let (own, share) = match self {
            Self::Turn => (tolerance.own_rad_s, tolerance.share_turn),
            Self::Forward => (tolerance.own_m_s, tolerance.forward_share),
        };
        own + share * one.abs().max(other.abs())
    }

    /// Returns the distance of a motion from the range of commands, m/s or rad/s; 0 within.
    pub(super) fn command_distance(self, motion: f64, commanded: &Commanded) -> f64 {
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        (least - motion).max(motion - most).max(0.0)
    }

    /// Returns whether a motion, m/s or rad/s, is within the tolerance of the commands.
    pub(super) fn follows_command(self, motion: f64, commanded: &Commanded) -> bool {
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        self.command_distance(motion, commanded) <= self.slack(FOLLOWS_COMMAND, least, most)
    }

    /// Returns whether wheels contradict their command and the body follows it, which no slip
    /// causes.
    pub(super) fn is_sensor_fault(self, rates: Rates, commanded: &Commanded) -> bool {
        if self.exceeds_command(rates, commanded) {
            return true;
        }
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        let off = self.command_distance(rates.wheels, commanded);
        let nearer = match self {
            Self::Turn => NEARER,
            // Forward, nothing makes the body faster than driven wheels.
            Self::Forward => NEARER_FORWARD,
        };
        off > self.slack(DEVIATES_FROM_COMMAND, least, most)
            && self.command_distance(rates.body, commanded) < nearer * off
    }

    /// Returns whether wheels measure more than commanded and the body does not follow: saturated
    /// motors and slipping wheels give less than commanded, never more.
    pub(super) fn exceeds_command(self, rates: Rates, commanded: &Commanded) -> bool {
        let Rates { wheels, body } = rates;
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        let (most, least) = if wheels < 0.0 {
            (-least, -most)
        } else {
            (most, least)
        };
        let (wheels, body) = (wheels.abs(), body * wheels.signum());
        least >= 0.0
            && wheels - most > self.slack(ABOVE, most, most)
            && body - most < NEARER_ABOVE * (wheels - most)
    }
}

/// Creates a finding about a subject from the compared rates, in the unit of the axis.
pub(super) fn finding(subject: Subject, kind: Kind, comparison: Comparison, axis: Axis) -> Finding {
    let Comparison {
        observed,
        predicted,
    } = comparison;
    Finding {
        subject,
        kind,
        observed,
        predicted,
        unit: axis.unit(),
    }
}

/// Returns the type of fault of the observed channel: frozen if `is_frozen`, inverted if the signs
/// differ and the magnitudes are similar, else inconsistent.
pub(super) fn kind_of(comparison: Comparison, is_frozen: bool) -> Kind {
    let Comparison {
        observed,
        predicted,
    } = comparison;
    let (small, large) = if observed.abs() < predicted.abs() {
        (observed.abs(), predicted.abs())
    } else {
        (predicted.abs(), observed.abs())
    };
    if is_frozen {
        Kind::Frozen
    } else if observed * predicted < 0.0 && small > SIGN_MIN && small > 0.6 * large {
        Kind::Inverted
    } else {
        Kind::Inconsistent
    }
}
