//! Second stage: localises the robot, estimates the friction of the ground, and cuts segments.

use std::sync::Arc;
use std::time::Duration;

use tread_api::friction::SideSlip;
use tread_api::ids::MissionId;
use tread_api::site::Cell;
use tread_control::estimation::{Estimate, Estimator, EstimatorPrior, SensorNoise};
use tread_control::geometry::{Point, Pose, Twist};
use tread_control::localisation::{FixOutcome, Localisation, LocalisationNoise};
use tread_control::measured::Measured;
use tread_control::robot::RobotModel;
use tread_control::slip::BodyVelocity;
use tread_control::tracking::ThetaKnowledge;

use super::sensing::{CheckedSample, SensingOutput};
use super::{Tick, age_s};
use crate::control_loop::channels::{ClosedSegment, Fault};
use crate::control_loop::gain::GroundRecord;
use crate::control_loop::prior::{Prior, ThetaSources};
use crate::control_loop::progress::ProgressWatch;
use crate::control_loop::segments::{CutInput, Place, SegmentCutter};
use crate::control_loop::site_view::{GroundUnderWheels, SiteView};
use crate::control_loop::slip::SlipMeter;
use crate::drive::{SILENT_AFTER_MAX, StatedNoise};
use crate::geometry::wire_point;

/// Range of the noise that a base states for its sensors, as a multiple of the default; values
/// outside are clamped.
const NOISE_RANGE: std::ops::RangeInclusive<f64> = 0.1..=30.0;
/// Age of the last fused position fix beyond which the position counts as lost.
const POSITION_LOST_AFTER: Duration = Duration::from_secs(3);

/// Input of the stage.
#[derive(Debug)]
pub(super) struct EstimationInput<'tick> {
    pub(super) tick: Tick,
    pub(super) sensed: &'tick SensingOutput,
    /// Noise that the base states for its sensors.
    pub(super) noise: StatedNoise,
    /// A new definition of the site.
    pub(super) site: Option<Arc<SiteView>>,
    /// Active mission, to which a segment that opens in this tick belongs.
    pub(super) mission: Option<MissionId>,
}

/// Output of the stage.
#[derive(Debug)]
pub(super) struct EstimationOutput<'tick> {
    pub(super) pose: Option<Pose>,
    pub(super) twist: Twist,
    pub(super) position_std_dev_m: f64,
    /// Measuring time of the last fix fused into the pose.
    pub(super) last_fix: Option<Duration>,
    /// Robot state for the tracking law.
    pub(super) measured: Measured,
    /// Active fault of the base or the localisation.
    pub(super) fault: Option<Fault>,
    /// State of the estimator, with measured θ.
    pub(super) estimate: Estimate,
    /// The robot's own knowledge of the ground, without a map.
    pub(super) ground: Ground,
    /// `ground` before this tick's segment was closed, for a mission that begins in this tick.
    pub(super) ground_at_begin: Ground,
    /// Whether the estimator detected a change of ground.
    pub(super) ground_changed: bool,
    /// Changes of ground that the estimator detected since the start.
    pub(super) ground_changes: u64,
    /// Whether a wheel slips beyond the model's range.
    pub(super) slips: bool,
    /// Longitudinal slip of each side.
    pub(super) slip: Option<SideSlip>,
    /// Position at which the wheels turn without moving the robot.
    pub(super) dug_in_at: Option<Point>,
    /// The active site definition.
    pub(super) site: Option<&'tick SiteView>,
    /// Cell of the open segment, and the terrain under all wheels.
    pub(super) cell: Option<Cell>,
    pub(super) terrain: Option<usize>,
    /// θ information and θ-weighted sum of the segment that was closed.
    pub(super) closed: Option<(f64, f64)>,
    /// Estimator blocks of this tick that belong to no cell.
    pub(super) unmapped_blocks: u64,
}

/// Objects that leave the loop after this stage.
#[derive(Debug, Default)]
pub(super) struct Released {
    /// A segment that was closed with information.
    pub(super) segment: Option<ClosedSegment>,
    /// A site definition that was replaced.
    pub(super) site: Option<Arc<SiteView>>,
}

