//! The fleet's certificate authority (CA), which signs the certificates of robots and of the
//! robots' port.
//!
//! Its private key is in one file that only its owner can read; anyone with the key can impersonate
//! any robot. The server generates key and certificate of the port at each start and does not store
//! them.
//!
//! The common name of a robot's certificate is `e{enrolment}.{robot}.{site}`. Identifiers contain
//! no dots, so the name is unambiguous. A robot that joins again gets the next enrolment number,
//! which invalidates its earlier certificates.

pub mod copies;
mod file;
mod rotation;

use std::fmt::Write as _;
use std::net::IpAddr;
use std::time::{Duration, SystemTime};

use jiff::{SignedDuration, Timestamp};
use rcgen::{
    BasicConstraints, CertificateParams, CertificateSigningRequestParams, DistinguishedName,
    DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
    PKCS_ECDSA_P256_SHA256,
};
use ring::hmac;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use sha2::{Digest as _, Sha256};
use tread_api::enrolment::renewal_message;
use tread_api::ids::{RobotId, SiteId};
use webpki::ring::ECDSA_P256_SHA256;
use webpki::{EndEntityCert, KeyUsage};
use x509_parser::prelude::{FromDer as _, X509Certificate};

pub use self::file::{AuthorityError, CERTIFICATE_FILE, KEY_FILE, NEXT_CERTIFICATE_FILE};
pub use self::rotation::{Authorities, Retiring, RotationError, RotationRefused, Trusted};
pub use tread_store::Issued;

/// Validity period of the authority's certificate.
const AUTHORITY_VALIDITY: SignedDuration = SignedDuration::from_hours(20 * 365 * 24);
/// Validity period of the certificate of the robots' port. It is replaced at each start, and before
/// a third of this period is over.
pub const PORT_CERTIFICATE_VALIDITY: SignedDuration = SignedDuration::from_hours(90 * 24);
/// Time by which a robot's clock may be behind the server's when it checks the port's certificate.
const BEHIND_MAX: SignedDuration = SignedDuration::from_hours(24);
/// Time after its expiry during which a certificate is still accepted for a renewal, so that a
/// robot that was switched off for a month can renew it. The database decides whether the robot may
/// renew.
pub const RENEWAL_GRACE: SignedDuration = SignedDuration::from_hours(30 * 24);
/// Names in the certificate of the robots' port that need no configuration.
const NAMES_HERE: [&str; 3] = ["localhost", "127.0.0.1", "::1"];

/// Robot and enrolment in the common name of a robot's certificate.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct RobotName {
    /// Site of the robot.
    pub site: SiteId,
    /// Identifier of the robot.
    pub robot: RobotId,
    /// Number of the robot's enrolment, from 1.
    pub enrolment: u32,
}

impl RobotName {
    fn text(&self) -> String {
        format!("e{}.{}.{}", self.enrolment, self.robot, self.site)
    }

    fn read(text: &str) -> Option<Self> {
        let (enrolment, rest) = text.strip_prefix('e')?.split_once('.')?;
        let (robot, site) = rest.split_once('.')?;
        let name = Self {
            site: site.parse().ok()?,
            robot: robot.parse().ok()?,
            enrolment: enrolment.parse().ok()?,
        };
        // `e+1` and `e01` parse too, but [`Self::text`] never writes them.
        (name.text() == text).then_some(name)
    }
}

