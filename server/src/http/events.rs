//! `GET /v1/events`: server-sent events.

use std::collections::HashSet;
use std::convert::Infallible;
use std::str::FromStr;

use axum::Extension;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use serde::Deserialize;
use tokio_util::sync::CancellationToken;
use tread_api::event::{self, Topic};
use tread_api::ids::SiteId;
use tread_api::problem::{ProblemBody, ProblemType};
use utoipa::IntoParams;

use super::extract::Query;
use super::problem::Problem;
use super::subject::Subject;
use crate::app::App;
use crate::app::events::{EventFilter, Subscription};
use crate::app::identity::Credential;
use crate::app::shares::Place;

/// Cuts the connection that a request came on.
#[derive(Debug, Clone, Default)]
pub(in crate::http) struct Cut(pub(in crate::http) CancellationToken);

/// Query parameters of the stream of events.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct EventQuery {
    /// Only these topics, separated by commas: `missions`, `robots`, `alerts`, `map`.
    topics: Option<String>,
    /// Only events of this site.
    site: Option<SiteId>,
    /// Only events of these robots, separated by commas.
    robots: Option<String>,
}

/// Stream events.
///
/// The stream starts with a snapshot, or with the events after the one that `Last-Event-ID` names.
#[utoipa::path(get, path = "/v1/events", tag = "events", operation_id = "stream_events",
    security(("token" = ["read"])),
    params(EventQuery, ("last-event-id" = Option<String>, Header,
        description = "Identifier of the last event that the client has read")),
    responses((status = 200, content_type = "text/event-stream", body = event::Event),
        (status = 400, body = ProblemBody), (status = 409, body = ProblemBody)))]
pub(super) async fn stream(
    State(app): State<App>,
    Subject(subject): Subject,
    cut: Option<Extension<Cut>>,
    Query(query): Query<EventQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let filter = filter(&app, &subject, query).await?;
    let last = headers.get("last-event-id");
    let last = last.and_then(|last| last.to_str().ok());
    let cut = cut.map(|Extension(cut)| cut.0).unwrap_or_default();
    let place = app.event_place(&subject)?;
    let subscription = app.subscribe(filter, last, cut).await?;
    let client = (subscription, place);
    let events = stream::unfold(client, async |client: (Subscription, Place)| {
        let (mut subscription, place) = client;
        let sent = subscription.next().await?;
        let mut event = Event::default().event(sent.name).data(&*sent.text);
        if let Some(id) = &sent.id {
            event = event.id(id);
        }
        Some((Ok::<_, Infallible>(event), (subscription, place)))
    });
    let events = Sse::new(events).keep_alive(KeepAlive::default());
    Ok(events.into_response())
}

async fn filter(
    app: &App,
    subject: &Credential,
    query: EventQuery,
) -> Result<EventFilter, Problem> {
    let refused = |field: &str, detail: String| {
        Problem::new(ProblemType::InvalidQuery)
            .detail(detail)
            .field(field)
    };
    let topics = listed("topics", query.topics.as_deref(), |name| {
        let known: Vec<&str> = Topic::ALL.map(Topic::as_str).into();
        Topic::from_name(name).ok_or_else(|| {
            let known = known.join("`, `");
            format!("`{}` is not a topic; the topics are `{known}`", short(name))
        })
    })?;
    let robots = listed("robots", query.robots.as_deref(), |name| {
        FromStr::from_str(name).map_err(|error: tread_api::ids::InvalidSlug| error.to_string())
    })?;
    let filter = EventFilter {
        topics,
        site: query.site.or_else(|| subject.scope.only_site().cloned()),
        robots,
        within: subject.scope.clone(),
    };
    match app.unknown_in(&filter).await? {
        Some((field, name)) => Err(refused(
            field,
            format!("`{name}` is unknown, or outside the scope of the token"),
        )),
        None => Ok(filter),
    }
}

fn listed<T: Eq + std::hash::Hash>(
    field: &str,
    text: Option<&str>,
    read: impl Fn(&str) -> Result<T, String>,
) -> Result<HashSet<T>, Problem> {
    let names = text.map(|text| text.split(',').map(str::trim));
    let Some(names) = names else {
        return Ok(HashSet::new());
    };
    names
        .map(|name| {
            read(name).map_err(|detail| {
                Problem::new(ProblemType::InvalidQuery)
                    .detail(detail)
                    .field(field)
            })
        })
        .collect()
}

fn short(name: &str) -> String {
    name.chars().take(80).collect()
}
