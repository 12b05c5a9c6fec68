//! Authentication of the REST API when a robot joins and renews.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, WebPkiSupportedAlgorithms};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, RootCertStore, SignatureScheme,
};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

/// How the REST API's certificate is verified.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Trust {
    /// By the machine's authorities.
    Machine,
    /// By this authority, PEM.
    Authority(String),
    /// By the SHA-256 fingerprint of its own certificate or of its authority's.
    Fingerprint(Fingerprint),
}

/// SHA-256 of a certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Fingerprint([u8; 32]);

/// The text is not a fingerprint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a fingerprint is the 64 hex digits of a certificate's SHA-256, with or without colons")]
pub struct InvalidFingerprint;

impl Fingerprint {
    fn of(certificate: &CertificateDer<'_>) -> Self {
        Self(Sha256::digest(certificate).into())
    }
}

impl FromStr for Fingerprint {
    type Err = InvalidFingerprint;

    fn from_str(text: &str) -> Result<Self, InvalidFingerprint> {
        let digits: Vec<u32> = text
            .chars()
            .filter(|character| *character != ':')
            .map(|character| character.to_digit(16))
            .collect::<Option<_>>()
            .ok_or(InvalidFingerprint)?;
        let (pairs, []) = digits.as_chunks::<2>() else {
            return Err(InvalidFingerprint);
        };
        let bytes: Vec<u8> = pairs
            .iter()
            .filter_map(|[high, low]| u8::try_from(high * 16 + low).ok())
            .collect();
        bytes.try_into().map(Self).map_err(|_| InvalidFingerprint)
    }
}

impl TryFrom<String> for Fingerprint {
    type Error = InvalidFingerprint;

    fn try_from(text: String) -> Result<Self, InvalidFingerprint> {
        text.parse()
    }
}

impl From<Fingerprint> for String {
    fn from(fingerprint: Fingerprint) -> Self {
        fingerprint.to_string()
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0
            .iter()
            .try_for_each(|byte| write!(formatter, "{byte:02x}"))
    }
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

/// Parses the certificates of a PEM text.
///
/// # Errors
/// There is none, or one cannot be parsed.
pub(super) fn certificates(pem: &str) -> Result<Vec<CertificateDer<'static>>, rustls::Error> {
    let unreadable = |_| rustls::Error::General("a certificate does not read".to_owned());
    let found: Vec<_> = CertificateDer::pem_slice_iter(pem.as_bytes())
        .collect::<Result<_, _>>()
        .map_err(unreadable)?;
    if found.is_empty() {
        return Err(rustls::Error::General("there is no certificate".to_owned()));
    }
    Ok(found)
}

impl Trust {
    /// Returns the TLS configuration; `None` for the machine's authorities. A certificate that an
    /// authority in `fleet`, PEM, has signed is accepted too: a member of the fleet trusts these
    /// anyway, and a server whose REST API has its certificate of them shows another one after a
    /// rotation.
    ///
    /// # Errors
    /// The certificate of the trusted authority cannot be parsed.
    pub fn client_config(
        &self,
        fleet: Option<&str>,
    ) -> Result<Option<ClientConfig>, rustls::Error> {
        let mut of_fleet = RootCertStore::empty();
        // A damaged certificate of the fleet vouches for nobody; the renewal replaces it.
        let readable = fleet.and_then(|pem| certificates(pem).ok());
        of_fleet.add_parsable_certificates(readable.into_iter().flatten());
        let builder = ClientConfig::builder_with_provider(provider());
        let builder = builder.with_safe_default_protocol_versions()?;
        let config = match self {
            Self::Machine => return Ok(None),
            Self::Authority(pem) => {
                let mut roots = of_fleet;
                for certificate in certificates(pem)? {
                    roots.add(certificate)?;
                }
                builder.with_root_certificates(roots)
            }
            Self::Fingerprint(fingerprint) => {
                let verifier = PinnedVerifier {
                    fingerprint: *fingerprint,
                    fleet: of_fleet,
                    algorithms: provider().signature_verification_algorithms,
                };
                builder
                    .dangerous()
                    .with_custom_certificate_verifier(Arc::new(verifier))
            }
        };
        Ok(Some(config.with_no_client_auth()))
    }
}

/// Accepts one certificate, or those that one authority or an authority of the fleet has signed.
#[derive(Debug)]
struct PinnedVerifier {
    fingerprint: Fingerprint,
    fleet: RootCertStore,
    algorithms: WebPkiSupportedAlgorithms,
}

