//! A client of the REST API.

use std::io;
use std::net::IpAddr;
use std::path::Path;
use std::time::Duration;

use reqwest::{Certificate, Method, RequestBuilder, Response, StatusCode, Url};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tread_api::enrolment::{CreateJoinToken, CreatedJoinToken, Enrolment, JoinToken};
use tread_api::friction::{CellFriction, TerrainFriction};
use tread_api::identity::{AuditEntry, CreateToken, CreatedToken, Session, Token};
use tread_api::ids::{HolderId, JoinTokenId, MissionId, RobotId, SiteId, TerrainId, TokenId};
use tread_api::mission::{CreateMission, Mission, MissionDetail, ReplaceMission};
use tread_api::page::{PAGE_LIMIT_MAX, Page};
use tread_api::problem::{ProblemBody, ProblemType};
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
    /// A token would go over the network for everybody to read.
    #[error(
        "a token is not sent to {address} without TLS: use https, or an address of this machine"
    )]
    ClearText { address: String },
    /// The certificate to trust is none.
    #[error("cannot trust the certificate in `{file}`")]
    Authority {
        file: String,
        #[source]
        cause: std::io::Error,
    },
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
    /// What answers opens no WebSocket.
    #[error("what answers at {address} opens no connection to drive a robot: is there a proxy?")]
    NoWebSocket { address: String },
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
    if problem.kind == ProblemType::Unauthenticated {
        return format!(
            "{text}: sign in with `tread login`, or give one with --token-file or TREAD_TOKEN"
        );
    }
    match &problem.detail {
        Some(detail) => format!("{text}: {detail}"),
        None => text,
    }
}

/// An address as it is written everywhere.
pub(crate) fn address_of(address: &str) -> &str {
    address.trim_end_matches('/')
}

/// Whether only this machine reads what is sent to a host.
fn is_here(url: &Url) -> bool {
    match url.host_str() {
        Some("localhost") => true,
        Some(host) => {
            let address = host.trim_start_matches('[').trim_end_matches(']');
            address
                .parse()
                .is_ok_and(|address: IpAddr| address.is_loopback())
        }
        None => false,
    }
}

/// A connection to one server.
#[derive(Debug, Clone)]
pub(crate) struct Client {
    address: String,
    token: Option<String>,
    http: reqwest::Client,
}

fn certificates(file: &Path) -> Result<Vec<Certificate>, ClientError> {
    let unusable = |cause| ClientError::Authority {
        file: file.display().to_string(),
        cause,
    };
    let text = std::fs::read(file).map_err(unusable)?;
    let found = Certificate::from_pem_bundle(&text);
    found.map_err(|error| unusable(io::Error::new(io::ErrorKind::InvalidData, error)))
}

impl Client {
    /// A client that shows this token, and trusts this authority instead of the machine's.
    pub(crate) fn new(
        address: &str,
        token: Option<&str>,
        authority: Option<&Path>,
    ) -> Result<Self, ClientError> {
        let invalid = || ClientError::Address {
            address: address.to_owned(),
        };
        let url = Url::parse(address).map_err(|_| invalid())?;
        if !matches!(url.scheme(), "http" | "https") || url.host().is_none() {
            return Err(invalid());
        }
        let is_tls = url.scheme() == "https";
        let address = address_of(address).to_owned();
        if token.is_some() && !is_tls && !is_here(&url) {
            return Err(ClientError::ClearText { address });
        }
        let mut builder = reqwest::Client::builder()
            .timeout(ANSWER_WAIT_MAX)
            .connect_timeout(CONNECT_WAIT_MAX)
            .user_agent(concat!("tread/", env!("CARGO_PKG_VERSION")));
        builder = match authority {
            Some(file) => builder.tls_certs_only(certificates(file)?),
            None if is_tls => builder,
            // Nobody is trusted, so that no machine's certificates need be read.
            None => builder.tls_certs_only([]),
        };
        let http = builder.build().map_err(|cause| ClientError::Unreachable {
            address: address.clone(),
            cause,
        })?;
        let token = token.map(str::to_owned);
        Ok(Self {
            address,
            token,
            http,
        })
    }

