//! Test that every command in README and docs is accepted by the present command lines.

use std::fmt::Write as _;

use tread_tests::markdown::documents;
use tread_tests::repository::root;
use tread_tests::shell::commands;

use super::{Arguments, protect_negative_points};

/// Placeholders in the documentation, with a valid value for each.
const PLACEHOLDERS: [(&str, &str); 3] = [
    (
        "FINGERPRINT",
        "9c0e51d2b7463f0c8a5e91d2b746617283940a1b2b3c7d4e8f500192f0c12b3c",
    ),
    ("TOKEN_ID", "0192f0c1-2b3c-7d4e-8f50-617283940a1b"),
    ("ROTATION", "3f0c8a5e91d2b746"),
];
/// Minimum number of commands that the test must check; fewer mean that the documentation was not
/// found.
const COMMANDS_MIN: usize = 40;

/// Returns the command line of one of our programs; `None` for any other program.
fn program(name: &str) -> Option<clap::Command> {
    match name {
        "tread" => Some(Arguments::whole()),
        "tread-server" => Some(tread_server::command_line()),
        "tread-agent" => Some(tread_agent::command_line()),
        _ => None,
    }
}

/// Returns the arguments of a command of one of our programs, with values for placeholders; `None`
/// for any other command. `cargo run --` counts as `tread`.
fn program_arguments(mut words: Vec<String>) -> Option<Vec<String>> {
    if words.starts_with(&["cargo".to_owned(), "run".to_owned()]) {
        let is_other = words
            .iter()
            .any(|word| ["-p", "--bin", "--example"].contains(&word.as_str()));
        let at = words.iter().position(|word| word == "--")?;
        if is_other {
            return None;
        }
        words.splice(..=at, ["tread".to_owned()]);
    }
    program(words.first()?)?;
    for (placeholder, instead) in PLACEHOLDERS {
        for word in &mut words {
            *word = word.replace(placeholder, instead);
        }
    }
    Some(words)
}

/// Returns the error of a complete command; `None` if it is valid.
fn fault(words: &[String]) -> Option<String> {
    let program = program(&words[0])?;
    let words = words
        .iter()
        .map(|word| protect_negative_points(word.into()));
    let refused = program.try_get_matches_from(words).err()?;
    let text = refused.to_string();
    let first = text.lines().next().unwrap_or_default().to_owned();
    refused.use_stderr().then_some(first)
}

/// Returns whether a flag of a command takes a value, with `is_deep` also of its subcommands;
/// `None` if the flag does not exist.
fn takes_value(command: &clap::Command, flag: &str, is_deep: bool) -> Option<bool> {
    let own = command
        .get_arguments()
        .find(|argument| argument.get_long() == Some(flag))
        .map(|argument| argument.get_action().takes_values());
    let mut below = command.get_subcommands().filter(|_| is_deep);
    own.or_else(|| below.find_map(|below| takes_value(below, flag, true)))
}

/// Returns the error of a command fragment in running text: an unknown command or flag. Required
/// arguments may be missing, and `…` stands for any arguments.
fn fault_of_part(words: &[&str]) -> Option<String> {
    let mut command = program(words[0])?;
    // Adds `help` and the other built-in subcommands of clap.
    command.build();
    let (mut path, mut is_shortened, mut has_values) = (words[0].to_owned(), false, false);
    let mut words = words[1..].iter();
    while let Some(word) = words.next() {
        let word = word.trim_end_matches(',');
        let is_placeholder = word.chars().all(|letter| !letter.is_lowercase());
        if let Some(flag) = word.strip_prefix("--") {
            let name = flag.split('=').next().unwrap_or_default();
            match takes_value(&command, name, is_shortened) {
                None => return Some(format!("`{path}` has no --{flag}")),
                Some(true) if !flag.contains('=') => _ = words.next(),
                Some(_) => {}
            }
        } else if let Some(below) = command.find_subcommand(word).filter(|_| !has_values) {
            path = format!("{path} {word}");
            command = below.clone();
        } else if is_placeholder || has_values || command.get_positionals().next().is_some() {
            is_shortened |= word.contains('…');
            has_values = true;
        } else {
            return Some(format!("`{path}` has no command `{word}`"));
        }
    }
    None
}

