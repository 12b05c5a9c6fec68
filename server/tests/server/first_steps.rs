//! `tread-server init` and `doctor` as somebody types them who has never run a server.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use reqwest::{Certificate, StatusCode};
use serde_json::Value;

use crate::harness::eventually;
use crate::ports::free_address;

const PROGRAM: &str = env!("CARGO_BIN_EXE_tread-server");

fn run(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(PROGRAM)
        .args(arguments)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

fn text(output: &Output) -> String {
    let all = [&output.stdout, &output.stderr];
    all.map(|bytes| String::from_utf8_lossy(bytes).into_owned())
        .join("\n")
}

fn mode(file: &Path) -> u32 {
    fs::metadata(file).unwrap().permissions().mode() & 0o777
}

/// A server that is ended when this is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // Both fail only if it has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(folder: &Path) -> Running {
    let log = fs::File::create(folder.join("log")).unwrap();
    let child = Command::new(PROGRAM)
        .args(["--config", "tread.toml"])
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stderr(log)
        .spawn();
    Running(child.unwrap())
}

fn doctor(folder: &Path) -> (Option<i32>, Value) {
    let output = run(folder, &["doctor", "--config", "tread.toml", "--json"]);
    let report = serde_json::from_slice(&output.stdout);
    (
        output.status.code(),
        report.unwrap_or_else(|error| panic!("{error}: {}", text(&output))),
    )
}

fn finding<'a>(report: &'a Value, name: &str) -> &'a Value {
    let mut checks = report["checks"].as_array().unwrap().iter();
    let found = checks.find(|check| check["name"] == name);
    found.unwrap_or_else(|| panic!("no `{name}` in {report}"))
}

fn authorities_client(folder: &Path) -> reqwest::Client {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let pem = fs::read(folder.join("tread-data/authority/ca.pem")).unwrap();
    let certificate = Certificate::from_pem(&pem).unwrap();
    let builder = reqwest::Client::builder().tls_certs_only([certificate]);
    builder.build().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_is_set_up_by_one_command_and_examined_before_during_and_after() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let [http, zenoh] = [(); 2].map(|()| free_address().port());
    let (http, zenoh) = (format!("127.0.0.1:{http}"), format!("127.0.0.1:{zenoh}"));
    let init = [
        "init",
        "--yes",
        "--config",
        "tread.toml",
        "--data-dir",
        "tread-data",
        "--names",
        "localhost",
        "--http",
        &http,
        "--zenoh",
        &zenoh,
        "--site",
        "park",
    ];
    let made = run(folder, &init);
    assert!(made.status.success(), "{}", text(&made));
    let said = text(&made);
    assert_eq!(mode(&folder.join("admin.token")), 0o600);
    assert_eq!(mode(&folder.join("tread-data/authority/ca.key")), 0o600);
    assert!(
        said.contains("tread login --server https://localhost:"),
        "{said}"
    );
    let fingerprint = said.split("SHA-256 ").nth(1).unwrap();
    let fingerprint = fingerprint.split_whitespace().next().unwrap();
    assert!(
        said.contains(&format!("--ca-fingerprint {fingerprint}")),
        "{said}"
    );

    // Nothing of it is replaced by another run.
    let config = fs::read_to_string(folder.join("tread.toml")).unwrap();
    let again = run(folder, &init);
    assert_eq!(again.status.code(), Some(1));
    assert!(text(&again).contains("--force"), "{}", text(&again));
    assert_eq!(
        fs::read_to_string(folder.join("tread.toml")).unwrap(),
        config
    );

    let (code, before) = doctor(folder);
    assert_eq!(code, Some(0), "{before}");
    assert_eq!(finding(&before, "server")["verdict"], "skipped");
    assert_eq!(finding(&before, "port of REST")["verdict"], "ok");

    let server = start(folder);
    let client = authorities_client(folder);
    let port = http.rsplit(':').next().unwrap();
    let address = format!("https://localhost:{port}");
    eventually(
        "the server is ready, by TLS of its own authority",
        async || match client.get(format!("{address}/readyz")).send().await {
            Ok(answer) if answer.status() == StatusCode::OK => Ok(()),
            other => Err((
                other.map(|answer| answer.status()),
                fs::read_to_string(folder.join("log")),
            )),
        },
    )
    .await;
    let token = fs::read_to_string(folder.join("admin.token")).unwrap();
    let asked = client.get(format!("{address}/v1/sites/park"));
    let answer = asked.bearer_auth(token.trim()).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    let (code, during) = doctor(folder);
    assert_eq!(code, Some(0), "{during}");
    for name in [
        "server",
        "port of REST",
        "readiness",
        "certificate served",
        "port of robots",
        "database",
    ] {
        assert_eq!(finding(&during, name)["verdict"], "ok", "{name}: {during}");
    }
    drop(server);

    // Another program takes the port meanwhile.
    let held = eventually("the port is free", async || TcpListener::bind(&http)).await;
    let (code, after) = doctor(folder);
    assert_eq!(code, Some(1), "{after}");
    let found = finding(&after, "port of REST");
    assert_eq!(found["verdict"], "problem");
    assert!(
        found["next_step"].as_str().unwrap().contains("ss -ltnp"),
        "{found}"
    );
    drop(held);
}

