//! Reading of X.509 certificates: their names, validity and issuer. Checks no signature of a chain.

use std::net::IpAddr;

use jiff::{SignedDuration, Timestamp};
use rustls::pki_types::{CertificateDer, ServerName};
use webpki::EndEntityCert;
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::{FromDer as _, X509Certificate};

/// Remaining validity below which a certificate is about to expire, unless it is short-lived.
pub const EXPIRING_BEFORE: SignedDuration = SignedDuration::from_hours(14 * 24);
/// Fraction of a certificate's validity below which a short-lived one is about to expire.
const EXPIRING_SHARE: i32 = 5;

/// Names, validity and issuer of a certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Certificate {
    /// Distinguished name of its subject, for people.
    pub subject: String,
    /// Distinguished name of its issuer, for people.
    pub issuer: String,
    /// Host names and addresses that it is for.
    pub names: Vec<String>,
    /// Begin of its validity.
    pub not_before: Timestamp,
    /// End of its validity.
    pub not_after: Timestamp,
}

/// Condition of a certificate at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Condition {
    /// It is valid, and will be for a while.
    Valid,
    /// Its validity ends soon.
    Expiring,
    /// Its validity is over.
    Expired,
    /// Its validity has not begun: it was made by a clock that is ahead of this one.
    NotYetValid,
}

impl Certificate {
    /// Reads a certificate; `None` if it cannot be parsed.
    pub fn read(der: &CertificateDer<'_>) -> Option<Self> {
        let (_, parsed) = X509Certificate::from_der(der).ok()?;
        let time = |time: &x509_parser::time::ASN1Time| Timestamp::from_second(time.timestamp());
        let alternative = parsed.subject_alternative_name().ok().flatten();
        let general = alternative
            .iter()
            .flat_map(|names| &names.value.general_names);
        Some(Self {
            subject: parsed.subject().to_string(),
            issuer: parsed.issuer().to_string(),
            names: general.filter_map(name).collect(),
            not_before: time(&parsed.validity().not_before).ok()?,
            not_after: time(&parsed.validity().not_after).ok()?,
        })
    }

    /// Returns its condition at a time.
    pub fn condition(&self, now: Timestamp) -> Condition {
        let lasts = self.not_after.duration_since(self.not_before);
        let left = self.not_after.duration_since(now);
        if now < self.not_before {
            Condition::NotYetValid
        } else if left <= SignedDuration::ZERO {
            Condition::Expired
        } else if left < EXPIRING_BEFORE.min(lasts / EXPIRING_SHARE) {
            Condition::Expiring
        } else {
            Condition::Valid
        }
    }
}

/// Returns a host name or an address; `None` for a name of another kind.
fn name(general: &GeneralName<'_>) -> Option<String> {
    match general {
        GeneralName::DNSName(name) => Some((*name).to_owned()),
        GeneralName::IPAddress(bytes) => {
            let address = match bytes.len() {
                4 => <[u8; 4]>::try_from(*bytes).ok().map(IpAddr::from),
                16 => <[u8; 16]>::try_from(*bytes).ok().map(IpAddr::from),
                _ => None,
            };
            address.map(|address| address.to_string())
        }
        GeneralName::OtherName(..)
        | GeneralName::RFC822Name(_)
        | GeneralName::X400Address(_)
        | GeneralName::DirectoryName(_)
        | GeneralName::EDIPartyName(_)
        | GeneralName::URI(_)
        | GeneralName::RegisteredID(_)
        | GeneralName::Invalid(..) => None,
    }
}

/// Returns whether clients that ask for this host name or address accept a certificate for it.
pub fn is_for(der: &CertificateDer<'_>, name: &str) -> bool {
    let Ok(leaf) = EndEntityCert::try_from(der) else {
        return false;
    };
    ServerName::try_from(name.to_owned())
        .is_ok_and(|name| leaf.verify_is_valid_for_subject_name(&name).is_ok())
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use rcgen::{CertificateParams, KeyPair};

    use super::*;

    fn at(text: &str) -> Timestamp {
        text.parse().unwrap()
    }

    fn made(names: &[&str], from: &str, until: &str) -> CertificateDer<'static> {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let mut params = CertificateParams::new(names).unwrap();
        params.not_before = SystemTime::from(at(from)).into();
        params.not_after = SystemTime::from(at(until)).into();
        let key = KeyPair::generate().unwrap();
        params.self_signed(&key).unwrap().der().clone()
    }

    #[test]
    fn a_certificate_says_whom_it_is_for_and_until_when() {
        let names = ["tread.example.org", "*.example.net", "192.0.2.1", "::1"];
        let der = made(&names, "2026-01-01T00:00:00Z", "2027-01-01T00:00:00Z");
        let read = Certificate::read(&der).unwrap();
        assert_eq!(read.names, names);
        assert_eq!(read.not_after, at("2027-01-01T00:00:00Z"));
        for name in ["tread.example.org", "a.example.net", "192.0.2.1", "::1"] {
            assert!(is_for(&der, name), "{name}");
        }
        for name in ["example.org", "a.b.example.net", "192.0.2.2", "no name"] {
            assert!(!is_for(&der, name), "{name}");
        }
        assert_eq!(Certificate::read(&CertificateDer::from(vec![1, 2])), None);
    }

    #[test]
    fn a_certificate_expires_in_time_for_somebody_to_act() {
        let year = made(&[], "2026-01-01T00:00:00Z", "2027-01-01T00:00:00Z");
        let day = made(&[], "2026-01-01T00:00:00Z", "2026-01-02T00:00:00Z");
        for (der, now, condition) in [
            (&year, "2025-12-31T23:00:00Z", Condition::NotYetValid),
            (&year, "2026-12-17T00:00:00Z", Condition::Valid),
            (&year, "2026-12-19T00:00:00Z", Condition::Expiring),
            (&year, "2027-01-01T00:00:00Z", Condition::Expired),
            (&day, "2026-01-01T12:00:00Z", Condition::Valid),
            (&day, "2026-01-01T20:00:00Z", Condition::Expiring),
        ] {
            let read = Certificate::read(der).unwrap();
            assert_eq!(read.condition(at(now)), condition, "{now}");
        }
    }
}
