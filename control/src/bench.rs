//! Peers, written only for comparison, and the run that compares. Nothing that ships uses them.

use crate::friction::FrictionCurve;
use crate::geometry::{Pose, Twist, wrap_angle_rad};
use crate::measured::{Measured, WheelSpeeds};
use crate::plan::Plan;
use crate::plant::{Ground, Plant, PlantError, PlantSpec};
use crate::reference::{Governor, GovernorInput, ReferenceSample};
use crate::robot::RobotModel;
use crate::tracking::{
    ThetaKnowledge, Tracker, TrackerConfig, TrackerError, TrackingErrors, desaturated,
};

/// Gains of the Kanayama tracker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KanayamaGains {
    /// `k_x`, per second.
    pub along_1_s: f64,
    /// `k_y`, per metre squared.
    pub cross_1_m2: f64,
    /// `k_θ`, per metre.
    pub heading_1_m: f64,
    /// `k_I` on the cross-track error, per metre squared and second.
    pub integral_1_m2_s: f64,
}

impl KanayamaGains {
    /// As usually shipped: no integral action.
    pub fn usual() -> Self {
        Self {
            along_1_s: 1.0,
            cross_1_m2: 4.0,
            heading_1_m: 3.0,
            integral_1_m2_s: 0.0,
        }
    }

    /// Tuned, with integral action: the peer that counts.
    pub fn tuned() -> Self {
        Self {
            along_1_s: 3.0,
            cross_1_m2: 16.0,
            heading_1_m: 6.0,
            integral_1_m2_s: 4.0,
        }
    }
}

/// Kanayama's tracker on the effective track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Kanayama {
    model: RobotModel,
    gains: KanayamaGains,
    integral_m_s: f64,
}

impl Kanayama {
    /// A tracker at rest.
    pub fn new(model: RobotModel, gains: KanayamaGains) -> Self {
        Self {
            model,
            gains,
            integral_m_s: 0.0,
        }
    }

    /// One tick.
    pub fn step(
        &mut self,
        reference: &ReferenceSample,
        measured: &Measured,
        dt_s: f64,
    ) -> WheelSpeeds {
        let gains = &self.gains;
        let ahead = measured.pose.body_from_site(reference.pose.point());
        let heading_rad = wrap_angle_rad(reference.pose.heading_rad - measured.pose.heading_rad);
        self.integral_m_s = (self.integral_m_s + ahead.y_m * dt_s).clamp(-0.1, 0.1);
        let twist = Twist {
            linear_m_s: reference.speed_m_s * heading_rad.cos() + gains.along_1_s * ahead.x_m,
            angular_rad_s: reference.turn_rad_s
                + reference.speed_m_s
                    * (gains.cross_1_m2 * ahead.y_m
                        + gains.heading_1_m * heading_rad.sin()
                        + gains.integral_1_m2_s * self.integral_m_s),
        };
        desaturated(&self.model, twist).0
    }
}

/// A law that drives a comparison.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Law {
    /// Kanayama's tracker.
    Kanayama(KanayamaGains),
    /// The shipped law, with what it is told about θ from the start.
    Shipped(Option<ThetaKnowledge>),
}

/// Under what a comparison runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scenario {
    /// The ground, the same everywhere.
    pub curve: FrictionCurve,
    /// Lag of the wheel servo, seconds; the shipped law leads the one of its own configuration.
    pub servo_lag_s: f64,
    /// Period of the loop, seconds.
    pub loop_s: f64,
}

/// Cross-track errors of one run.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CrossTrack {
    /// Root mean square after the first half of the path, metres.
    pub rms_m: f64,
    /// Largest on the whole path, metres.
    pub most_m: f64,
}

/// Why a comparison cannot run.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BenchError {
    /// The plant was refused.
    #[error("the simulated base was refused")]
    Plant(#[from] PlantError),
    /// The shipped law was refused.
    #[error("the law was refused")]
    Tracker(#[from] TrackerError),
}

/// Drives a plan on the free plant without noise; the reference waits for nobody, so that it is
/// the same for every law.
///
/// # Errors
/// [`BenchError`] when the scenario's lag is out of range.
pub fn cross_track(
    plan: &Plan,
    start: Pose,
    model: RobotModel,
    scenario: &Scenario,
    law: Law,
) -> Result<CrossTrack, BenchError> {
    let spec = PlantSpec {
        servo_lag_s: scenario.servo_lag_s,
        ..PlantSpec::default()
    };
    let mut plant = Plant::new(model, spec, start)?;
    let ground = Ground::uniform(scenario.curve);
    let mut governor = Governor::new(&model);
    let mut kanayama = Kanayama::new(model, KanayamaGains::usual());
    let mut tracker = Tracker::new(model, TrackerConfig::default())?;
    let mut told = None;
    match law {
        Law::Kanayama(gains) => kanayama.gains = gains,
        Law::Shipped(knowledge) => {
            told = knowledge;
            if let Some(known) = knowledge {
                tracker.warm_start(known);
            }
        }
    }
    let (mut sum, mut count, mut most_m) = (0.0, 0.0_f64, 0.0_f64);
    while !governor.is_at_end(plan) {
        let reference = governor.step(plan, &GovernorInput::default(), scenario.loop_s);
        let state = plant.state();
        let measured = Measured {
            pose: state.pose,
            twist: state.twist(),
            wheel_speeds: state.wheel_speeds,
            pose_age_s: 0.0,
        };
        let cross_m = TrackingErrors::between(&reference, &measured).cross_m;
        most_m = most_m.max(cross_m.abs());
        if reference.arc_m > 0.5 * plan.length_m() {
            sum += cross_m * cross_m;
            count += 1.0;
        }
        let command = match law {
            Law::Kanayama(_) => kanayama.step(&reference, &measured, scenario.loop_s),
            Law::Shipped(_) => {
                tracker
                    .step(&reference, &measured, told, scenario.loop_s)
                    .wheel_speeds
            }
        };
        plant.step(command, &ground, scenario.loop_s);
    }
    Ok(CrossTrack {
        rms_m: (sum / count.max(1.0)).sqrt(),
        most_m,
    })
}
