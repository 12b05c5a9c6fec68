//! A PostgreSQL server that is stopped and killed while robots upload and one is driven.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use reqwest::StatusCode;
use sqlx::{Connection as _, PgConnection};
use tread_api::friction::StoredSegment;
use tread_api::mission::MissionState;
use tread_api::page::Page;
use tread_server::db::Location;

use super::{address_of, created};
use crate::drive::{Socket, driven_at};
use crate::harness::{Yard, eventually, folder_of_the_crate, measured, segment};
use crate::robot::Robot;

/// How long PostgreSQL is stopped; longer than the server's limits of its statements and of its health. The
/// variable gives other seconds.
const STOPPED: Duration = Duration::from_secs(8);
const STOPPED_VARIABLE: &str = "TREAD_POSTGRES_STOPPED_S";

/// A PostgreSQL server of this test alone.
struct OwnPostgres {
    /// Ends, and with it PostgreSQL, when its input is closed.
    keeper: Child,
    admin: String,
    data: PathBuf,
}

impl OwnPostgres {
    /// Starts one; `None`, which is reported, where PostgreSQL is not installed.
    async fn start() -> Option<Self> {
        let script = folder_of_the_crate().join("../store-postgres/with-postgres");
        let mut keeper = Command::new(script);
        keeper.args(["sh", "-c", "echo \"$TREAD_TEST_POSTGRES\"; exec cat"]);
        keeper.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut keeper = keeper.spawn().unwrap();
        let mut admin = String::new();
        let mut said = BufReader::new(keeper.stdout.take().unwrap());
        said.read_line(&mut admin).unwrap();
        if admin.is_empty() {
            eprintln!("this test was NOT RUN: {}", keeper.wait().unwrap());
            return None;
        }
        let admin = admin.trim().to_owned();
        let mut connection = PgConnection::connect(&admin).await.unwrap();
        let (data,): (String,) = sqlx::query_as("SHOW data_directory")
            .fetch_one(&mut connection)
            .await
            .unwrap();
        Some(Self {
            keeper,
            admin,
            data: data.into(),
        })
    }

    fn main_process(&self) -> Pid {
        let text = fs::read_to_string(self.data.join("postmaster.pid")).unwrap();
        Pid::from_raw(text.lines().next().unwrap().trim().parse().unwrap())
    }

    /// Sends a signal to all its processes.
    fn signal(&self, signal: Signal) {
        let main = self.main_process();
        for process in children_of(main).into_iter().chain([main]) {
            // One may have ended since it was listed.
            let _ = kill(process, signal);
        }
    }

    /// Ends it without a chance to write anything, and starts it again.
    fn kill_and_restart(&self) {
        let main = self.main_process();
        let children = children_of(main);
        for process in [main].into_iter().chain(children) {
            let _ = kill(process, Signal::SIGKILL);
        }
        let options = fs::read_to_string(self.data.join("postmaster.opts")).unwrap();
        let program = Path::new(options.split(' ').next().unwrap());
        let control = program.with_file_name("pg_ctl");
        let owner = fs::metadata(&self.data).unwrap();
        // Where nobody reaps the process, `pg_ctl` would wait for its end.
        let _ = fs::remove_file(self.data.join("postmaster.pid"));
        let mut restart = if nix::unistd::geteuid().is_root() {
            let mut as_owner = Command::new("setpriv");
            as_owner.arg(format!("--reuid={}", owner.uid()));
            as_owner.arg(format!("--regid={}", owner.gid()));
            as_owner.arg("--clear-groups").arg(control);
            as_owner
        } else {
            Command::new(control)
        };
        restart.args(["restart", "--wait", "--mode=immediate", "--timeout=60"]);
        restart.arg("--pgdata").arg(&self.data);
        restart
            .arg("--log")
            .arg(self.data.with_file_name("server.log"));
        restart.current_dir(&self.data).stdout(Stdio::null());
        assert!(restart.status().unwrap().success());
    }
}

impl Drop for OwnPostgres {
    fn drop(&mut self) {
        self.signal(Signal::SIGCONT);
        drop(self.keeper.stdin.take());
        // Its end is that of PostgreSQL.
        let _ = self.keeper.wait();
    }
}

fn children_of(parent: Pid) -> Vec<Pid> {
    let processes = fs::read_dir("/proc").unwrap();
    let ids = processes.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse::<i32>().ok());
    let is_child = |id: &i32| {
        let stat = fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
        // After the name in parentheses: state and parent.
        let fields = stat
            .rsplit_once(')')
            .map(|(_, rest)| rest.split_whitespace());
        let found = fields.and_then(|mut fields| fields.nth(1)?.parse().ok());
        found == Some(parent.as_raw())
    };
    ids.filter(is_child).map(Pid::from_raw).collect()
}

/// Uploads one measurement, again and again until it is acknowledged.
async fn acknowledged(robot: &Robot, seq: u64) {
    let record = vec![measured(seq, segment((2, 2), 0.2, 10))];
    eventually("the measurement is acknowledged", async || {
        robot.upload(record.clone()).await
    })
    .await;
}

async fn ready_is(yard: &Yard, expected: StatusCode) {
    eventually("the readiness changes", async || {
        let (status, body) = yard.get_value("/readyz").await;
        (status == expected).then_some(()).ok_or(body)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stopped_and_a_killed_postgresql_lose_nothing_that_was_acknowledged() {
    let Some(postgres) = OwnPostgres::start().await else {
        return;
    };
    let seconds = std::env::var(STOPPED_VARIABLE).ok();
    let stopped = seconds.map_or(STOPPED, |text| Duration::from_secs(text.parse().unwrap()));
    let folder = tempfile::tempdir().unwrap();
    let address = address_of(&created(&postgres.admin, folder.path()));
    let yard = Yard::start_configured(|config, _| config.database = Location::Postgres(address));
    let yard = yard.await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let other = Robot::join(&yard, "rover-2").await;
    acknowledged(&robot, 1).await;

    postgres.signal(Signal::SIGSTOP);
    ready_is(&yard, StatusCode::SERVICE_UNAVAILABLE).await;
    let mut socket = Socket::open(&yard, "rover-2").await;
    socket.acquire("desk").await;
    socket.drive(0.4).await;
    driven_at(&other, 0.4).await;
    let lost = vec![measured(2, segment((2, 2), 0.2, 20))];
    robot.upload(lost).await.unwrap_err();
    tokio::time::sleep(stopped).await;
    postgres.signal(Signal::SIGCONT);
    ready_is(&yard, StatusCode::OK).await;
    acknowledged(&robot, 2).await;

    postgres.kill_and_restart();
    for seq in 3..6 {
        acknowledged(&robot, seq).await;
    }
    ready_is(&yard, StatusCode::OK).await;
    let stored: Page<StoredSegment> = yard.get("/v1/sites/yard/segments?limit=100").await;
    let seqs: Vec<u64> = stored.items.iter().map(|one| one.seq).collect();
    assert_eq!(seqs, [1, 2, 3, 4, 5], "each once");
    let detail = yard.mission(mission.id).await;
    assert_eq!(detail.mission.state, MissionState::Active, "{detail:?}");
    drop((robot, other));
    yard.server.stop().await.unwrap();
}
