//! Joins the fleet and renews the certificate over the server's REST API.
//!
//! A renewal is authenticated by a signature with the present key over the request for the next
//! certificate, which is signed with the next key. It needs no TLS client certificates and passes
//! any proxy, and an eavesdropper cannot use the answer, which fits a key that only the robot has.

use std::net::IpAddr;
use std::time::Duration;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use jiff::Timestamp;
use rcgen::{CertificateParams, DistinguishedName, KeyPair, SigningKey as _};
use reqwest::{StatusCode, Url};
use serde::Serialize;
use tread_api::enrolment::{EnrolRobot, RenewCertificate, RobotCertificate, renewal_message};
use tread_api::ids::RobotId;
use tread_api::problem::ProblemBody;

use super::{Membership, Trust};

/// Longest wait for an answer.
const ANSWER_WAIT_MAX: Duration = Duration::from_secs(15);
/// Longest wait for a connection.
const CONNECT_WAIT_MAX: Duration = Duration::from_secs(5);

/// Why a robot got no certificate.
#[derive(Debug, thiserror::Error)]
pub enum MembershipError {
    /// The address is not a valid URL.
    #[error("`{0}` is not the address of a server: use one like https://tread.example:8420")]
    Address(String),
    /// The connection to another machine would not be encrypted.
    #[error("`{0}` is another machine without TLS: use https")]
    ClearText(String),
    /// The certificate of the authority cannot be parsed.
    #[error("the authority to trust cannot be used")]
    Trust(#[source] rustls::Error),
    /// No key could be made.
    #[error("no key could be made, or it could not sign")]
    Key(#[source] rcgen::Error),
    /// No server answers at the address.
    #[error("no connection to a server that is trusted at `{server}`")]
    Unreachable {
        /// Address of the server.
        server: String,
        /// Error of the request.
        #[source]
        source: reqwest::Error,
    },
    /// The server refused.
    #[error("the server refused ({status}): {detail}")]
    Refused {
        /// HTTP status of the answer.
        status: StatusCode,
        /// Detail of the answer.
        detail: String,
    },
    /// The answer cannot be parsed.
    #[error("the answer of `{0}` does not read: is it a Tread server?")]
    NotUnderstood(String),
}

/// Parameters of an enrolment.
#[derive(Clone)]
pub struct Enrolment {
    /// Address of the REST API.
    pub server: String,
    /// How the REST API is authenticated.
    pub trust: Trust,
    /// The secret of a join token.
    pub token: String,
    /// The robot; not needed if the token names it.
    pub robot: Option<RobotId>,
    /// Endpoint of the robots' port in zenoh's notation, if it is not on the server's address.
    pub endpoint: Option<String>,
}

impl std::fmt::Debug for Enrolment {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("Enrolment")
            .field("server", &self.server)
            .field("robot", &self.robot)
            .finish_non_exhaustive()
    }
}

/// Joins the fleet: makes a key, which never leaves the robot, and requests a certificate for it.
///
/// # Errors
/// [`MembershipError`]; nothing is saved.
pub async fn enrol(enrolment: &Enrolment, now: Timestamp) -> Result<Membership, MembershipError> {
    let url = parse(&enrolment.server)?;
    let (key, request) = new_key()?;
    let body = EnrolRobot {
        token: enrolment.token.trim().to_owned(),
        robot: enrolment.robot.clone(),
        certificate_request: request,
    };
    let answer = post(&url, (&enrolment.trust, None), "v1/enrolments", &body).await?;
    let host = url.host_str().unwrap_or_default();
    let default_endpoint = || format!("tls/{host}:{}", answer.port);
    Ok(Membership {
        endpoint: enrolment.endpoint.clone().unwrap_or_else(default_endpoint),
        site: answer.site,
        robot: answer.robot,
        enrolment: answer.enrolment,
        certificate: answer.certificate,
        key: key.serialize_pem(),
        authority: answer.authority,
        server: enrolment.server.clone(),
        trust: enrolment.trust.clone(),
        issued_at: now,
        lifetime_s: answer.lifetime_s,
    })
}

impl Membership {
    /// Requests the next certificate, for a new key.
    ///
    /// # Errors
    /// [`MembershipError`]; the present certificate stays valid.
    pub(super) async fn renewed(&self, now: Timestamp) -> Result<Self, MembershipError> {
        let url = parse(&self.server)?;
        let present = KeyPair::from_pem(&self.key).map_err(MembershipError::Key)?;
        let (next, request) = new_key()?;
        let proof = present
            .sign(&renewal_message(&request))
            .map_err(MembershipError::Key)?;
        let body = RenewCertificate {
            certificate: self.certificate.clone(),
            certificate_request: request,
            proof: BASE64_STANDARD.encode(proof),
        };
        let trust = (&self.trust, Some(self.authority.as_str()));
        let answer = post(&url, trust, "v1/enrolments/renew", &body).await?;
        Ok(Self {
            certificate: answer.certificate,
            key: next.serialize_pem(),
            authority: answer.authority,
            issued_at: now,
            lifetime_s: answer.lifetime_s,
            ..self.clone()
        })
    }
}

/// Makes a key, and a certificate request without names, which the server would ignore.
fn new_key() -> Result<(KeyPair, String), MembershipError> {
    let key = KeyPair::generate().map_err(MembershipError::Key)?;
    let mut params = CertificateParams::default();
    params.distinguished_name = DistinguishedName::new();
    let request = params
        .serialize_request(&key)
        .and_then(|request| request.pem())
        .map_err(MembershipError::Key)?;
    Ok((key, request))
}

fn parse(server: &str) -> Result<Url, MembershipError> {
    let invalid = || MembershipError::Address(server.to_owned());
    let mut url = Url::parse(server).map_err(|_| invalid())?;
    let host = url.host_str().ok_or_else(invalid)?;
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    let is_here = host == "localhost"
        || bare
            .parse()
            .is_ok_and(|address: IpAddr| address.is_loopback());
    match url.scheme() {
        "https" => {}
        "http" if is_here => {}
        "http" => return Err(MembershipError::ClearText(server.to_owned())),
        _ => return Err(invalid()),
    }
    if !url.path().ends_with('/') {
        let path = format!("{}/", url.path());
        url.set_path(&path);
    }
    Ok(url)
}

async fn post<B: Serialize + Sync>(
    url: &Url,
    (trust, fleet): (&Trust, Option<&str>),
    path: &str,
    body: &B,
) -> Result<RobotCertificate, MembershipError> {
    let server = url.to_string();
    let unreachable = |source| MembershipError::Unreachable {
        server: server.clone(),
        source,
    };
    let mut builder = reqwest::Client::builder()
        .timeout(ANSWER_WAIT_MAX)
        .connect_timeout(CONNECT_WAIT_MAX)
        .user_agent(concat!("tread-agent/", env!("CARGO_PKG_VERSION")));
    builder = match trust.client_config(fleet).map_err(MembershipError::Trust)? {
        Some(config) => builder.tls_backend_preconfigured(config),
        None if url.scheme() == "https" => builder,
        // No roots are trusted, so that the machine's certificates are not read.
        None => builder.tls_certs_only([]),
    };
    let client = builder.build().map_err(unreachable)?;
    let not_understood = || MembershipError::NotUnderstood(server.clone());
    let address = url.join(path).map_err(|_| not_understood())?;
    let response = client.post(address).json(body).send().await;
    let response = response.map_err(unreachable)?;
    let status = response.status();
    let text = response.bytes().await.map_err(unreachable)?;
    if status.is_success() {
        return serde_json::from_slice(&text).map_err(|_| not_understood());
    }
    let problem = serde_json::from_slice::<ProblemBody>(&text).map_err(|_| not_understood())?;
    Err(MembershipError::Refused {
        status,
        detail: problem.detail.unwrap_or(problem.title),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_goes_to_another_machine_by_tls_alone() {
        for good in [
            "https://tread.example:8420",
            "http://127.0.0.1:8420",
            "http://[::1]:1/",
            "http://localhost/prefix",
        ] {
            assert!(
                parse(good).is_ok_and(|url| url.path().ends_with('/')),
                "{good}"
            );
        }
        for bad in [
            "http://192.0.2.7",
            "ftp://localhost",
            "nonsense",
            "http://127.0.0.1.example",
        ] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }
}
