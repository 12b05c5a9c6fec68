//! Examples for every command, shown below its help. A test parses each of them.

use crate::exit::EXIT_CODES;

/// Path of each command, with its examples.
const EXAMPLES: &[(&str, &str)] = &[
    (
        "",
        "  tread demo\n  tread watch\n  tread send circle --robot rover-1 --center 8,6 --radius 3 --wait",
    ),
    (
        "demo",
        "  tread demo --robots 2\n  tread demo --exit-after 90s --json",
    ),
    (
        "completions",
        "  tread completions bash > ~/.local/share/bash-completion/completions/tread\n  tread completions zsh > ~/.zfunc/_tread",
    ),
    ("man", "  tread man --dir ~/.local/share/man/man1"),
    ("status", "  tread status"),
    (
        "doctor",
        "  tread doctor\n  tread doctor --site park --json",
    ),
    ("sites", "  tread sites"),
    (
        "sites create",
        "  tread sites create north-yard --name \"North yard\" --cell 0.5\n  tread sites create quay --origin 53.5413,9.9841 --x-axis 30",
    ),
    (
        "sites set-origin",
        "  tread sites set-origin north-yard 48.1374,11.5755 --x-axis -12.5",
    ),
    (
        "sites remove-origin",
        "  tread sites remove-origin north-yard",
    ),
    ("robots", "  tread robots\n  tread robots rover-1"),
    (
        "robots join-token",
        "  tread robots join-token --name rover-1 --expires 1h > token\n  tread robots join-token --all --expires 8h",
    ),
    ("robots join-token list", "  tread robots join-token list"),
    (
        "robots join-token revoke",
        "  tread robots join-token revoke 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    ("robots enrolments", "  tread robots enrolments"),
    ("authority", "  tread authority"),
    ("authority status", "  tread authority status --json"),
    ("authority start", "  tread authority start"),
    (
        "authority finish",
        "  tread authority finish 3f0c8a5e91d2b746\n  tread authority finish 3f0c8a5e91d2b746 --force",
    ),
    (
        "authority replace",
        "  tread authority replace\n  tread authority replace --yes --json",
    ),
    (
        "robots rename",
        "  tread robots rename rover-1 \"Old Betsy\"",
    ),
    (
        "robots tag",
        "  tread robots tag rover-1 north spare\n  tread robots tag rover-1 --none",
    ),
    ("robots retire", "  tread robots retire rover-1"),
    (
        "robots release",
        "  tread robots release rover-1\n  tread robots release --all",
    ),
    ("robots restore", "  tread robots restore rover-1"),
    ("robots revoke", "  tread robots revoke rover-1"),
    (
        "send",
        "  tread send circle --robot rover-1 --center 8,6 --radius 3 --turns 2\n  tread send waypoints --robot rover-1 4,4 8,4 12,7",
    ),
    (
        "send circle",
        "  tread send circle --robot rover-1 --center 8,6 --radius 3 --check\n  tread send circle --robot rover-1 --center 8,6 --radius 3 --wait --timeout 5m",
    ),
    (
        "send waypoints",
        "  tread send waypoints --robot rover-1 --speed 0.6 4,4 8,4 12,7 16,7\n  tread send waypoints --robot rover-1 --file way.csv --replaces 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    (
        "missions",
        "  tread missions --robot rover-1\n  tread missions --state failed --json",
    ),
    (
        "missions show",
        "  tread missions show 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    (
        "missions wait",
        "  tread missions wait 0192f0c1-2b3c-7d4e-8f50-617283940a1b --timeout 10m",
    ),
    (
        "missions pause",
        "  tread missions pause 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    (
        "missions resume",
        "  tread missions resume 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    (
        "missions cancel",
        "  tread missions cancel 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    ("terrains", "  tread terrains"),
    ("terrains show", "  tread terrains show sand-pit --json"),
    (
        "terrains create",
        "  tread terrains create sand-pit --class sand 0,0 6,0 6,4 0,4",
    ),
    (
        "terrains change",
        "  tread terrains change sand-pit --class gravel --layer 1",
    ),
    ("terrains delete", "  tread terrains delete sand-pit"),
    (
        "friction",
        "  tread friction\n  tread friction point 4.5,2\n  tread friction cells --box 0,0,20,10 --json",
    ),
    (
        "friction terrains",
        "  tread friction terrains sand-pit --as-of 24h",
    ),
    (
        "friction history",
        "  tread friction history sand-pit --from 12h --step 30m\n  tread friction history -1.5,2 --from 1h --step 1m",
    ),
    (
        "friction cells",
        "  tread friction cells --box -5,-5,10,10 --resolution 2",
    ),
    ("friction point", "  tread friction point -1.5,2"),
    (
        "friction path",
        "  tread friction path --robot rover-1 0,0 4,0 8,3",
    ),
    (
        "friction difference",
        "  tread friction difference --from 48h --to 24h",
    ),
    (
        "friction visits",
        "  tread friction visits --box 0,0,20,10 --limit 5",
    ),
    (
        "friction map",
        "  tread friction map --png out.png --box 0,0,20,10",
    ),
    ("friction robots", "  tread friction robots"),
    ("friction withdrawals", "  tread friction withdrawals"),
    (
        "friction withdraw",
        "  tread friction withdraw rover-1 --from 3h --reason \"flat tyre\"",
    ),
    (
        "stop",
        "  tread stop rover-1 --reason \"child on the yard\"\n  tread stop --all",
    ),
    ("stops", "  tread stops --in-force"),
    (
        "clear",
        "  tread clear rover-1\n  tread clear rover-1 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    (
        "alerts",
        "  tread alerts\n  tread alerts --all --robot rover-1 --kind robot-lost",
    ),
    (
        "alerts acknowledge",
        "  tread alerts acknowledge 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    ("webhooks", "  tread webhooks"),
    ("webhooks list", "  tread webhooks list --json"),
    (
        "webhooks add",
        "  tread webhooks add \"on call\" https://alerts.example.org/tread > secret\n  tread webhooks add lost https://alerts.example.org/lost --kinds robot-lost,mission-failed --for yard",
    ),
    ("webhooks remove", "  tread webhooks remove \"on call\""),
    ("webhooks test", "  tread webhooks test \"on call\""),
    (
        "webhooks deliveries",
        "  tread webhooks deliveries \"on call\" --limit 50",
    ),
    ("webhooks enable", "  tread webhooks enable \"on call\""),
    ("webhooks disable", "  tread webhooks disable \"on call\""),
    (
        "webhooks rotate",
        "  tread webhooks rotate \"on call\" > secret",
    ),
    ("drive", "  tread drive rover-1 --speed 0.3"),
    ("leases", "  tread leases"),
    ("limits", "  tread limits rover-1"),
    (
        "limits set",
        "  tread limits rover-1 set gate-house --speed 0.3 --for 10s",
    ),
    ("limits end", "  tread limits rover-1 end gate-house"),
    (
        "geofence",
        "  tread geofence --json > fence.json\n  tread geofence --set fence.json --revision 3",
    ),
    (
        "watch",
        "  tread watch\n  tread watch --robot rover-1 --json",
    ),
    (
        "login",
        "  tread login --server https://tread.example.org:8420 --token-file token",
    ),
    ("logout", "  tread logout"),
    ("whoami", "  tread whoami"),
    ("token", "  tread token"),
    ("tokens", "  tread tokens"),
    ("tokens list", "  tread tokens list"),
    (
        "tokens create",
        "  tread tokens create \"wall screen\" --role viewer --valid-days 365\n  tread tokens create \"night shift\" --rights drive,clear_stop --for yard,park/rover-1",
    ),
    (
        "tokens revoke",
        "  tread tokens revoke 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    ("sessions", "  tread sessions"),
    ("sessions list", "  tread sessions list --json"),
    (
        "sessions end",
        "  tread sessions end 0192f0c1-2b3c-7d4e-8f50-617283940a1b",
    ),
    ("audit", "  tread audit --refused"),
    ("audit export", "  tread audit export --output audit.jsonl"),
    (
        "audit verify",
        "  tread audit verify\n  tread audit verify audit.jsonl",
    ),
];

/// Returns the same command line with the examples of each command below its help.
pub(super) fn with_examples(command: clap::Command) -> clap::Command {
    let codes = format!("{}\n\n{EXIT_CODES}", below_help("").unwrap_or_default());
    all_below(command, "").after_help(codes)
}

fn below_help(path: &str) -> Option<String> {
    let (_, lines) = EXAMPLES.iter().find(|(known, _)| *known == path)?;
    Some(format!("Examples:\n{lines}"))
}

fn all_below(command: clap::Command, path: &str) -> clap::Command {
    let names: Vec<String> = command
        .get_subcommands()
        .map(|below| below.get_name().to_owned())
        .collect();
    let mut command = command;
    for name in names {
        let path = format!("{path} {name}");
        let path = path.trim_start();
        command = command.mut_subcommand(&name, |below| all_below(below, path));
    }
    match below_help(path) {
        Some(text) => command.after_help(text),
        None => command,
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;
    use crate::args::{Arguments, protect_negative_points};

    fn visible_paths(command: &clap::Command, path: &str, found: &mut Vec<String>) {
        found.push(path.to_owned());
        let below = command.get_subcommands();
        for below in below.filter(|below| !below.is_hide_set() && below.get_name() != "help") {
            let path = format!("{path} {}", below.get_name());
            visible_paths(below, path.trim_start(), found);
        }
    }

    /// Splits a line into words as a shell does, with support for quotes and `>` only.
    fn words(line: &str) -> Vec<String> {
        let typed = line.split(" > ").next().unwrap_or_default();
        let mut words = Vec::new();
        for (index, piece) in typed.trim().split('"').enumerate() {
            if index % 2 == 1 {
                words.push(piece.to_owned());
            } else {
                words.extend(piece.split_whitespace().map(str::to_owned));
            }
        }
        words
    }

    /// Returns the path of the parsed subcommand.
    fn chain(matches: &clap::ArgMatches) -> String {
        match matches.subcommand() {
            Some((name, below)) => format!("{name} {}", chain(below)).trim_end().to_owned(),
            None => String::new(),
        }
    }

    #[test]
    fn every_command_shows_an_example_and_every_example_is_one_of_its_own_and_is_understood() {
        let mut paths = Vec::new();
        visible_paths(&Arguments::command(), "", &mut paths);
        for path in &paths {
            assert!(below_help(path).is_some(), "`{path}` has no example");
        }
        for (path, lines) in EXAMPLES {
            assert!(paths.iter().any(|known| known == path), "`{path}` is gone");
            for line in lines.lines() {
                let words = words(line).into_iter();
                let words = words.map(|word| protect_negative_points(word.into()));
                let matches = match Arguments::whole().try_get_matches_from(words) {
                    Ok(matches) => matches,
                    Err(refused) => panic!("`{line}` is not understood: {refused}"),
                };
                let ran = chain(&matches);
                assert!(ran.starts_with(path), "`{line}` is no example of `{path}`");
            }
        }
    }
}
