//! Examines the fleet's authority and the certificate of the REST API.

use std::path::Path;

use rustls::pki_types::{CertificateDer, TrustAnchor};
use tread_api::diagnosis::{Finding, NextStep};
use webpki::EndEntityCert;

use super::DoctorInput;
use crate::authority::{Authority, NEXT_CERTIFICATE_FILE};
use crate::certificate::{Certificate, Condition, is_for};
use crate::config::credentials::is_passed;
use crate::config::{TlsFiles, TlsSource};
use crate::error_text::chain;
use crate::http::tls::{Tls, read_files};

pub(super) fn findings(examined: &DoctorInput) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(robots) = &examined.config.robots {
        findings.push(authority(examined, &robots.authority));
    }
    match &examined.config.tls {
        Some(TlsSource::Files(files)) => findings.extend(of_files(examined, files)),
        Some(TlsSource::Authority) => {
            let names = examined.config.certificate_names();
            findings.push(Finding::on("certificate").ok(format!(
                "the fleet's authority issues it, for localhost, {}",
                names.join(", ")
            )));
        }
        None if examined.config.web.behind_https => findings
            .push(Finding::on("certificate").skipped("the proxy has it: check its expiry there")),
        None => findings.push(
            Finding::on("certificate")
                .skipped("there is none: the REST API is for this machine alone"),
        ),
    }
    findings
}

fn authority(examined: &DoctorInput, folder: &Path) -> Finding {
    let shown = folder.display();
    if folder.join(NEXT_CERTIFICATE_FILE).exists() {
        return Finding::on("authority").warning(
            format!("a rotation of the authority in `{shown}` is under way"),
            NextStep(
                "`tread authority` shows which robots are left; then `tread authority finish`",
            ),
        );
    }
    let authority = match Authority::load(folder) {
        Ok(authority) => authority,
        Err(error) => {
            return Finding::on("authority").problem(
                chain(&error),
                NextStep(
                    "run this as the user that the server runs as; `tread-server init` makes an \
                     authority where there is none; a backup brings a lost one back",
                ),
            );
        }
    };
    let fingerprint = authority.fingerprint();
    let read = Certificate::read(authority.certificate());
    let now = examined.clock.machine_time();
    let condition = read.as_ref().map(|read| read.condition(now));
    match (condition, read) {
        (Some(Condition::Valid) | None, _) | (_, None) => {
            Finding::on("authority").ok(format!("`{shown}`, SHA-256 {fingerprint}"))
        }
        (Some(Condition::Expiring), Some(read)) => Finding::on("authority").warning(format!("the authority in `{shown}` expires at {}", read.not_after),
            NextStep("rotate it: `tread authority start`"),
        ),
        (Some(Condition::Expired), Some(read)) => Finding::on("authority").problem(format!("the authority in `{shown}` expired at {}", read.not_after),
            NextStep(
                "set the clock if it is wrong; otherwise `tread authority replace`, and every robot \
                 joins again",
            ),
        ),
        (Some(Condition::NotYetValid), Some(read)) => Finding::on("authority").problem(format!(
                "the authority in `{shown}` is valid from {} only, and the clock says {now:.0}",
                read.not_before
            ),
            NextStep("set the clock"),
        ),
    }
}

fn of_files(examined: &DoctorInput, files: &TlsFiles) -> Vec<Finding> {
    let step = if is_passed(&files.certificate) || is_passed(&files.key) {
        "run this as root, who alone reads credentials, and see that certificate and key are \
         there, PEM, and belong together"
    } else {
        "name files that exist and belong together, PEM, readable by the user that the server \
         runs as"
    };
    let read = Tls::load(files.clone()).and_then(|_| read_files(files));
    let (certificates, _key) = match read {
        Ok(read) => read,
        Err(error) => {
            return vec![Finding::on("certificate").problem(chain(&error), NextStep(step))];
        }
    };
    let shown = files.certificate.display().to_string();
    let Some(leaf) = certificates.first() else {
        return vec![
            Finding::on("certificate")
                .problem(format!("`{shown}` holds no certificate"), NextStep(step)),
        ];
    };
    let Some(certificate) = Certificate::read(leaf) else {
        return vec![Finding::on("certificate").problem(
            format!("the certificate in `{shown}` does not read"),
            NextStep(step),
        )];
    };
    vec![
        validity(examined, &shown, &certificate),
        names(examined, &shown, leaf, &certificate),
        issuers(&shown, &certificates),
    ]
}

