//! Friction: what robots measure, and what the map says.
//!
//! θ = 1/K is the slip compliance of the ground for one robot model, K its friction stiffness.
//! `mu_peak` is a lower bound of the peak friction seen. None of them stands for another.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::geometry::Point;
use crate::ids::{ConfigurationId, MissionId, RobotId, SiteId};
use crate::site::Cell;
use crate::terrain::{TerrainClass, TerrainRef};

/// An estimate as an additive pair: sums of such pairs are again estimates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Information {
    /// Information Λ = 1/σ², in the inverse square of the value's unit.
    pub information: f64,
    /// Λ times the value.
    pub weighted: f64,
}

impl Information {
    /// The value, if anything is known.
    pub fn value(&self) -> Option<f64> {
        (self.information > 0.0).then(|| self.weighted / self.information)
    }

    /// The standard deviation, if anything is known.
    pub fn std_dev(&self) -> Option<f64> {
        (self.information > 0.0).then(|| self.information.sqrt().recip())
    }
}

/// What the error of a segment's θ is made of: an independent part, which averages out over
/// segments, and common parts, which do not.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ThetaErrors {
    /// Information 1/σ² on θ of the independent part alone.
    pub independent_information: f64,
    /// Standard deviation, as a share of θ, of the error that all segments of one robot have in
    /// common: its mass, yaw inertia and torque constants.
    pub robot_ratio: f64,
    /// Standard deviation, as a share of θ, of the error that all robots on the same tyres have in
    /// common: how the tyres' force bends with slip.
    pub tyre_ratio: f64,
}

/// Largest friction coefficient that a segment may name. Rubber on dry concrete has about 1; no
/// wheel on any ground that robots drive on has more than this.
pub const MU_PEAK_MAX: f64 = 1.5;

/// What a robot learned in one cell on one pass; it does not contain any prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Segment {
    /// The robot's model and tyres.
    pub configuration: ConfigurationId,
    /// The mission during which it was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mission: Option<MissionId>,
    /// Begin of the measurement by the robot's clock.
    pub started_at: Timestamp,
    /// End of the measurement by the robot's clock.
    pub ended_at: Timestamp,
    /// Revision of the grid that gave the cell.
    pub grid_revision: u32,
    /// The cell.
    pub cell: Cell,
    /// The terrain under the robot; absent where none is drawn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub terrain: Option<TerrainRef>,
    /// θ, slip per friction coefficient. For readers that add up segments without common
    /// errors: it claims no more than the sum of a robot's segments keeps.
    pub theta: Information,
    /// What the error of θ is made of; absent from an older agent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub theta_errors: Option<ThetaErrors>,
    /// Ratio of effective to geometric track, where turning showed it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effective_track_ratio: Option<Information>,
    /// Rolling resistance coefficient, where torque showed it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rolling_resistance: Option<Information>,
    /// Largest friction coefficient that the ground has demonstrably given, a lower bound.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mu_peak_lower_bound: Option<f64>,
    /// Samples that carried information.
    pub samples: u32,
    /// Distance driven, metres.
    pub distance_m: f64,
    /// Share of the time with a wheel beyond the linear range, 0 to 1.
    pub saturation_ratio: f64,
}

/// Largest θ that is taken for a measurement; softer ground than K = 0.02 is not driven.
pub const THETA_MAX: f64 = 50.0;
/// Most information that one segment may claim, from a standard deviation of 10⁻⁵.
pub const INFORMATION_MAX: f64 = 1.0e10;
/// Largest common error that a segment may name, as a share of θ.
pub const COMMON_RATIO_MAX: f64 = 10.0;
/// How far apart the tyres' errors of two measurements on the same tyres may be, as a share of
/// either: one standard deviation. They are the same where tyres slip alike, and grow with the
/// slip.
pub const TYRE_DIFFERENCE_SHARE: f64 = 0.5;
/// Most samples that one segment may claim.
pub const SAMPLES_MAX: u32 = 10_000_000;

/// Why a segment is not a possible measurement.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InvalidSegment {
    /// A number is not finite or out of its range.
    #[error("{0} is out of range")]
    OutOfRange(&'static str),
    /// It ends before it starts.
    #[error("ended_at lies before started_at")]
    EndsBeforeStart,
}

