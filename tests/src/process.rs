//! One process of the fleet: started, stopped politely, killed without a word, and measured.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use anyhow::Context;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::time::Instant;

/// Longest wait for a process that was asked to stop.
const STOP_WAIT_MAX: Duration = Duration::from_secs(15);
/// Time between two looks at a process that is to end.
const POLL_INTERVAL: Duration = Duration::from_millis(10);
/// Ticks per second of the kernel's CPU accounting, the same on every Linux of today.
const CLOCK_TICKS_PER_SECOND: f64 = 100.0;

/// The executable that is a server or an agent; those of this package stand beside each other.
///
/// # Errors
/// It was not built.
pub fn node() -> anyhow::Result<PathBuf> {
    let node = std::env::current_exe()?.with_file_name("node");
    anyhow::ensure!(
        node.exists(),
        "{} is missing: build it with `cargo build --release -p tread-tests --bins`",
        node.display()
    );
    Ok(node)
}

/// The program `tread`, beside this one.
///
/// # Errors
/// It was not built.
pub fn tread() -> anyhow::Result<PathBuf> {
    let tread = std::env::current_exe()?.with_file_name("tread");
    anyhow::ensure!(
        tread.exists(),
        "{} is missing: build it with `cargo build -p tread`, in the same profile",
        tread.display()
    );
    Ok(tread)
}

/// A child process; it is killed when it is dropped.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
}

impl Process {
    /// Starts `program`, with its output appended to `log`.
    ///
    /// # Errors
    /// The program cannot be started or its log not be written.
    pub fn start(
        name: &str,
        program: &Path,
        arguments: &[String],
        log: &Path,
    ) -> anyhow::Result<Self> {
        Self::start_with_environment(name, program, arguments, (log, &[]))
    }

    /// The same, with these variables of the environment beside those of this process.
    ///
    /// # Errors
    /// The program cannot be started or its log not be written.
    pub fn start_with_environment(
        name: &str,
        program: &Path,
        arguments: &[String],
        (log, environment): (&Path, &[(String, String)]),
    ) -> anyhow::Result<Self> {
        let log_file = File::options().create(true).append(true).open(log);
        let log_file = log_file.with_context(|| format!("cannot write {}", log.display()))?;
        let child = Command::new(program)
            .args(arguments)
            .envs(environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::null())
            .stdout(log_file.try_clone()?)
            .stderr(log_file)
            .spawn()
            .with_context(|| format!("cannot start {}", program.display()))?;
        Ok(Self {
            name: name.to_owned(),
            child,
        })
    }

    /// Ends the process as a power cut would.
    pub fn kill(&mut self) {
        // Both fail only if it has ended already.
        _ = self.child.kill();
        _ = self.child.wait();
    }

    /// Sends a signal to the process; does nothing if it has ended.
    pub fn signal(&self, signal: Signal) {
        _ = kill(Pid::from_raw(self.child.id().cast_signed()), signal);
    }

    /// Asks the process to stop and waits until it has.
    ///
    /// # Errors
    /// It has not stopped within [`STOP_WAIT_MAX`]; it is killed then.
    pub async fn stop(&mut self) -> anyhow::Result<ExitStatus> {
        self.signal(Signal::SIGTERM);
        let deadline = Instant::now() + STOP_WAIT_MAX;
        loop {
            if let Some(status) = self.child.try_wait()? {
                return Ok(status);
            }
            if Instant::now() >= deadline {
                self.kill();
                anyhow::bail!("{} did not stop within {STOP_WAIT_MAX:?}", self.name);
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    }

    /// How it ended, if it has.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().ok().flatten()
    }

    /// Whether it has ended. What is left of a process until somebody asks how it ended counts as
    /// ended.
    pub fn has_ended(&self) -> bool {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id()));
        stat.map_or(true, |stat| {
            let behind_name = stat.rsplit_once(") ");
            behind_name.is_none_or(|(_, fields)| fields.starts_with(['Z', 'X']))
        })
    }

    /// What it has used so far; `None` when it is gone.
    pub fn usage(&self) -> Option<Usage> {
        usage_of(self.child.id())
    }

    /// How many of its threads have a name that begins so.
    pub fn threads(&self, beginning: &str) -> usize {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", self.child.id()));
        let named_so = |task: std::io::Result<std::fs::DirEntry>| {
            let name = std::fs::read_to_string(task.ok()?.path().join("comm")).ok()?;
            name.starts_with(beginning).then_some(())
        };
        tasks.map_or(0, |tasks| tasks.filter_map(named_so).count())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// What a process has used.
#[derive(Debug, Clone, Copy, serde::Serialize)]
pub struct Usage {
    /// Processor time since its start, seconds.
    pub cpu_s: f64,
    /// Resident memory, bytes.
    pub memory_bytes: u64,
    /// Largest resident memory so far, bytes.
    pub memory_peak_bytes: u64,
}

/// What a process has used so far, from `/proc`; `None` when it is gone.
pub fn usage_of(process_id: u32) -> Option<Usage> {
    let stat = std::fs::read_to_string(format!("/proc/{process_id}/stat")).ok()?;
    // The name in parentheses may contain spaces, so fields are counted from behind it.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |index: usize| fields.get(index)?.parse::<f64>().ok();
    let cpu_s = (ticks(11)? + ticks(12)?) / CLOCK_TICKS_PER_SECOND;
    let status = std::fs::read_to_string(format!("/proc/{process_id}/status")).ok()?;
    let kib = |name: &str| {
        let line = status.lines().find(|line| line.starts_with(name))?;
        line.split_whitespace().nth(1)?.parse::<u64>().ok()
    };
    Some(Usage {
        cpu_s,
        memory_bytes: kib("VmRSS:")? * 1024,
        memory_peak_bytes: kib("VmHWM:")? * 1024,
    })
}