    /// The token that is shown.
    pub(crate) fn token(&self) -> Option<&str> {
        self.token.as_deref()
    }

    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    pub(crate) fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.http.request(method, format!("{}{path}", self.address));
        match &self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
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
        Err(self.refusal(response).await)
    }

    /// What an answer that is no success says.
    pub(crate) async fn refusal(&self, response: Response) -> ClientError {
        let (address, status) = (self.address.clone(), response.status());
        let body = match response.bytes().await {
            Ok(body) => body,
            Err(cause) => return ClientError::Unreachable { address, cause },
        };
        match serde_json::from_slice(&body) {
            Ok(problem) => ClientError::Refused { problem },
            Err(cause) => ClientError::NotUnderstood {
                address,
                status,
                cause,
            },
        }
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

    /// Who the token is.
    pub(crate) async fn session(&self) -> Result<Session, ClientError> {
        self.get("/v1/session").await
    }

    pub(crate) async fn tokens(&self) -> Result<Vec<Token>, ClientError> {
        self.all("/v1/tokens").await
    }

    /// Makes a token by which a robot may join.
    pub(crate) async fn create_join_token(
        &self,
        request: &CreateJoinToken,
    ) -> Result<CreatedJoinToken, ClientError> {
        self.post("/v1/join-tokens", request).await
    }

    /// Join tokens, newest first.
    pub(crate) async fn join_tokens(&self) -> Result<Vec<JoinToken>, ClientError> {
        self.all("/v1/join-tokens").await
    }

    /// Revokes a join token.
    pub(crate) async fn revoke_join_token(
        &self,
        id: JoinTokenId,
    ) -> Result<JoinToken, ClientError> {
        let path = format!("/v1/join-tokens/{id}");
        self.send(self.request(Method::DELETE, &path)).await
    }

    /// How the robots of a site stand that have ever joined.
    pub(crate) async fn enrolments(&self, site: &SiteId) -> Result<Vec<Enrolment>, ClientError> {
        self.all(&format!("/v1/sites/{site}/enrolments")).await
    }

    /// Puts a robot out of the fleet.
    pub(crate) async fn revoke_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
    ) -> Result<Enrolment, ClientError> {
        let path = format!("/v1/sites/{site}/enrolments/{robot}");
        self.send(self.request(Method::DELETE, &path)).await
    }

    pub(crate) async fn create_token(
        &self,
        request: &CreateToken,
    ) -> Result<CreatedToken, ClientError> {
        self.post("/v1/tokens", request).await
    }

    pub(crate) async fn revoke_token(&self, token: TokenId) -> Result<Token, ClientError> {
        let path = format!("/v1/tokens/{token}");
        self.send(self.request(Method::DELETE, &path)).await
    }

    /// The newest entries of the audit log, at most `limit`.
    pub(crate) async fn audit(
        &self,
        who: Option<&str>,
        refused: bool,
        limit: u32,
    ) -> Result<Page<AuditEntry>, ClientError> {
        let mut query = vec![
            ("limit", limit.to_string()),
            ("refused", refused.to_string()),
        ];
        query.extend(who.map(|who| ("who", who.to_owned())));
        self.send(self.request(Method::GET, "/v1/audit").query(&query))
            .await
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_goes_over_the_network_only_by_tls() {
        let _first = rustls::crypto::ring::default_provider().install_default();
        let to = |address| Client::new(address, Some("t"), None).map(|_| ());
        for here in [
            "http://127.0.0.1:8420/",
            "http://[::1]:8420",
            "http://localhost:1",
        ] {
            assert!(to(here).is_ok(), "{here}");
        }
        for away in [
            "http://192.0.2.1:8420",
            "http://tread.example",
            "http://localhost.example",
        ] {
            assert!(
                matches!(to(away), Err(ClientError::ClearText { .. })),
                "{away}"
            );
            assert!(Client::new(away, None, None).is_ok());
        }
        assert!(matches!(
            to("ftp://127.0.0.1"),
            Err(ClientError::Address { .. })
        ));
    }
}
