//! The fleet's own authority: signs robots' certificates and the robots' port's own.
//!
//! Its key is in one file that only its owner can read; whoever has it can pose as any robot. The
//! port's certificate is made anew by each run of the server, so there is no second key to guard.
//!
//! A robot's certificate names `e{enrolment}.{robot}.{site}`: identifiers have no dots, so the
//! name reads back one way only, and what a robot had before it joined again counts no more.

mod file;
mod issued;
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
pub use self::issued::Issued;
pub use self::rotation::{Authorities, Retiring, RotationError, RotationRefused, Trusted};

/// How long the authority lasts.
const AUTHORITY_LASTS: SignedDuration = SignedDuration::from_hours(20 * 365 * 24);
/// How long the robots' port's certificate lasts; it is made anew with each start, and before a
/// third of this is over.
pub const PORT_LASTS: SignedDuration = SignedDuration::from_hours(90 * 24);
/// How far robots' clocks may be behind when they look at the port's certificate.
const BEHIND_MAX: SignedDuration = SignedDuration::from_hours(24);
/// How long after its end a certificate still counts for a renewal: a robot that stood in a shed
/// for a month comes back by itself. Whether it may is in the database, not in the certificate.
pub const RENEWAL_GRACE: SignedDuration = SignedDuration::from_hours(30 * 24);
/// Names of the port that need no configuration.
const NAMES_HERE: [&str; 3] = ["localhost", "127.0.0.1", "::1"];

/// Whom a robot's certificate names.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct RobotName {
    /// The site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// How often it has joined, from 1.
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
        // `e+1` and `e01` parse too, and are no names of ours.
        (name.text() == text).then_some(name)
    }
}

/// Why a certificate or a request for one does not count.
#[derive(Debug, thiserror::Error)]
pub enum CertificateError {
    /// The request does not read, or is not signed with its own key.
    #[error("the request for a certificate does not read, or its own signature is wrong")]
    Request(#[source] rcgen::Error),
    /// The key is of another kind.
    #[error("a robot's key must be ECDSA P-256")]
    Algorithm,
    /// The certificate does not read.
    #[error("the certificate does not read")]
    Unreadable,
    /// The authority has not signed it, or it is for another purpose.
    #[error("the certificate is not one of this fleet's robots")]
    Foreign,
    /// It was over too long ago, or is not valid yet.
    #[error("the certificate's time is over")]
    Over,
    /// The proof was not made with the key of the certificate.
    #[error("the proof was not made with the present key")]
    Proof,
    /// Signing failed.
    #[error("the certificate could not be signed")]
    Signing(#[source] rcgen::Error),
}

/// A robot's certificate as it was signed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Signed {
    /// PEM.
    pub certificate: String,
    /// Its SHA-256, in hexadecimal digits.
    pub fingerprint: String,
    /// From when on it is refused.
    pub expires_at: Timestamp,
}

/// Certificate and key of a port.
pub struct PortIdentity {
    /// The certificate, followed by its authority's.
    pub chain: Vec<CertificateDer<'static>>,
    /// Its key.
    pub key: PrivateKeyDer<'static>,
}

/// The fleet's authority.
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

/// A certificate's time, which knows no fractions of seconds.
fn set_times(params: &mut CertificateParams, from: Timestamp, until: Timestamp) {
    params.not_before = SystemTime::from(from).into();
    params.not_after = SystemTime::from(until).into();
}

fn later(now: Timestamp, span: SignedDuration) -> Timestamp {
    now.checked_add(span).unwrap_or(Timestamp::MAX)
}

fn earlier(now: Timestamp, span: SignedDuration) -> Timestamp {
    now.checked_sub(span).unwrap_or(Timestamp::UNIX_EPOCH)
}

impl Authority {
    /// Makes a new authority in memory.
    ///
    /// # Errors
    /// The operating system gives no random numbers.
    pub fn generate(name: &str, now: Timestamp) -> Result<Self, rcgen::Error> {
        let key = KeyPair::generate()?;
        let mut params = CertificateParams::default();
        params.distinguished_name = named(name);
        set_times(
            &mut params,
            earlier(now, BEHIND_MAX),
            later(now, AUTHORITY_LASTS),
        );
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

    /// The authority's own certificate, PEM.
    pub fn certificate_pem(&self) -> &str {
        &self.certificate_pem
    }

    /// The authority's own certificate.
    pub fn certificate(&self) -> &CertificateDer<'static> {
        &self.certificate
    }

