//! The program under conditions of the machine: a full disk, a read-only disk, a damaged database,
//! files of another user, a clock an hour off, an expired certificate. Each gives a message that names
//! the thing and what to do, and nothing that was acknowledged is lost.
//!
//! Disks are of the test's own mount namespace, which needs root; without it the test says so.

mod disks;

use std::fs::{self, File, Permissions};
use std::os::unix::fs::{PermissionsExt as _, chown};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::SystemTime;

use jiff::{SignedDuration, Timestamp};
use rcgen::{CertificateParams, KeyPair};
use serde_json::Value;
use tread_server::Server;
use tread_server::clock::Clock;

use crate::harness::{config, database, eventually, time};

const PROGRAM: &str = env!("CARGO_BIN_EXE_tread-server");
/// A user who may do nothing in particular.
const NOBODY: u32 = 65_534;

fn is_root() -> bool {
    nix::unistd::Uid::effective().is_root()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn assert_says(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "`{part}` in: {text}");
    }
}

/// Runs the program as a user who may do nothing, on a copy that this user can execute.
fn as_nobody(folder: &Path, arguments: &[String]) -> String {
    let copy = folder.join("program");
    if !copy.exists() {
        fs::copy(PROGRAM, &copy).unwrap();
        fs::set_permissions(&copy, Permissions::from_mode(0o755)).unwrap();
    }
    let output = Command::new("setpriv")
        .args(["--reuid", "65534", "--regid", "65534", "--clear-groups"])
        .arg(&copy)
        .args(arguments)
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    said(&output)
}

#[test]
fn files_that_the_servers_user_may_not_use_are_named_with_what_to_do() {
    if !is_root() {
        eprintln!("NOT CHECKED: only root can run the server as another user");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    fs::set_permissions(folder.path(), Permissions::from_mode(0o755)).unwrap();
    let at = |name: &str| folder.path().join(name);
    let shown = |name: &str| at(name).display().to_string();
    let owned = |name: &str| {
        fs::create_dir(at(name)).unwrap();
        chown(at(name), Some(NOBODY), Some(NOBODY)).unwrap();
    };
    owned("data");
    let config = at("tread.toml");
    let flags = |database: &str| {
        let mut flags = vec![
            "--http=127.0.0.1:0".to_owned(),
            "--zenoh=127.0.0.1:0".to_owned(),
        ];
        flags.push(format!("--database={}", shown(database)));
        flags
    };
    let with_config = |text: &str| {
        fs::write(&config, text).unwrap();
        let mut flags = flags("data/tread.db");
        flags.push(format!("--config={}", config.display()));
        flags
    };

    let arguments = with_config("site = \"yard\"\n");
    fs::set_permissions(&config, Permissions::from_mode(0o600)).unwrap();
    let text = as_nobody(folder.path(), &arguments);
    assert_says(
        &text,
        &[
            &shown("tread.toml"),
            "Permission denied",
            "must be able to read it",
        ],
    );
    fs::set_permissions(&config, Permissions::from_mode(0o644)).unwrap();

    let made = rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).unwrap();
    fs::write(at("cert.pem"), made.cert.pem()).unwrap();
    fs::write(at("key.pem"), made.signing_key.serialize_pem()).unwrap();
    fs::set_permissions(at("key.pem"), Permissions::from_mode(0o600)).unwrap();
    let tls = format!(
        "[tls]\ncertificate = \"{}\"\nkey = \"{}\"\n",
        shown("cert.pem"),
        shown("key.pem")
    );
    let text = as_nobody(folder.path(), &with_config(&tls));
    assert_says(&text, &[&shown("key.pem"), "must be able to read it"]);

    fs::create_dir(at("closed")).unwrap();
    let text = as_nobody(folder.path(), &flags("closed/tread.db"));
    assert_says(
        &text,
        &[&shown("closed/tread.db"), "Permission denied", "chown"],
    );

    // The database is of root, in a folder of the server's user.
    fs::write(at("data/roots.db"), "").unwrap();
    fs::set_permissions(at("data/roots.db"), Permissions::from_mode(0o600)).unwrap();
    let text = as_nobody(folder.path(), &flags("data/roots.db"));
    assert_says(&text, &[&shown("data/roots.db"), "chown"]);

    let text = as_nobody(folder.path(), &flags("nowhere/tread.db"));
    assert_says(&text, &[&shown("nowhere"), "create"]);
}

/// Runs the server until it has failed to start; what it said.
fn fails_to_start(folder: &Path) -> String {
    let output = Command::new(PROGRAM)
        .args(["--http=127.0.0.1:0", "--zenoh=127.0.0.1:0"])
        .arg(format!("--database={}", database(folder).display()))
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    said(&output)
}

fn doctor(folder: &Path, flags: &[&str]) -> (Option<i32>, Value) {
    // Whatever else runs on this machine has other ports.
    let config = folder.join("doctor.toml");
    fs::write(&config, "http = \"127.0.0.1:0\"\nzenoh = \"127.0.0.1:0\"\n").unwrap();
    let output = Command::new(PROGRAM)
        .args(["doctor", "--json"])
        .args(flags)
        .arg(format!("--config={}", config.display()))
        .arg(format!("--database={}", database(folder).display()))
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let report = serde_json::from_slice(&output.stdout);
    let report = report.unwrap_or_else(|error| panic!("{error}: {}", said(&output)));
    (output.status.code(), report)
}

