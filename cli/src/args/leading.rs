//! Options of the connection that stand before the command: `tread --server URL robots`.
//!
//! Each command that connects to a server declares these options, so that the others refuse them.
//! Options in front are moved behind the command, where it reads them.

use std::ffi::{OsStr, OsString};

use clap::Command;

/// Options that may stand before the command, and whether a value follows each.
const LEADING: [(&str, bool); 6] = [
    ("--server", true),
    ("--site", true),
    ("--token-file", true),
    ("--ca", true),
    ("--ca-fingerprint", true),
    ("--json", false),
];

/// Moves options of the connection from before the command to behind it. Anything else stays as it
/// is, for clap to judge.
pub(super) fn options_after_command(words: Vec<OsString>, command: &Command) -> Vec<OsString> {
    let mut at = 1;
    while let Some(has_value) = words.get(at).and_then(|word| leading(word)) {
        at += if has_value { 2 } else { 1 };
    }
    let begin = at.min(words.len());
    if begin <= 1 {
        return words;
    }
    let mut end = begin;
    let mut inner = command;
    while let Some(found) = words.get(end).and_then(|word| inner.find_subcommand(word)) {
        inner = found;
        end += 1;
    }
    let mut moved = vec![words[0].clone()];
    moved.extend_from_slice(&words[begin..end]);
    moved.extend_from_slice(&words[1..begin]);
    moved.extend_from_slice(&words[end..]);
    if end > begin {
        return moved;
    }
    // Without a command clap says that one is missing or unknown, which is what is wrong.
    let rest = &words[begin..];
    std::iter::once(&words[0]).chain(rest).cloned().collect()
}

/// Returns whether the next word is the value of this option; `None` if the option is not one that
/// may stand before the command.
fn leading(word: &OsStr) -> Option<bool> {
    let word = word.to_str()?;
    let (name, has_own_value) = match word.split_once('=') {
        Some((name, _)) => (name, true),
        None => (word, false),
    };
    let (_, takes_value) = LEADING.iter().find(|(known, _)| *known == name)?;
    Some(*takes_value && !has_own_value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::Arguments;

    fn moved(line: &str) -> String {
        let words = line.split(' ').map(OsString::from).collect();
        let moved = options_after_command(words, &Arguments::whole());
        let words: Vec<&str> = moved.iter().filter_map(|word| word.to_str()).collect();
        words.join(" ")
    }

    #[test]
    fn options_before_the_command_mean_what_they_mean_behind_it() {
        for (before, behind) in [
            ("tread --server URL robots", "tread robots --server URL"),
            (
                "tread --server=URL --json robots rename a b",
                "tread robots rename --server=URL --json a b",
            ),
            (
                "tread --site annex missions show 0a1b --json",
                "tread missions show --site annex 0a1b --json",
            ),
            ("tread --json demo", "tread demo --json"),
            (
                "tread --site annex stop --all",
                "tread stop --site annex --all",
            ),
            ("tread robots --server URL", "tread robots --server URL"),
            ("tread --help", "tread --help"),
            ("tread --server URL robotz", "tread robotz"),
            ("tread --server", "tread"),
        ] {
            assert_eq!(moved(before), behind);
        }
    }

    #[test]
    fn every_command_that_connects_takes_them_in_front() {
        for line in [
            "tread --server http://127.0.0.1:9 robots",
            "tread --server http://127.0.0.1:9 robots rename a b",
            "tread --site annex --json friction cells",
            "tread --token-file t --ca c send circle --robot r --center 0,0 --radius 3",
            "tread --site annex limits rover-1 set gate --hold --for 1m",
            "tread --json demo",
        ] {
            let words = line.split(' ').map(OsString::from).collect();
            let whole = Arguments::whole();
            let words = options_after_command(words, &whole);
            if let Err(refused) = whole.try_get_matches_from(words) {
                panic!("`{line}` was refused: {refused}");
            }
        }
    }
}
