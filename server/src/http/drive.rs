//! `GET /v1/sites/{site}/robots/{robot}/drive`: a WebSocket to watch a robot and to drive it.
//!
//! One JSON object in each text frame ([`DriveRequest`] in, [`DriveUpdate`] out). Any other frame
//! closes the socket with a code, and stops the robot if the socket has its lease:
//!
//! | code | |
//! |---|---|
//! | 1001 | the server is shutting down |
//! | 1003 | a binary frame |
//! | 1007 | a text frame that is not JSON |
//! | 1008 | JSON that is not a `DriveRequest`, missing pongs, or a token that has ended |
//! | 1009 | a frame above [`DRIVE_FRAME_MAX`] bytes |

use std::error::Error as _;
use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::extract::State;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::response::Response;
use futures_util::FutureExt as _;
use serde_json::Value;
use tokio::time::{Instant, MissedTickBehavior};
use tokio_util::sync::CancellationToken;
use tread_api::drive::{
    self, DRIVE_FRAME_MAX, DRIVE_VIEW_PERIOD_MS, Drive, DriveRefusal, DriveRequest, DriveUpdate,
    ReleaseCause,
};
use tread_api::ids::{RobotId, SiteId};
use tread_api::problem::{ProblemBody, ProblemType};
use tread_api::rights::Right;
use tread_api::stop::STOP_TEXT_MAX;
use tread_api::text::cleaned;

use super::extract::{Path, parse_frame};
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;
use crate::app::identity::Credential;
use crate::app::stops::StopReason;
use crate::app::teleop::{Refused, Session};
use crate::connections::Slot;

/// Interval between two pings.
const PING_PERIOD: Duration = Duration::from_secs(1);
/// Maximum time without any frame from a client, not even a pong; beyond it the socket counts as
/// lost.
const SILENCE_MAX: Duration = Duration::from_secs(3);
/// Maximum time for sending a frame; a client that does not read is lost.
const SEND_MAX: Duration = Duration::from_secs(1);
/// Maximum time that a socket closed by the server waits for its client to close it too.
const GOODBYE_MAX: Duration = Duration::from_millis(500);
/// Maximum number of frames read before they are processed, so that the newest drive command
/// counts.
const DRAIN_MAX: usize = 64;
/// Minimum interval between two refusals of drive commands for the same cause: a driver sends many.
const REFUSAL_PERIOD: Duration = Duration::from_millis(500);

/// Watch and drive a robot over a WebSocket.
///
/// Each text frame holds one JSON object: `DriveRequest` from the client, `DriveUpdate` from the
/// server. A client with the right `read` may watch and stop the robot; driving requires the right
/// `drive`.
#[utoipa::path(get, path = "/v1/sites/{site}/robots/{robot}/drive", tag = "safety",
    security(("token" = ["read"])),
    operation_id = "drive_robot", params(("site" = SiteId, Path), ("robot" = RobotId, Path)),
    responses((status = 101, description = "The frames of the socket", body = DriveUpdate),
        (status = 400, body = ProblemBody), (status = 404, body = ProblemBody),
        (status = 409, body = ProblemBody)))]
pub(super) async fn drive(
    State(app): State<App>,
    Subject(subject): Subject,
    place: Option<Extension<Arc<Slot>>>,
    Path((site, robot)): Path<(SiteId, RobotId)>,
    upgrade: Result<WebSocketUpgrade, axum::extract::ws::rejection::WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let upgrade = upgrade.map_err(|rejection| {
        Problem::new(ProblemType::InvalidHeader)
            .detail(format!("this is a WebSocket: {}", rejection.body_text()))
    })?;
    let session = app.begin_drive(&site, &robot).await?;
    let slot = app.drive_slot(&subject)?;
    // A socket is never closed as an idle connection in favour of new ones.
    let at_work = place.map(|Extension(place)| place.hold());
    let stop = session.stop_token();
    let upgrade = upgrade
        .max_frame_size(DRIVE_FRAME_MAX)
        .max_message_size(DRIVE_FRAME_MAX);
    Ok(upgrade.on_upgrade(move |socket| async move {
        let mut connection = Connection {
            app,
            socket,
            session,
            subject,
            robot: (site, robot),
            last_message_at: Instant::now(),
            ping_due: Instant::now(),
            pinged_at: None,
            socket_delay: None,
            refused_at: None,
        };
        let end = connection.run(&stop).await;
        connection.end(end).await;
        drop((slot, at_work));
    }))
}

/// Reason why a socket ends.
enum End {
    /// The client closed it, or the connection is lost.
    Gone,
    /// The server closes it.
    Closed { code: u16, detail: String },
}

struct Connection {
    app: App,
    socket: WebSocket,
    session: Session,
    subject: Arc<Credential>,
    robot: (SiteId, RobotId),
    last_message_at: Instant,
    ping_due: Instant,
    /// Time of the ping that is not answered yet.
    pinged_at: Option<Instant>,
    /// Round-trip time to the client, from the last pong.
    socket_delay: Option<Duration>,
    refused_at: Option<(DriveRefusal, Instant)>,
}

