//! Sends traces of missions in the OpenTelemetry format to a collector, by OTLP over HTTP.
//!
//! It sends nothing unless `[tracing]` names an endpoint. A separate thread sends the spans from a
//! bounded queue. If the collector is away, spans are lost; missions are not affected.
//!
//! ```text
//! mission ────────────────────────────────────────── server, when it has ended
//! ├─ store ──────── server, from the request to the commit
//! ├─ offer ──────── server, each attempt
//! │  ├─ plan ────── agent
//! │  └─ drive ───── agent, from start to end
//! ```
//!
//! [`log_filter()`] gives the filter of the log, with the same levels of libraries in both programs.

mod client;
mod log_filter;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use jiff::Timestamp;
use opentelemetry::trace::{
    SpanContext, SpanId, SpanKind, Status, TraceFlags, TraceId, TraceState,
};
use opentelemetry::{InstrumentationScope, KeyValue};
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig as _, WithHttpConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{
    BatchConfigBuilder, BatchSpanProcessor, SpanData, SpanEvents, SpanLinks, SpanProcessor as _,
};
use reqwest::Url;
use serde::Deserialize;
use tread_api::ids::MissionId;
use tread_api::wire::trace::TraceParent;
use uuid::Uuid;

use self::client::Client;
pub use self::log_filter::{LOG_FILTER_DEFAULT, log_filter};

/// Maximum number of spans in the queue; further spans are dropped.
const SPANS_WAITING_MAX: usize = 2_048;
/// Maximum number of spans of one request.
const BATCH_SPANS_MAX: usize = 256;
/// Interval between two requests.
const SEND_EVERY: Duration = Duration::from_secs(1);
/// Maximum time for a request.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time to send the last spans when the program stops.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum number of missions whose place in the trace is kept.
const OPEN_MAX: usize = 16;

/// `[tracing]`: the collector that receives the traces.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TracingConfig {
    /// URL of the collector's OTLP/HTTP endpoint for traces, such as
    /// `http://127.0.0.1:4318/v1/traces`; without it no traces are sent.
    pub endpoint: Option<String>,
}

/// Reason why traces cannot be sent.
#[derive(Debug, thiserror::Error)]
pub enum TelemetryError {
    /// The endpoint is no URL.
    #[error(
        "`tracing.endpoint` is `{0}`, and must be the URL of an OTLP/HTTP endpoint for traces, such \
         as http://127.0.0.1:4318/v1/traces"
    )]
    Endpoint(String),
    /// The HTTP client could not be created.
    #[error("the client for `tracing.endpoint` cannot be made")]
    Client(#[source] reqwest::Error),
    /// The exporter could not be created.
    #[error("the exporter for `tracing.endpoint` cannot be made: {0}")]
    Exporter(String),
}

impl TracingConfig {
    /// Checks the endpoint.
    ///
    /// # Errors
    /// [`TelemetryError::Endpoint`].
    pub fn check(&self) -> Result<(), TelemetryError> {
        let Some(endpoint) = &self.endpoint else {
            return Ok(());
        };
        let is_valid = Url::parse(endpoint)
            .is_ok_and(|url| matches!(url.scheme(), "http" | "https") && url.has_host());
        if is_valid {
            return Ok(());
        }
        Err(TelemetryError::Endpoint(endpoint.clone()))
    }
}

/// Sends spans; clones share the queue. Without an endpoint it does nothing.
#[derive(Debug, Clone, Default)]
pub struct Telemetry {
    inner: Option<Arc<Inner>>,
}

#[derive(Debug)]
struct Inner {
    processor: BatchSpanProcessor,
    scope: InstrumentationScope,
    open: Mutex<VecDeque<Open>>,
}

/// A mission that has not ended, with its place in the trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Open {
    mission: MissionId,
    /// Parent of its further spans.
    pub parent: TraceParent,
    /// Time at which the robot began to drive it; `None` before that.
    pub began_at: Option<Timestamp>,
}

