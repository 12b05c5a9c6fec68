//! What the base says: where the robot is, the friction of the ground, and what is broken.

use std::sync::atomic::Ordering;
use std::time::Duration;

use tread_api::friction::TYRE_DIFFERENCE_SHARE;
use tread_control::estimation::{SensorNoise, SensorSample};
use tread_control::localisation::{FixOutcome, PositionFix};
use tread_control::slip::BodyVelocity;
use tread_control::tracking::ThetaKnowledge;

use super::{LoopCore, TICK_MAX_S, age_s};
use crate::control_loop::active::Hold;
use crate::control_loop::channels::{ClosedSegment, Fault, LoopEvent, Shared};
use crate::control_loop::gain::GroundRecord;
use crate::control_loop::prior::{Prior, told};
use crate::control_loop::segments::{CutInput, Moment, Place};
use crate::control_loop::site_view::Footing;
use crate::control_loop::surface::Comparison;
use crate::drive::{Feedback, StatedNoise};
use crate::geometry::wire_point;

/// How long a base that was silent must be heard before its mission goes on.
const HEARD_AGAIN_FOR: Duration = Duration::from_millis(500);
/// Range within which a base's own word on its noise is believed, as a multiple of the default.
const NOISE_RANGE: std::ops::RangeInclusive<f64> = 0.1..=30.0;
/// Oldest word of a sensor of the robot's own speed that says how fast it is now.
pub(super) const BODY_SPEED_AGE_MAX: Duration = Duration::from_millis(150);
/// Oldest position fix with which the position does not count as lost.
const POSITION_LOST_AFTER: Duration = Duration::from_secs(3);

impl LoopCore {
    /// Takes what the base said; true if the estimator found the ground changed.
    pub(super) fn take_samples(&mut self, feedback: &Feedback) -> bool {
        let mut ground_changed = false;
        let mut has_new_block = false;
        let lost = u64::from(feedback.lost());
        self.ends
            .shared
            .lost_samples
            .fetch_add(lost, Ordering::Relaxed);
        self.motion.fix = None;
        for sample in feedback.samples() {
            self.check_sensors(sample);
            if sample.tilt_rad.is_some() {
                self.tilt_rad = sample.tilt_rad;
            }
            if let Some(speed_m_s) = sample.body_speed_m_s.filter(|speed| speed.is_finite()) {
                self.body_speed = Some((speed_m_s, sample.at));
            }
            let gyro_rad_s = sample.yaw_rate_rad_s.filter(|rate| rate.is_finite());
            let wheel_speeds = sample.wheel_speeds.filter(|speeds| speeds.is_finite());
            if let (Some(gyro_rad_s), Some(wheel_speeds)) = (gyro_rad_s, wheel_speeds) {
                let dt_s = self
                    .last_sample
                    .map_or(0.0, |last| sample.at.saturating_sub(last).as_secs_f64())
                    .min(TICK_MAX_S);
                // Only what can be used counts as a word of the base: one that says nothing but
                // nonsense is as good as silent.
                self.last_sample = Some(sample.at);
                self.check_gap(sample.at);
                self.integrated_to = self.integrated_to.max(Some(sample.at));
                self.measured_wheels = wheel_speeds;
                if dt_s > 0.0 {
                    let forward = self.model.twist_from_wheel_speeds(wheel_speeds).linear_m_s;
                    self.progress.note_wheels(forward * dt_s);
                    self.localisation.predict(gyro_rad_s, wheel_speeds, dt_s);
                    // With wheels on two grounds there is no one θ to learn.
                    if self.footing != Some(Footing::Mixed) && self.may_learn() {
                        let taken = SensorSample {
                            wheel_speeds,
                            gyro_rad_s,
                            acceleration: sample.acceleration,
                            body_speed_m_s: sample.body_speed_m_s,
                            wheel_torques: sample.wheel_torques,
                        };
                        let outcome = self.estimator.update(&taken, dt_s);
                        ground_changed |= outcome.ground_changed;
                        has_new_block |= outcome.block_done;
                        if outcome.block_done {
                            self.slips = outcome.slips;
                        }
                        if outcome.block_done && self.cutter.cell().is_none() {
                            Shared::count(&self.ends.shared.unplaced_blocks);
                        }
                    }
                }
            }
            if let Some(pose) = sample.position {
                self.check_gap(sample.at);
                self.progress.note_fix(pose.point());
                // A position takes longer to be found than the motion since.
                let fix = PositionFix {
                    pose,
                    age_s: self
                        .last_sample
                        .map_or(0.0, |last| last.saturating_sub(sample.at).as_secs_f64()),
                    noise: sample.position_noise,
                };
                match self.localisation.correct(&fix) {
                    FixOutcome::Started | FixOutcome::Fused | FixOutcome::Restarted => {
                        self.last_fix = Some(sample.at);
                    }
                    FixOutcome::Invalid | FixOutcome::Outlier => {}
                }
            }
        }
        if has_new_block {
            self.estimate = self.estimator.estimate();
        }
        ground_changed
    }

    /// Where the robot went while its wheels were not heard, nobody knows: without this, what its
    /// position says afterwards would be refused as a jump.
    fn check_gap(&mut self, at: Duration) {
        let Some(integrated_to) = self.integrated_to else {
            return;
        };
        let gap = at.saturating_sub(integrated_to);
        if gap > self.silent_after {
            self.localisation.lose_track(gap.as_secs_f64());
            self.integrated_to = Some(at);
        }
    }