impl Connection {
    async fn run(&mut self, stop: &CancellationToken) -> End {
        let client = self.session.client();
        if let Err(end) = self.send(&DriveUpdate::Welcome { client }).await {
            return end;
        }
        let mut views = tokio::time::interval(Duration::from_millis(DRIVE_VIEW_PERIOD_MS));
        views.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let ended = self.subject.ended();
        loop {
            let processed = tokio::select! {
                biased;
                () = stop.cancelled() => Err(End::Closed {
                    code: close_code::AWAY,
                    detail: "the server is shutting down".to_owned(),
                }),
                () = ended.cancelled() => Err(signed_out()),
                frame = self.socket.recv() => self.receive(frame).await,
                _ = views.tick() => self.show().await,
            };
            if let Err(end) = processed {
                return end;
            }
        }
    }

    /// Reads the waiting frames and processes them; of consecutive drive commands only the last
    /// counts.
    async fn receive(&mut self, frame: Option<Result<Message, axum::Error>>) -> Result<(), End> {
        let mut requests = Vec::new();
        let mut next = Some(frame);
        let mut refused = None;
        while let Some(frame) = next {
            match self.read(frame) {
                Ok(request) => requests.extend(request),
                Err(end) => {
                    refused = Some(end);
                    break;
                }
            }
            next = if requests.len() < DRAIN_MAX {
                self.socket.recv().now_or_never()
            } else {
                None
            };
        }
        if let Some(End::Closed { .. }) = refused {
            // Drive commands received with an invalid frame are dropped.
            requests.retain(|request| matches!(request, DriveRequest::Stop(_)));
        }
        let newer: Vec<bool> = requests
            .iter()
            .skip(1)
            .map(|request| matches!(request, DriveRequest::Drive(_)))
            .chain([false])
            .collect();
        for (request, newer) in requests.into_iter().zip(newer) {
            match request {
                DriveRequest::Drive(_) if newer => {
                    self.app.counters().drive_commands_replaced.one();
                }
                DriveRequest::Drive(drive) => self.drive(drive).await?,
                DriveRequest::Acquire(driver) => self.acquire(&driver.name, false).await?,
                DriveRequest::Take(driver) => self.acquire(&driver.name, true).await?,
                DriveRequest::Release(_) => self.release().await?,
                DriveRequest::Stop(words) => {
                    let words = StopReason {
                        by: Some(self.subject.author(words.by.as_deref())),
                        reason: words.reason,
                    };
                    self.stop(words).await?;
                }
            }
        }
        refused.map_or(Ok(()), Err)
    }

    fn read(
        &mut self,
        frame: Option<Result<Message, axum::Error>>,
    ) -> Result<Option<DriveRequest>, End> {
        let refused = |code, detail: String| {
            self.app.counters().drive_frames_refused.one();
            Err(End::Closed { code, detail })
        };
        let message = match frame {
            None => return Err(End::Gone),
            Some(Ok(message)) => message,
            Some(Err(error)) => {
                return fault(&error)
                    .map_or(Err(End::Gone), |(code, detail)| refused(code, detail));
            }
        };
        self.last_message_at = Instant::now();
        match message {
            Message::Text(text) => match parse_frame(&text) {
                Ok(request) => Ok(Some(request)),
                Err(error) => {
                    if let Some(words) = stop_of(&text) {
                        return Ok(Some(DriveRequest::Stop(words)));
                    }
                    // The parser reports an unknown variant as a syntax error.
                    let is_json = serde_json::from_str::<serde::de::IgnoredAny>(&text).is_ok();
                    let code = if is_json {
                        close_code::POLICY
                    } else {
                        close_code::INVALID
                    };
                    refused(code, error.to_string())
                }
            },
            Message::Binary(_) => {
                let detail = "send JSON in text frames".to_owned();
                refused(close_code::UNSUPPORTED, detail)
            }
            Message::Pong(_) => {
                self.socket_delay = self.pinged_at.take().map(|at| at.elapsed());
                Ok(None)
            }
            Message::Ping(_) => Ok(None),
            Message::Close(_) => Err(End::Gone),
        }
    }

    async fn acquire(&mut self, name: &str, take: bool) -> Result<(), End> {
        let (site, robot) = &self.robot;
        if !self.subject.may_at(Right::Drive, site, robot) {
            let refused = DriveUpdate::Refused {
                cause: DriveRefusal::Forbidden,
                detail: "driving requires a token with the right `drive`".to_owned(),
            };
            return self.send(&refused).await;
        }
        let name = match name.trim() {
            "" => String::new(),
            name => self.subject.author(Some(name)),
        };
        let update = match self.session.acquire(&name, take).await {
            Ok(lease) => DriveUpdate::Leased(lease),
            Err(Refused { cause, detail }) => DriveUpdate::Refused { cause, detail },
        };
        self.send(&update).await
    }

