//! A client of the REST API.

use std::time::Duration;

use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tread_api::friction::{CellFriction, TerrainFriction};
use tread_api::ids::{HolderId, MissionId, RobotId, SiteId, TerrainId};
use tread_api::mission::{CreateMission, Mission, MissionDetail, ReplaceMission};
use tread_api::page::{PAGE_LIMIT_MAX, Page};
use tread_api::problem::ProblemBody;
use tread_api::robot::Robot;
use tread_api::safety::{Geofence, LimitStatus, ReplaceGeofence, SetLimit};
use tread_api::stop::{ClearStop, FleetStop, Stop, StopFleet, StopRobot};
use tread_api::terrain::{CreateTerrain, Terrain};
use tread_api::trajectory::{CheckTrajectory, TrajectoryCheck};

/// Longest wait for an answer; planning the longest path takes a while.
const ANSWER_WAIT_MAX: Duration = Duration::from_secs(30);
/// Longest life of one stream of events; then it is opened again where it ended.
const STREAM_WAIT_MAX: Duration = Duration::from_hours(24);
/// Longest wait for a connection.
const CONNECT_WAIT_MAX: Duration = Duration::from_secs(3);
/// Most pages of one list that are followed.
const PAGES_MAX: usize = 100;

/// Why a request got no answer that can be used.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ClientError {
    /// The address is not one.
    #[error("`{address}` is not the address of a server: use one like http://127.0.0.1:8420")]
    Address { address: String },
    /// Nothing answers there.
    #[error(
        "no server answers at {address}: start one with `tread demo` or `tread-server`, or name \
         another with --server"
    )]
    Unreachable {
        address: String,
        #[source]
        cause: reqwest::Error,
    },
    /// The server refused.
    #[error("{}", refusal(.problem))]
    Refused { problem: Box<ProblemBody> },
    /// What answers does not speak this API.
    #[error("what answers at {address} is no Tread server of this version ({status})")]
    NotUnderstood {
        address: String,
        status: StatusCode,
        #[source]
        cause: serde_json::Error,
    },
}

fn refusal(problem: &ProblemBody) -> String {
    let mut text = problem.title.clone();
    if let Some(field) = &problem.field {
        text = format!("{text}, at `{field}`");
    }
    match &problem.detail {
        Some(detail) => format!("{text}: {detail}"),
        None => text,
    }
}

/// A connection to one server.
#[derive(Debug, Clone)]
pub(crate) struct Client {
    address: String,
    http: reqwest::Client,
}