/// The robot's own knowledge of the ground at its position, without a map.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ground {
    measured: Option<ThetaKnowledge>,
    /// Revision of the grid, and the cell.
    cell: Option<(u32, Cell)>,
}

/// Effects of this tick's samples.
#[derive(Debug, Default)]
struct SampleEffects {
    ground_changed: bool,
    has_new_block: bool,
    unmapped_blocks: u64,
}

/// The stage's state.
#[derive(Debug)]
pub(super) struct Estimation {
    model: RobotModel,
    localisation: Localisation,
    estimator: Estimator,
    estimate: Estimate,
    cutter: SegmentCutter,
    site: Option<Arc<SiteView>>,
    ground_under_wheels: Option<GroundUnderWheels>,
    last_fix: Option<Duration>,
    /// Time up to which the localisation has integrated the robot's motion.
    integrated_to: Option<Duration>,
    /// Age of the last sample beyond which the base counts as silent.
    silent_after: Duration,
    /// Noise that the base states for its sensors.
    stated_noise: StatedNoise,
    slips: bool,
    ground_changes: u64,
    slip: SlipMeter,
    progress: ProgressWatch,
}

impl Estimation {
    pub(super) fn new(model: RobotModel) -> Self {
        let prior = EstimatorPrior::default();
        let estimator = Estimator::with_prior(model, SensorNoise::default(), prior);
        Self {
            model,
            localisation: Localisation::new(model, LocalisationNoise::default()),
            estimate: estimator.estimate(),
            estimator,
            cutter: SegmentCutter::default(),
            site: None,
            ground_under_wheels: None,
            last_fix: None,
            integrated_to: None,
            silent_after: SILENT_AFTER_MAX,
            stated_noise: StatedNoise::default(),
            slips: false,
            ground_changes: 0,
            slip: SlipMeter::default(),
            progress: ProgressWatch::default(),
        }
    }

    /// Sets the time after which the base counts as silent.
    pub(super) fn set_silent_after(&mut self, silent_after: Duration) {
        self.silent_after = silent_after;
    }

    /// Sets the estimator's prior of the robot's parameters.
    pub(super) fn set_prior(&mut self, prior: EstimatorPrior) {
        self.estimator = Estimator::with_prior(self.model, SensorNoise::default(), prior);
        self.estimate = self.estimator.estimate();
    }

    /// Localises the robot, updates the estimator, and closes the segment where required.
    pub(super) fn step(&mut self, input: EstimationInput<'_>) -> (EstimationOutput<'_>, Released) {
        let (tick, sensed) = (input.tick, input.sensed);
        let now = tick.now.monotonic;
        self.apply_noise(input.noise);
        let effects = self.process_samples(sensed.samples());
        self.measure_slip(sensed, tick);
        let retired = input.site.and_then(|site| self.replace_site(site));
        let ground_at_begin = self.ground();
        let segment = self.cut_segment(tick, input.mission, effects.ground_changed);
        let pose = self.localisation.pose();
        let twist = self.localisation.twist();
        let closed = segment.as_ref().map(|segment| {
            let statistics = &segment.statistics;
            (statistics.theta_information, statistics.theta_weighted)
        });
        let estimated = EstimationOutput {
            pose,
            twist,
            position_std_dev_m: self.localisation.position_std_dev_m(),
            last_fix: self.last_fix,
            measured: Measured {
                pose: pose.unwrap_or_default(),
                twist,
                wheel_speeds: sensed.wheel_speeds,
                pose_age_s: age_s(now, self.last_fix),
                position_std_dev_m: self.localisation.position_std_dev_m(),
            },
            fault: self.fault(sensed, now),
            estimate: self.estimate,
            ground: self.ground(),
            ground_at_begin,
            ground_changed: effects.ground_changed,
            ground_changes: self.ground_changes,
            slips: self.slips,
            slip: self.slip.slip(),
            dug_in_at: self.progress.dug_in_at(),
            cell: self.cutter.cell(),
            terrain: match self.ground_under_wheels {
                Some(GroundUnderWheels::Whole(terrain)) => terrain,
                Some(GroundUnderWheels::Mixed) | None => None,
            },
            closed,
            unmapped_blocks: effects.unmapped_blocks,
            site: self.site.as_deref(),
        };
        let released = Released {
            segment,
            site: retired,
        };
        (estimated, released)
    }

