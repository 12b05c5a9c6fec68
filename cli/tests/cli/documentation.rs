//! The commands that README and documentation show are run, in their order: those of a page in one
//! shell, against a demo, or against server and agent that the page itself starts.
//!
//! A comment `not run: why` above a block leaves it out. `run in a clean root: name` leaves it to
//! `deploy/check-packages --install`. `args/documented.rs` reads every command all the same.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use tread_tests::markdown::{Block, Document, documents};
use tread_tests::ports::free_address;
use tread_tests::repository::root;
use tread_tests::wait::{SHORT, eventually};

const PROGRAM: &str = env!("CARGO_BIN_EXE_tread");
/// Most blocks that are not run.
const NOT_RUN_MAX: usize = 26;
/// Begin of the comment above a block that is not run.
const NOT_RUN: &str = "not run: ";
/// Begin of the comment above a block that is run from packages alone; a name follows.
const IN_CLEAN_ROOT: &str = "run in a clean root: ";
/// Program that runs those blocks.
const CLEAN_ROOT: &str = "deploy/check-packages";
/// Pages whose commands are for the fleet of a demo.
const WITH_A_DEMO: [&str; 3] = ["README.md", "docs/rest.md", "docs/friction.md"];
/// The page that starts a server and an agent of its own.
const OF_ITS_OWN: &str = "docs/deployment.md";
/// Longest time of one page, seconds.
const PAGE_S_MAX: &str = "45";
/// Address of the REST API in the documentation.
const API: &str = "127.0.0.1:8420";
/// The robots' port in the documentation.
const ROUTER: &str = "127.0.0.1:7447";

/// What stands before every page.
const BEGIN: &str = r#"
set -euo pipefail
PS4='+ line $LINENO: '
cd "$FOLDER"
# An answer that refuses fails the page.
curl() { command curl --fail-with-body --show-error --max-time 20 "$@"; }
tread() {
    case "$*" in
        # It reads the keys of a terminal.
        drive*) ;;
        # It goes on until somebody ends it.
        watch*) timeout --signal=INT 2 "$PROGRAM" "$@" || [ $? = 124 ] ;;
        # Nobody waits for a robot here.
        *" --wait "*) "$PROGRAM" "${@/--wait/--priority=0}" ;;
        # It exits with 1 while the robot is stopped.
        "clear rover-1") "$PROGRAM" "$@" || [ $? = 1 ] ;;
        # It asks a person.
        "authority replace") "$PROGRAM" "$@" --yes ;;
        *) "$PROGRAM" "$@" ;;
    esac
}
# Both end with this shell.
tread-server() {
    case "$1" in
        init | forget-certificates | backup | doctor) "$PROGRAM" server "$@" ;;
        *)
            "$PROGRAM" server "$@" >"$FOLDER/server.log" 2>&1 &
            for _ in $(seq 150); do
                if command curl -s --fail "http://$API/readyz" >/dev/null; then return 0; fi
                sleep 0.1
            done
            cat "$FOLDER/server.log" >&2
            return 1
            ;;
    esac
}
tread-agent() {
    case "$1" in
        enroll) "$PROGRAM" agent "$@" ;;
        *) "$PROGRAM" agent "$@" >"$FOLDER/agent.log" 2>&1 & ;;
    esac
}
# What the documentation writes for what differs each time.
TOKEN_ID() { "$PROGRAM" tokens --json | grep -o '"id":"[^"]*"' | head -n 1 | cut -d '"' -f 4; }
ROTATION() { "$PROGRAM" authority --json | grep -o '"id":"[^"]*"' | head -n 1 | cut -d '"' -f 4; }
"#;

fn is_run(block: &Block) -> bool {
    let note = block.note.as_deref().unwrap_or_default();
    block.language == "sh" && !note.starts_with(NOT_RUN) && !note.starts_with(IN_CLEAN_ROOT)
}

/// The shell's script of a page.
fn script(page: &Document, api: &str) -> String {
    let mut script = BEGIN.to_owned();
    for block in page.blocks.iter().filter(|block| is_run(block)) {
        let place = format!("{}:{}", page.name, block.line);
        let text = &block.text;
        let _ = write!(
            script,
            "echo '== {place}' >&2\nset -x\n{text}{{ set +x; }} 2>/dev/null\n"
        );
    }
    let script = script.replace("https://tread.example.org:8420", &format!("http://{api}"));
    let script = script.replace(API, api);
    let script = script.replace(" TOKEN_ID", " \"$(TOKEN_ID)\"");
    script.replace(" ROTATION", " \"$(ROTATION)\"")
}

/// Runs a page in its shell.
async fn run(page: &Document, api: &str, folder: &Path) -> Output {
    let file = folder.join("page.sh");
    std::fs::write(&file, script(page, api)).unwrap();
    let mut command = Command::new("timeout");
    command
        .args(["--kill-after=5", PAGE_S_MAX, "bash"])
        .arg(&file)
        .env_clear()
        .env("PATH", std::env::var_os("PATH").unwrap())
        .env("HOME", folder)
        .env("FOLDER", folder)
        .env("PROGRAM", PROGRAM)
        .env("API", api)
        .env("TREAD_SERVER", format!("http://{api}"))
        .stdin(Stdio::null());
    let ended = tokio::task::spawn_blocking(move || command.output()).await;
    ended.unwrap().unwrap()
}

