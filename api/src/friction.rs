//! Friction: what robots measure in segments, and estimates fused from them in the friction map.
//!
//! θ = 1/K is the slip compliance of the ground for one robot model and its tyres, K the friction
//! stiffness. `mu_peak_lower_bound` is a lower bound of the peak friction coefficient; it can be
//! derived neither from θ nor from K.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::geometry::Point;
use crate::ids::{ConfigurationId, MissionId, RobotId, SiteId};
use crate::site::Cell;
use crate::terrain::{TerrainClass, TerrainRef};

/// Estimate of a value in additive form: the component-wise sum of the estimates of independent
/// measurements is their optimal combination.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Information {
    /// Information Λ = 1/σ², in the inverse square of the value's unit.
    pub information: f64,
    /// Λ times the value, in the inverse of the value's unit.
    pub weighted: f64,
}

impl Information {
    /// Returns the estimated value; `None` if there is no information.
    pub fn value(&self) -> Option<f64> {
        (self.information > 0.0).then(|| self.weighted / self.information)
    }

    /// Returns the standard deviation of the value; `None` if there is no information.
    pub fn std_dev(&self) -> Option<f64> {
        (self.information > 0.0).then(|| self.information.sqrt().recip())
    }
}

/// Components of the error of a segment's θ: an independent component, which averages out over
/// segments, and common components, which do not.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ThetaErrors {
    /// Information 1/σ² on θ from the independent error alone.
    pub independent_information: f64,
    /// Standard deviation, as a ratio of θ, of the error that all segments of one robot share: from
    /// its mass, yaw inertia and torque constants.
    pub robot_ratio: f64,
    /// Standard deviation, as a ratio of θ, of the error that all robots with the same tyres share:
    /// from their friction curve, and from slip that does not follow the model.
    pub tyre_ratio: f64,
}

/// Maximum `mu_peak_lower_bound` of a segment; a segment with a larger value is refused. Rubber on
/// dry concrete reaches a friction coefficient of about 1; no wheel on drivable ground exceeds this
/// value.
pub const MU_PEAK_MAX: f64 = 1.5;

/// Measurement of one robot in one cell on one pass, as additive statistics without any prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Segment {
    /// Configuration of the robot: model and tyres.
    pub configuration: ConfigurationId,
    /// Mission during which it was measured; absent if there was none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mission: Option<MissionId>,
    /// Start of the measurement, by the robot's clock.
    pub started_at: Timestamp,
    /// End of the measurement, by the robot's clock.
    pub ended_at: Timestamp,
    /// Revision of the grid to which `cell` refers.
    pub grid_revision: u32,
    /// Cell in which it was measured.
    pub cell: Cell,
    /// Terrain under the robot; absent where no terrain is drawn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub terrain: Option<TerrainRef>,
    /// θ, slip per friction coefficient. Its information is reduced so that a reader who adds up
    /// the segments of a robot without regard to common errors does not underestimate the error of
    /// the sum.
    pub theta: Information,
    /// Components of the error of θ; absent from an older agent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub theta_errors: Option<ThetaErrors>,
    /// Ratio of effective to geometric track width; absent if the robot did not turn enough to
    /// measure it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effective_track_ratio: Option<Information>,
    /// Rolling resistance coefficient; absent if it could not be measured, for lack of wheel
    /// torque.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rolling_resistance: Option<Information>,
    /// Largest friction coefficient that this measurement demonstrated, 0 to 1.5; a lower bound of
    /// the peak.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mu_peak_lower_bound: Option<f64>,
    /// Number of samples with information, at least 1.
    pub samples: u32,
    /// Distance driven, metres.
    pub distance_m: f64,
    /// Fraction of the time in which a wheel's slip was beyond the linear range, 0 to 1.
    pub saturation_ratio: f64,
}