    /// How fast the robot really goes along its path, as well as it is known: slip tells wheels and
    /// robot apart, and position fixes tell of it only after a while.
    pub(super) fn real_m_s(&self, now: Duration) -> f64 {
        let is_new = |at: Duration| now.saturating_sub(at) <= BODY_SPEED_AGE_MAX;
        match self.body_speed {
            Some((speed_m_s, at)) if is_new(at) && self.is_odometry_right() => speed_m_s,
            Some(_) | None => self.localisation.twist().linear_m_s,
        }
    }

    /// How much the wheels slip; nothing is known of a base that is silent.
    pub(super) fn measure_slip(&mut self, now: Duration, dt_s: f64) {
        let is_silent =
            self.is_base_silent || age_s(now, self.last_sample) > self.silent_after.as_secs_f64();
        let velocity = BodyVelocity {
            forward_m_s: self.real_m_s(now),
            left_m_s: 0.0,
            yaw_rate_rad_s: self.localisation.twist().angular_rad_s,
        };
        let heard = (!is_silent).then_some((velocity, self.measured_wheels));
        self.slip.step(heard, &self.model, dt_s);
    }

    /// What is known of the ground: what was measured, and what the map knows of the cell. The
    /// estimator itself never hears of the map.
    pub(super) fn ground(&self, prior: &Prior) -> GroundRecord {
        // What is wrong in all that this robot measures is right for itself: its law feeds slip
        // forward by the same mass, inertia and tyres.
        let measured = self.estimate.theta.map(|measured| ThetaKnowledge {
            theta: measured.theta,
            std_dev: measured.own_std_dev,
        });
        let site = self.site.as_ref();
        let mapped = site.zip(self.localisation.pose()).and_then(|(site, pose)| {
            let grid = site.grid();
            let cell = grid.cell_at(wire_point(pose))?;
            prior.at(grid.revision, cell)
        });
        GroundRecord {
            traction_limit_mu: prior.traction_limit_mu(),
            is_on_the_map: mapped.is_some(),
            told: told(measured, mapped),
            measured,
        }
    }

    /// Holds what a closed segment says against what the map says of its cell.
    fn compare(&mut self, segment: &ClosedSegment) {
        let active = self.active.as_mut();
        let Some(active) = active.filter(|active| segment.mission == Some(active.job.mission))
        else {
            return;
        };
        let (prior, statistics) = (&active.job.prior, &segment.statistics);
        let expected = prior.at(segment.site.grid().revision, segment.cell);
        let Some((expected, theta)) = expected.zip(statistics.theta()) else {
            return;
        };
        let comparison = Comparison {
            cell: segment.cell,
            measured: ThetaKnowledge {
                theta,
                std_dev: statistics.own_information.sqrt().recip(),
            },
            expected,
            robot_bias_ratio: prior
                .robot_bias_ratio()
                .max(statistics.common_ratio.robot)
                .hypot(TYRE_DIFFERENCE_SHARE * statistics.common_ratio.tyres),
        };
        active.compare(&comparison);
        self.surface.note(comparison);
    }

    pub(super) fn cut_segments(&mut self, now: Moment, ground_changed: bool, dt_s: f64) {
        let pose = self.localisation.pose();
        let mut place = None;
        self.footing = None;
        if let (Some(site), Some(pose)) = (&self.site, pose) {
            let footing = site.footing(pose, &self.model);
            self.footing = Some(footing);
            let former = self.cutter.cell();
            if let (Footing::Whole(terrain), Some(cell)) =
                (footing, site.cell(wire_point(pose), former))
            {
                place = Some(Place { cell, terrain });
            }
        }
        let speed_m_s = self.localisation.twist().linear_m_s.abs();
        let input = CutInput {
            now,
            place,
            site: self.site.as_ref(),
            mission: self.active.as_ref().map(|active| active.job.mission),
            driven_m: if speed_m_s.is_finite() {
                speed_m_s * dt_s
            } else {
                0.0
            },
            ground_changed,
        };
        let cut = self.cutter.step(input, &mut self.estimator);
        if cut.is_new_ground {
            // What was known of the ground before says nothing here.
            self.estimate = self.estimator.estimate();
        }
        if let Some(segment) = cut.segment {
            let statistics = &segment.statistics;
            self.closed = Some((statistics.theta_information, statistics.theta_weighted));
            self.compare(&segment);
            self.outgoing.send(LoopEvent::Segment(segment));
        }
    }

    /// Holds the mission of a base that is silent, and lets it go on when that is heard again for a
    /// while.
    pub(super) fn hold_for_base(&mut self, now: Duration, fault: Option<Fault>) {
        if fault == Some(Fault::BaseSilent) {
            self.base_silent_at = Some(now);
        }
        let is_on_hold = self
            .base_silent_at
            .is_some_and(|silent_at| now.saturating_sub(silent_at) < HEARD_AGAIN_FOR);
        if !is_on_hold {
            self.base_silent_at = None;
        }
        if let Some(active) = &mut self.active {
            active.hold(Hold::Base, is_on_hold);
        }
    }

    /// Weighs samples by what the base says of its sensors, as far as that can be.
    pub(super) fn take_noise(&mut self, stated: StatedNoise) {
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

    pub(super) fn fault(&self, now: Duration) -> Option<Fault> {
        let is_older = |at: Option<Duration>, most: Duration| {
            at.is_some_and(|at| now.saturating_sub(at) > most)
        };
        if self.is_base_silent || is_older(self.last_sample, self.silent_after) {
            Some(Fault::BaseSilent)
        } else if is_older(self.last_fix, POSITION_LOST_AFTER) {
            Some(Fault::PositionLost)
        } else {
            None
        }
    }
}
