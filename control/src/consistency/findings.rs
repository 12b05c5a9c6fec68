//! What the monitor finds, in the words that others read.

/// What a finding is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Subject {
    /// The wheels' measured speeds.
    Wheels,
    /// The gyro.
    Gyro,
    /// The accelerometer.
    Accelerometer,
    /// Odometry: the measured speed of the body over ground.
    Odometry,
    /// The position fixes.
    Position,
    /// The left wheels stand though they are commanded to turn.
    LeftWheels,
    /// The right wheels do.
    RightWheels,
    /// Wheels and body disagree, by slip or by a sensor: nothing distinguishes them.
    WheelsAndMotion,
    /// Channels that say how the body moves disagree, and nothing tells which is right.
    Motion,
}

impl Subject {
    /// All of them.
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

    /// For people.
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

    /// Whether wheels and gyro may be right where this is wrong.
    pub(super) fn is_beside_dead_reckoning(self) -> bool {
        matches!(self, Self::Odometry | Self::Position)
    }

    /// Whether a robot with this finding may not know where it is. Where it must not move without
    /// that, no motion can show that the finding is over.
    pub(super) fn is_of_place(self) -> bool {
        matches!(self, Self::Position | Self::Motion)
    }

    /// What a robot with this finding may still do.
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

/// What a finding asks for; later ones are stricter and include the earlier.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Consequence {
    /// Nothing is learned of the ground.
    NoLearning,
    /// The robot drives slowly.
    Slow,
    /// The robot does not drive by itself.
    Hold,
}

/// How a channel is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// It repeats its word to the last bit.
    Frozen,
    /// Its sign is wrong.
    Inverted,
    /// It leapt.
    Jumped,
    /// It contradicts the others otherwise: biased, scaled, rotated.
    Inconsistent,
    /// It stands though it is commanded to turn.
    Locked,
}

/// What the figures of a finding are.
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
    /// Its symbol.
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

/// A contradiction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finding {
    /// What it is about.
    pub subject: Subject,
    /// How it is wrong.
    pub kind: Kind,
    /// What it says.
    pub observed: f64,
    /// What the others say.
    pub predicted: f64,
    /// The unit of both.
    pub unit: Unit,
}

/// What a channel says beside what the others let expect.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Comparison {
    pub(super) observed: f64,
    pub(super) predicted: f64,
}

impl Comparison {
    /// The same, with the others in doubt.
    pub(super) fn reversed(self) -> Self {
        Self {
            observed: self.predicted,
            predicted: self.observed,
        }
    }
}

/// The findings that stand, in the order of [`Subject::ALL`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Findings {
    pub(super) standing: [Option<Finding>; Subject::ALL.len()],
}

impl Findings {
    /// Each of them.
    pub fn iter(&self) -> impl Iterator<Item = &Finding> {
        self.standing.iter().flatten()
    }

    /// The one about a subject.
    pub fn about(&self, subject: Subject) -> Option<&Finding> {
        self.standing[subject as usize].as_ref()
    }

    /// The strictest consequence.
    pub fn consequence(&self) -> Option<Consequence> {
        self.iter()
            .map(|finding| finding.subject.consequence())
            .max()
    }
}