/// Maximum plausible θ; a segment with a larger value is refused. It corresponds to K = 0.02,
/// ground on which no robot drives.
pub const THETA_MAX: f64 = 50.0;
/// Maximum information of one segment on any value; corresponds to a standard deviation of 10⁻⁵.
pub const INFORMATION_MAX: f64 = 1.0e10;
/// Maximum standard deviation of a common error in a segment, as a ratio of θ.
pub const COMMON_RATIO_MAX: f64 = 10.0;
/// Standard deviation of the difference between the tyre errors of two measurements with the same
/// tyres, as a ratio of the larger of them. The difference vanishes at equal slip and grows with
/// the difference in slip.
pub const TYRE_DIFFERENCE_SHARE: f64 = 0.5;
/// Maximum number of samples of one segment.
pub const SAMPLES_MAX: u32 = 10_000_000;

/// Reason why a segment is not a plausible measurement.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InvalidSegment {
    /// A field is not finite or out of its range; contains the field's name.
    #[error("{0} is out of range")]
    OutOfRange(&'static str),
    /// The segment ends before it starts.
    #[error("ended_at lies before started_at")]
    EndsBeforeStart,
}

impl Segment {
    /// Checks that every field is within its plausible range.
    ///
    /// # Errors
    /// [`InvalidSegment`] names the first field that is not.
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

/// Friction estimates of a robot at one moment: that of the tracking law, and that of the
/// estimator. They are never combined.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LiveFriction {
    /// Adapted estimate θ̂ of the tracking law; suited for control, but not a measurement of θ.
    /// `null` while no law runs.
    pub theta_loop: Option<f64>,
    /// θ measured by the estimator in the present cell and terrain; `null` without information.
    pub theta_measured: Option<ThetaEstimate>,
    /// Why there is no θ, or none whose 95 % interval is narrower than ± 60 %; `null` if there is one, and
    /// from an older agent.
    #[serde(default)]
    pub no_estimate: Option<NoEstimate>,
    /// Whether the recent motion carried information on θ.
    pub excited: bool,
    /// Longitudinal slip of the wheels; `null` while the wheels hardly turn or hardly change their
    /// speed, and from an older agent.
    #[serde(default)]
    pub slip: Option<SideSlip>,
    /// Parameters of the robot, estimated together with θ; `null` for a robot whose model is configured as
    /// exact, before it has driven for some seconds, and from an older agent.
    #[serde(default)]
    pub robot_parameters: Option<RobotParameters>,
}

/// Why a robot has no estimate of θ, and which manoeuvre would help.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoEstimate {
    /// The equations of motion do not describe what the sensors measure: the ground has changed, a sensor
    /// is wrong, or the model is.
    Misfit,
    /// The gyro or the accelerometer is not of the same time as the wheel speeds: by more than can be identified, or
    /// differently than before.
    LateSensor,
    /// The robot has not driven for long enough.
    Short,
    /// The wheels slip beyond the range in which friction follows from slip nearly all the time.
    Slip,
    /// The robot drove hardly any arcs: it rolled straight on, or turned on the spot.
    NoTurns,
    /// Nearly all turns were to one side, so that different wheel radii look like slip.
    OneSided,
    /// The speed hardly changed.
    NoAcceleration,
    /// The manoeuvres so far do not suffice.
    Uncertain,
    /// A reason of a newer agent.
    #[serde(other)]
    Other,
}

impl NoEstimate {
    /// Returns the reason as a phrase.
    pub fn reason(self) -> &'static str {
        match self {
            Self::Misfit => "the equations of motion do not describe what the sensors measure",
            Self::LateSensor => "the gyro or the accelerometer is late, or its delay has changed",
            Self::Short => "the robot has driven too little on this ground",
            Self::Slip => "the wheels slip beyond the range in which friction follows from slip",
            Self::NoTurns => "the robot drove hardly any arcs",
            Self::OneSided => "nearly all turns were to one side",
            Self::NoAcceleration => "the speed hardly changed",
            Self::Uncertain => "the manoeuvres so far do not suffice",
            Self::Other => "for a reason that this program does not know",
        }
    }

    /// Returns what would help, as an imperative; `None` for an unknown reason.
    pub fn help(self) -> Option<&'static str> {
        match self {
            Self::Misfit => Some(
                "drive on for some seconds if the ground has just changed; otherwise run `tread-agent doctor`",
            ),
            Self::LateSensor => Some(
                "drive on for some seconds if the ground has just changed; otherwise check the time stamps and filters of wheel speeds and inertial unit",
            ),
            Self::Short => Some("drive for 20 s or more without a break"),
            Self::Slip => Some("turn in wider arcs, more slowly, and not on the spot"),
            Self::NoTurns => Some("drive arcs to both sides, as in a figure-8"),
            Self::OneSided => Some("turn to both sides, as in a figure-8"),
            Self::NoAcceleration => {
                Some("change the speed by half within three seconds, several times")
            }
            Self::Uncertain => Some("drive figure-8s of 2 to 4 m for a minute, at changing speed"),
            Self::Other => None,
        }
    }
}

