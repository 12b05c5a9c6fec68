//! Alert about the certificate of the REST API, before and after it has expired.

use tread_api::robot::Severity;

use super::App;
use crate::certificate::{Certificate, Condition};

/// Code of the alert about a certificate of the REST API that expires soon or cannot be used.
pub const CERTIFICATE_ALERT: &str = "certificate-expiring";

impl App {
    /// Raises, changes or clears the alert about the certificate of the REST API; `origin` says
    /// where it comes from.
    pub fn update_certificate_alert(&self, certificate: Option<&Certificate>, origin: &str) {
        let now = self.clock().machine_time();
        let ends = certificate.map(|certificate| certificate.not_after);
        self.storage().record_certificate_expiry(ends);
        let problem = certificate.and_then(|certificate| problem(certificate, origin, now));
        let severity = problem
            .as_ref()
            .map_or(Severity::Warning, |(severity, _)| *severity);
        let text = problem.map(|(_, text)| text);
        self.set_server_alert(CERTIFICATE_ALERT, severity, text);
    }
}

/// Returns a description of a certificate's problem; `None` if it has none.
fn problem(
    certificate: &Certificate,
    origin: &str,
    now: jiff::Timestamp,
) -> Option<(Severity, String)> {
    let until = certificate.not_after;
    match certificate.condition(now) {
        Condition::Valid => None,
        Condition::Expiring => Some((
            Severity::Warning,
            format!(
                "the certificate of the REST API, from {origin}, expires at {until}: replace the \
                 file, and the server takes it within a minute"
            ),
        )),
        Condition::Expired => Some((
            Severity::Critical,
            format!(
                "the certificate of the REST API, from {origin}, expired at {until}, and clients \
                 refuse it: replace the file, and the server takes it within a minute; if it should \
                 be valid, set this machine's clock, which says {now}"
            ),
        )),
        Condition::NotYetValid => Some((
            Severity::Critical,
            format!(
                "the certificate of the REST API, from {origin}, is valid from {} only, and this \
                 machine's clock says {now}: set the clock, or replace the file",
                certificate.not_before
            ),
        )),
    }
}
