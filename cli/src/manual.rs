//! Documentation generated from the command line: shell completions and man pages.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;
use clap_complete::Shell;

use crate::args::Arguments;
use crate::output::note;

/// Name of the program.
const PROGRAM: &str = "tread";

/// Prints the completion script for a shell.
pub(crate) fn completions(shell: Shell) -> anyhow::Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Arguments::whole(), PROGRAM, &mut script);
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script).context("cannot print")?;
    Ok(ExitCode::SUCCESS)
}

/// Writes a man page for each command to a folder.
pub(crate) fn man_pages(folder: &Path) -> anyhow::Result<ExitCode> {
    let named = || format!("cannot write man pages to {}", folder.display());
    std::fs::create_dir_all(folder).with_context(named)?;
    clap_mangen::generate_to(Arguments::whole(), folder).with_context(named)?;
    note(&format!(
        "read them with `man -l {}`",
        folder.join("tread.1").display()
    ));
    Ok(ExitCode::SUCCESS)
}