/// Parameters of a robot, estimated together with θ while it drives.
///
/// On flat ground torques and accelerations determine only the apparent mass; the mass itself also depends on
/// the priors of torque constants and rotors. Without wheel torques no mass is observable.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotParameters {
    /// Apparent mass over the configured mass: torque scale times the sum of mass, payload and the
    /// inertia of rotors and wheels at the rim.
    pub apparent_mass_ratio: ParameterEstimate,
    /// Mass with payload, kg.
    pub mass_kg: ParameterEstimate,
    /// Yaw inertia per mass over its configured value.
    pub yaw_inertia_ratio: ParameterEstimate,
    /// Centre of mass forward of the centre of the wheels, m.
    pub center_of_mass_forward_m: ParameterEstimate,
    /// Centre of mass to the left of the centre of the wheels, m.
    pub center_of_mass_left_m: ParameterEstimate,
}

/// Estimate of one parameter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ParameterEstimate {
    /// Estimated value.
    pub value: f64,
    /// Standard deviation of the estimate.
    pub std_dev: f64,
    /// Whether the prior dominates: the variance is more than half of the prior variance, so that the
    /// drive added little.
    pub prior_dominated: bool,
}

impl ParameterEstimate {
    /// Returns the 95 % interval `(low, high)`.
    pub fn interval_95(&self) -> (f64, f64) {
        let half = NORMAL_95 * self.std_dev;
        (self.value - half, self.value + half)
    }
}

/// Mean longitudinal slip of the wheels of each side, equation (3) of the paper: (rim speed −
/// ground speed) / rim speed, −1 to 1, positive when driving.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SideSlip {
    /// Slip of the left wheels.
    pub left_ratio: f64,
    /// Slip of the right wheels.
    pub right_ratio: f64,
}

/// Estimate of θ with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ThetaEstimate {
    /// θ = 1/K, slip per friction coefficient.
    pub theta: f64,
    /// Standard deviation of θ.
    pub std_dev: f64,
}

/// Default standard deviation of one robot's bias, as a ratio of θ.
pub const ROBOT_BIAS_RATIO: f64 = 0.08;

/// Half-width of a 95 % interval of the normal distribution, in standard deviations.
pub const NORMAL_95: f64 = 1.959_963_984_540_054;

/// Half-width of a 90 % interval of the normal distribution, in standard deviations; 5 % lie beyond
/// each end.
pub const NORMAL_90: f64 = 1.644_853_626_951_472_7;

impl ThetaEstimate {
    /// Returns the 95 % interval `(low, high)`; the lower end is at least 0.
    pub fn interval_95(&self) -> (f64, f64) {
        let half = NORMAL_95 * self.std_dev;
        ((self.theta - half).max(0.0), self.theta + half)
    }
}