/// Error of a certificate or of a certificate signing request.
#[derive(Debug, thiserror::Error)]
pub enum CertificateError {
    /// The request cannot be parsed, or is not signed with its own key.
    #[error("the request for a certificate does not read, or its own signature is wrong")]
    Request(#[source] rcgen::Error),
    /// The key in the request is not ECDSA P-256.
    #[error("a robot's key must be ECDSA P-256")]
    Algorithm,
    /// The certificate cannot be parsed.
    #[error("the certificate does not read")]
    Unreadable,
    /// No authority of the fleet signed the certificate, or it is not one of a robot.
    #[error("the certificate is not one of this fleet's robots")]
    Foreign,
    /// The certificate expired longer than [`RENEWAL_GRACE`] ago.
    #[error("the certificate's time is over")]
    Over,
    /// The proof of possession was not signed with the key of the certificate.
    #[error("the proof was not made with the present key")]
    Proof,
    /// The certificate could not be signed.
    #[error("the certificate could not be signed")]
    Signing(#[source] rcgen::Error),
}

/// A robot's certificate that was just signed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignedCertificate {
    /// Certificate, PEM.
    pub certificate: String,
    /// SHA-256 of the certificate, in hexadecimal digits.
    pub fingerprint: String,
    /// End of its validity.
    pub expires_at: Timestamp,
}

/// TLS certificate and key of the robots' port.
pub struct PortIdentity {
    /// Certificate of the port, followed by the authority's.
    pub chain: Vec<CertificateDer<'static>>,
    /// Private key of the port.
    pub key: PrivateKeyDer<'static>,
}

/// A certificate authority of the fleet, with its private key.
pub struct Authority {
    certificate_pem: String,
    fingerprint: String,
    certificate: CertificateDer<'static>,
    issuer: Issuer<'static, KeyPair>,
}

impl std::fmt::Debug for Authority {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Authority").finish_non_exhaustive()
    }
}

fn named(name: &str) -> DistinguishedName {
    let mut names = DistinguishedName::new();
    names.push(DnType::CommonName, name);
    names
}

fn later(now: Timestamp, span: SignedDuration) -> Timestamp {
    now.checked_add(span).unwrap_or(Timestamp::MAX)
}

fn earlier(now: Timestamp, span: SignedDuration) -> Timestamp {
    now.checked_sub(span).unwrap_or(Timestamp::UNIX_EPOCH)
}

impl Authority {
    /// Generates a new authority in memory, valid from a day before `now`.
    ///
    /// # Errors
    /// The operating system provides no random numbers.
    pub fn generate(name: &str, now: Timestamp) -> Result<Self, rcgen::Error> {
        let key = KeyPair::generate()?;
        let mut params = CertificateParams::default();
        params.distinguished_name = named(name);
        params.not_before = SystemTime::from(earlier(now, BEHIND_MAX)).into();
        params.not_after = SystemTime::from(later(now, AUTHORITY_VALIDITY)).into();
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let signed = params.self_signed(&key)?;
        let certificate_pem = signed.pem();
        let certificate: CertificateDer<'static> = signed.into();
        Ok(Self {
            certificate_pem,
            fingerprint: fingerprint(&certificate),
            certificate,
            issuer: Issuer::new(params, key),
        })
    }

    fn from_pem(certificate_pem: String, key_pem: &str) -> Result<Self, rcgen::Error> {
        let key = KeyPair::from_pem(key_pem)?;
        let unreadable = |_| rcgen::Error::CouldNotParseCertificate;
        let certificate =
            CertificateDer::from_pem_slice(certificate_pem.as_bytes()).map_err(unreadable)?;
        let (_, parsed) = X509Certificate::from_der(&certificate)
            .map_err(|_| rcgen::Error::CouldNotParseCertificate)?;
        let of_key = rcgen::PublicKeyData::subject_public_key_info(&key);
        if parsed.public_key().raw != of_key || !parsed.is_ca() {
            return Err(rcgen::Error::CouldNotParseCertificate);
        }
        let issuer = Issuer::from_ca_cert_der(&certificate, key)?;
        Ok(Self {
            certificate_pem,
            fingerprint: fingerprint(&certificate),
            certificate,
            issuer,
        })
    }

    /// Returns the authority's own certificate, PEM.
    pub fn certificate_pem(&self) -> &str {
        &self.certificate_pem
    }