impl Client {
    pub(crate) fn new(address: &str) -> Result<Self, ClientError> {
        let invalid = || ClientError::Address {
            address: address.to_owned(),
        };
        let url = reqwest::Url::parse(address).map_err(|_| invalid())?;
        if url.scheme() != "http" || url.host().is_none() {
            return Err(invalid());
        }
        let address = address.trim_end_matches('/').to_owned();
        let http = reqwest::Client::builder()
            .timeout(ANSWER_WAIT_MAX)
            .connect_timeout(CONNECT_WAIT_MAX)
            .user_agent(concat!("tread/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(|cause| ClientError::Unreachable {
                address: address.clone(),
                cause,
            })?;
        Ok(Self { address, http })
    }

    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.http.request(method, format!("{}{path}", self.address))
    }

    async fn send<T: DeserializeOwned>(&self, request: RequestBuilder) -> Result<T, ClientError> {
        let unreachable = |cause| ClientError::Unreachable {
            address: self.address.clone(),
            cause,
        };
        let response = request.send().await.map_err(unreachable)?;
        let status = response.status();
        let body = response.bytes().await.map_err(unreachable)?;
        let not_understood = |cause| ClientError::NotUnderstood {
            address: self.address.clone(),
            status,
            cause,
        };
        if status.is_success() {
            serde_json::from_slice(&body).map_err(not_understood)
        } else {
            let problem = serde_json::from_slice(&body).map_err(not_understood)?;
            Err(ClientError::Refused {
                problem: Box::new(problem),
            })
        }
    }

    /// Sends what has no answer but that it is done.
    async fn send_for_nothing(&self, request: RequestBuilder) -> Result<(), ClientError> {
        let unreachable = |cause| ClientError::Unreachable {
            address: self.address.clone(),
            cause,
        };
        let response = request.send().await.map_err(unreachable)?;
        let status = response.status();
        if status.is_success() {
            return Ok(());
        }
        let body = response.bytes().await.map_err(unreachable)?;
        let problem =
            serde_json::from_slice(&body).map_err(|cause| ClientError::NotUnderstood {
                address: self.address.clone(),
                status,
                cause,
            })?;
        Err(ClientError::Refused {
            problem: Box::new(problem),
        })
    }

    async fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        self.send(self.request(Method::GET, path)).await
    }

    async fn post<B: Serialize + Sync, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        self.send(self.request(Method::POST, path).json(body)).await
    }

    /// Follows a list to its end, at most [`PAGES_MAX`] pages.
    async fn all<T: DeserializeOwned>(&self, path: &str) -> Result<Vec<T>, ClientError> {
        let mut items = Vec::new();
        let mut cursor: Option<String> = None;
        for _ in 0..PAGES_MAX {
            let mut query = vec![("limit", PAGE_LIMIT_MAX.to_string())];
            query.extend(cursor.map(|cursor| ("cursor", cursor)));
            let page: Page<T> = self
                .send(self.request(Method::GET, path).query(&query))
                .await?;
            items.extend(page.items);
            cursor = page.next_cursor;
            if cursor.is_none() {
                break;
            }
        }
        Ok(items)
    }

    /// Whether the server is ready to work.
    pub(crate) async fn is_ready(&self) -> bool {
        let answer = self.request(Method::GET, "/readyz").send().await;
        answer.is_ok_and(|response| response.status().is_success())
    }

    pub(crate) async fn robots(&self, site: &SiteId) -> Result<Vec<Robot>, ClientError> {
        self.all(&format!("/v1/sites/{site}/robots")).await
    }

    pub(crate) async fn robot(&self, site: &SiteId, robot: &RobotId) -> Result<Robot, ClientError> {
        self.get(&format!("/v1/sites/{site}/robots/{robot}")).await
    }

    pub(crate) async fn terrains(&self, site: &SiteId) -> Result<Vec<Terrain>, ClientError> {
        self.all(&format!("/v1/sites/{site}/terrains")).await
    }

    pub(crate) async fn create_terrain(
        &self,
        site: &SiteId,
        terrain: &CreateTerrain,
    ) -> Result<Terrain, ClientError> {
        self.post(&format!("/v1/sites/{site}/terrains"), terrain)
            .await
    }

    pub(crate) async fn create_mission(
        &self,
        mission: &CreateMission,
    ) -> Result<Mission, ClientError> {
        self.post("/v1/missions", mission).await
    }

    /// The newest missions of a site, at most `limit`.
    pub(crate) async fn missions(
        &self,
        site: &SiteId,
        robot: Option<&RobotId>,
        limit: u32,
    ) -> Result<Page<Mission>, ClientError> {
        let mut query = vec![("site", site.to_string()), ("limit", limit.to_string())];
        query.extend(robot.map(|robot| ("robot", robot.to_string())));
        self.send(self.request(Method::GET, "/v1/missions").query(&query))
            .await
    }

    pub(crate) async fn mission(&self, mission: MissionId) -> Result<MissionDetail, ClientError> {
        self.get(&format!("/v1/missions/{mission}")).await
    }

    /// Wants a mission paused, resumed or cancelled.
    pub(crate) async fn act(&self, mission: MissionId, verb: &str) -> Result<Mission, ClientError> {
        let path = format!("/v1/missions/{mission}/{verb}");
        self.send(self.request(Method::POST, &path)).await
    }

    /// Wants a mission to be another trajectory.
    pub(crate) async fn replace_mission(
        &self,
        mission: MissionId,
        replacement: &ReplaceMission,
    ) -> Result<Mission, ClientError> {
        self.post(&format!("/v1/missions/{mission}/replace"), replacement)
            .await
    }

    /// What a trajectory would ask of its robot.
    pub(crate) async fn check_trajectory(
        &self,
        check: &CheckTrajectory,
    ) -> Result<TrajectoryCheck, ClientError> {
        self.post("/v1/trajectories/check", check).await
    }

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
        self.post(
            &format!("/v1/sites/{site}/robots/{robot}/stop/clear"),
            clear,
        )
        .await
    }

    pub(crate) async fn limits(
        &self,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Page<LimitStatus>, ClientError> {
        self.get(&format!("/v1/sites/{site}/robots/{robot}/limits"))
            .await
    }

    /// Sets a holder's limit, or ends it.
    pub(crate) async fn change_limit(
        &self,
        site: &SiteId,
        robot: &RobotId,
        holder: &HolderId,
        limit: Option<&SetLimit>,
    ) -> Result<(), ClientError> {
        let path = format!("/v1/sites/{site}/robots/{robot}/limits/{holder}");
        let request = match limit {
            Some(limit) => self.request(Method::PUT, &path).json(limit),
            None => self.request(Method::DELETE, &path),
        };
        self.send_for_nothing(request).await
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

    /// Opens the stream of events of a site, from where `last` points.
    pub(crate) async fn events(
        &self,
        site: &SiteId,
        robot: Option<&RobotId>,
        last: Option<&str>,
    ) -> Result<Response, ClientError> {
        let mut query = vec![
            ("site", site.to_string()),
            ("topics", "robots,missions".to_owned()),
        ];
        query.extend(robot.map(|robot| ("robots", robot.to_string())));
        // The stream has no end of its own.
        let mut request = self
            .request(Method::GET, "/v1/events")
            .query(&query)
            .timeout(STREAM_WAIT_MAX);
        if let Some(last) = last {
            request = request.header("last-event-id", last);
        }
        let unreachable = |cause| ClientError::Unreachable {
            address: self.address.clone(),
            cause,
        };
        let response = request.send().await.map_err(unreachable)?;
        let status = response.status();
        if status.is_success() {
            return Ok(response);
        }
        let body = response.bytes().await.map_err(unreachable)?;
        let problem =
            serde_json::from_slice(&body).map_err(|cause| ClientError::NotUnderstood {
                address: self.address.clone(),
                status,
                cause,
            })?;
        Err(ClientError::Refused {
            problem: Box::new(problem),
        })
    }

    pub(crate) async fn terrain_friction(
        &self,
        site: &SiteId,
        terrain: Option<&TerrainId>,
    ) -> Result<Vec<TerrainFriction>, ClientError> {
        let path = format!("/v1/sites/{site}/friction/terrains");
        match terrain {
            Some(terrain) => Ok(vec![self.get(&format!("{path}/{terrain}")).await?]),
            None => self.all(&path).await,
        }
    }

    pub(crate) async fn cell_friction(
        &self,
        site: &SiteId,
    ) -> Result<Vec<CellFriction>, ClientError> {
        self.all(&format!("/v1/sites/{site}/friction/cells")).await
    }
}