/// A span that has ended.
#[derive(Debug, Clone)]
pub struct Span {
    /// Its name.
    pub name: &'static str,
    /// Its trace, and its parent; `None` for the root, whose identifier the trace gives.
    pub place: Place,
    /// Time of its begin.
    pub began_at: Timestamp,
    /// Time of its end, not before its begin.
    pub ended_at: Timestamp,
    /// Attributes, which have the same names as fields of the log.
    pub attributes: Vec<(&'static str, String)>,
    /// Reason of its failure, if it failed.
    pub failure: Option<String>,
}

/// Place of a span in its trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// The root span of a trace.
    Root(TraceParent),
    /// A span with this identifier, below a parent.
    Below {
        /// The trace, with the parent.
        parent: TraceParent,
        /// Identifier of the span itself.
        span_id: u64,
    },
}

impl Place {
    /// Returns the place of a new span below a parent.
    pub fn below(parent: TraceParent) -> Self {
        // A UUID of version 4 is never zero.
        let span_id = Uuid::new_v4().as_u64_pair().0;
        Self::Below { parent, span_id }
    }

    /// Returns the trace context for children of the span.
    pub fn context(self) -> TraceParent {
        match self {
            Self::Root(root) => root,
            Self::Below { parent, span_id } => parent.with_span(span_id),
        }
    }
}

impl Telemetry {
    /// Starts to send to the collector; does nothing without an endpoint. Call it within a tokio
    /// runtime, because the client sends on that runtime.
    ///
    /// # Errors
    /// [`TelemetryError`]: the endpoint is no URL, or no client can be made.
    pub fn start(config: &TracingConfig, service: &'static str) -> Result<Self, TelemetryError> {
        config.check()?;
        let Some(endpoint) = &config.endpoint else {
            return Ok(Self::default());
        };
        let client = Client::new(REQUEST_TIMEOUT).map_err(TelemetryError::Client)?;
        let exporter = SpanExporter::builder()
            .with_http()
            .with_http_client(client)
            .with_endpoint(endpoint)
            .with_protocol(Protocol::HttpBinary)
            .with_timeout(REQUEST_TIMEOUT)
            .build()
            .map_err(|error| TelemetryError::Exporter(error.to_string()))?;
        let batches = BatchConfigBuilder::default()
            .with_max_queue_size(SPANS_WAITING_MAX)
            .with_max_export_batch_size(BATCH_SPANS_MAX)
            .with_scheduled_delay(SEND_EVERY)
            .build();
        let mut processor = BatchSpanProcessor::new(exporter, batches);
        let version = KeyValue::new("service.version", env!("CARGO_PKG_VERSION"));
        let resource = Resource::builder_empty()
            .with_service_name(service)
            .with_attribute(version)
            .build();
        processor.set_resource(&resource);
        Ok(Self {
            inner: Some(Arc::new(Inner {
                processor,
                scope: InstrumentationScope::builder("tread").build(),
                open: Mutex::default(),
            })),
        })
    }

    /// Returns whether spans are sent.
    pub fn is_on(&self) -> bool {
        self.inner.is_some()
    }

    /// Puts a span into the queue, without waiting.
    pub fn send(&self, span: Span) {
        if let Some(inner) = &self.inner {
            inner.processor.on_end(data(span, inner.scope.clone()));
        }
    }

    /// Keeps the parent of a mission's further spans.
    pub fn remember(&self, mission: MissionId, parent: TraceParent) {
        let began_at = self.open(mission).began_at;
        self.keep(Open {
            mission,
            parent,
            began_at,
        });
    }

    /// Keeps the time at which the robot began to drive a mission.
    pub fn began(&self, mission: MissionId, at: Timestamp) {
        self.keep(Open {
            began_at: Some(at),
            ..self.open(mission)
        });
    }