fn validity(examined: &DoctorInput, shown: &str, certificate: &Certificate) -> Finding {
    let now = examined.clock.machine_time();
    let (from, until) = (certificate.not_before, certificate.not_after);
    match certificate.condition(now) {
        Condition::Valid => Finding::on("certificate").ok(format!("`{shown}`, valid until {until}")),
        Condition::Expiring => Finding::on("certificate").warning(format!("the certificate in `{shown}` expires at {until}"),
            NextStep("replace the file; a running server takes it within a minute"),
        ),
        Condition::Expired => Finding::on("certificate").problem(format!("the certificate in `{shown}` expired at {until}; clients refuse it"),
            NextStep(
                "replace the file, and a running server takes it within a minute; set the clock if it \
                 is wrong",
            ),
        ),
        Condition::NotYetValid => Finding::on("certificate").problem(format!(
                "the certificate in `{shown}` is valid from {from} only, and the clock says \
                 {now:.0}"
            ),
            NextStep("set the clock, or replace the file"),
        ),
    }
}

fn names(
    examined: &DoctorInput,
    shown: &str,
    leaf: &CertificateDer<'_>,
    certificate: &Certificate,
) -> Finding {
    let hosts = &examined.config.web.hosts;
    let missing: Vec<&String> = hosts.iter().filter(|host| !is_for(leaf, host)).collect();
    let names = certificate.names.join(", ");
    match missing.first() {
        None if hosts.is_empty() => Finding::on("certificate names").warning(
            format!("`{shown}` is for {names}, and `web.hosts` names none of them"),
            NextStep("add the names by which browsers find the server to `web.hosts`"),
        ),
        None => Finding::on("certificate names").ok(format!("`{shown}` is for {names}")),
        Some(host) => Finding::on("certificate names").problem(
            format!("`{shown}` is for {names}, and not for `{host}` of `web.hosts`"),
            NextStep("get a certificate for that name too, or remove it from `web.hosts`"),
        ),
    }
}

/// Examines whether each certificate of the file is signed by the next.
fn issuers(shown: &str, certificates: &[CertificateDer<'static>]) -> Finding {
    for pair in certificates.windows(2) {
        let [one, next] = pair else { continue };
        let is_signed =
            webpki::anchor_from_trusted_cert(next).is_ok_and(|issuer| is_signed_by(one, issuer));
        if !is_signed {
            return Finding::on("certificate chain").problem(
                format!(
                    "in `{shown}` a certificate is followed by one that has not signed it; clients \
                     refuse it"
                ),
                NextStep("put the server's certificate first, then each one's issuer"),
            );
        }
    }
    let last = certificates.last().and_then(Certificate::read);
    let from = last.map_or_else(String::new, |last| last.issuer);
    Finding::on("certificate chain").ok(format!("it leads to `{from}`"))
}

fn is_signed_by(certificate: &CertificateDer<'_>, issuer: TrustAnchor<'_>) -> bool {
    let Ok(leaf) = EndEntityCert::try_from(certificate) else {
        return false;
    };
    let Some(read) = Certificate::read(certificate) else {
        return false;
    };
    let seconds = u64::try_from(read.not_after.as_second()).unwrap_or_default();
    let at = rustls::pki_types::UnixTime::since_unix_epoch(std::time::Duration::from_secs(seconds));
    let provider = rustls::crypto::ring::default_provider();
    let anchors = [issuer];
    let verified = leaf.verify_for_usage(
        provider.signature_verification_algorithms.all,
        &anchors,
        &[],
        at,
        webpki::KeyUsage::server_auth(),
        None,
        None,
    );
    match verified {
        Ok(_) => true,
        // The error concerns neither the signature nor the name of the issuer.
        Err(error) => !matches!(
            error,
            webpki::Error::UnknownIssuer | webpki::Error::InvalidSignatureForPublicKey
        ),
    }
}