    /// Returns the authority's own certificate, DER.
    pub fn certificate(&self) -> &CertificateDer<'static> {
        &self.certificate
    }

    /// Returns the SHA-256 of the authority's own certificate, in hexadecimal digits.
    pub fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    /// Derives a secret key for `purpose` from the authority's private key by HMAC-SHA-256.
    pub fn derive_key(&self, purpose: &str) -> hmac::Key {
        let own = hmac::Key::new(hmac::HMAC_SHA256, self.issuer.key().serialized_der());
        let derived = hmac::sign(&own, purpose.as_bytes());
        hmac::Key::new(hmac::HMAC_SHA256, derived.as_ref())
    }

    /// Signs a certificate for `name` and the public key in `request`, valid from a minute before
    /// `now` until `now` + `lifetime`. All other fields of the request are ignored.
    ///
    /// # Errors
    /// [`CertificateError::Signing`] if the operating system provides no random numbers.
    pub fn sign(
        &self,
        request: &RobotRequest,
        name: &RobotName,
        now: Timestamp,
        lifetime: SignedDuration,
    ) -> Result<SignedCertificate, CertificateError> {
        // Certificates have whole seconds.
        let until = later(now, lifetime).as_second();
        let expires_at = Timestamp::from_second(until).unwrap_or(Timestamp::MAX);
        let mut params =
            CertificateParams::new(vec![name.text()]).map_err(CertificateError::Signing)?;
        params.distinguished_name = named(&name.text());
        params.not_before = SystemTime::from(earlier(now, SignedDuration::from_mins(1))).into();
        params.not_after = SystemTime::from(expires_at).into();
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        params.use_authority_key_identifier_extension = true;
        let signed = params
            .signed_by(&request.0.public_key, &self.issuer)
            .map_err(CertificateError::Signing)?;
        Ok(SignedCertificate {
            certificate: signed.pem(),
            fingerprint: fingerprint(signed.der()),
            expires_at,
        })
    }

    /// Generates key and certificate of the robots' port for `names` in addition to `localhost`.
    ///
    /// # Errors
    /// A name is invalid, or the operating system provides no random numbers.
    pub fn port_identity(
        &self,
        names: &[String],
        now: Timestamp,
    ) -> Result<PortIdentity, rcgen::Error> {
        let mut all: Vec<String> = NAMES_HERE.map(str::to_owned).to_vec();
        all.extend(names.iter().cloned());
        all.dedup();
        let key = KeyPair::generate()?;
        let mut params = CertificateParams::new(all)?;
        params.distinguished_name = named("tread-server");
        params.not_before = SystemTime::from(earlier(now, BEHIND_MAX)).into();
        params.not_after = SystemTime::from(later(now, PORT_CERTIFICATE_VALIDITY)).into();
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
        params.use_authority_key_identifier_extension = true;
        let leaf = params.signed_by(&key, &self.issuer)?;
        Ok(PortIdentity {
            chain: vec![leaf.into(), self.certificate.clone()],
            key: PrivateKeyDer::Pkcs8(key.serialize_der().into()),
        })
    }
}

/// A robot's certificate whose signature by an authority of the fleet was verified.
#[derive(Debug)]
pub struct PresentCertificate {
    certificate: CertificateDer<'static>,
    name: RobotName,
    issuer: String,
    is_retired: bool,
}

impl PresentCertificate {
    /// Returns the robot and enrolment that the certificate names.
    pub fn name(&self) -> &RobotName {
        &self.name
    }

    /// Returns the SHA-256 of the certificate, in hexadecimal digits.
    pub fn fingerprint(&self) -> String {
        fingerprint(&self.certificate)
    }

    /// Returns the fingerprint of the authority that signed the certificate.
    pub fn issuer(&self) -> &str {
        &self.issuer
    }

    /// Returns whether the signing authority is retired. The certificate then identifies the robot
    /// in messages but is not accepted.
    pub fn is_retired(&self) -> bool {
        self.is_retired
    }

