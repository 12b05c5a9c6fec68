//! Requests about the server, sites, robots and events.

use reqwest::{Method, Response};
use tread_api::ids::{RobotId, SiteId};
use tread_api::robot::{Robot, UpdateRobot};
use tread_api::site::{CreateSite, GeoOrigin, Site};

use super::{Client, ClientError, STREAM_WAIT_MAX};

impl Client {
    /// Requests version, uptime and counters of the server.
    pub(crate) async fn status(&self) -> Result<serde_json::Value, ClientError> {
        self.get("/v1/server").await
    }

    pub(crate) async fn sites(&self) -> Result<Vec<Site>, ClientError> {
        self.all("/v1/sites").await
    }

    pub(crate) async fn create_site(&self, site: &CreateSite) -> Result<Site, ClientError> {
        self.post("/v1/sites", site).await
    }

    /// Sets the position of a site in WGS 84.
    pub(crate) async fn set_site_origin(
        &self,
        site: &SiteId,
        origin: &GeoOrigin,
    ) -> Result<Site, ClientError> {
        let path = format!("/v1/sites/{site}/origin");
        self.send(self.request(Method::PUT, &path).json(origin))
            .await
    }

    /// Removes the position of a site in WGS 84.
    pub(crate) async fn remove_site_origin(&self, site: &SiteId) -> Result<Site, ClientError> {
        self.delete(&format!("/v1/sites/{site}/origin")).await
    }

    /// Lists the robots of a site, with `retired` including retired ones.
    pub(crate) async fn robots(
        &self,
        site: &SiteId,
        retired: bool,
    ) -> Result<Vec<Robot>, ClientError> {
        let query = vec![("retired", retired.to_string())];
        self.all_with(&format!("/v1/sites/{site}/robots"), &query)
            .await
    }

    pub(crate) async fn robot(&self, site: &SiteId, robot: &RobotId) -> Result<Robot, ClientError> {
        self.get(&format!("/v1/sites/{site}/robots/{robot}")).await
    }

    /// Renames, tags, retires or restores a robot.
    pub(crate) async fn update_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
        change: &UpdateRobot,
    ) -> Result<Robot, ClientError> {
        let path = format!("/v1/sites/{site}/robots/{robot}");
        self.send(self.request(Method::PATCH, &path).json(change))
            .await
    }

    /// Releases a robot after a restoration of the server.
    pub(crate) async fn release_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Robot, ClientError> {
        let path = format!("/v1/sites/{site}/robots/{robot}/release");
        self.send(self.request(Method::POST, &path)).await
    }

    /// Opens the event stream of a site, behind the event with the identifier `last` if given.
    pub(crate) async fn events(
        &self,
        site: &SiteId,
        robot: Option<&RobotId>,
        last: Option<&str>,
    ) -> Result<Response, ClientError> {
        let mut query = vec![("site", site.to_string())];
        query.extend(robot.map(|robot| ("robots", robot.to_string())));
        // The stream does not end by itself.
        let mut request = self
            .request(Method::GET, "/v1/events")
            .query(&query)
            .timeout(STREAM_WAIT_MAX);
        if let Some(last) = last {
            request = request.header("last-event-id", last);
        }
        self.answered(request).await
    }
}
