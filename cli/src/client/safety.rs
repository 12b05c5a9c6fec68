//! Requests about stops, alerts, external limits and geofences.

use reqwest::Method;
use tread_api::ids::{AlertCode, AlertId, OwnerId, RobotId, SiteId};
use tread_api::page::Page;
use tread_api::robot::Alert;
use tread_api::safety::{Geofence, LimitStatus, ReplaceGeofence, SetLimit};
use tread_api::stop::{ClearStop, FleetStop, Stop, StopFleet, StopRobot};

use super::{Client, ClientError};

impl Client {
    pub(crate) async fn stop_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
        words: &StopRobot,
    ) -> Result<Stop, ClientError> {
        self.post(&format!("/v1/sites/{site}/robots/{robot}/stop"), words)
            .await
    }

    pub(crate) async fn stop_fleet(&self, words: &StopFleet) -> Result<FleetStop, ClientError> {
        self.post("/v1/stop", words).await
    }

    pub(crate) async fn clear_stop(
        &self,
        site: &SiteId,
        robot: &RobotId,
        clear: &ClearStop,
    ) -> Result<Stop, ClientError> {
        let path = format!("/v1/sites/{site}/robots/{robot}/stop/clear");
        self.post(&path, clear).await
    }

    /// Lists the newest stops of a site, at most `limit`.
    pub(crate) async fn stops(
        &self,
        site: &SiteId,
        robot: Option<&RobotId>,
        in_force: bool,
        limit: u32,
    ) -> Result<Page<Stop>, ClientError> {
        let mut query = vec![
            ("site", site.to_string()),
            ("in_force", in_force.to_string()),
            ("limit", limit.to_string()),
        ];
        query.extend(robot.map(|robot| ("robot", robot.to_string())));
        self.get_with("/v1/stops", &query).await
    }

    /// Lists the newest alerts of a site, at most `limit`.
    pub(crate) async fn alerts(
        &self,
        site: &SiteId,
        (robot, kind): (Option<&RobotId>, Option<&AlertCode>),
        raised: bool,
        limit: u32,
    ) -> Result<Page<Alert>, ClientError> {
        let mut query = vec![
            ("site", site.to_string()),
            ("raised", raised.to_string()),
            ("limit", limit.to_string()),
        ];
        query.extend(robot.map(|robot| ("robot", robot.to_string())));
        query.extend(kind.map(|kind| ("kind", kind.to_string())));
        self.get_with("/v1/alerts", &query).await
    }

    /// Acknowledges an alert.
    pub(crate) async fn acknowledge(&self, alert: AlertId) -> Result<Alert, ClientError> {
        let path = format!("/v1/alerts/{alert}/acknowledge");
        self.send(self.request(Method::POST, &path)).await
    }

    pub(crate) async fn limits(
        &self,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Page<LimitStatus>, ClientError> {
        self.get(&format!("/v1/sites/{site}/robots/{robot}/limits"))
            .await
    }

    /// Sets an owner's limit, or ends it if `limit` is `None`.
    pub(crate) async fn change_limit(
        &self,
        site: &SiteId,
        robot: &RobotId,
        owner: &OwnerId,
        limit: Option<&SetLimit>,
    ) -> Result<(), ClientError> {
        let path = format!("/v1/sites/{site}/robots/{robot}/limits/{owner}");
        let request = match limit {
            Some(limit) => self.request(Method::PUT, &path).json(limit),
            None => self.request(Method::DELETE, &path),
        };
        self.answered(request).await.map(|_done| ())
    }

    pub(crate) async fn geofence(&self, site: &SiteId) -> Result<Geofence, ClientError> {
        self.get(&format!("/v1/sites/{site}/geofence")).await
    }

    pub(crate) async fn replace_geofence(
        &self,
        site: &SiteId,
        geofence: &ReplaceGeofence,
        revision: Option<u64>,
    ) -> Result<Geofence, ClientError> {
        let path = format!("/v1/sites/{site}/geofence");
        let mut request = self.request(Method::PUT, &path).json(geofence);
        if let Some(revision) = revision {
            request = request.header("if-match", format!("\"{revision}\""));
        }
        self.send(request).await
    }
}
