//! Enrolments of robots, and the certificates that count for a renewal.

use jiff::Timestamp;

use crate::Issued;

/// Certificates of an enrolment that are accepted for a renewal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AcceptedCertificates {
    /// None: the enrolment is not in force.
    None,
    /// Any certificate of a trusted authority: none are recorded.
    Any,
    /// These certificates.
    These(Issued),
}

/// A renewal.
#[derive(Debug, Clone, Copy)]
pub struct Renewal<'renewal> {
    /// Time of the request.
    pub at: Timestamp,
    /// Expiry of the next certificate.
    pub expires_at: Timestamp,
    /// Fingerprint of the authority that signed the certificate shown for the renewal.
    pub authority: &'renewal str,
    /// Certificates that are accepted from now on.
    pub issued: &'renewal Issued,
}