/// Fused friction of one area of ground, from the measurements of all robots.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FusedFriction {
    /// θ = 1/K, slip per friction coefficient.
    pub theta: f64,
    /// Standard deviation of θ, including the robots' biases and the age of their measurements.
    pub std_dev: f64,
    /// Lower end of the 95 % interval of θ.
    pub theta_low_95: f64,
    /// Upper end of the 95 % interval of θ.
    pub theta_high_95: f64,
    /// Friction stiffness K = 1/θ.
    pub stiffness: f64,
    /// Quantiles at 5 % and 95 % of θ and of K.
    pub bounds: FrictionBounds,
    /// Largest friction coefficient that robots have recently demonstrated, a lower bound of the
    /// peak; `null` if none was demonstrated recently, or none since the ground changed.
    pub mu_peak_lower_bound: Option<f64>,
    /// Ratio of effective to geometric track width; `null` where no robot turned enough to measure
    /// it.
    pub effective_track_ratio: Option<ValueEstimate>,
    /// Rolling resistance coefficient; `null` where it was not measured, for lack of wheel torque.
    pub rolling_resistance: Option<ValueEstimate>,
    /// Number of all segments measured here so far, including segments without information on θ and
    /// those from before the ground changed.
    pub segments: u64,
    /// Number of robots whose measurements contribute.
    pub robots: u32,
    /// End of the newest measurement.
    pub newest_at: Timestamp,
    /// Age of the newest measurement, seconds.
    pub age_s: f64,
    /// Whether the measurements differ by more than their noise and the robots' biases explain.
    pub disputed: bool,
    /// Time since which the ground has had its present friction; earlier measurements are ignored.
    /// `null` if no change was detected.
    pub changed_at: Option<Timestamp>,
}

/// Quantiles of θ and K at 5 % and 95 %, as in `RoadFriction` of COVESA VSS, where the most
/// probable value lies between them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FrictionBounds {
    /// 5 % quantile of θ: θ is below it with a probability of 5 %.
    pub theta_lower_5: f64,
    /// 95 % quantile of θ: θ is above it with a probability of 5 %.
    pub theta_upper_95: f64,
    /// 5 % quantile of K, 1 / `theta_upper_95`.
    pub stiffness_lower_5: f64,
    /// 95 % quantile of K: K is above it with a probability of 5 %; `null` when the measurements do
    /// not bound K from above.
    pub stiffness_upper_95: Option<f64>,
}

/// Estimate of a value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ValueEstimate {
    /// Estimated value.
    pub value: f64,
    /// Standard deviation of the estimate.
    pub std_dev: f64,
}

/// Friction of one terrain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TerrainFriction {
    /// Terrain at its present revision.
    pub terrain: TerrainRef,
    /// Name of the terrain, for people.
    pub name: String,
    /// Class of the ground.
    pub class: TerrainClass,
    /// Time up to which measurements are included: the requested time rounded down to a minute, or
    /// to the end of an epoch whose raw measurements are missing or too many. `null` if no time was
    /// requested; all measurements are included then.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
    /// Friction for each robot model.
    pub models: Vec<ModelFriction>,
}

/// Friction of an area for one robot model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelFriction {
    /// Configuration: robot model and tyres.
    pub configuration: ConfigurationId,
    /// Name of the robot model.
    pub model: String,
    /// Fused friction; `null` when there is no measurement.
    pub friction: Option<FusedFriction>,
    /// Expected friction from other terrains of the same class; present only where this terrain has
    /// not been measured.
    #[serde(default)]
    pub prior: Option<ClassPrior>,
    /// Normalisation by which measurements of other models were converted to this model's θ; `null`
    /// if none was applied.
    #[serde(default)]
    pub normalisation: Option<String>,
}

/// Friction expected from the same class of ground elsewhere on the site. It is not a measurement
/// of this ground.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ClassPrior {
    /// Class of the ground.
    pub class: TerrainClass,
    /// Expected θ.
    pub theta: f64,
    /// Standard deviation of θ, including the variation between terrains of one class.
    pub std_dev: f64,
    /// Number of terrains from which the expectation is derived.
    pub terrains: u32,
}

/// Friction of a terrain at several times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TerrainHistory {
    /// Terrain at its present revision.
    pub terrain: TerrainRef,
    /// Friction at each time, the oldest first.
    pub items: Vec<FrictionAt>,
}

/// Friction at a point at several times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PointHistory {
    /// Cell that contains the point.
    pub cell: Cell,
    /// Terrain under the point, `null` where none is drawn. Only measurements on this terrain are
    /// included.
    pub terrain: Option<TerrainRef>,
    /// Friction at each time, the oldest first.
    pub items: Vec<FrictionAt>,
}

/// Friction at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FrictionAt {
    /// Requested time.
    pub at: Timestamp,
    /// Time up to which measurements are included: `at` rounded down to a minute, or to the end of
    /// an epoch whose raw measurements are missing or too many; equal to `at` if that is the
    /// present.
    pub as_of: Timestamp,
    /// Friction for each robot model.
    pub models: Vec<ModelFriction>,
}

