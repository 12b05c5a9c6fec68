//! The commands to run after `tread-server init`.

use std::fmt::Write as _;

use super::choices::{CertificateSource, Choices};
use super::service::check_service;

/// Returns an argument, quoted for a shell if necessary.
fn shell_quoted(text: &str) -> String {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_./:,@%+=".contains(&byte);
    if !text.is_empty() && text.bytes().all(is_plain) {
        return text.to_owned();
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

/// Returns the address of the REST API for people.
fn server(choices: &Choices) -> String {
    let (port, first) = (choices.http.port(), choices.names.first());
    let host = first.map_or("127.0.0.1", String::as_str);
    let host = if host.contains(':') {
        format!("[{host}]")
    } else {
        host.to_owned()
    };
    match choices.web {
        CertificateSource::Authority | CertificateSource::Files(_) => {
            format!("https://{host}:{port}")
        }
        CertificateSource::Proxy => format!("https://{host}"),
        CertificateSource::Loopback => format!("http://{}", choices.http),
    }
}

/// Returns a list of the created files and the next commands. `fingerprint` is that of the fleet's
/// authority, `is_started` whether the server runs.
pub(crate) fn next_steps(choices: &Choices, fingerprint: Option<&str>, is_started: bool) -> String {
    let config = shell_quoted(&choices.config.display().to_string());
    let token = shell_quoted(&choices.token_file.display().to_string());
    let server = server(choices);
    let trust = match (&choices.web, fingerprint) {
        (CertificateSource::Authority, Some(fingerprint)) => {
            format!(" --ca-fingerprint {fingerprint}")
        }
        (_, _) => String::new(),
    };
    let start = if is_started {
        String::new()
    } else if check_service(choices).is_ok() {
        "  systemctl enable --now tread-server\n".to_owned()
    } else {
        format!("  tread-server --config {config}\n")
    };
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = write!(
        text,
        "configuration  {config}\n\
         data           {}\n\
         admin's token  {token} (mode 0600)\n",
        shell_quoted(&choices.data_dir.display().to_string()),
    );
    if let Some(fingerprint) = fingerprint {
        let _ = writeln!(text, "authority      SHA-256 {fingerprint}");
    }
    let _ = write!(
        text,
        "\nnext:\n  tread-server doctor --config {config}\n{start}  \
         tread login --server {server}{trust} --token-file {token}\n"
    );
    if choices.has_authority() {
        // Clients on the same machine reach the server without its proxy.
        let _ = write!(
            text,
            "a robot:\n  \
             tread robots join-token --server {server} --name rover-1 --expires 1h > token\n  \
             tread-agent enroll --server {server}{trust} --token-file token --config robot.toml   \
             # on the robot\n  \
             tread-agent --config robot.toml\n"
        );
    } else {
        let _ = write!(
            text,
            "a robot on this machine, which needs no certificate:\n  \
             tread-agent --config robot.toml   # with site = \"{}\", robot = \"rover-1\" and \
             server = \"tcp/{}\" in it\n\
             robots of other machines join a server with `[robots]` in its configuration: \
             `tread-server init --names NAME` writes one\n",
            choices.site, choices.zenoh
        );
    }
    text
}
