//! The first steps with a server of one's own: set up by questions in a terminal, trusted by the
//! fingerprint of its authority, and examined from afar.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use tempfile::TempDir;
use tread_server::{Config, RunningServer, Server, ServerArgs};

use crate::terminal::Terminal;

const PROGRAM: &str = env!("CARGO_BIN_EXE_tread");

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_is_set_up_by_questions_whose_defaults_enter_takes() {
    let folder = tempfile::tempdir().unwrap();
    let shown = |name: &str| folder.path().join(name).display().to_string();
    let (config, data) = (shown("tread.toml"), shown("data"));
    let words = ["server", "init", "--config", &config, "--data-dir", &data];
    let mut terminal = Terminal::run(PROGRAM, &words);
    for (question, answer) in [
        ("Configuration file", "\n"),
        ("Site [yard]", "Not a site\n"),
        ("cannot be taken", "park\n"),
        ("One of 1 to 4 [1]", "\n"),
        ("Names and addresses", "localhost\n"),
        ("Address of the REST API [0.0.0.0:8420]", "127.0.0.1:0\n"),
        (
            "Address that robots connect to [0.0.0.0:7447]",
            "127.0.0.1:0\n",
        ),
        ("File for the admin's token", "\n"),
        ("Write this configuration? [yes]", "\n"),
    ] {
        terminal.shows(question).await;
        terminal.press(answer);
    }
    terminal.shows("tread-agent enroll --server").await;
    assert_eq!(terminal.ended().await, Some(0), "{}", terminal.screen());
    let read = Config::load(&ServerArgs {
        config: Some(config.into()),
        ..ServerArgs::default()
    });
    assert_eq!(read.unwrap().site.as_str(), "park");
}

/// A server that was set up by `init`, with a certificate of its own authority.
struct OwnServer {
    folder: TempDir,
    server: RunningServer,
    fingerprint: String,
}

impl OwnServer {
    async fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name).display().to_string();
        let config = at("tread.toml");
        let flags = [
            "server",
            "init",
            "--yes",
            "--names",
            "localhost",
            "--http",
            "127.0.0.1:0",
            "--zenoh",
            "127.0.0.1:0",
            "--config",
            &config,
            "--data-dir",
            &at("data"),
        ];
        let made = run(folder.path(), &flags);
        let said = String::from_utf8_lossy(&made.stdout).into_owned();
        assert!(made.status.success(), "{}", text(&made));
        let fingerprint = said.split("SHA-256 ").nth(1).unwrap();
        let fingerprint = fingerprint.split_whitespace().next().unwrap().to_owned();
        let config = Config::load(&ServerArgs {
            config: Some(config.into()),
            ..ServerArgs::default()
        });
        let server = Server::start(config.unwrap()).await.unwrap();
        Self {
            folder,
            server,
            fingerprint,
        }
    }

    /// Runs the command line as a user of this folder.
    async fn run(&self, words: &[&str]) -> Output {
        let address = format!("https://localhost:{}", self.server.http_address().port());
        let words: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
        let folder = self.folder.path().to_owned();
        let running = tokio::task::spawn_blocking(move || {
            let mut words: Vec<&str> = words.iter().map(String::as_str).collect();
            words.extend(["--server", &address]);
            run(&folder, &words)
        });
        running.await.unwrap()
    }

    /// Runs the command line as that user, who names no server.
    async fn run_unnamed(&self, words: &'static [&'static str]) -> Output {
        let folder = self.folder.path().to_owned();
        let running = tokio::task::spawn_blocking(move || run(&folder, words));
        running.await.unwrap()
    }
}

fn run(home: &Path, words: &[&str]) -> Output {
    Command::new(PROGRAM)
        .args(words)
        .env("HOME", home)
        .env_remove("XDG_CONFIG_HOME")
        .env_remove("TREAD_CREDENTIALS")
        .env_remove("TREAD_TOKEN")
        .env_remove("TREAD_SERVER")
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

fn text(output: &Output) -> String {
    let all = [&output.stdout, &output.stderr];
    all.map(|bytes| String::from_utf8_lossy(bytes).into_owned())
        .join("\n")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_is_trusted_by_the_fingerprint_of_its_authority_and_by_no_other() {
    let own = OwnServer::start().await;
    let token = own.folder.path().join("admin.token").display().to_string();
    let untrusted = own.run(&["whoami", "--token-file", &token]).await;
    assert_eq!(untrusted.status.code(), Some(3), "{}", text(&untrusted));
    let said = text(&untrusted);
    for part in ["authority is not trusted here", "--ca-fingerprint"] {
        assert!(said.contains(part), "`{part}` in {said}");
    }
    let wrong = own.fingerprint.replace('a', "b").replace('0', "1");
    let wrong = if wrong == own.fingerprint {
        "0".repeat(64)
    } else {
        wrong
    };
    let login = ["login", "--token-file", &token, "--ca-fingerprint"];
    let refused = own.run(&[&login[..], &[&wrong]].concat()).await;
    assert_eq!(refused.status.code(), Some(3), "{}", text(&refused));

    let login = own.run(&[&login[..], &[&own.fingerprint]].concat()).await;
    assert!(login.status.success(), "{}", text(&login));
    // From here on it is kept.
    let doctor = own.run(&["doctor"]).await;
    let said = text(&doctor);
    assert!(doctor.status.success(), "{said}");
    for part in [
        "answers by TLS",
        "the server's and this machine's agree",
        "`admin` may",
        "the server can work",
        "no robot has connected to site `yard` yet",
    ] {
        assert!(said.contains(part), "`{part}` in {said}");
    }
    // A command that names no server goes to that of the last login, until its logout.
    let whoami = own.run_unnamed(&["whoami"]).await;
    assert!(whoami.status.success(), "{}", text(&whoami));
    let logout = own.run_unnamed(&["logout"]).await;
    assert!(logout.status.success(), "{}", text(&logout));
    let last = own.folder.path().join(".config/tread/last-login.json");
    assert_eq!(std::fs::read_to_string(last).unwrap().trim(), "{}");
    let doctor = own.run(&["doctor", "--json"]).await;
    assert_eq!(doctor.status.code(), Some(1), "{}", text(&doctor));
    let report: serde_json::Value = serde_json::from_slice(&doctor.stdout).unwrap();
    assert_eq!(report["ok"], false);
    let step = report["checks"][0]["next_step"].as_str().unwrap();
    assert!(step.contains("--ca-fingerprint"), "{report}");
    own.server.stop().await.unwrap();
}

#[test]
fn a_server_that_is_not_there_is_a_problem_with_a_next_step() {
    let folder = tempfile::tempdir().unwrap();
    let words = ["doctor", "--server", "http://127.0.0.1:9"];
    let doctor = run(folder.path(), &words);
    assert_eq!(doctor.status.code(), Some(1));
    let said = text(&doctor);
    assert!(said.contains("WRONG server: no server answers"), "{said}");
    assert!(said.contains("do: "), "{said}");
}