impl ServerCertVerifier for PinnedVerifier {
    fn verify_server_cert(
        &self,
        leaf: &CertificateDer<'_>,
        chain: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        if Fingerprint::of(leaf) == self.fingerprint {
            return Ok(ServerCertVerified::assertion());
        }
        let is_named =
            |certificate: &&CertificateDer<'_>| Fingerprint::of(certificate) == self.fingerprint;
        let unknown = || rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer);
        let mut roots = self.fleet.clone();
        if let Some(authority) = chain.iter().find(is_named) {
            roots.add(authority.clone().into_owned())?;
        }
        if roots.is_empty() {
            return Err(unknown());
        }
        let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider())
            .build()
            .map_err(|_| unknown())?;
        verifier.verify_server_cert(leaf, chain, name, ocsp, now)
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls12_signature(message, certificate, signature, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls13_signature(message, certificate, signature, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

#[cfg(test)]
mod tests {
    use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};

    use super::*;

    fn roots_of(pem: &str) -> RootCertStore {
        let mut roots = RootCertStore::empty();
        for certificate in certificates(pem).unwrap() {
            roots.add(certificate).unwrap();
        }
        roots
    }

    #[test]
    fn a_fingerprint_reads_with_and_without_colons() {
        let fingerprint = Fingerprint::of(&CertificateDer::from(b"certificate".to_vec()));
        let text = fingerprint.to_string();
        let pairs: Vec<String> = text
            .as_bytes()
            .chunks(2)
            .map(|pair| String::from_utf8_lossy(pair).to_uppercase())
            .collect();
        assert_eq!(text.parse(), Ok(fingerprint));
        assert_eq!(pairs.join(":").parse(), Ok(fingerprint));
        for wrong in [
            "",
            "ab",
            &text[1..],
            &format!("{text}00"),
            &text.replace('a', "x"),
        ] {
            let read = wrong.parse::<Fingerprint>();
            assert!(read.is_err() || read == Ok(fingerprint), "`{wrong}`");
        }
        assert!("00".parse::<Fingerprint>().is_err());
    }

    #[test]
    fn a_pinned_certificate_is_taken_and_others_are_not_even_of_the_same_name() {
        let authority_key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let authority = params.self_signed(&authority_key).unwrap();
        let issuer = Issuer::new(params, authority_key);
        let leaf = |names: &[&str]| {
            let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
            let key = KeyPair::generate().unwrap();
            let params = CertificateParams::new(names).unwrap();
            params.signed_by(&key, &issuer).unwrap()
        };
        let (mine, other) = (leaf(&["tread.example"]), leaf(&["else.example"]));
        let name = ServerName::try_from("tread.example").unwrap();
        let now = UnixTime::since_unix_epoch(std::time::Duration::from_secs(1_790_000_000));
        let takes =
            |pinned: Fingerprint, leaf: &rcgen::Certificate, chain: &[CertificateDer<'_>]| {
                let verifier = PinnedVerifier {
                    fingerprint: pinned,
                    fleet: RootCertStore::empty(),
                    algorithms: provider().signature_verification_algorithms,
                };
                let looked_at = verifier.verify_server_cert(leaf.der(), chain, &name, &[], now);
                looked_at.is_ok()
            };
        let chain = [authority.der().clone()];
        let of = |certificate: &rcgen::Certificate| Fingerprint::of(certificate.der());
        assert!(takes(of(&mine), &mine, &[]));
        assert!(takes(of(&authority), &mine, &chain));
        assert!(!takes(of(&authority), &mine, &[]), "it is not shown");
        assert!(
            !takes(of(&authority), &other, &chain),
            "it has another name"
        );
        assert!(!takes(of(&mine), &other, &chain));
        let after_a_rotation = |fleet: &str| {
            let verifier = PinnedVerifier {
                fingerprint: Fingerprint::of(&CertificateDer::from(b"former".to_vec())),
                fleet: roots_of(fleet),
                algorithms: provider().signature_verification_algorithms,
            };
            let looked_at = verifier.verify_server_cert(mine.der(), &chain, &name, &[], now);
            looked_at.is_ok()
        };
        assert!(after_a_rotation(&authority.pem()));
        let stranger = KeyPair::generate().unwrap();
        let stranger = CertificateParams::default().self_signed(&stranger).unwrap();
        assert!(!after_a_rotation(&stranger.pem()));
    }
}
