//! The REST API as any client speaks it.

use reqwest::header::{AUTHORIZATION, HeaderValue};
use reqwest::{Method, StatusCode};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::{MissionDetail, MissionState};
use tread_api::page::Page;
use tread_api::problem::ProblemType;
use tread_api::robot::Robot;

use crate::wait::eventually;

/// Entries asked for in one page.
const PAGE_LIMIT: usize = 1_000;

/// A client of one server.
#[derive(Debug, Clone)]
pub struct Rest {
    address: String,
    http: reqwest::Client,
}

impl Rest {
    /// A client of the server at `address`, such as `http://127.0.0.1:8420`, that shows this
    /// token.
    ///
    /// # Panics
    /// If no client can be made.
    pub fn new(address: String, token: &str) -> Self {
        // The first call counts; all install the same.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let bearer = HeaderValue::try_from(format!("Bearer {token}")).expect("a token is text");
        let http = reqwest::Client::builder()
            .default_headers([(AUTHORIZATION, bearer)].into_iter().collect())
            .tls_certs_only([])
            .build()
            .expect("a client needs nothing of the machine");
        Self { address, http }
    }

    /// The same client of a server at another address.
    #[must_use]
    pub fn at(&self, address: String) -> Self {
        let http = self.http.clone();
        Self { address, http }
    }

    /// Sends a request and returns status and body; `None` if nobody answers.
    pub async fn call(
        &self,
        method: Method,
        path: &str,
        body: Option<&Value>,
    ) -> Option<(StatusCode, Value)> {
        let request = self.http.request(method, format!("{}{path}", self.address));
        let request = match body {
            Some(body) => request.json(body),
            None => request,
        };
        let response = request.send().await.ok()?;
        let status = response.status();
        let text = response.text().await.ok()?;
        Some((
            status,
            serde_json::from_str(&text).unwrap_or(Value::String(text)),
        ))
    }

    /// Reads the body of a successful answer as it is; `None` if there is none.
    pub async fn bytes(&self, path: &str) -> Option<Vec<u8>> {
        let request = self.http.get(format!("{}{path}", self.address));
        let response = request.send().await.ok()?.error_for_status().ok()?;
        Some(response.bytes().await.ok()?.to_vec())
    }

    /// Reads something that must be there.
    ///
    /// # Panics
    /// If it is not there, or not what was expected.
    pub async fn get<T: DeserializeOwned>(&self, path: &str) -> T {
        let (status, body) = self
            .call(Method::GET, path, None)
            .await
            .expect("the server answers");
        assert!(status.is_success(), "GET {path}: {status} {body}");
        let text = body.to_string();
        serde_json::from_value(body).unwrap_or_else(|error| panic!("GET {path}: {error}: {text}"))
    }

    /// Posts something that must be taken.
    ///
    /// # Panics
    /// If it is refused.
    pub async fn post(&self, path: &str, body: &Value) -> Value {
        let answer = self.call(Method::POST, path, Some(body)).await;
        let (status, answer) = answer.expect("the server answers");
        assert!(status.is_success(), "POST {path}: {status} {answer}");
        answer
    }

    /// Posts something that must be refused with a problem of this kind.
    ///
    /// # Panics
    /// If it is taken, or refused for another reason.
    pub async fn post_refused(&self, path: &str, body: &Value, kind: ProblemType) -> Value {
        let answer = self.call(Method::POST, path, Some(body)).await;
        let (status, answer) = answer.expect("the server answers");
        assert!(status.is_client_error(), "POST {path}: {status} {answer}");
        assert_eq!(answer["type"], json!(kind), "POST {path}: {answer}");
        answer
    }

    /// Posts a text as it is, with the media type of JSON.
    ///
    /// # Panics
    /// If nobody answers.
    pub async fn post_text(&self, path: &str, text: &str) -> (StatusCode, Value) {
        let request = self.http.post(format!("{}{path}", self.address));
        answer(
            request
                .header("content-type", "application/json")
                .body(text.to_owned()),
        )
        .await
    }

    /// Posts a text without a media type.
    ///
    /// # Panics
    /// If nobody answers.
    pub async fn post_without_type(&self, path: &str, text: &str) -> (StatusCode, Value) {
        let request = self.http.post(format!("{}{path}", self.address));
        answer(request.body(text.to_owned())).await
    }

    /// Every entry of a list.
    pub async fn all<T: DeserializeOwned>(&self, path: &str) -> Vec<T> {
        let joint = if path.contains('?') { '&' } else { '?' };
        let mut items = Vec::new();
        let mut cursor: Option<String> = None;
        loop {
            let from = cursor
                .map(|cursor| format!("&cursor={cursor}"))
                .unwrap_or_default();
            let page: Page<T> = self
                .get(&format!("{path}{joint}limit={PAGE_LIMIT}{from}"))
                .await;
            items.extend(page.items);
            cursor = page.next_cursor;
            if cursor.is_none() {
                return items;
            }
        }
    }

    /// One robot.
    pub async fn robot(&self, robot: &RobotId) -> Option<Robot> {
        let path = format!("/v1/sites/{}/robots/{robot}", crate::fleet::SITE);
        let (status, body) = self.call(Method::GET, &path, None).await?;
        status
            .is_success()
            .then(|| serde_json::from_value(body).expect("a robot"))
    }

    /// Creates a mission.
    pub async fn send(&self, robot: &RobotId, trajectory: Value) -> MissionId {
        let body = json!({"site": crate::fleet::SITE, "robot": robot, "trajectory": trajectory});
        let mission = self.post("/v1/missions", &body).await;
        serde_json::from_value(mission["id"].clone()).expect("a mission has an id")
    }

    /// A mission with its history.
    pub async fn mission(&self, mission: MissionId) -> MissionDetail {
        self.get(&format!("/v1/missions/{mission}")).await
    }

    /// Waits until a mission is in one of these states; a server that is away is waited for.
    pub async fn mission_reaches(
        &self,
        mission: MissionId,
        states: &[MissionState],
        bound: std::time::Duration,
    ) -> MissionDetail {
        let path = format!("/v1/missions/{mission}");
        let look = || async {
            let (_, body) = self.call(Method::GET, &path, None).await?;
            serde_json::from_value::<MissionDetail>(body).ok()
        };
        let what = format!("mission {mission} is one of {states:?}");
        let reached = |detail: &Option<MissionDetail>| {
            detail
                .as_ref()
                .is_some_and(|detail| states.contains(&detail.mission.state))
        };
        eventually(&what, bound, look, reached)
            .await
            .expect("it was seen")
    }
}

async fn answer(request: reqwest::RequestBuilder) -> (StatusCode, Value) {
    let response = request.send().await.expect("the server answers");
    let status = response.status();
    (status, response.json().await.expect("every answer is JSON"))
}
