//! Fails calls of SQLite in this process, by a small C library that is loaded before the C library.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

const CONTROL: &str = "TREAD_FAULT_CONTROL";
const NUMBERS: usize = 6;

/// What fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    WriteFull = 1,
    WriteIo = 2,
    SyncIo = 3,
    ReadIo = 4,
    ReadGarbage = 5,
    NoMemory = 6,
    SyncSlow = 7,
    /// Whatever touches the database waits, until something else is set.
    Hang = 8,
}

impl Fault {
    /// Those that fail a call.
    pub(crate) const ALL: [Self; 6] = [
        Self::WriteFull,
        Self::WriteIo,
        Self::SyncIo,
        Self::ReadIo,
        Self::ReadGarbage,
        Self::NoMemory,
    ];
}

/// The loaded library.
#[derive(Debug)]
pub(crate) struct Interposer {
    control: File,
}

impl Interposer {
    /// The library of this process; `None` in a process that was started without it.
    pub(crate) fn loaded() -> Option<Self> {
        let path = std::env::var_os(CONTROL)?;
        let control = OpenOptions::new()
            .read(true)
            .write(true)
            .open(path)
            .unwrap();
        let interposer = Self { control };
        interposer.assert_loaded();
        Some(interposer)
    }

    /// Fails the test unless the process has loaded the library.
    pub(crate) fn assert_loaded(&self) {
        assert_eq!(
            self.number(4),
            3,
            "the library is not loaded, or SQLite's allocator is not among the program's symbols"
        );
    }

    fn number(&self, index: u64) -> u64 {
        let mut bytes = [0; 8];
        self.control.read_exact_at(&mut bytes, index * 8).unwrap();
        u64::from_le_bytes(bytes)
    }

    fn set(&self, index: u64, value: u64) {
        let bytes = value.to_le_bytes();
        self.control.write_all_at(&bytes, index * 8).unwrap();
    }

    /// Lets the n-th call fail, and all later ones if it `lasts`.
    pub(crate) fn arm(&self, fault: Fault, nth: u64, lasts: bool) {
        self.set(1, nth);
        self.set(2, u64::from(lasts));
        self.set(3, 0);
        self.set(0, fault as u64);
    }

    /// Lets the next sync take so long.
    pub(crate) fn slow_down(&self, delay: Duration) {
        self.set(5, u64::try_from(delay.as_millis()).unwrap());
        self.arm(Fault::SyncSlow, 1, false);
    }

    /// How many calls have failed, or were slow, since something was set.
    pub(crate) fn fired(&self) -> u64 {
        self.number(3)
    }

    /// Lets everything work again; how many calls have failed.
    pub(crate) fn disarm(&self) -> u64 {
        self.set(0, 0);
        self.fired()
    }
}

/// Runs a test of this program again, in a process in which calls can fail.
pub(crate) fn run_with_faults(test: &str) {
    let folder = tempfile::tempdir().unwrap();
    let control = folder.path().join("control");
    std::fs::write(&control, [0; 8 * NUMBERS]).unwrap();
    let library = compiled(folder.path());
    let child = Command::new(std::env::current_exe().unwrap())
        .args([test, "--exact", "--nocapture"])
        .env("LD_PRELOAD", library)
        .env(CONTROL, control)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&child.stderr);
    let printed = String::from_utf8_lossy(&child.stdout);
    assert!(
        child.status.success() && printed.contains("1 passed"),
        "{}\n{printed}\n{said}",
        child.status
    );
    eprintln!("{printed}");
}

/// A program whose calls can fail, and what lets them; the folder must outlive it.
pub(crate) fn program_with_faults(mut program: Command, folder: &Path) -> (Command, Interposer) {
    let control = folder.join("control");
    std::fs::write(&control, [0; 8 * NUMBERS]).unwrap();
    program
        .env("LD_PRELOAD", compiled(folder))
        .env(CONTROL, &control);
    let mut options = OpenOptions::new();
    let control = options.read(true).write(true).open(control).unwrap();
    (program, Interposer { control })
}

fn compiled(folder: &Path) -> PathBuf {
    let here = PathBuf::from(std::env::var_os("CARGO_MANIFEST_DIR").unwrap());
    let library = folder.join("interpose.so");
    let compiler = std::env::var_os("CC").unwrap_or_else(|| OsString::from("cc"));
    let done = Command::new(compiler)
        .args(["-shared", "-fPIC", "-O1", "-Wall", "-o"])
        .arg(&library)
        .arg(here.join("tests/faults/interpose.c"))
        .arg("-ldl")
        .output()
        .expect("a C compiler is there: SQLite is built with it");
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{said}");
    library
}