impl Segment {
    /// Checks that this is a possible measurement.
    ///
    /// # Errors
    /// [`InvalidSegment`] names the field.
    pub fn validate(&self) -> Result<(), InvalidSegment> {
        let check = |holds: bool, field: &'static str| {
            if holds {
                Ok(())
            } else {
                Err(InvalidSegment::OutOfRange(field))
            }
        };
        let information = |pair: &Information, value_max: f64| {
            (0.0..=INFORMATION_MAX).contains(&pair.information)
                && pair.weighted.is_finite()
                && pair.weighted.abs() <= value_max * pair.information
        };
        if self.ended_at < self.started_at {
            return Err(InvalidSegment::EndsBeforeStart);
        }
        check(
            self.theta.information > 0.0
                && self.theta.weighted > 0.0
                && information(&self.theta, THETA_MAX),
            "theta",
        )?;
        let ratio = 0.0..=COMMON_RATIO_MAX;
        check(
            self.theta_errors.is_none_or(|errors| {
                errors.independent_information > 0.0
                    && errors.independent_information <= INFORMATION_MAX
                    && ratio.contains(&errors.robot_ratio)
                    && ratio.contains(&errors.tyre_ratio)
            }),
            "theta_errors",
        )?;
        let track = self.effective_track_ratio.as_ref();
        check(
            track.is_none_or(|pair| information(pair, 100.0)),
            "effective_track_ratio",
        )?;
        let rolling = self.rolling_resistance.as_ref();
        check(
            rolling.is_none_or(|pair| information(pair, 10.0)),
            "rolling_resistance",
        )?;
        let peak = self.mu_peak_lower_bound;
        check(
            peak.is_none_or(|mu| (0.0..=MU_PEAK_MAX).contains(&mu)),
            "mu_peak_lower_bound",
        )?;
        check((1..=SAMPLES_MAX).contains(&self.samples), "samples")?;
        check((0.0..=1.0e6).contains(&self.distance_m), "distance_m")?;
        check(
            (0.0..=1.0).contains(&self.saturation_ratio),
            "saturation_ratio",
        )
    }
}

/// Both estimates that a robot keeps, never mixed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LiveFriction {
    /// θ̂ of the tracking law in the loop; it tracks well and is no measurement.
    pub theta_loop: Option<f64>,
    /// θ measured in the present cell and ground; `null` without information.
    pub theta_measured: Option<ThetaEstimate>,
    /// Whether the motion of late carried information on θ.
    pub excited: bool,
    /// Longitudinal slip of the wheels; `null` while they hardly turn or change their speed, and
    /// from an older agent.
    #[serde(default)]
    pub slip: Option<SideSlip>,
}

/// Longitudinal slip of the wheels of each side, equation (3) of the paper: rim speed minus ground
/// speed, over the rim speed; −1 to 1, positive when driving.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SideSlip {
    /// Left wheels.
    pub left_ratio: f64,
    /// Right wheels.
    pub right_ratio: f64,
}

/// θ with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ThetaEstimate {
    /// θ = 1/K, slip per friction coefficient.
    pub theta: f64,
    /// Standard deviation of θ.
    pub std_dev: f64,
}

/// Standard deviation of one robot's own bias as a share of θ, where nothing else is configured.
pub const ROBOT_BIAS_RATIO: f64 = 0.08;

/// Standard deviations to either side of a 95 % interval.
pub const NORMAL_95: f64 = 1.959_963_984_540_054;

/// Standard deviations to either side of a 90 % interval, each end of which is passed by 5 %.
pub const NORMAL_90: f64 = 1.644_853_626_951_472_7;

impl ThetaEstimate {
    /// The 95 % interval, low and high; θ is never negative.
    pub fn interval_95(&self) -> (f64, f64) {
        let half = NORMAL_95 * self.std_dev;
        ((self.theta - half).max(0.0), self.theta + half)
    }
}

/// The map's estimates of one piece of ground.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FusedFriction {
    /// θ = 1/K, slip per friction coefficient.
    pub theta: f64,
    /// Standard deviation of θ, including the robots' own biases and the age of their measurements.
    pub std_dev: f64,
    /// Lower end of the 95 % interval of θ.
    pub theta_low_95: f64,
    /// Upper end of the 95 % interval of θ.
    pub theta_high_95: f64,
    /// Friction stiffness K = 1/θ.
    pub stiffness: f64,
    /// What is undercut and what is exceeded once in twenty times.
    pub bounds: FrictionBounds,
    /// Largest friction coefficient that the ground has shown of late, a lower bound of the peak;
    /// `null` when nothing was shown lately or before the ground changed.
    pub mu_peak_lower_bound: Option<f64>,
    /// Ratio of effective to geometric track; `null` where no turning showed it.
    pub effective_track_ratio: Option<ValueEstimate>,
    /// Rolling resistance coefficient; `null` where no torque showed it.
    pub rolling_resistance: Option<ValueEstimate>,
    /// Segments that were ever measured here, including those without information on θ and those
    /// from before the ground changed: how often it was visited.
    pub segments: u64,
    /// Robots behind the estimate.
    pub robots: u32,
    /// End of the newest measurement.
    pub newest_at: Timestamp,
    /// Age of the newest measurement, seconds.
    pub age_s: f64,
    /// Whether measurements differ by more than chance and the robots' own biases let them.
    pub disputed: bool,
    /// Since when the ground is as it is, if it is known to have been otherwise; what was measured
    /// before does not count.
    pub changed_at: Option<Timestamp>,
}

