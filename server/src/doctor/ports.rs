//! Examines whether each port is free for the server, or held by it.

use std::io;
use std::net::{SocketAddr, TcpListener};

use jiff::SignedDuration;
use jiff::fmt::rfc2822;
use tread_api::diagnosis::{Finding, NextStep};

use super::DoctorInput;
use super::probe::{self, Answer};
use crate::authority::Authority;
use crate::certificate::{Certificate, Condition};
use crate::config::TlsSource;
use crate::http::tls::read_files;

/// Maximum difference between this clock and the server's that counts as equal.
const CLOCK_DIFFERENCE_MAX: SignedDuration = SignedDuration::from_secs(5);

/// State of a port.
enum Port {
    /// The server can take it.
    Free,
    /// A program has it.
    Taken,
    /// No program has it, but the server cannot take it.
    Impossible(io::Error),
}

/// Port of the configuration: its name in findings, its key, and its address.
#[derive(Clone, Copy)]
struct Configured {
    name: &'static str,
    key: &'static str,
    address: SocketAddr,
}

fn probe(address: SocketAddr) -> Port {
    match TcpListener::bind(address) {
        Ok(_) => Port::Free,
        Err(error) if error.kind() == io::ErrorKind::AddrInUse => Port::Taken,
        Err(error) => Port::Impossible(error),
    }
}

pub(super) async fn findings(examined: &DoctorInput) -> Vec<Finding> {
    let config = &examined.config;
    let mut findings = rest(examined).await;
    findings.push(robots(examined).await);
    if let Some(address) = config.metrics {
        let port = Configured {
            name: "port of metrics",
            key: "metrics",
            address,
        };
        findings.push(match probe(address) {
            Port::Taken => match probe::get(address, false, "/metrics").await {
                Some(answer) if answer.text.contains("tread_uptime") => {
                    Finding::on(port.name).ok(format!("our server answers on {address}"))
                }
                Some(_) | None => port.taken(),
            },
            other @ (Port::Free | Port::Impossible(_)) => port.not_taken(examined, other),
        });
    }
    findings
}

/// Examines the port of the REST API.
async fn rest(examined: &DoctorInput) -> Vec<Finding> {
    let address = examined.config.http;
    let port = Configured {
        name: "port of REST",
        key: "http",
        address,
    };
    match probe(address) {
        Port::Taken => {}
        other @ (Port::Free | Port::Impossible(_)) => {
            return vec![port.not_taken(examined, other)];
        }
    }
    let is_tls = examined.config.tls.is_some();
    let Some(answer) = probe::get(address, is_tls, "/healthz").await else {
        return vec![port.taken()];
    };
    if !answer.is_health() {
        return vec![port.taken()];
    }
    let mut findings =
        vec![Finding::on(port.name).ok(format!("a Tread server answers on {address}"))];
    if examined.server_process.is_none() {
        findings = vec![Finding::on(port.name).problem(
            format!("a Tread server answers on {address}, and it does not use this database"),
            NextStep("stop that server, or give this one another address by `http`"),
        )];
    }
    findings.extend(readiness(address, is_tls).await);
    findings.extend(clock_of(examined, &answer));
    findings.extend(served(examined, &answer));
    findings
}

async fn readiness(address: SocketAddr, is_tls: bool) -> Option<Finding> {
    let answer = probe::get(address, is_tls, "/readyz").await?;
    if answer.is_health() {
        return Some(Finding::on("readiness").ok("the server can work"));
    }
    let body = answer.text.split("\r\n\r\n").nth(1).unwrap_or_default();
    let problem: serde_json::Value = serde_json::from_str(body).unwrap_or_default();
    let why = problem["detail"].as_str().unwrap_or("it does not say why");
    Some(Finding::on("readiness").problem(
        format!("the server cannot work: {why}"),
        NextStep("see the findings on folder, disk and database, and docs/runbook.md"),
    ))
}

/// Compares the clock with the server's.
fn clock_of(examined: &DoctorInput, answer: &Answer) -> Option<Finding> {
    let said = rfc2822::parse(answer.header("date")?).ok()?.timestamp();
    let difference = examined.clock.machine_time().duration_since(said);
    (difference.abs() > CLOCK_DIFFERENCE_MAX).then(|| {
        Finding::on("clock of the server").warning(
            format!("the server says {said}, {} s off", difference.as_secs()),
            NextStep("ask again; if it lasts, the clock is being set"),
        )
    })
}