    fn keep(&self, open: Open) {
        let Some(inner) = &self.inner else { return };
        let mut kept = inner.open.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|known| known.mission != open.mission);
        kept.push_back(open);
        if kept.len() > OPEN_MAX {
            kept.pop_front();
        }
    }

    /// Returns the kept place of a mission, or the root of its trace if none is kept.
    pub fn open(&self, mission: MissionId) -> Open {
        let unknown = Open {
            mission,
            parent: TraceParent::of_mission(mission),
            began_at: None,
        };
        let Some(inner) = &self.inner else {
            return unknown;
        };
        let kept = inner.open.lock().unwrap_or_else(PoisonError::into_inner);
        let found = kept.iter().find(|known| known.mission == mission);
        found.copied().unwrap_or(unknown)
    }

    /// Sends the spans in the queue, and ends. Blocks for at most two seconds.
    pub fn stop(&self) {
        if let Some(inner) = &self.inner
            && let Err(error) = inner.processor.shutdown_with_timeout(STOP_TIMEOUT)
        {
            tracing::warn!("the last traces were not sent: {error}");
        }
    }
}

fn data(span: Span, scope: InstrumentationScope) -> SpanData {
    let (parent_span_id, is_remote) = match span.place {
        Place::Root(_) => (SpanId::INVALID, false),
        Place::Below { parent, .. } => (SpanId::from(parent.span_id), true),
    };
    let own = span.place.context();
    let attributes = span
        .attributes
        .into_iter()
        .map(|(name, value)| KeyValue::new(name, value));
    SpanData {
        span_context: SpanContext::new(
            TraceId::from(own.trace_id),
            SpanId::from(own.span_id),
            TraceFlags::SAMPLED,
            false,
            TraceState::NONE,
        ),
        parent_span_id,
        parent_span_is_remote: is_remote,
        span_kind: SpanKind::Internal,
        name: span.name.into(),
        start_time: SystemTime::from(span.began_at),
        end_time: SystemTime::from(span.ended_at.max(span.began_at)),
        attributes: attributes.collect(),
        dropped_attributes_count: 0,
        events: SpanEvents::default(),
        links: SpanLinks::default(),
        status: match span.failure {
            Some(reason) => Status::error(reason),
            None => Status::Ok,
        },
        instrumentation_scope: scope,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_is_a_url_by_http() {
        let config = |endpoint: &str| TracingConfig {
            endpoint: Some(endpoint.to_owned()),
        };
        assert!(TracingConfig::default().check().is_ok());
        assert!(config("http://127.0.0.1:4318/v1/traces").check().is_ok());
        assert!(
            config("https://collector.example/v1/traces")
                .check()
                .is_ok()
        );
        for wrong in ["", "127.0.0.1:4318", "grpc://x:1", "http://"] {
            let refused = config(wrong).check().unwrap_err().to_string();
            assert!(refused.contains("tracing.endpoint"), "{refused}");
        }
    }

    #[test]
    fn without_an_endpoint_nothing_is_kept_or_sent() {
        let telemetry = Telemetry::default();
        let mission: MissionId = "0192f0c1-2b3c-7d4e-8f50-617283940a1b".parse().unwrap();
        let root = TraceParent::of_mission(mission);
        telemetry.remember(mission, root.with_span(7));
        assert_eq!(telemetry.open(mission).parent, root);
        assert!(!telemetry.is_on());
        telemetry.stop();
    }

    #[tokio::test]
    async fn the_parents_of_the_last_missions_are_remembered() {
        let config = TracingConfig {
            endpoint: Some("http://127.0.0.1:9/v1/traces".to_owned()),
        };
        let telemetry = Telemetry::start(&config, "test").unwrap();
        let mission = |number: usize| {
            let text = format!("0192f0c1-2b3c-7d4e-8f50-6172839400{number:02x}");
            text.parse::<MissionId>().unwrap()
        };
        for number in 0..=OPEN_MAX {
            let parent = TraceParent::of_mission(mission(number)).with_span(7);
            telemetry.remember(mission(number), parent);
        }
        assert_eq!(telemetry.open(mission(1)).parent.span_id, 7);
        let first = telemetry.open(mission(0));
        assert_eq!(first.parent, TraceParent::of_mission(mission(0)));
        telemetry.began(mission(1), Timestamp::UNIX_EPOCH);
        let second = telemetry.open(mission(1));
        assert_eq!(second.parent.span_id, 7);
        assert_eq!(second.began_at, Some(Timestamp::UNIX_EPOCH));
    }
}