    /// Verifies that `proof` is a signature (ECDSA P-256 with SHA-256, DER) of the renewal message of the
    /// request, by the key of this certificate.
    ///
    /// # Errors
    /// [`CertificateError::Proof`] if it is not, [`CertificateError::Unreadable`] if the certificate cannot
    /// be parsed.
    pub fn check_proof(&self, request_pem: &str, proof: &[u8]) -> Result<(), CertificateError> {
        let leaf =
            EndEntityCert::try_from(&self.certificate).map_err(|_| CertificateError::Unreadable)?;
        leaf.verify_signature(ECDSA_P256_SHA256, &renewal_message(request_pem), proof)
            .map_err(|_| CertificateError::Proof)
    }
}

/// A certificate signing request (PKCS#10) with a valid signature by its own ECDSA P-256 key.
#[derive(Debug)]
pub struct RobotRequest(CertificateSigningRequestParams);

impl RobotRequest {
    /// Parses a request and checks its signature.
    ///
    /// # Errors
    /// [`CertificateError::Request`] if it cannot be parsed or its signature is wrong,
    /// [`CertificateError::Algorithm`] if its key is not ECDSA P-256.
    pub fn read(pem: &str) -> Result<Self, CertificateError> {
        let request =
            CertificateSigningRequestParams::from_pem(pem).map_err(CertificateError::Request)?;
        if request.public_key.algorithm() != &PKCS_ECDSA_P256_SHA256 {
            return Err(CertificateError::Algorithm);
        }
        Ok(Self(request))
    }
}

/// Returns the robot that a certificate names and the end of its validity. Does not check the
/// signature.
///
/// # Errors
/// [`CertificateError::Unreadable`] if it cannot be parsed, [`CertificateError::Foreign`] if it
/// names no robot.
pub fn named_in(
    certificate: &CertificateDer<'_>,
) -> Result<(RobotName, Timestamp), CertificateError> {
    let (_, parsed) =
        X509Certificate::from_der(certificate).map_err(|_| CertificateError::Unreadable)?;
    let mut names = parsed.subject().iter_common_name();
    let (name, None) = (names.next(), names.next()) else {
        return Err(CertificateError::Foreign);
    };
    let text = name.and_then(|name| name.as_str().ok());
    let name = text
        .and_then(RobotName::read)
        .ok_or(CertificateError::Foreign)?;
    let expires_at = Timestamp::from_second(parsed.validity().not_after.timestamp())
        .map_err(|_| CertificateError::Unreadable)?;
    Ok((name, expires_at))
}

/// Returns the SHA-256 of a certificate, in hexadecimal digits.
fn fingerprint(certificate: &CertificateDer<'_>) -> String {
    let mut text = String::with_capacity(64);
    for byte in Sha256::digest(certificate) {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
    }
    text
}

/// Returns whether `authority` signed `leaf` for client authentication and both are valid at
/// `looked_at`.
fn is_signed_by(
    leaf: &EndEntityCert<'_>,
    authority: &CertificateDer<'_>,
    looked_at: Timestamp,
) -> bool {
    let Ok(anchor) = webpki::anchor_from_trusted_cert(authority) else {
        return false;
    };
    let seconds = u64::try_from(looked_at.as_second()).unwrap_or_default();
    let anchors = [anchor];
    let verified = leaf.verify_for_usage(
        &[ECDSA_P256_SHA256],
        &anchors,
        &[],
        UnixTime::since_unix_epoch(Duration::from_secs(seconds)),
        KeyUsage::client_auth(),
        None,
        None,
    );
    verified.is_ok()
}

/// Returns whether `name` is an IP address or a host name, as allowed in the port's certificate.
pub fn is_port_name(name: &str) -> bool {
    let is_label = |label: &str| {
        let allowed = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-';
        !label.is_empty() && label.len() <= 63 && label.bytes().all(allowed)
    };
    name.parse::<IpAddr>().is_ok() || (name.len() <= 253 && name.split('.').all(is_label))
}

#[cfg(test)]
mod tests;
