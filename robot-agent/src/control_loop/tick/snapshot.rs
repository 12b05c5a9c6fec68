//! What the loop says of itself after each tick.

use std::time::Duration;

use tread_api::friction::ThetaEstimate;
use tread_api::robot::RobotMode;
use tread_control::geometry::{Pose, Twist};
use tread_control::measured::Measured;
use tread_control::tracking::TrackingErrors;

use super::{LoopCore, age_s};
use crate::control_loop::active::Active;
use crate::control_loop::channels::{Fault, Snapshot};
use crate::control_loop::site_view::Footing;
use crate::drive::Battery;

impl LoopCore {
    fn mode(&self, fault: Option<Fault>) -> RobotMode {
        if self.guard.is_stopped() {
            RobotMode::Stopped
        } else if fault.is_some() {
            RobotMode::Fault
        } else if self.guard.is_leased() {
            RobotMode::Teleoperated
        } else if self.active.is_some() {
            RobotMode::Tracking
        } else {
            RobotMode::Idle
        }
    }

    /// The robot as the tracking law sees it.
    pub(super) fn measured(&self, now: Duration) -> Measured {
        Measured {
            pose: self.localisation.pose().unwrap_or_default(),
            twist: self.localisation.twist(),
            wheel_speeds: self.measured_wheels,
            pose_age_s: age_s(now, self.last_fix),
            position_std_dev_m: self.localisation.position_std_dev_m(),
        }
    }

    /// How far a held mission's reference is from the robot, metres.
    fn off_path_m(&self, now: Duration) -> Option<f64> {
        let active = self.active.as_ref().filter(|active| active.is_on_hold())?;
        let follower = &active.job.follower;
        let reference = follower.governor().sample(follower.plan());
        let errors = TrackingErrors::between(&reference, &self.measured(now));
        Some(errors.distance_m())
    }

    pub(super) fn snapshot(
        &self,
        now: Duration,
        fault: Option<Fault>,
        battery: Option<Battery>,
    ) -> Snapshot {
        let pose = self
            .localisation
            .pose()
            .filter(|pose: &Pose| pose.is_finite());
        let twist = Some(self.localisation.twist()).filter(|twist: &Twist| twist.is_finite());
        let terrain = match self.footing {
            Some(Footing::Whole(terrain)) => terrain,
            Some(Footing::Mixed) | None => None,
        };
        let measured = self.estimate.theta.map(|theta| ThetaEstimate {
            theta: theta.theta,
            std_dev: theta.std_dev,
        });
        Snapshot {
            at: now,
            mode: self.mode(fault),
            fault,
            pose: pose.zip(self.last_fix),
            twist: twist.zip(self.last_sample),
            mission: self.active.as_ref().map(|active| active.progress),
            governor: self
                .active
                .as_ref()
                .map(|active| *active.job.follower.governor()),
            is_on_hold: self.active.as_ref().is_some_and(Active::is_on_hold),
            off_path_m: self.off_path_m(now),
            stands: self.stands(),
            gate: self.guard.gate(),
            fence_revision: self.site.as_ref().map(|site| site.fence_revision()),
            battery,
            theta_loop: self.theta_loop.filter(|theta| theta.is_finite()),
            theta_measured: measured
                .filter(|theta| theta.theta.is_finite() && theta.std_dev.is_finite()),
            excited: !self.estimate.no_new_information,
            surface_change: self.surface.raised(),
            dug_in_at: self.progress.dug_in_at(),
            overrun: self.overrun(),
            findings: self.findings,
            standing: self.standing.report(),
            slip: self.slip.slip(),
            cell: self.cutter.cell(),
            terrain,
            terrain_revision: self.site.as_ref().map(|site| site.terrain_revision()),
            ticks: self.ticks,
        }
    }
}
