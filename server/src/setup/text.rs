//! Writes choices as a configuration file.

use std::fmt::Write as _;
use std::path::Path;

use super::choices::{CertificateSource, Choices};

/// Returns a text as a basic string of TOML, which has the same escapes as JSON.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

fn path(path: &Path) -> String {
    quoted(&path.display().to_string())
}

fn list(names: &[String]) -> String {
    let names: Vec<String> = names.iter().map(|name| quoted(name)).collect();
    format!("[{}]", names.join(", "))
}

/// Returns the text of the configuration file.
pub(super) fn toml(choices: &Choices) -> String {
    let mut text = String::from(
        "# Configuration of a Tread server, written by `tread-server init`. Every setting is in\n\
         # docs/deployment.md; `tread-server doctor` examines it.\n",
    );
    // Writing to a string cannot fail.
    let _ = write!(
        text,
        "http = {}\nzenoh = {}\n# metrics = \"127.0.0.1:9464\"   # for Prometheus\ndatabase = {}\nsite = {}\n",
        quoted(&choices.http.to_string()),
        quoted(&choices.zenoh.to_string()),
        path(&choices.data_dir.join("tread.db")),
        quoted(choices.site.as_str()),
    );
    match &choices.web {
        CertificateSource::Authority => text.push_str(
            "\n[tls]\n# The fleet's authority issues the certificate, and another one in time.\n\
             authority = true\n",
        ),
        CertificateSource::Files(files) => {
            let _ = write!(
                text,
                "\n[tls]\ncertificate = {}\nkey = {}\n",
                path(&files.certificate),
                path(&files.key)
            );
        }
        CertificateSource::Proxy | CertificateSource::Loopback => {}
    }
    match &choices.web {
        CertificateSource::Proxy => {
            let _ = write!(
                text,
                "\n[web]\nhosts = {}\nbehind_https = true\ntrusted_proxies = [\"127.0.0.1\", \"::1\"]\n",
                list(&choices.names)
            );
        }
        CertificateSource::Authority | CertificateSource::Files(_) => {
            let _ = write!(text, "\n[web]\nhosts = {}\n", list(&choices.names));
        }
        CertificateSource::Loopback => {}
    }
    if choices.has_authority() {
        let _ = write!(
            text,
            "\n[robots]\nauthority = {}\nnames = {}\n",
            path(&choices.authority()),
            list(&choices.names)
        );
    }
    text
}