/// Friction of the ground at a point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PointFriction {
    /// Time up to which measurements are included: the requested time rounded down to a minute, or
    /// to the end of an epoch whose raw measurements are missing or too many. `null` if no time was
    /// requested; all measurements are included then.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
    /// Cell that contains the point.
    pub cell: Cell,
    /// Terrain under the point, `null` where none is drawn. Only measurements on this terrain are
    /// included.
    pub terrain: Option<TerrainRef>,
    /// Friction for each robot model.
    pub models: Vec<ModelFriction>,
}

/// Body of `POST /v1/sites/{site}/friction/path`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PathFrictionRequest {
    /// Corners of the path in the site frame, 2 to 10 000; at most 10 km long.
    pub points: Vec<Point>,
    /// Robot that is to drive the path. Its model selects the measurements, its limits bound the
    /// speed.
    pub robot: RobotId,
    /// Time as of which the map is read; the present when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub as_of: Option<Timestamp>,
    /// Normalisation by which measurements of other models are included; only the robot's own model
    /// when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub normalisation: Option<String>,
}

/// Friction along a path, with the speed that it permits the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PathFriction {
    /// Time up to which measurements are included: the requested time rounded down to a minute, or
    /// to the end of an epoch whose raw measurements are missing or too many. `null` if no time was
    /// requested; all measurements are included then.
    #[serde(default)]
    pub as_of: Option<Timestamp>,
    /// Length of the path, metres.
    pub length_m: f64,
    /// Configuration (robot model and tyres) for which θ holds.
    pub configuration: ConfigurationId,
    /// Normalisation that was applied; `null` if none.
    pub normalisation: Option<String>,
    /// Fraction of the length on which friction was measured, 0 to 1.
    pub known_ratio: f64,
    /// Sections of the path in driving order, each within one cell.
    pub pieces: Vec<PathPiece>,
}

/// Friction on one section of a path.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PathPiece {
    /// Start of the section, metres along the path.
    pub from_m: f64,
    /// Cell of the section.
    pub cell: Cell,
    /// θ; `null` where nothing was measured.
    pub theta: Option<f64>,
    /// Standard deviation of θ; `null` where nothing was measured.
    pub std_dev: Option<f64>,
    /// 95 % quantile of θ; `null` where nothing was measured.
    pub theta_upper_95: Option<f64>,
    /// Age of the newest measurement, seconds; `null` where nothing was measured.
    pub age_s: Option<f64>,
    /// Whether the measurements contradict each other.
    pub disputed: bool,
    /// Traction limit, a friction coefficient: the larger of the recently demonstrated one and a
    /// cautious default, but not above the one at which the wheels' slip leaves the linear range
    /// for `theta_upper_95`.
    pub traction_limit_mu: f64,
    /// Permitted speed at the start of the section, m/s, from curvature, traction limit and the
    /// robot's limits; the robot comes to rest at the end of the path.
    pub speed_m_s: f64,
}

/// Friction of a cell at two times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CellDifference {
    /// The cell.
    pub cell: Cell,
    /// Terrain; `null` where none was drawn.
    pub terrain: Option<TerrainRef>,
    /// Configuration: robot model and tyres.
    pub configuration: ConfigurationId,
    /// Friction at the first time; `null` if nothing was measured by then.
    pub before: Option<FusedFriction>,
    /// Friction at the second time; `null` if nothing was measured by then.
    pub after: Option<FusedFriction>,
    /// Difference of θ over its standard deviation; `null` unless both values are known.
    pub z_score: Option<f64>,
    /// Normalisation that was applied; `null` if none.
    #[serde(default)]
    pub normalisation: Option<String>,
}

