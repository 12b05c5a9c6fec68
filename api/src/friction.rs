//! Friction: what robots measure, and what the map says.
//!
//! θ = 1/K is the slip compliance of the ground for one robot model, K its friction stiffness.
//! `mu_peak` is a lower bound of the peak friction seen. None of them stands for another.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{ConfigurationId, MissionId, RobotId};
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
    /// θ, slip per friction coefficient.
    pub theta: Information,
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
/// Most information that one segment may claim, from a deviation of 10⁻⁵.
pub const INFORMATION_MAX: f64 = 1.0e10;
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
            self.theta.information > 0.0 && information(&self.theta, THETA_MAX),
            "theta",
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
            peak.is_none_or(|mu| (0.0..=10.0).contains(&mu)),
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
}

/// θ with its deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ThetaEstimate {
    /// θ = 1/K, slip per friction coefficient.
    pub theta: f64,
    /// Standard deviation of θ.
    pub std_dev: f64,
}

/// Standard deviations to either side of a 95 % interval.
pub const NORMAL_95: f64 = 1.959_963_984_540_054;

impl ThetaEstimate {
    /// The 95 % interval, low and high; θ is never negative.
    pub fn interval_95(&self) -> (f64, f64) {
        let half = NORMAL_95 * self.std_dev;
        ((self.theta - half).max(0.0), self.theta + half)
    }
}

/// What the map knows of one piece of ground.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FusedFriction {
    /// θ = 1/K, slip per friction coefficient.
    pub theta: f64,
    /// Standard deviation of θ, with the robots' own biases and the age of what they measured.
    pub std_dev: f64,
    /// Lower end of the 95 % interval of θ.
    pub theta_low_95: f64,
    /// Upper end of the 95 % interval of θ.
    pub theta_high_95: f64,
    /// Friction stiffness K = 1/θ.
    pub stiffness: f64,
    /// Largest friction coefficient seen, a lower bound of the peak.
    pub mu_peak_lower_bound: Option<f64>,
    /// Segments behind it.
    pub segments: u64,
    /// Robots behind it.
    pub robots: u32,
    /// End of the newest measurement.
    pub newest_at: Timestamp,
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
}

/// The friction of one cell, per terrain and robot model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CellFriction {
    /// The cell.
    pub cell: Cell,
    /// The terrain; `null` where none was drawn. A border cell is listed once per terrain.
    pub terrain: Option<TerrainRef>,
    /// The robot model and tyres.
    pub configuration: ConfigurationId,
    /// What is known.
    pub friction: FusedFriction,
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