    /// Sets the estimator's noise to that stated by the base, clamped to [`NOISE_RANGE`].
    fn apply_noise(&mut self, stated: StatedNoise) {
        if self.stated_noise == stated {
            return;
        }
        self.stated_noise = stated;
        let default = SensorNoise::default();
        let within = |stated: Option<f64>, default: f64| {
            let (least, most) = (NOISE_RANGE.start() * default, NOISE_RANGE.end() * default);
            stated.map_or(default, |stated| stated.clamp(least, most))
        };
        self.estimator.set_noise(SensorNoise {
            gyro_rad_s: within(stated.gyro_rad_s, default.gyro_rad_s),
            accelerometer_m_s2: within(stated.accelerometer_m_s2, default.accelerometer_m_s2),
            body_speed_m_s: within(stated.body_speed_m_s, default.body_speed_m_s),
            ..default
        });
    }

    fn process_samples(&mut self, samples: &[CheckedSample]) -> SampleEffects {
        let mut effects = SampleEffects::default();
        for sample in samples {
            if !sample.shows_progress {
                self.progress.suspend();
            }
            self.process_motion(sample, &mut effects);
            let Some(fix) = sample.fix else {
                continue;
            };
            self.check_gap(sample.at);
            if sample.shows_progress {
                self.progress.add_fix(fix.pose.point());
            }
            match self.localisation.correct(&fix) {
                FixOutcome::Started | FixOutcome::Fused | FixOutcome::Restarted => {
                    self.last_fix = Some(sample.at);
                }
                FixOutcome::Invalid | FixOutcome::Outlier => {}
            }
        }
        if effects.has_new_block {
            self.estimate = self.estimator.estimate();
        }
        effects
    }

    fn process_motion(&mut self, sample: &CheckedSample, effects: &mut SampleEffects) {
        let Some((motion, dt_s)) = sample.motion else {
            return;
        };
        self.check_gap(sample.at);
        self.integrated_to = self.integrated_to.max(Some(sample.at));
        if dt_s <= 0.0 {
            return;
        }
        let twist = self.model.twist_from_wheel_speeds(motion.wheel_speeds);
        self.progress.add_wheel_distance(twist.linear_m_s * dt_s);
        self.localisation.predict(&motion, dt_s);
        // With wheels on two kinds of ground there is no single θ to estimate.
        if self.ground_under_wheels == Some(GroundUnderWheels::Mixed) || !sample.may_learn {
            return;
        }
        let outcome = self.estimator.update(&motion, dt_s);
        effects.ground_changed |= outcome.ground_changed;
        self.ground_changes += u64::from(outcome.ground_changed);
        effects.has_new_block |= outcome.block_done;
        if outcome.block_done {
            self.slips = outcome.slips;
            effects.unmapped_blocks += u64::from(self.cutter.cell().is_none());
        }
    }

    /// Increases the localisation's uncertainty for a gap without wheel samples; otherwise the next
    /// fix would be rejected as a jump.
    fn check_gap(&mut self, at: Duration) {
        let Some(integrated_to) = self.integrated_to else {
            return;
        };
        let gap = at.saturating_sub(integrated_to);
        if gap > self.silent_after {
            self.localisation
                .widen_without_measurements(gap.as_secs_f64());
            self.integrated_to = Some(at);
        }
    }