    /// The SHA-256 of the authority's own certificate, in hexadecimal digits.
    pub fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    /// Derives a secret key for one purpose from the authority's own (HMAC-SHA-256).
    pub fn derive_key(&self, purpose: &str) -> hmac::Key {
        let own = hmac::Key::new(hmac::HMAC_SHA256, self.issuer.key().serialized_der());
        let derived = hmac::sign(&own, purpose.as_bytes());
        hmac::Key::new(hmac::HMAC_SHA256, derived.as_ref())
    }

    /// Signs a certificate for the key in a robot's request. What else the request says is not
    /// looked at.
    ///
    /// # Errors
    /// [`CertificateError::Request`] or [`CertificateError::Algorithm`]; signing fails for want
    /// of random numbers only.
    pub fn sign(
        &self,
        request: &RobotRequest,
        name: &RobotName,
        now: Timestamp,
        lifetime: SignedDuration,
    ) -> Result<Signed, CertificateError> {
        // Whole seconds, as the certificate has them.
        let until = later(now, lifetime).as_second();
        let expires_at = Timestamp::from_second(until).unwrap_or(Timestamp::MAX);
        let mut params =
            CertificateParams::new(vec![name.text()]).map_err(CertificateError::Signing)?;
        params.distinguished_name = named(&name.text());
        set_times(
            &mut params,
            earlier(now, SignedDuration::from_mins(1)),
            expires_at,
        );
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        params.use_authority_key_identifier_extension = true;
        let signed = params
            .signed_by(&request.0.public_key, &self.issuer)
            .map_err(CertificateError::Signing)?;
        Ok(Signed {
            certificate: signed.pem(),
            fingerprint: fingerprint(signed.der()),
            expires_at,
        })
    }

    /// Makes certificate and key of a port that goes by these names.
    ///
    /// # Errors
    /// A name is none, or there are no random numbers.
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
        set_times(
            &mut params,
            earlier(now, BEHIND_MAX),
            later(now, PORT_LASTS),
        );
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

/// A robot's certificate that an authority of the fleet has signed.
#[derive(Debug)]
pub struct PresentCertificate {
    certificate: CertificateDer<'static>,
    name: RobotName,
    issuer: String,
    is_retired: bool,
}

impl PresentCertificate {
    /// Whom it names.
    pub fn name(&self) -> &RobotName {
        &self.name
    }

    /// Its SHA-256, in hexadecimal digits.
    pub fn fingerprint(&self) -> String {
        fingerprint(&self.certificate)
    }

    /// The fingerprint of the authority that signed it.
    pub fn issuer(&self) -> &str {
        &self.issuer
    }

    /// Whether that authority was retired: the certificate tells whose it was and counts for nothing.
    pub fn is_retired(&self) -> bool {
        self.is_retired
    }

    /// Checks that whoever asks for a renewal has the key of this certificate.
    ///
    /// # Errors
    /// [`CertificateError::Proof`].
    pub fn check_proof(&self, request_pem: &str, proof: &[u8]) -> Result<(), CertificateError> {
        let leaf =
            EndEntityCert::try_from(&self.certificate).map_err(|_| CertificateError::Unreadable)?;
        leaf.verify_signature(ECDSA_P256_SHA256, &renewal_message(request_pem), proof)
            .map_err(|_| CertificateError::Proof)
    }
}

/// A request for a certificate that is signed with its own key.
#[derive(Debug)]
pub struct RobotRequest(CertificateSigningRequestParams);

impl RobotRequest {
    /// Reads a request.
    ///
    /// # Errors
    /// It does not read, its signature is wrong, or its key is of another kind than ECDSA P-256.
    pub fn read(pem: &str) -> Result<Self, CertificateError> {
        let request =
            CertificateSigningRequestParams::from_pem(pem).map_err(CertificateError::Request)?;
        if request.public_key.algorithm() != &PKCS_ECDSA_P256_SHA256 {
            return Err(CertificateError::Algorithm);
        }
        Ok(Self(request))
    }
}

/// Whom a certificate names, and when it ends. Says nothing about who signed it.
///
/// # Errors
/// It does not read, or names no robot.
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

/// The SHA-256 of a certificate in hexadecimal digits.
fn fingerprint(certificate: &CertificateDer<'_>) -> String {
    let mut text = String::with_capacity(64);
    for byte in Sha256::digest(certificate) {
        // Writing to a text cannot fail.
        let _ = write!(text, "{byte:02x}");
    }
    text
}

/// Whether an authority has signed a certificate for a client, as of that time.
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

/// Whether a text may stand as a name in the port's certificate: an address or a host name.
pub fn is_port_name(name: &str) -> bool {
    let is_label = |label: &str| {
        let allowed = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-';
        !label.is_empty() && label.len() <= 63 && label.bytes().all(allowed)
    };
    name.parse::<IpAddr>().is_ok() || (name.len() <= 253 && name.split('.').all(is_label))
}

#[cfg(test)]
mod tests;
