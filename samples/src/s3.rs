//! S3-compatible storage that we did not write, as a process of its own on the loopback.

use std::io::{BufRead as _, BufReader};
use std::net::TcpListener;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// How long it may take to start: it reads hundreds of files, which may be on a cold disk.
const START_MAX: Duration = Duration::from_mins(1);

/// Storage at work; its process ends with it.
#[derive(Debug)]
pub struct S3Server {
    process: Child,
    port: u16,
}

impl S3Server {
    /// Starts one and waits until it listens. Returns `None`, which it reports, if it is not installed.
    ///
    /// # Panics
    /// It does not start.
    pub fn start(test: &str) -> Option<Self> {
        let program = program();
        if !program.exists() {
            eprintln!(
                "`{test}` was NOT RUN: {} does not exist; `./check` installs it",
                program.display()
            );
            return None;
        }
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = free.local_addr().expect("its address").port();
        drop(free);
        Some(Self::at(port))
    }

    fn at(port: u16) -> Self {
        let mut command = Command::new(program());
        command.args(["-H", "127.0.0.1", "-p", &port.to_string()]);
        command.stdin(Stdio::null()).stdout(Stdio::null());
        let mut process = command.stderr(Stdio::piped()).spawn().expect("moto_server");
        let said = BufReader::new(process.stderr.take().expect("its log"));
        let (started, ready) = std::sync::mpsc::channel();
        // Ends with the process; its log is read so that it never waits.
        std::thread::spawn(move || {
            for line in said.lines().map_while(Result::ok) {
                if line.contains("Running on") {
                    // Nobody waits for it any more after the timeout.
                    let _ = started.send(());
                }
            }
        });
        let server = Self { process, port };
        ready
            .recv_timeout(START_MAX)
            .expect("moto_server says that it runs");
        server
    }

    /// Returns the number of its process, for signals.
    pub fn process(&self) -> u32 {
        self.process.id()
    }

    /// Returns its address.
    pub fn endpoint(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    /// Returns the environment of a program that uses it.
    pub fn environment(&self) -> Vec<(&'static str, String)> {
        vec![
            ("AWS_ENDPOINT_URL", self.endpoint()),
            ("AWS_ALLOW_HTTP", "true".to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
            ("AWS_ACCESS_KEY_ID", "test".to_owned()),
            ("AWS_SECRET_ACCESS_KEY", "test".to_owned()),
        ]
    }

    /// Ends the process and starts an empty one at the same address.
    pub fn restart(&mut self) {
        self.end();
        *self = Self::at(self.port);
    }

    /// Ends the process.
    pub fn end(&mut self) {
        // It may have ended by itself.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Drop for S3Server {
    fn drop(&mut self) {
        self.end();
    }
}

fn program() -> PathBuf {
    let cache = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from);
    let home = || PathBuf::from(std::env::var_os("HOME").unwrap_or_default()).join(".cache");
    cache
        .unwrap_or_else(home)
        .join("tread/moto/bin/moto_server")
}
