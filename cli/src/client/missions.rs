//! Requests about missions and checks of trajectories.

use reqwest::Method;
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{CreateMission, Mission, MissionDetail, MissionState, ReplaceMission};
use tread_api::page::Page;
use tread_api::trajectory::{CheckTrajectory, TrajectoryCheck};

use super::{Client, ClientError};

impl Client {
    pub(crate) async fn create_mission(
        &self,
        mission: &CreateMission,
    ) -> Result<Mission, ClientError> {
        self.post("/v1/missions", mission).await
    }

    /// Lists the newest missions of a site, at most `limit`.
    pub(crate) async fn missions(
        &self,
        site: &SiteId,
        robot: Option<&RobotId>,
        state: Option<MissionState>,
        limit: u32,
    ) -> Result<Page<Mission>, ClientError> {
        let mut query = vec![("site", site.to_string()), ("limit", limit.to_string())];
        query.extend(robot.map(|robot| ("robot", robot.to_string())));
        query.extend(state.map(|state| ("state", state.as_str().to_owned())));
        self.get_with("/v1/missions", &query).await
    }

    /// Lists all missions of a site that the client reads, the newest first.
    pub(crate) async fn all_missions(&self, site: &SiteId) -> Result<Vec<Mission>, ClientError> {
        let query = vec![("site", site.to_string())];
        self.all_with("/v1/missions", &query).await
    }

    pub(crate) async fn mission(&self, mission: MissionId) -> Result<MissionDetail, ClientError> {
        self.get(&format!("/v1/missions/{mission}")).await
    }

    /// Requests that a mission be paused, resumed or cancelled: `verb` is the last part of the
    /// route.
    pub(crate) async fn act(&self, mission: MissionId, verb: &str) -> Result<Mission, ClientError> {
        let path = format!("/v1/missions/{mission}/{verb}");
        self.send(self.request(Method::POST, &path)).await
    }

    /// Requests that a mission drive another trajectory.
    pub(crate) async fn replace_mission(
        &self,
        mission: MissionId,
        replacement: &ReplaceMission,
    ) -> Result<Mission, ClientError> {
        self.post(&format!("/v1/missions/{mission}/replace"), replacement)
            .await
    }

    /// Checks a trajectory without driving it.
    pub(crate) async fn check_trajectory(
        &self,
        check: &CheckTrajectory,
    ) -> Result<TrajectoryCheck, ClientError> {
        self.post("/v1/trajectories/check", check).await
    }
}