/// Cell whose measurement would reduce the uncertainty of the map, with the expected gain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct VisitSuggestion {
    /// Cell to visit.
    pub cell: Cell,
    /// Centre of the cell.
    pub center: Point,
    /// Terrain at the centre; `null` where none is drawn.
    pub terrain: Option<TerrainRef>,
    /// Expected gain of a visit: natural logarithm of the ratio of the standard deviation of θ
    /// before the visit to that after it. Where nothing was measured, the standard deviation before
    /// the visit is that of the prior.
    pub gain: f64,
    /// Present standard deviation of θ over θ; `null` when nothing was measured.
    pub relative_std_dev: Option<f64>,
    /// Normalisation that was applied; `null` if none.
    #[serde(default)]
    pub normalisation: Option<String>,
    /// Whether the measurements contradict each other.
    pub disputed: bool,
}

/// Contribution of one robot to the map of a site.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotContribution {
    /// The robot.
    pub robot: RobotId,
    /// Number of cells that it has measured.
    pub cells: u64,
    /// Number of its segments.
    pub segments: u64,
    /// Start of the epoch (hour, day or month) of its first measurement.
    pub first_at: Timestamp,
    /// End of its newest measurement.
    pub newest_at: Timestamp,
    /// Estimated bias: median, over terrains that other robots have measured too, of the robot's θ
    /// over the θ of all robots of its models. `null` if there is no such terrain.
    pub bias_ratio: Option<f64>,
}

/// Friction of one cell for one terrain and one robot model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CellFriction {
    /// Index of the cell, in squares of side `size_m`.
    pub cell: Cell,
    /// Side of the square, metres.
    pub size_m: f64,
    /// Terrain; `null` where none was drawn. A cell on a border is listed once for each of its
    /// terrains.
    pub terrain: Option<TerrainRef>,
    /// Configuration: robot model and tyres.
    pub configuration: ConfigurationId,
    /// Fused friction of the cell.
    pub friction: FusedFriction,
    /// Normalisation by which measurements of other models were converted to this model's θ; `null`
    /// if none was applied.
    #[serde(default)]
    pub normalisation: Option<String>,
}

/// Segment as the server has stored it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StoredSegment {
    /// Number of the segment within its site, in the order of commits, with gaps.
    pub id: i64,
    /// Robot that measured it.
    pub robot: RobotId,
    /// Run of the robot's agent that measured it.
    pub boot: crate::ids::BootId,
    /// Sequence number of the record within that run.
    pub seq: u64,
    /// Time when the server received it.
    pub received_at: Timestamp,
    /// The measurement.
    pub segment: Segment,
}

/// Body of `POST /v1/sites/{site}/robots/{robot}/withdrawals`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CreateWithdrawal {
    /// Time within the first hour to withdraw; from the first measurement when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<Timestamp>,
    /// Time within the last hour to withdraw; the present hour when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to: Option<Timestamp>,
    /// Reason, for people.
    pub reason: String,
}

/// Withdrawal of a robot's measurements of some whole hours from the friction map.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Withdrawal {
    /// Number of the withdrawal.
    pub id: i64,
    /// Robot whose measurements are withdrawn.
    pub robot: RobotId,
    /// Start of the first withdrawn hour.
    pub from: Timestamp,
    /// End of the last withdrawn hour.
    pub before: Timestamp,
    /// Reason, for people.
    pub reason: String,
    /// Name of the token or person that withdrew them.
    pub by: String,
    /// Time of the withdrawal.
    pub at: Timestamp,
}

/// Region in which the friction map of a site may have changed since the previous message.
///
/// Sent at most once a second. Changes are merged into squares of cells, so a box may contain
/// unchanged cells. Request the cells that you need.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MapChange {
    /// Site of the map.
    pub site: SiteId,
    /// Time of this message.
    pub at: Timestamp,
    /// Revision of the grid to which the boxes refer.
    pub grid_revision: u32,
    /// Number of changes of the site's terrains. If it differs from the previous message, the
    /// friction of any cell may have changed.
    pub terrain_revision: u64,
    /// Whether any part of the map may have changed; `boxes` is empty then.
    #[serde(alias = "everything")]
    pub entire_map: bool,
    /// Changed boxes of cells, at most 256.
    pub boxes: Vec<CellBox>,
}

/// Box of cells; both corners are part of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CellBox {
    /// Corner cell with the lowest coordinates.
    pub min: Cell,
    /// Corner cell with the highest coordinates.
    pub max: Cell,
}