    async fn release(&mut self) -> Result<(), End> {
        if self.session.release() {
            let released = DriveUpdate::Released {
                cause: ReleaseCause::Released,
                detail: "given back".to_owned(),
            };
            return self.send(&released).await;
        }
        Ok(())
    }

    async fn drive(&mut self, drive: Drive) -> Result<(), End> {
        let Err(Refused { cause, detail }) = self.session.drive(drive) else {
            return Ok(());
        };
        let is_repeated = self
            .refused_at
            .is_some_and(|(last, at)| last == cause && at.elapsed() < REFUSAL_PERIOD);
        if is_repeated {
            return Ok(());
        }
        self.refused_at = Some((cause, Instant::now()));
        self.send(&DriveUpdate::Refused { cause, detail }).await
    }

    async fn stop(&mut self, words: StopReason) -> Result<(), End> {
        let update = match self.session.stop(words).await {
            Ok(stop) => DriveUpdate::Stopped(Box::new(stop)),
            Err(error) => DriveUpdate::Refused {
                cause: DriveRefusal::Unreachable,
                detail: error.to_string(),
            },
        };
        self.send(&update).await
    }

    /// Sends the robot's state and pings, and checks that the lease and the client are still there.
    async fn show(&mut self) -> Result<(), End> {
        if self.last_message_at.elapsed() > SILENCE_MAX {
            return Err(End::Closed {
                code: close_code::POLICY,
                detail: "the server received no frame on this socket, not even a pong".to_owned(),
            });
        }
        if self.app.clock().now() >= self.subject.expires_at {
            return Err(signed_out());
        }
        if let Some((cause, detail)) = self.session.lost_lease() {
            self.send(&DriveUpdate::Released { cause, detail }).await?;
        }
        let now = Instant::now();
        if now >= self.ping_due {
            self.ping_due = now + PING_PERIOD;
            self.pinged_at = Some(now);
            self.put(Message::Ping(Vec::new().into())).await?;
        }
        let view = self.session.view(self.socket_delay);
        self.send(&DriveUpdate::View(Box::new(view))).await
    }

    async fn send(&mut self, update: &DriveUpdate) -> Result<(), End> {
        let text = serde_json::to_string(update).unwrap_or_default();
        self.put(Message::Text(text.into())).await
    }

    async fn put(&mut self, message: Message) -> Result<(), End> {
        match tokio::time::timeout(SEND_MAX, self.socket.send(message)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) | Err(_) => Err(End::Gone),
        }
    }

    /// Commands the robot to stop first, then sends the reason and closes the socket.
    async fn end(mut self, end: End) {
        self.session.end();
        if let End::Closed { code, detail } = end {
            let update = DriveUpdate::Ended {
                detail: detail.clone(),
            };
            if self.send(&update).await.is_ok() {
                // A reason has at most 123 bytes.
                let reason: String = detail.chars().filter(char::is_ascii).take(120).collect();
                let frame = CloseFrame {
                    code,
                    reason: reason.into(),
                };
                // A client that is gone needs no reason.
                if self.put(Message::Close(Some(frame))).await.is_ok() {
                    self.wait_until_closed().await;
                }
            }
        }
    }

    /// Keeps the socket open until the client has closed it too: a client that writes into a closed
    /// socket never reads the reason.
    async fn wait_until_closed(&mut self) {
        let answered = async {
            loop {
                match self.socket.recv().await {
                    Some(Ok(Message::Close(_))) => return,
                    Some(Ok(_)) => {}
                    // After a frame that could not be read nothing more can be read.
                    Some(Err(_)) | None => std::future::pending().await,
                }
            }
        };
        // Whether it was read does not matter any more.
        let _ = tokio::time::timeout(GOODBYE_MAX, answered).await;
    }
}

/// Parses what it can of a frame that requests a stop: a stop is not refused for its other content.
fn stop_of(text: &str) -> Option<drive::StopReason> {
    let frame: serde_json::Map<String, Value> = serde_json::from_str(text).ok()?;
    let words = frame.get("stop")?;
    let text = |field: &str| {
        let text = words.get(field)?.as_str()?;
        Some(cleaned(text, STOP_TEXT_MAX))
    };
    Some(drive::StopReason {
        by: text("by"),
        reason: text("reason"),
    })
}

fn signed_out() -> End {
    End::Closed {
        code: close_code::POLICY,
        detail: "the token or session has ended".to_owned(),
    }
}

/// Returns the close code and text for a client's error; `None` if the connection is lost.
fn fault(error: &axum::Error) -> Option<(u16, String)> {
    use tokio_tungstenite::tungstenite::Error;
    let cause = error.source()?.downcast_ref::<Error>()?;
    if let Error::Capacity(_) = cause {
        let detail = format!("a frame may have at most {DRIVE_FRAME_MAX} bytes");
        Some((close_code::SIZE, detail))
    } else if let Error::Utf8(_) = cause {
        Some((close_code::INVALID, "a text frame must be UTF-8".to_owned()))
    } else if let Error::Protocol(broken) = cause {
        Some((close_code::PROTOCOL, broken.to_string()))
    } else {
        None
    }
}