/// Bounds in the sense of COVESA VSS `RoadFriction`: with the most probable value between them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FrictionBounds {
    /// θ is below this with 5 %.
    pub theta_lower_5: f64,
    /// θ is above this with 5 %.
    pub theta_upper_95: f64,
    /// K is below this with 5 %: 1 / `theta_upper_95`.
    pub stiffness_lower_5: f64,
    /// K is above this with 5 %; `null` when the measurements set no such bound.
    pub stiffness_upper_95: Option<f64>,
}

/// A value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ValueEstimate {
    /// The value.
    pub value: f64,
    /// Its standard deviation.
    pub std_dev: f64,
}

/// The friction of one terrain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TerrainFriction {
    /// The terrain at its present revision.
    pub terrain: TerrainRef,
    /// Name for people.
    pub name: String,
    /// Kind of ground.
    pub class: TerrainClass,
    /// As of when: nothing that was measured later counts. The end of the last epoch before
    /// the requested time; `null` when no time was, and all that has come counts.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
    /// What is known for each robot model, kept apart.
    pub models: Vec<ModelFriction>,
}

/// Friction for one robot model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelFriction {
    /// The robot model and tyres.
    pub configuration: ConfigurationId,
    /// The model's name.
    pub model: String,
    /// What is known; `null` when nothing is.
    pub friction: Option<FusedFriction>,
    /// Friction of other terrains of this class, where this one has not been measured.
    #[serde(default)]
    pub prior: Option<ClassPrior>,
    /// The declared normalisation that brought other models' measurements to this one's θ, if any.
    #[serde(default)]
    pub normalisation: Option<String>,
}

/// An expectation from the same class of ground elsewhere. It is no measurement of this ground.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ClassPrior {
    /// The class.
    pub class: TerrainClass,
    /// θ to expect.
    pub theta: f64,
    /// Its standard deviation, including how terrains of one class differ.
    pub std_dev: f64,
    /// Terrains that it was learned from.
    pub terrains: u32,
}

/// What is known of a terrain as it was at several times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TerrainHistory {
    /// The terrain at its present revision.
    pub terrain: TerrainRef,
    /// The oldest time first.
    pub items: Vec<TerrainAt>,
}

/// What was known of a terrain at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TerrainAt {
    /// The time.
    pub at: Timestamp,
    /// As of when this is: nothing that was measured later counts. The end of the last epoch before
    /// `at`; `at` itself where that is now.
    pub as_of: Timestamp,
    /// Per robot model.
    pub models: Vec<ModelFriction>,
}

/// What is known of the ground at a point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PointFriction {
    /// As of when: nothing that was measured later counts. The end of the last epoch before
    /// the requested time; `null` when no time was, and all that has come counts.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
    /// The cell.
    pub cell: Cell,
    /// The terrain under the point; `null` where none is drawn. Only measurements on it count.
    pub terrain: Option<TerrainRef>,
    /// Per robot model.
    pub models: Vec<ModelFriction>,
}

/// The body of `POST /v1/sites/{site}/friction/path`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AskPath {
    /// Corners of the path, 2 to 10 000, at most 10 km.
    pub points: Vec<Point>,
    /// Who is to drive it; its model decides whose measurements count, its limits what speed
    /// follows.
    pub robot: RobotId,
    /// As of when; now when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub as_of: Option<Timestamp>,
    /// A declared normalisation, to count other models' measurements too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub normalisation: Option<String>,
}

/// What is known along a path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PathFriction {
    /// As of when: nothing that was measured later counts. The end of the last epoch before
    /// the requested time; `null` when no time was, and all that has come counts.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
    /// Length, metres.
    pub length_m: f64,
    /// The robot model whose θ this is.
    pub configuration: ConfigurationId,
    /// The normalisation that was used, if any.
    pub normalisation: Option<String>,
    /// Share of the length on which friction was measured, 0 to 1.
    pub known_ratio: f64,
    /// Pieces of the path, each in one cell, in order.
    pub pieces: Vec<PathPiece>,
}

/// What is known of one piece of a path.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PathPiece {
    /// Begin, metres along the path.
    pub from_m: f64,
    /// The cell.
    pub cell: Cell,
    /// θ; `null` when nothing is known.
    pub theta: Option<f64>,
    /// Its standard deviation.
    pub std_dev: Option<f64>,
    /// θ is above this with 5 %.
    pub theta_upper_95: Option<f64>,
    /// Age of the newest measurement, seconds.
    pub age_s: Option<f64>,
    /// Whether measurements contradict each other.
    pub disputed: bool,
    /// Friction coefficient to plan with: the larger of what was shown of late and a cautious
    /// value, within what keeps the wheels' slip in the linear range at `theta_upper_95`.
    pub traction_limit_mu: f64,
    /// Speed at its start, metres per second, from the curves, the traction limit and the robot's
    /// limits; the robot stands at the end of the path.
    pub speed_m_s: f64,
}

