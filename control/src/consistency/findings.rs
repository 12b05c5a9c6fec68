//! Findings of the consistency monitor.

/// Sensor channel, or group of channels, that a finding names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Subject {
    /// Measured wheel speeds.
    Wheels,
    /// Gyro.
    Gyro,
    /// Accelerometer.
    Accelerometer,
    /// Odometry: the measured speed of the body over ground.
    Odometry,
    /// Position fixes.
    Position,
    /// Left wheels that are commanded to turn but stand still.
    LeftWheels,
    /// Right wheels that are commanded to turn but stand still.
    RightWheels,
    /// Wheels and body disagree, by slip or by a faulty sensor; the data do not distinguish them.
    WheelsAndMotion,
    /// Channels of the body's motion (gyro, odometry, position) disagree, and the data do not show
    /// which is wrong.
    Motion,
}

impl Subject {
    /// All subjects, in the order of their discriminants.
    pub const ALL: [Self; 9] = [
        Self::Wheels,
        Self::Gyro,
        Self::Accelerometer,
        Self::Odometry,
        Self::Position,
        Self::LeftWheels,
        Self::RightWheels,
        Self::WheelsAndMotion,
        Self::Motion,
    ];

    /// Returns the name to display.
    pub fn text(self) -> &'static str {
        match self {
            Self::Wheels => "wheel speeds",
            Self::Gyro => "gyro",
            Self::Accelerometer => "accelerometer",
            Self::Odometry => "odometry speed",
            Self::Position => "position",
            Self::LeftWheels => "left wheels",
            Self::RightWheels => "right wheels",
            Self::WheelsAndMotion => "wheels and motion",
            Self::Motion => "gyro, odometry and position",
        }
    }

    /// Returns whether dead reckoning by wheels and gyro does not use this subject, so that it may
    /// be right while the subject is wrong.
    pub(super) fn is_outside_dead_reckoning(self) -> bool {
        matches!(self, Self::Odometry | Self::Position)
    }

    /// Returns whether the robot's position may be wrong under this finding. A robot that must not
    /// move without a position cannot show by motion that the finding is over.
    pub(super) fn concerns_position(self) -> bool {
        matches!(self, Self::Position | Self::Motion)
    }

    /// Returns the restriction of the robot under a finding about this subject.
    pub fn consequence(self) -> Consequence {
        match self {
            Self::Accelerometer | Self::Odometry => Consequence::NoLearning,
            Self::WheelsAndMotion => Consequence::Slow,
            Self::Wheels
            | Self::Gyro
            | Self::Position
            | Self::LeftWheels
            | Self::RightWheels
            | Self::Motion => Consequence::Hold,
        }
    }
}

/// Restriction of the robot under a finding; later ones are stricter and include the earlier.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Consequence {
    /// Friction is not estimated.
    NoLearning,
    /// The robot drives slowly, and friction is not estimated.
    Slow,
    /// The robot stops, and is only teleoperated slowly.
    Hold,
}

/// Type of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Values repeat to the last bit.
    Frozen,
    /// The sign is wrong.
    Inverted,
    /// The value jumped.
    Jumped,
    /// Other contradiction to the other channels: bias, scale, rotation.
    Inconsistent,
    /// Wheels stand still though they are commanded to turn.
    Locked,
}

/// Unit of the values of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// m
    Metres,
    /// rad
    Radians,
    /// m/s
    MetresPerSecond,
    /// rad/s
    RadiansPerSecond,
    /// m/s²
    MetresPerSecondSquared,
}

impl Unit {
    /// Returns the symbol, for instance `m/s`.
    pub fn symbol(self) -> &'static str {
        match self {
            Self::Metres => "m",
            Self::Radians => "rad",
            Self::MetresPerSecond => "m/s",
            Self::RadiansPerSecond => "rad/s",
            Self::MetresPerSecondSquared => "m/s²",
        }
    }
}

/// Contradiction between one subject and the other channels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finding {
    /// Sensor channel or group of channels that contradicts the others.
    pub subject: Subject,
    /// Type of fault.
    pub kind: Kind,
    /// Measured value, in `unit`.
    pub observed: f64,
    /// Value predicted from the other channels, in `unit`.
    pub predicted: f64,
    /// Unit of `observed` and `predicted`.
    pub unit: Unit,
}

/// Value of a channel and its prediction from the other channels, in metres, radians, or one of
/// these per second.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Comparison {
    pub(super) observed: f64,
    pub(super) predicted: f64,
}

impl Comparison {
    /// Returns the comparison from the other channel's view: observed and predicted swapped.
    pub(super) fn reversed(self) -> Self {
        Self {
            observed: self.predicted,
            predicted: self.observed,
        }
    }
}

/// Active findings of the monitor, at most one per subject.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Findings {
    pub(super) active: [Option<Finding>; Subject::ALL.len()],
}

impl Findings {
    /// Returns all active findings, in the order of [`Subject::ALL`].
    pub fn iter(&self) -> impl Iterator<Item = &Finding> {
        self.active.iter().flatten()
    }

    /// Returns the active finding about a subject, if there is one.
    pub fn about(&self, subject: Subject) -> Option<&Finding> {
        self.active[subject as usize].as_ref()
    }

    /// Returns the strictest restriction of all active findings; None without findings.
    pub fn consequence(&self) -> Option<Consequence> {
        self.iter()
            .map(|finding| finding.subject.consequence())
            .max()
    }
}
