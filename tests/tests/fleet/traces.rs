//! One mission is one trace through server and agent, as a collector receives it that the test plays.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};

use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message as _;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_api::wire::trace::TraceParent;
use tread_tests::fleet::Fleet;
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::bend;

const ANSWER: &[u8] =
    b"HTTP/1.1 200 OK\r\ncontent-type: application/x-protobuf\r\ncontent-length: 0\r\n\r\n";

/// A span with the name of the service that sent it.
type Received = (String, Span);

/// A collector that keeps what it is sent.
#[derive(Debug, Clone, Default)]
struct Collector {
    spans: Arc<Mutex<Vec<Received>>>,
}

impl Collector {
    /// Listens on the loopback; the URL of its endpoint.
    async fn start(&self) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let collector = self.clone();
        #[expect(clippy::disallowed_methods, reason = "it ends with the test")]
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                let collector = collector.clone();
                #[expect(clippy::disallowed_methods, reason = "it ends with the test")]
                tokio::spawn(async move { collector.serve(stream).await });
            }
        });
        format!("http://{address}/v1/traces")
    }

    async fn serve(&self, stream: TcpStream) {
        let mut stream = BufReader::new(stream);
        loop {
            let mut length = 0;
            let mut line = String::new();
            loop {
                line.clear();
                if stream.read_line(&mut line).await.unwrap_or(0) == 0 {
                    return;
                }
                let lower = line.to_ascii_lowercase();
                if let Some(value) = lower.strip_prefix("content-length:") {
                    length = value.trim().parse().unwrap();
                }
                if line == "\r\n" {
                    break;
                }
            }
            let mut body = vec![0; length];
            if stream.read_exact(&mut body).await.is_err() {
                return;
            }
            self.take(&body);
            if stream.write_all(ANSWER).await.is_err() {
                return;
            }
        }
    }

    fn take(&self, body: &[u8]) {
        let request = ExportTraceServiceRequest::decode(body).expect("it is OTLP");
        let mut kept = self.spans.lock().unwrap();
        for of_service in request.resource_spans {
            let resource = of_service.resource.expect("spans have a resource");
            let named = resource
                .attributes
                .iter()
                .find(|it| it.key == "service.name");
            let value = named.and_then(|named| named.value.clone()?.value);
            let Some(Value::StringValue(service)) = value else {
                panic!("no service.name in {resource:?}");
            };
            for scope in of_service.scope_spans {
                kept.extend(scope.spans.into_iter().map(|span| (service.clone(), span)));
            }
        }
    }

    /// The spans of a trace, by name.
    fn of_trace(&self, trace_id: u128) -> BTreeMap<String, Vec<Received>> {
        let mut found = BTreeMap::<String, Vec<Received>>::new();
        for (service, span) in self.spans.lock().unwrap().iter() {
            if span.trace_id == trace_id.to_be_bytes() {
                let of_name = found.entry(span.name.clone()).or_default();
                of_name.push((service.clone(), span.clone()));
            }
        }
        found
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_one_trace_through_server_and_agent() {
    let collector = Collector::default();
    let endpoint = collector.start().await;
    let tracing = format!("[tracing]\nendpoint = \"{endpoint}\"\n");
    let config = format!("[robots]\nauthority = \"authority\"\n{tracing}");
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let mut fleet = Fleet::start_in_environment(node, &config, &[]).await;
    let file = fleet.file("robot.toml");
    std::fs::write(&file, tracing).unwrap();
    fleet.agents_get(&[&format!("--config={}", file.display())]);
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
    let trace = TraceParent::of_mission(mission);
    assert_eq!(trace.trace_id, mission.as_uuid().as_u128());
    let names = ["mission", "offer", "plan", "drive"];
    let look = async || collector.of_trace(trace.trace_id);
    let spans = eventually("all spans have arrived", SHORT, look, |spans| {
        names.iter().all(|name| spans.contains_key(*name))
    })
    .await;
    let one = |name: &str| {
        let found = &spans[name];
        assert_eq!(found.len(), 1, "{name}: {spans:#?}");
        &found[0]
    };
    let (service, of_mission) = one("mission");
    assert_eq!(service, "tread-server");
    assert_eq!(of_mission.span_id, trace.span_id.to_be_bytes());
    assert!(of_mission.parent_span_id.iter().all(|byte| *byte == 0));
    // An offer may have been repeated; the last was accepted.
    let (service, offer) = spans["offer"].last().unwrap();
    assert_eq!(service, "tread-server");
    assert_eq!(offer.parent_span_id, of_mission.span_id);
    let offers: Vec<&Vec<u8>> = spans["offer"]
        .iter()
        .map(|(_, span)| &span.span_id)
        .collect();
    let (service, plan) = spans["plan"].last().unwrap();
    assert_eq!(service, "tread-agent");
    assert!(offers.contains(&&plan.parent_span_id), "{spans:#?}");
    let (service, drive) = one("drive");
    assert_eq!(service, "tread-agent");
    assert!(offers.contains(&&drive.parent_span_id), "{spans:#?}");
    assert!(
        drive.end_time_unix_nano > drive.start_time_unix_nano + 1_000_000_000,
        "it drove for longer than a second: {drive:?}"
    );
    assert!(of_mission.start_time_unix_nano <= plan.start_time_unix_nano);
    fleet.stop_agent(&robot).await.unwrap();
    fleet.stop_server().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collector_that_is_away_costs_spans_and_no_mission() {
    let config = "[robots]\nauthority = \"authority\"\n[tracing]\nendpoint = \"http://127.0.0.1:9/v1/traces\"\n";
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let mut fleet = Fleet::start_in_environment(node, config, &[]).await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
        .await;
    let ended = fleet.stop_server().await.unwrap();
    assert!(ended.success(), "{ended}");
}