async fn holds(page: &Document, api: &str, folder: &Path) {
    let ended = run(page, api, folder).await;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(
        ended.status.success(),
        "{}: {}\n{}\n{}",
        page.name,
        ended.status,
        text(&ended.stdout),
        text(&ended.stderr)
    );
}

fn page(name: &str) -> Document {
    let found = documents().into_iter().find(|page| page.name == name);
    found.unwrap_or_else(|| panic!("there is no {name}"))
}

/// A demo with one robot, which ends with the test.
struct Demo {
    process: Child,
    log: PathBuf,
}

impl Demo {
    async fn start(port: u16, folder: &Path) -> Self {
        let log = folder.join("demo.log");
        let file = std::fs::File::create(&log).unwrap();
        let process = Command::new(PROGRAM)
            .args(["demo", "--robots", "1", "--port"])
            .arg(port.to_string())
            .env("HOME", folder)
            .env_remove("XDG_CONFIG_HOME")
            .env_remove("TREAD_CREDENTIALS")
            .stdin(Stdio::null())
            .stdout(file.try_clone().unwrap())
            .stderr(file)
            .spawn();
        let demo = Self {
            process: process.unwrap(),
            log,
        };
        let look = async || std::fs::read_to_string(&demo.log).unwrap_or_default();
        let is_there = |said: &String| said.contains("missions sent");
        eventually("the demo is there", SHORT * 2, look, is_there).await;
        demo
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        // Its parts end with it. Both fail only if it has ended already.
        _ = self.process.kill();
        _ = self.process.wait();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_commands_for_a_demo_do_what_their_pages_say() {
    let folder = tempfile::tempdir().unwrap();
    let api = free_address();
    let demo = Demo::start(api.port(), folder.path()).await;
    for name in WITH_A_DEMO {
        let page = page(name);
        holds(&page, &api.to_string(), folder.path()).await;
    }
    drop(demo);
}

/// The configuration of a page's server: its first one, and `[robots]` of the later one.
fn server_configuration(page: &Document, folder: &Path, api: &str, router: &str) -> String {
    let of = |begin: &str| {
        let begins = |line: &str| line.starts_with(begin);
        let is_one = |block: &&Block| block.language == "toml" && block.text.lines().any(begins);
        let block = page.blocks.iter().find(is_one);
        &block.unwrap_or_else(|| panic!("no `{begin}`")).text
    };
    let robots = of("[robots]").lines();
    let robots: Vec<&str> = robots
        .skip_while(|line| !line.starts_with("[robots]"))
        .collect();
    let text = format!("{}\n{}\n", of("database ="), robots.join("\n"));
    let text = text.replace(API, api).replace(ROUTER, router);
    let in_folder = |name: &str| folder.join(name).display().to_string();
    text.replace("/etc/tread/authority", &in_folder("authority"))
        .replace("\"tread.db\"", &format!("\"{}\"", in_folder("tread.db")))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_and_a_robot_are_set_up_as_their_page_says() {
    let folder = tempfile::tempdir().unwrap();
    let page = page(OF_ITS_OWN);
    let (api, router) = (free_address().to_string(), free_address().to_string());
    let configuration = server_configuration(&page, folder.path(), &api, &router);
    std::fs::write(folder.path().join("tread.toml"), configuration).unwrap();
    let robot = std::fs::read_to_string(root().join("robot-agent/robot.example.toml")).unwrap();
    let robot = robot.replace("/var/lib/tread-agent", &folder.path().display().to_string());
    // It goes where its membership says.
    let robot = robot.lines().filter(|line| !line.starts_with("server ="));
    let robot = robot.collect::<Vec<_>>().join("\n");
    std::fs::write(folder.path().join("robot.toml"), robot).unwrap();
    holds(&page, &api, folder.path()).await;
}

#[test]
fn every_block_is_run_or_says_why_not() {
    let mut not_run = Vec::new();
    let clean_root = std::fs::read_to_string(root().join(CLEAN_ROOT)).unwrap();
    let named = clean_root.lines().find_map(|line| {
        let names = line.strip_prefix("for block in ")?.strip_suffix("; do")?;
        Some(names.split(' ').collect::<Vec<_>>())
    });
    let named = named.expect("the names of blocks stand in a loop");
    for page in documents() {
        let name = &page.name;
        let has_a_session = WITH_A_DEMO.contains(&name.as_str()) || name == OF_ITS_OWN;
        for block in page.blocks.iter().filter(|block| block.language == "sh") {
            let place = format!("{name}:{}", block.line);
            let note = block.note.as_deref().unwrap_or_default();
            if let Some(block) = note.strip_prefix(IN_CLEAN_ROOT) {
                let is_run = name == OF_ITS_OWN && named.contains(&block.trim());
                assert!(is_run, "{CLEAN_ROOT} does not run {place}");
            } else if is_run(block) {
                assert!(
                    has_a_session,
                    "{place} is run by nothing: say `{NOT_RUN}…` above"
                );
            } else {
                not_run.push(place);
            }
        }
    }
    let count = not_run.len();
    assert!(count <= NOT_RUN_MAX, "{count} are not run: {not_run:#?}");
}
