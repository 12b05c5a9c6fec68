//! The two motions that are compared, and how far two words on one of them may be apart.

use super::super::history::Commanded;
use super::super::{Comparison, Finding, Kind, Subject, Unit};
use crate::geometry::Twist;

/// Slowest motions that show an inverted sign, radians and metres per second.
const SIGN_MIN: f64 = 0.12;
/// How well the body or the wheels obey a command.
const OBEYS: Tolerance = Tolerance {
    own_rad_s: 0.15,
    own_m_s: 0.08,
    share_turn: 0.2,
    forward_share: 0.2,
};
/// From where on wheels do not, if the body does.
const DISOBEYS: Tolerance = Tolerance {
    own_rad_s: 0.08,
    own_m_s: 0.05,
    share_turn: 0.15,
    forward_share: 0.15,
};
/// How much more than commanded wheels may say.
const ABOVE: Tolerance = Tolerance {
    own_rad_s: 0.1,
    own_m_s: 0.05,
    share_turn: 0.1,
    forward_share: 0.05,
};
/// How near, of what the wheels say above the command, the body is to that.
const NEARER_ABOVE: f64 = 0.4;
/// The same forward, of a body to its command than wheels are.
const NEARER_FORWARD: f64 = 0.9;
/// Nearer to one than to the other: at most this share of the distance.
pub(super) const NEARER: f64 = 0.6;

/// How far two motions may be apart: a part of its own and a share of the larger.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tolerance {
    pub(super) own_rad_s: f64,
    pub(super) own_m_s: f64,
    pub(super) share_turn: f64,
    pub(super) forward_share: f64,
}

/// What the wheels and another channel of the body say of one motion.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rates {
    pub(super) wheels: f64,
    pub(super) body: f64,
}

/// One of the two motions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Axis {
    Turn,
    Forward,
}

impl Rates {
    pub(super) fn difference(self) -> f64 {
        (self.body - self.wheels).abs()
    }

    /// The wheels are in doubt.
    pub(super) fn of_wheels(self) -> Comparison {
        Comparison {
            observed: self.wheels,
            predicted: self.body,
        }
    }

    /// The other channel is in doubt.
    pub(super) fn of_body(self) -> Comparison {
        self.of_wheels().reversed()
    }
}

impl Axis {
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

    /// How far two values of this motion may be apart, in either order.
    pub(super) fn slack(self, tolerance: Tolerance, one: f64, other: f64) -> f64 {
        let (own, share) = match self {
            Self::Turn => (tolerance.own_rad_s, tolerance.share_turn),
            Self::Forward => (tolerance.own_m_s, tolerance.forward_share),
        };
        own + share * one.abs().max(other.abs())
    }

    /// How far a motion is from all that was commanded.
    pub(super) fn off_command(self, motion: f64, commanded: &Commanded) -> f64 {
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        (least - motion).max(motion - most).max(0.0)
    }

    pub(super) fn obeys(self, motion: f64, commanded: &Commanded) -> bool {
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        self.off_command(motion, commanded) <= self.slack(OBEYS, least, most)
    }

    /// Whether wheels contradict their command and the body is on the command's side: what no slip
    /// does.
    pub(super) fn is_of_sensor(self, rates: Rates, commanded: &Commanded) -> bool {
        if self.is_above(rates, commanded) {
            return true;
        }
        let (least, most) = (self.of(commanded.least), self.of(commanded.most));
        let off = self.off_command(rates.wheels, commanded);
        let nearer = match self {
            Self::Turn => NEARER,
            // Ahead nothing makes the body faster than wheels that are driven.
            Self::Forward => NEARER_FORWARD,
        };
        off > self.slack(DISOBEYS, least, most)
            && self.off_command(rates.body, commanded) < nearer * off
    }

    /// Whether wheels say more than they are commanded and the body does not: motors reach less
    /// than is asked of them, or the wheels slip, but never more.
    pub(super) fn is_above(self, rates: Rates, commanded: &Commanded) -> bool {
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

/// How a channel is wrong.
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
