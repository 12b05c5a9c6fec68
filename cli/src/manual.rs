//! Documentation generated from the command line: shell completions and man pages, of this program
//! and of the two that run on server and robots, for their packages.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;
use clap_complete::Shell;

use crate::args::{Arguments, Program};
use crate::output::print_note;

/// Returns a program's name and its command line.
fn command_line(program: Program) -> (&'static str, clap::Command) {
    match program {
        Program::Tread => ("tread", Arguments::whole()),
        Program::TreadServer => ("tread-server", tread_server::command_line()),
        Program::TreadAgent => ("tread-agent", tread_agent::command_line()),
    }
}

/// Prints the completion script for a shell.
pub(crate) fn completions(shell: Shell, program: Program) -> anyhow::Result<ExitCode> {
    let mut script = Vec::new();
    let (name, mut command_line) = command_line(program);
    clap_complete::generate(shell, &mut command_line, name, &mut script);
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script).context("cannot print")?;
    Ok(ExitCode::SUCCESS)
}

/// Writes a man page for each command to a folder.
pub(crate) fn man_pages(folder: &Path, program: Program) -> anyhow::Result<ExitCode> {
    let named = || format!("cannot write man pages to {}", folder.display());
    let (name, command_line) = command_line(program);
    std::fs::create_dir_all(folder).with_context(named)?;
    clap_mangen::generate_to(command_line, folder).with_context(named)?;
    let page = folder.join(name).with_extension("1");
    print_note(&format!("read them with `man -l {}`", page.display()));
    Ok(ExitCode::SUCCESS)
}
