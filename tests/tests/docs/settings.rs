//! Every TOML of the documentation is read by the program that it is for.
//!
//! A comment above the block says by which: `server configuration` (a file of `tread-server`, or a part
//! of one; `… with tls web` adds those sections, which it needs), or `robot.toml`.

use std::fmt::Write as _;
use std::path::Path;

use tread_agent::AgentConfig;
use tread_agent::config::Flags;
use tread_server::{Config, ServerArgs};
use tread_tests::markdown::documents;

/// Sections that a part of a server's configuration may need.
const SECTIONS: [(&str, &str); 2] = [
    (
        "tls",
        "[tls]\ncertificate = \"cert.pem\"\nkey = \"key.pem\"\n",
    ),
    ("web", "[web]\nhosts = [\"tread.example.org\"]\n"),
];

/// Everything that an error says, its causes too.
fn said(error: &dyn std::error::Error) -> String {
    match error.source() {
        Some(cause) => format!("{error}: {}", said(cause)),
        None => error.to_string(),
    }
}

/// What is wrong with a file of settings.
fn fault(note: &str, text: &str, folder: &Path) -> Option<String> {
    let file = folder.join("settings.toml");
    if note == "robot.toml" {
        std::fs::write(&file, text).unwrap();
        let flags = Flags {
            config: Some(file),
            site: Some("yard".parse().unwrap()),
            robot: Some("rover-1".parse().unwrap()),
            data_dir: Some(folder.join("robot")),
            ..Flags::default()
        };
        return AgentConfig::load(&flags).err().map(|error| said(&error));
    }
    let Some(with) = note.strip_prefix("server configuration") else {
        return Some(format!("`{note}` names no program"));
    };
    let mut text = text.to_owned();
    for name in with.split_whitespace().filter(|name| *name != "with") {
        let Some((_, section)) = SECTIONS.iter().find(|(known, _)| *known == name) else {
            return Some(format!("`{name}` is no section"));
        };
        text.push_str(section);
    }
    std::fs::write(&file, text).unwrap();
    let args = ServerArgs {
        config: Some(file),
        ..ServerArgs::default()
    };
    Config::load(&args).err().map(|error| said(&error))
}

#[test]
fn every_setting_of_the_documentation_is_read_by_its_program() {
    let folder = tempfile::tempdir().unwrap();
    let (mut faults, mut read) = (String::new(), 0);
    for document in documents() {
        for block in document
            .blocks
            .iter()
            .filter(|block| block.language == "toml")
        {
            read += 1;
            let note = block.note.as_deref().unwrap_or("no comment above");
            if let Some(fault) = fault(note, &block.text, folder.path()) {
                let _ = writeln!(faults, "{}:{}: {fault}", document.name, block.line);
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
    assert!(read > 5, "only {read} were found");
}

#[test]
fn settings_that_nobody_knows_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    assert_eq!(fault("robot.toml", "rate_hz = 50.0\n", at), None);
    assert_eq!(fault("server configuration", "site = \"yard\"\n", at), None);
    assert!(fault("robot.toml", "rate_hz = 5.0\n", at).is_some());
    assert!(fault("robot.toml", "rate = 50.0\n", at).is_some());
    assert!(fault("server configuration", "sites = 1\n", at).is_some());
    assert!(fault("server configuration with mail", "", at).is_some());
    assert!(fault("else", "", at).is_some());
}