/// The findings on one question.
fn findings(report: &Value, name: &str) -> String {
    let checks = report["checks"].as_array().unwrap().iter();
    let of_name = checks.filter(|check| check["name"] == name);
    let lines: Vec<String> = of_name.map(Value::to_string).collect();
    lines.join("\n")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_damaged_database_is_named_with_what_to_do_and_left_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(config(folder.path(), "127.0.0.1:0"))
        .await
        .unwrap();
    server.stop().await.unwrap();
    let file = database(folder.path());
    let whole = fs::read(&file).unwrap();
    // The tables are in all pages but the first, which has the schema.
    for (what, damaged) in [("its header", 0..64), ("its tables", 4_096..whole.len())] {
        let mut bytes = whole.clone();
        bytes[damaged].fill(0xff);
        fs::write(&file, &bytes).unwrap();
        let text = fails_to_start(folder.path());
        assert_says(
            &text,
            &[&file.display().to_string(), "restore a backup", ".recover"],
        );
        let (code, report) = doctor(folder.path(), &[]);
        assert_eq!(code, Some(1), "{what}: {report}");
        let found = findings(&report, "database") + &findings(&report, "database content");
        assert_says(&found, &["problem", "restore a backup"]);
        // Nothing is written over what may be recovered.
        let after = fs::read(&file).unwrap();
        assert!(after == bytes, "{what}: the file was changed");
    }
    fs::write(&file, &whole).unwrap();
    let (code, report) = doctor(folder.path(), &["--deep"]);
    assert_eq!(code, Some(0), "{report}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_clock_an_hour_behind_is_said_by_server_and_doctor() {
    let folder = tempfile::tempdir().unwrap();
    let now = Clock::system().machine_time();
    let ahead = Clock::manual(now + SignedDuration::from_hours(1));
    let server = Server::start_with_clock(config(folder.path(), "127.0.0.1:0"), ahead).await;
    let server = server.unwrap();
    let first = tread_server::app::identity::tokens::FirstAdmin {
        name: "tests".to_owned(),
        valid_days: 1,
        force: true,
    };
    server.app().create_first_admin(first).await.unwrap();
    server.stop().await.unwrap();
    let (code, report) = doctor(folder.path(), &[]);
    assert_eq!(code, Some(1), "{report}");
    assert_says(
        &findings(&report, "clock"),
        &["before the newest time in the database", "chrony"],
    );

    let log = File::create(folder.path().join("log")).unwrap();
    let mut child = Command::new(PROGRAM)
        .args(["--http=127.0.0.1:0", "--zenoh=127.0.0.1:0"])
        .arg(format!("--database={}", database(folder.path()).display()))
        .env_remove("RUST_LOG")
        .stderr(log)
        .spawn()
        .unwrap();
    let text = eventually("the server says it", async || {
        let log = fs::read_to_string(folder.path().join("log")).unwrap_or_default();
        if log.contains("behind the server's times") {
            Ok(log)
        } else {
            Err(log)
        }
    })
    .await;
    child.kill().unwrap();
    child.wait().unwrap();
    assert_says(
        &text,
        &[
            "the machine's clock has gone back",
            "have the clock synchronised",
        ],
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_expired_certificate_is_named_and_a_new_file_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let write = |from: Timestamp, until: Timestamp| {
        let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
        let mut params = CertificateParams::new(names).unwrap();
        params.not_before = SystemTime::from(from).into();
        params.not_after = SystemTime::from(until).into();
        let key = KeyPair::generate().unwrap();
        fs::write(at("cert.pem"), params.self_signed(&key).unwrap().pem()).unwrap();
        fs::write(at("key.pem"), key.serialize_pem()).unwrap();
    };
    write(time("2020-01-01T00:00:00Z"), time("2021-01-01T00:00:00Z"));
    fs::set_permissions(at("key.pem"), Permissions::from_mode(0o600)).unwrap();
    let text = format!(
        "http = \"127.0.0.1:0\"\nzenoh = \"127.0.0.1:0\"\ndatabase = \"{}\"\n\
         [tls]\ncertificate = \"{}\"\nkey = \"{}\"\n[web]\nhosts = [\"localhost\"]\n",
        database(folder.path()).display(),
        at("cert.pem").display(),
        at("key.pem").display()
    );
    fs::write(at("tread.toml"), text).unwrap();
    let flag = format!("--config={}", at("tread.toml").display());
    let log = File::create(at("log")).unwrap();
    let mut child = Command::new(PROGRAM)
        .arg(&flag)
        .env_remove("RUST_LOG")
        .stderr(log)
        .spawn()
        .unwrap();
    let said = eventually("the server says it", async || {
        let log = fs::read_to_string(at("log")).unwrap_or_default();
        if log.contains("expired at") {
            Ok(log)
        } else {
            Err(log)
        }
    })
    .await;
    child.kill().unwrap();
    child.wait().unwrap();
    let file = at("cert.pem").display().to_string();
    assert_says(&said, &[&file, "expired at 2021-01-01", "replace the file"]);
    let doctor = || {
        let output = Command::new(PROGRAM)
            .args(["doctor", "--json", &flag])
            .output()
            .unwrap();
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let found = findings(&doctor(), "certificate");
    assert_says(
        &found,
        &[&file, "expired at 2021-01-01", "replace the file"],
    );
    let now = Clock::system().machine_time();
    write(
        now - SignedDuration::from_hours(1),
        now + SignedDuration::from_hours(9_000),
    );
    let found = findings(&doctor(), "certificate");
    assert_says(&found, &["\"verdict\":\"ok\"", "valid until"]);
}