#[test]
fn without_a_configuration_init_and_doctor_say_how_to_make_one() {
    let folder = tempfile::tempdir().unwrap();
    let init = run(folder.path(), &["init", "--config", "tread.toml"]);
    assert_eq!(init.status.code(), Some(1));
    assert!(text(&init).contains("--yes"), "{}", text(&init));
    let (code, report) = doctor(folder.path());
    assert_eq!(code, Some(1));
    let found = finding(&report, "configuration");
    assert!(
        found["text"].as_str().unwrap().contains("tread.toml"),
        "{found}"
    );
    assert!(
        found["next_step"]
            .as_str()
            .unwrap()
            .contains("tread-server init"),
        "{found}"
    );
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        0,
        "nothing was made"
    );
}

#[test]
fn what_fails_leaves_no_half_of_a_configuration() {
    let folder = tempfile::tempdir().unwrap();
    // The folder of the data is a file.
    fs::write(folder.path().join("data"), "").unwrap();
    let made = run(
        folder.path(),
        &[
            "init",
            "--config",
            "tread.toml",
            "--yes",
            "--data-dir",
            "data",
        ],
    );
    assert_eq!(made.status.code(), Some(1));
    assert!(text(&made).contains("`data`"), "{}", text(&made));
    let token = folder.path().join("tokens");
    fs::create_dir(&token).unwrap();
    let made = run(
        folder.path(),
        &[
            "init",
            "--config",
            "tread.toml",
            "--yes",
            "--token-file",
            "tokens",
        ],
    );
    assert_eq!(made.status.code(), Some(1));
    let mut left: Vec<_> = fs::read_dir(folder.path())
        .unwrap()
        .map(|file| file.unwrap().file_name())
        .collect();
    left.sort();
    assert_eq!(left, ["data", "tokens"]);
}

#[test]
fn flags_that_do_not_go_together_are_refused_by_their_names() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, said) in [
        (vec!["init", "--yes", "--tls", "files"], "--tls-certificate"),
        (vec!["init", "--yes", "--tls", "proxy"], "--names"),
        (
            vec!["init", "--yes", "--http", "0.0.0.0:1"],
            "--http 0.0.0.0:1",
        ),
        (vec!["init", "--yes", "--database", "x.db"], "--data-dir"),
        (vec!["init", "--yes", "--site", "A b"], "--site"),
        (vec!["init", "--yes", "--tls-key", "x"], "--tls-certificate"),
        // Either the service is not installed, or it reads another configuration.
        (vec!["init", "--start"], "--start needs"),
    ] {
        let mut arguments = arguments;
        if !arguments.contains(&"--database") {
            arguments.extend(["--config", "tread.toml"]);
        }
        let refused = run(folder.path(), &arguments);
        assert!(!refused.status.success(), "{arguments:?}");
        assert!(
            text(&refused).contains(said),
            "`{said}` in {}",
            text(&refused)
        );
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}
