//! The program as a service manager sees it.

use std::os::unix::fs::PermissionsExt as _;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use crate::harness::{PATIENCE, client, eventually, folder_of_the_crate};

fn program(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tread-server"));
    command
        .args(arguments)
        .env_remove("RUST_LOG")
        .stdin(Stdio::null());
    command
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_wrong_key_in_the_configuration_stops_the_start_with_file_line_and_key() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tread.toml");
    std::fs::write(&file, "# mine\ndatabse = \"x.db\"\n").unwrap();
    let output = program(&["--config", file.to_str().unwrap()])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let said = said(&output);
    for part in ["tread.toml", "line 2", "databse"] {
        assert!(said.contains(part), "`{part}` in: {said}");
    }
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no database was made"
    );
}

#[test]
fn an_address_that_others_can_reach_stops_the_start_with_a_sentence() {
    let output = program(&["--http", "0.0.0.0:0"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(
        said(&output).contains("other machines can reach"),
        "{}",
        said(&output)
    );
    let output = program(&["--no-such-flag"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_program_starts_makes_its_database_and_stops_when_asked() {
    let folder = tempfile::tempdir().unwrap();
    let database = folder.path().join("tread.db");
    let log = std::fs::File::create(folder.path().join("log")).unwrap();
    let config = folder.path().join("tread.toml");
    std::fs::write(&config, "[audit]\nlog = true\n").unwrap();
    let arguments = [
        "--http=127.0.0.1:0",
        "--zenoh=127.0.0.1:0",
        "--site=field",
        "--log-format=json",
    ];
    let mut child = program(&arguments)
        .arg(format!("--database={}", database.display()))
        .arg(format!("--config={}", config.display()))
        .stderr(log)
        .spawn()
        .unwrap();
    let address = eventually("the API is up", async || {
        let log = std::fs::read_to_string(folder.path().join("log")).unwrap();
        let line = log
            .lines()
            .find(|line| line.contains("REST API on "))
            .map(str::to_owned);
        let address = line.and_then(|line| {
            let rest = line.split("REST API on ").nth(1)?;
            Some(rest.split(',').next()?.to_owned())
        });
        address.ok_or(log)
    })
    .await;
    let database_flag = format!("--database={}", database.display());
    let init = || program(&["init", &database_flag]).output().unwrap();
    let first = init();
    assert!(first.status.success(), "{}", said(&first));
    let token = String::from_utf8(first.stdout).unwrap();
    let asking = client(Some(token.trim()));
    let site = asking.get(format!("{address}/v1/sites/field"));
    assert_eq!(site.send().await.unwrap().status(), 200);
    let second = init();
    assert_eq!(second.status.code(), Some(1));
    assert!(
        second.stdout.is_empty() && said(&second).contains("--force"),
        "{}",
        said(&second)
    );
    assert!(database.is_file());
    let file = folder.path().join("admin.token");
    let to_file = format!("--token-file={}", file.display());
    let again = program(&["init", "--force", &to_file, &database_flag])
        .output()
        .unwrap();
    assert!(
        again.status.success() && again.stdout.is_empty(),
        "{}",
        said(&again)
    );
    let mode = std::fs::metadata(&file).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    let newer = std::fs::read_to_string(&file).unwrap();
    let of = async |token: &str| {
        let asked = client(Some(token.trim())).get(format!("{address}/v1/session"));
        asked.send().await.unwrap().status()
    };
    assert_eq!(of(&newer).await, 200);
    eventually(
        "the running server has noticed that the first one was replaced",
        async || {
            let status = of(&token).await;
            if status == 401 { Ok(()) } else { Err(status) }
        },
    )
    .await;
    let creating = client(Some(newer.trim())).post(format!("{address}/v1/sites"));
    let creating = creating.json(&serde_json::json!({"id": "annex"}));
    assert_eq!(creating.send().await.unwrap().status(), 201);
    eventually("the entry is in the log with its hash", async || {
        let log = std::fs::read_to_string(folder.path().join("log")).unwrap();
        let lines = log.lines().filter(|line| line.contains("tread_audit"));
        let mut lines = lines.filter(|line| line.contains("annex"));
        match lines.next() {
            Some(line) if line.contains("\"hash\":\"") => Ok(()),
            Some(_) | None => Err(log),
        }
    })
    .await;
    let asked = Command::new("kill")
        .arg(child.id().to_string())
        .status()
        .unwrap();
    assert!(asked.success());
    let ended = tokio::task::spawn_blocking(move || child.wait().unwrap());
    let ended = tokio::time::timeout(PATIENCE + Duration::from_secs(10), ended).await;
    assert_eq!(ended.unwrap().unwrap().code(), Some(0));
}

#[test]
fn a_release_checks_the_sums_of_our_own_crates_for_overflow() {
    let manifest = folder_of_the_crate().join("../Cargo.toml");
    let manifest: toml::Table = std::fs::read_to_string(manifest).unwrap().parse().unwrap();
    let release = &manifest["profile"]["release"];
    assert_eq!(release["overflow-checks"].as_bool(), Some(true));
    let packages = release["package"].as_table().unwrap();
    let members = manifest["workspace"]["members"].as_array().unwrap();
    for member in members {
        let name = format!("tread-{}", member.as_str().unwrap());
        let own = packages
            .get(&name)
            .and_then(|own| own.get("overflow-checks"));
        assert!(own.is_none(), "{name} has checks of its own");
    }
}