/// Compares the served certificate with the file.
fn served(examined: &DoctorInput, answer: &Answer) -> Option<Finding> {
    let leaf = answer.leaf.as_ref()?;
    let read = Certificate::read(leaf)?;
    if let Some(TlsSource::Files(files)) = &examined.config.tls
        && let Ok((certificates, _key)) = read_files(files)
        && certificates.first() != Some(leaf)
    {
        return Some(Finding::on("certificate served").warning(
            format!(
                "the server shows another certificate than `{}`, valid until {}",
                files.certificate.display(),
                read.not_after
            ),
            NextStep(
                "wait a minute: it reads the file again then, and its log says if it cannot use it",
            ),
        ));
    }
    let now = examined.clock.machine_time();
    let is_well = matches!(read.condition(now), Condition::Valid | Condition::Expiring);
    let text = format!("valid until {}", read.not_after);
    Some(if is_well {
        Finding::on("certificate served").ok(text)
    } else {
        Finding::on("certificate served").problem(
            format!("the server shows one that is not valid now: {text}"),
            NextStep("see the finding on the certificate, and set the clock if it is wrong"),
        )
    })
}

/// Examines the robots' port.
async fn robots(examined: &DoctorInput) -> Finding {
    let address = examined.config.zenoh;
    let port = Configured {
        name: "port of robots",
        key: "zenoh",
        address,
    };
    match probe(address) {
        Port::Taken => {}
        other @ (Port::Free | Port::Impossible(_)) => {
            return port.not_taken(examined, other);
        }
    }
    let Some(robots) = &examined.config.robots else {
        let is_ours = examined.server_process.is_some() && probe::is_open(address).await;
        return if is_ours {
            Finding::on(port.name).ok(format!("it accepts connections on {address}"))
        } else {
            port.taken()
        };
    };
    let Some(leaf) = probe::certificate(address).await else {
        return port.taken();
    };
    let issuer = Certificate::read(&leaf).map(|read| read.issuer);
    let authority = Authority::load(&robots.authority).ok();
    let subject = authority
        .as_ref()
        .and_then(|authority| Certificate::read(authority.certificate()))
        .map(|read| read.subject);
    if issuer.is_some() && issuer == subject {
        Finding::on(port.name).ok(format!(
            "it answers on {address} with a certificate of the fleet's authority"
        ))
    } else {
        Finding::on(port.name).problem(
            format!("what answers on {address} shows no certificate of the fleet's authority"),
            NextStep("stop the other program, or give the robots another address by `zenoh`"),
        )
    }
}

impl Configured {
    fn taken(self) -> Finding {
        let Self { name, key, address } = self;
        let port = address.port();
        Finding::on(name).problem(format!("another program has {address}"),
            NextStep(format!(
                "`ss -ltnp sport = :{port}` shows which; stop it, or take another address by `{key}`"
            )),
        )
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "of all other errors the message says enough"
    )]
    fn not_taken(self, examined: &DoctorInput, port: Port) -> Finding {
        let Self { name, key, address } = self;
        match (port, examined.server_process) {
            (Port::Taken, _) => self.taken(),
            (Port::Free, Some(process)) if address.port() != 0 => Finding::on(name).problem(format!("the server, process {process}, does not have {address}"),
                NextStep(
                    "it was started with another configuration, is still starting, or hangs: see its log",
                ),
            ),
            (Port::Free, _) => Finding::on(name).ok(format!("{address} is free")),
            (Port::Impossible(error), _) => {
                let step = match error.kind() {
                    io::ErrorKind::PermissionDenied => format!(
                        "ports below 1024 are for root: take another by `{key}`, or give the server \
                         CAP_NET_BIND_SERVICE"
                    ),
                    io::ErrorKind::AddrNotAvailable => format!(
                        "`{key}` must be an address of this machine (`ip address`), or 0.0.0.0 for all"
                    ),
                    _ => format!("take another address by `{key}`"),
                };
                Finding::on(name).problem(format!("cannot listen on {address}: {error}"),
                    NextStep(step),
                )
            }
        }
    }
}
