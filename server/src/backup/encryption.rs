//! Encrypts and decrypts archives with a program of the operator's choice, such as `age` or `gpg`.
//! The archive is piped through the program's standard input and standard output.

use std::io::{self, BufReader, Read};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};

use super::manifest::ArchivedFile;

/// Reason why an archive cannot be encrypted or decrypted.
#[derive(Debug, thiserror::Error)]
pub enum EncryptionError {
    /// The shell cannot be started.
    #[error("cannot run `{command}`")]
    Start {
        /// The command.
        command: String,
        /// The cause.
        #[source]
        cause: io::Error,
    },
    /// The command failed.
    #[error("`{command}` failed: {status}; what it says is above, or in the server's log")]
    Failed {
        /// The command.
        command: String,
        /// Its exit status.
        status: ExitStatus,
    },
    /// The command succeeded and wrote nothing, or far too little.
    #[error(
        "`{command}` wrote {written_bytes} bytes of an archive of a database of {database_bytes}: it must \
         write all of it to its standard output, not to a file"
    )]
    TooLittle {
        /// The command.
        command: String,
        /// Size of its output, bytes.
        written_bytes: u64,
        /// Size of the database in the archive, bytes.
        database_bytes: u64,
    },
}

/// Ratio by which a program that also compresses makes no archive smaller: databases are hardly
/// compressible beyond a tenth of this.
const COMPRESSION_MAX: u64 = 1_000;

/// A shell command that encrypts, or decrypts, its standard input to its standard output.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Filter(pub String);

impl Filter {
    /// Starts the command, and pipes its output.
    ///
    /// # Errors
    /// [`EncryptionError::Start`].
    pub fn start(&self, input: Stdio) -> Result<Child, EncryptionError> {
        let mut shell = Command::new("sh");
        shell.arg("-c").arg(&self.0).stdin(input);
        let started = shell.stdout(Stdio::piped()).spawn();
        started.map_err(|cause| EncryptionError::Start {
            command: self.0.clone(),
            cause,
        })
    }

    /// Checks that the command can have written a whole archive, which nobody can read back without the
    /// key.
    ///
    /// # Errors
    /// [`EncryptionError::TooLittle`].
    pub fn check_size(
        &self,
        written_bytes: u64,
        database: &ArchivedFile,
    ) -> Result<(), EncryptionError> {
        let database_bytes = database.bytes;
        if written_bytes > database_bytes / COMPRESSION_MAX {
            return Ok(());
        }
        Err(EncryptionError::TooLittle {
            command: self.0.clone(),
            written_bytes,
            database_bytes,
        })
    }

    /// Checks the exit status of the command.
    ///
    /// # Errors
    /// [`EncryptionError::Failed`].
    pub fn check(&self, status: ExitStatus) -> Result<(), EncryptionError> {
        if status.success() {
            return Ok(());
        }
        Err(EncryptionError::Failed {
            command: self.0.clone(),
            status,
        })
    }
}

/// Reader of an archive, with or without a command that decrypts it.
pub enum Opening<R: Read> {
    /// Without a command.
    Plain(R),
    /// The output of a command; dropping this ends the command.
    Filtered(Filtered),
}

/// The output of a command.
pub struct Filtered {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Filtered {
    /// Takes the output of a command that was started.
    pub fn new(mut child: Child) -> Option<Self> {
        let output = child.stdout.take()?;
        Some(Self {
            child,
            output: BufReader::new(output),
        })
    }
}

impl Drop for Filtered {
    fn drop(&mut self) {
        // Both calls fail only if the command has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl<R: Read> Read for Opening<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Plain(input) => input.read(buffer),
            Self::Filtered(filtered) => filtered.output.read(buffer),
        }
    }
}
