//! A planned mission, and the inputs of its planning, from which the same plan is computed again to
//! the bit.

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tread_api::ids::{MissionId, PlanHash};
use tread_api::site::Grid;
use tread_api::trajectory::Trajectory;
use tread_api::wire::command::PathPrior;
use tread_control::follower::{Follower, FollowerConfig};
use tread_control::geometry::Pose;
use tread_control::plan::{Plan, PlanOptions};
use tread_control::robot::RobotModel;

use super::driven::Driven;
use super::prior::Prior;
use crate::geometry::{control_trajectory, plan_options};

/// A planned mission, ready to drive.
#[derive(Debug)]
pub(crate) struct Job {
    pub(crate) mission: MissionId,
    pub(crate) revision: u32,
    pub(crate) plan_hash: PlanHash,
    pub(crate) follower: Follower,
    /// Friction of the map along the path.
    pub(crate) prior: Prior,
    /// Latest start, by the monotonic clock; a later start ends the mission as expired.
    pub(crate) start_by: Option<Duration>,
    /// Longest silence of the server before the mission is stopped; `None` for no limit.
    pub(crate) silence_max: Option<Duration>,
    /// Record of the driven path and of the mission's quality.
    pub(crate) driven: Driven,
    /// Inputs from which this job was planned.
    pub(crate) origin: Arc<JobOrigin>,
}

/// Request, start pose and map data from which a mission was planned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct JobOrigin {
    pub(crate) mission: MissionId,
    pub(crate) revision: u32,
    pub(crate) plan_hash: PlanHash,
    pub(crate) trajectory: Trajectory,
    /// Start pose of the plan, in the site frame.
    pub(crate) start: Pose,
    /// Friction of the map along the path.
    pub(crate) prior: Option<PathPrior>,
    /// The grid of the site for which it was planned.
    pub(crate) grid: Option<Grid>,
    /// Latest start, by the monotonic clock.
    pub(crate) start_by: Option<Duration>,
    /// Longest silence of the server before the mission is stopped; `None` for no limit.
    pub(crate) silence_max: Option<Duration>,
}

impl JobOrigin {
    /// Plans the trajectory for a robot.
    ///
    /// # Errors
    /// The reason why the trajectory cannot be planned, as a sentence.
    pub(crate) fn plan(&self, model: &RobotModel) -> Result<Plan, String> {
        let prior = Prior::new(self.prior.as_ref());
        let traction_limit = self.grid.and_then(|grid| prior.traction_limit_map(grid));
        let options = PlanOptions {
            traction_limit_mu: prior.traction_limit_mu(),
            traction_limits: traction_limit.as_ref(),
            ..plan_options(&self.trajectory)
        };
        let trajectory = control_trajectory(&self.trajectory);
        Plan::with_options(&trajectory, self.start, model, &options)
            .map_err(|refused| refused.to_string())
    }

    /// Creates the job of a plan.
    ///
    /// # Errors
    /// The reason why the tracking law refuses the plan, as a sentence.
    pub(crate) fn job(self, plan: Plan, model: RobotModel) -> Result<Box<Job>, String> {
        let follower = Follower::new(plan, model, FollowerConfig::default())
            .map_err(|refused| refused.to_string())?;
        Ok(Box::new(Job {
            mission: self.mission,
            revision: self.revision,
            plan_hash: self.plan_hash,
            follower,
            prior: Prior::new(self.prior.as_ref()),
            start_by: self.start_by,
            silence_max: self.silence_max,
            driven: Driven::new(),
            origin: Arc::new(self),
        }))
    }
}