    /// Updates the slip of each side; undefined while the base is silent.
    fn measure_slip(&mut self, sensed: &SensingOutput, tick: Tick) {
        let now = tick.now.monotonic;
        let is_silent = sensed.is_base_silent
            || age_s(now, sensed.last_sample) > self.silent_after.as_secs_f64();
        let twist = self.localisation.twist();
        let velocity = BodyVelocity {
            forward_m_s: real_m_s(sensed, twist, now),
            left_m_s: 0.0,
            yaw_rate_rad_s: twist.angular_rad_s,
        };
        let measured = (!is_silent).then_some((velocity, sensed.wheel_speeds));
        self.slip.step(measured, &self.model, tick.dt_s);
    }

    /// Replaces the site definition and returns the former one.
    fn replace_site(&mut self, site: Arc<SiteView>) -> Option<Arc<SiteView>> {
        self.cutter.abandon(&mut self.estimator);
        self.estimate = self.estimator.estimate();
        self.site.replace(site)
    }

    fn ground(&self) -> Ground {
        // A bias common to all measurements of this robot does not matter here: its tracking law
        // feeds slip forward with the same mass, inertia and tyres.
        let measured = self.estimate.theta.map(|measured| ThetaKnowledge {
            theta: measured.theta,
            std_dev: measured.own_std_dev,
        });
        let place = self.site.as_ref().zip(self.localisation.pose());
        let cell = place.and_then(|(site, pose)| {
            let grid = site.grid();
            Some((grid.revision, grid.cell_at(wire_point(pose))?))
        });
        Ground { measured, cell }
    }

    fn cut_segment(
        &mut self,
        tick: Tick,
        mission: Option<MissionId>,
        ground_changed: bool,
    ) -> Option<ClosedSegment> {
        let mut place = None;
        self.ground_under_wheels = None;
        if let (Some(site), Some(pose)) = (&self.site, self.localisation.pose()) {
            let ground_under_wheels = site.ground_under_wheels(pose, &self.model);
            self.ground_under_wheels = Some(ground_under_wheels);
            let former = self.cutter.cell();
            if let (GroundUnderWheels::Whole(terrain), Some(cell)) =
                (ground_under_wheels, site.cell(wire_point(pose), former))
            {
                place = Some(Place { cell, terrain });
            }
        }
        let speed_m_s = self.localisation.twist().linear_m_s.abs();
        let input = CutInput {
            now: tick.now,
            place,
            site: self.site.as_ref(),
            mission,
            driven_m: if speed_m_s.is_finite() {
                speed_m_s * tick.dt_s
            } else {
                0.0
            },
            ground_changed,
        };
        let cut = self.cutter.step(input, &mut self.estimator);
        if cut.is_new_ground {
            // What was estimated on the former ground does not apply here.
            self.estimate = self.estimator.estimate();
        }
        cut.segment
    }

    fn fault(&self, sensed: &SensingOutput, now: Duration) -> Option<Fault> {
        let is_older = |at: Option<Duration>, most: Duration| {
            at.is_some_and(|at| now.saturating_sub(at) > most)
        };
        if sensed.is_base_silent || is_older(sensed.last_sample, self.silent_after) {
            Some(Fault::BaseSilent)
        } else if is_older(self.last_fix, POSITION_LOST_AFTER) {
            Some(Fault::PositionLost)
        } else {
            None
        }
    }
}

impl Ground {
    /// Fuses the robot's own knowledge with the map's of the same cell; the estimator does not use
    /// the result.
    pub(super) fn with(&self, prior: &Prior) -> GroundRecord {
        let mapped = self
            .cell
            .and_then(|(grid_revision, cell)| prior.at(grid_revision, cell));
        GroundRecord {
            traction_limit_mu: prior.traction_limit_mu(),
            is_on_the_map: mapped.is_some(),
            given: ThetaSources {
                measured: self.measured,
                prior: mapped,
            }
            .fused(),
            measured: self.measured,
        }
    }
}

/// Returns the best known speed along the path, m/s: odometry over ground if recent and
/// uncontradicted, otherwise the localisation's, which is wrong under slip until position fixes
/// correct it.
pub(super) fn real_m_s(sensed: &SensingOutput, twist: Twist, now: Duration) -> f64 {
    sensed.odometry_m_s(now).unwrap_or(twist.linear_m_s)
}
