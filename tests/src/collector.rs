//! A collector of traces: receives OTLP over HTTP on the loopback and keeps the spans.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use anyhow::Context as _;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message as _;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpListener, TcpStream};

const ANSWER: &[u8] =
    b"HTTP/1.1 200 OK\r\ncontent-type: application/x-protobuf\r\ncontent-length: 0\r\n\r\n";
/// Maximum number of bytes of one request.
const REQUEST_BYTES_MAX: usize = 16 * 1024 * 1024;

/// A span with the name of the service that sent it.
pub type Received = (String, Span);

/// A collector that keeps what it is sent.
#[derive(Debug, Clone, Default)]
pub struct Collector {
    spans: Arc<Mutex<Vec<Received>>>,
}

impl Collector {
    fn lock(&self) -> MutexGuard<'_, Vec<Received>> {
        self.spans.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Listens on the loopback until the process ends, and returns the URL of its endpoint.
    ///
    /// # Errors
    /// No port is free.
    pub async fn start(&self) -> anyhow::Result<String> {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let address = listener.local_addr()?;
        let collector = self.clone();
        #[expect(clippy::disallowed_methods, reason = "it ends with the process")]
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                let collector = collector.clone();
                #[expect(clippy::disallowed_methods, reason = "it ends with the process")]
                tokio::spawn(async move {
                    if let Err(error) = collector.serve(stream).await {
                        eprintln!("the collector of traces: {error:#}");
                    }
                });
            }
        });
        Ok(format!("http://{address}/v1/traces"))
    }

    async fn serve(&self, stream: TcpStream) -> anyhow::Result<()> {
        let mut stream = BufReader::new(stream);
        loop {
            let mut length = 0;
            let mut line = String::new();
            loop {
                line.clear();
                if stream.read_line(&mut line).await? == 0 {
                    return Ok(());
                }
                let lower = line.to_ascii_lowercase();
                if let Some(value) = lower.strip_prefix("content-length:") {
                    length = value.trim().parse().context("no length")?;
                }
                if line == "\r\n" {
                    break;
                }
            }
            anyhow::ensure!(length <= REQUEST_BYTES_MAX, "a request of {length} bytes");
            let mut body = vec![0; length];
            stream.read_exact(&mut body).await?;
            self.take(&body)?;
            stream.write_all(ANSWER).await?;
        }
    }

    fn take(&self, body: &[u8]) -> anyhow::Result<()> {
        let request = ExportTraceServiceRequest::decode(body).context("it is no OTLP")?;
        let mut kept = self.lock();
        for of_service in request.resource_spans {
            let resource = of_service.resource.context("spans without a resource")?;
            let named = resource
                .attributes
                .iter()
                .find(|it| it.key == "service.name");
            let value = named.and_then(|named| named.value.clone()?.value);
            let Some(Value::StringValue(service)) = value else {
                anyhow::bail!("no service.name in {resource:?}");
            };
            for scope in of_service.scope_spans {
                kept.extend(scope.spans.into_iter().map(|span| (service.clone(), span)));
            }
        }
        Ok(())
    }

    /// Returns the spans of a trace, by name.
    pub fn of_trace(&self, trace_id: u128) -> BTreeMap<String, Vec<Received>> {
        let mut found = BTreeMap::<String, Vec<Received>>::new();
        for (service, span) in self.lock().iter() {
            if span.trace_id == trace_id.to_be_bytes() {
                let of_name = found.entry(span.name.clone()).or_default();
                of_name.push((service.clone(), span.clone()));
            }
        }
        found
    }
}