/// How a cell differs between two times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CellDifference {
    /// The cell.
    pub cell: Cell,
    /// The terrain; `null` where none was drawn.
    pub terrain: Option<TerrainRef>,
    /// The robot model and tyres.
    pub configuration: ConfigurationId,
    /// What was known at the first time.
    pub before: Option<FusedFriction>,
    /// What was known at the second time.
    pub after: Option<FusedFriction>,
    /// Difference of θ in its own standard deviations; `null` unless both are known.
    pub z_score: Option<f64>,
    /// The normalisation that was used, if any.
    #[serde(default)]
    pub normalisation: Option<String>,
}

/// Where a visit would teach most.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct VisitSuggestion {
    /// The cell.
    pub cell: Cell,
    /// Its middle.
    pub center: Point,
    /// The terrain; `null` where none is drawn.
    pub terrain: Option<TerrainRef>,
    /// Factor by which a visit would shrink the standard deviation of θ, as its natural logarithm;
    /// for unknown ground relative to the prior.
    pub gain: f64,
    /// Standard deviation of θ over θ now; `null` when nothing is known.
    pub relative_std_dev: Option<f64>,
    /// The normalisation that was used, if any.
    #[serde(default)]
    pub normalisation: Option<String>,
    /// Whether measurements contradict each other.
    pub disputed: bool,
}

/// What one robot has put into the map of a site.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotContribution {
    /// The robot.
    pub robot: RobotId,
    /// Cells that it has measured.
    pub cells: u64,
    /// Its segments.
    pub segments: u64,
    /// Begin of the hour or day of its first measurement.
    pub first_at: Timestamp,
    /// End of its newest measurement.
    pub newest_at: Timestamp,
    /// Median of its θ over the one of all robots of its models together, over the terrains that it
    /// has measured: its bias as far as it shows. `null` where it has measured alone.
    pub bias_ratio: Option<f64>,
}

/// The friction of one cell, per terrain and robot model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CellFriction {
    /// The cell.
    pub cell: Cell,
    /// Side of the cell, metres; `ix` and `iy` count squares of this size.
    pub size_m: f64,
    /// The terrain; `null` where none was drawn. A border cell is listed once per terrain.
    pub terrain: Option<TerrainRef>,
    /// The robot model and tyres.
    pub configuration: ConfigurationId,
    /// What is known.
    pub friction: FusedFriction,
    /// The declared normalisation that brought other models' measurements to this one's θ, if any.
    #[serde(default)]
    pub normalisation: Option<String>,
}

/// A segment as the server stored it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StoredSegment {
    /// Counts the site's segments in the order of their commits, with gaps.
    pub id: i64,
    /// Who measured.
    pub robot: RobotId,
    /// Which run of its agent.
    pub boot: crate::ids::BootId,
    /// Its number within that run.
    pub seq: u64,
    /// When the server took it.
    pub received_at: Timestamp,
    /// The measurement.
    pub segment: Segment,
}

/// The body of `POST /v1/sites/{site}/robots/{robot}/withdrawals`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateWithdrawal {
    /// A time of the first hour; from the beginning when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<Timestamp>,
    /// A time of the last hour; the present one when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to: Option<Timestamp>,
    /// Why, for people.
    pub reason: String,
}

/// What a robot measured in some whole hours does not count.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Withdrawal {
    /// Its number.
    pub id: i64,
    /// Whose measurements.
    pub robot: RobotId,
    /// Begin of the first hour.
    pub from: Timestamp,
    /// End of the last hour.
    pub before: Timestamp,
    /// Why.
    pub reason: String,
    /// Who said so.
    pub by: String,
    /// When.
    pub at: Timestamp,
}

/// Where the map of a site has changed: in these boxes of cells, since the event before.
///
/// Changes are sent at most once a second and merged into squares of cells, so that what is in
/// a box may be as it was. Query what you need of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MapChange {
    /// The site.
    pub site: SiteId,
    /// Time of this message.
    pub at: Timestamp,
    /// Revision of the grid that the cells are of.
    pub grid_revision: u32,
    /// Counts changes of the site's terrains; another one than before may change the answer about any cell.
    pub terrain_revision: u64,
    /// Whether anything of the map may have changed; there are no boxes then.
    pub everything: bool,
    /// Where, at most 256 boxes.
    pub boxes: Vec<CellBox>,
}

/// A box of cells, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CellBox {
    /// The cell with the lowest coordinates.
    pub min: Cell,
    /// The cell with the highest coordinates.
    pub max: Cell,
}