#[test]
fn every_command_of_the_documentation_is_understood() {
    let (mut faults, mut looked_at) = (String::new(), 0);
    for document in documents() {
        let name = &document.name;
        for block in document
            .blocks
            .iter()
            .filter(|block| block.language == "sh")
        {
            for typed in commands(&block.text) {
                let Some(words) = program_arguments(typed.words) else {
                    continue;
                };
                looked_at += 1;
                if let Some(fault) = fault(&words) {
                    let line = block.line + typed.line;
                    let _ = writeln!(faults, "{name}:{line}: {fault}");
                }
            }
        }
        for code in &document.codes {
            let words: Vec<String> = code.text.split_whitespace().map(str::to_owned).collect();
            let words = program_arguments(words).unwrap_or_default();
            let words: Vec<&str> = words.iter().map(String::as_str).collect();
            if words.len() < 2 {
                continue;
            }
            looked_at += 1;
            if let Some(fault) = fault_of_part(&words) {
                let _ = writeln!(faults, "{name}:{}: `{}`: {fault}", code.line, code.text);
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
    assert!(looked_at >= COMMANDS_MIN, "only {looked_at} were found");
}

#[test]
fn every_program_that_the_docs_run_by_cargo_is_there() {
    let mut faults = String::new();
    for document in documents() {
        for block in document
            .blocks
            .iter()
            .filter(|block| block.language == "sh")
        {
            for typed in commands(&block.text) {
                let mut words = typed.words.iter();
                if words.next().is_none_or(|first| first != "cargo") {
                    continue;
                }
                while let Some(word) = words.next() {
                    let folders: &[&str] = match word.as_str() {
                        "--" => break,
                        "--bin" => &["tests/src/bin", "lab/src/bin", "tests"],
                        "--example" => &[
                            "control/examples",
                            "server/examples",
                            "ros2/examples",
                            "robot-agent/examples",
                        ],
                        _ => continue,
                    };
                    let target = words.next().map(String::as_str).unwrap_or_default();
                    let is_at = |folder: &str| {
                        let at = root().join(folder);
                        target == "tread"
                            || at.join(target).is_dir()
                            || at.join(format!("{target}.rs")).exists()
                    };
                    if !folders.iter().any(|folder| is_at(folder)) {
                        let (name, line) = (&document.name, block.line + typed.line);
                        let _ = writeln!(faults, "{name}:{line}: there is no `{target}`");
                    }
                }
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
}

#[test]
fn commands_that_are_gone_are_found() {
    let whole = |line: &str| {
        let typed = commands(line).remove(0);
        program_arguments(typed.words).and_then(|words| fault(&words))
    };
    for good in [
        "tread send circle --robot rover-1 --center 8,6 --radius 3",
        "tread-agent replay a.mcap",
        "cargo run --release -- demo --robots 3",
        "tread send waypoints --robot rover-1 -1,-2 3,4",
        "curl -s x",
    ] {
        assert_eq!(whole(good), None, "{good}");
    }
    for bad in [
        "tread send square --robot rover-1",
        "tread send circle --robot rover-1 --center 8,6",
        "tread-server --port 3",
        "cargo run --release -- demo --robot 3",
    ] {
        assert!(whole(bad).is_some(), "{bad}");
    }
    let part = |line: &str| fault_of_part(&line.split_whitespace().collect::<Vec<_>>());
    for good in [
        "tread send … --excite --check",
        "tread robots revoke",
        "tread help",
        "tread COMMAND --help",
    ] {
        assert_eq!(part(good), None, "{good}");
    }
    for bad in ["tread robots --gone", "tread dance", "tread-agent check"] {
        assert!(part(bad).is_some(), "{bad}");
    }
}
