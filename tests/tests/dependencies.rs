//! Dependencies point one way. This reads what every module names of its own crate, and fails on a
//! direction that `ARCHITECTURE.md` forbids and on modules that need each other.
//!
//! A folder counts as one module among its siblings; what a parent and its children name of each
//! other does not count. Code that is compiled for tests alone does not either. Paths count wherever
//! they stand, also in macros. Between siblings, what a module takes from an import of its parent
//! counts as taken from where it is defined. Imports by `*` are not followed.

mod module_names;
mod rust_source;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs;
use std::path::Path;

use tread_tests::repository::{files, root};

use module_names::{Module, Modules, modules_of};

/// Crates whose modules are read.
const CRATES: [&str; 12] = [
    "api",
    "cli",
    "control",
    "db",
    "lab",
    "robot-agent",
    "ros2",
    "server",
    "store",
    "store-postgres",
    "store-sqlite",
    "telemetry",
];

/// Crates of this workspace that a crate may depend on, tests aside.
const CRATE_RULES: [(&str, &[&str]); 12] = [
    ("api", &[]),
    ("control", &[]),
    ("ros2", &[]),
    ("telemetry", &["tread-api"]),
    (
        "robot-agent",
        &[
            "tread-api",
            "tread-control",
            "tread-ros2",
            "tread-telemetry",
        ],
    ),
    ("store", &["tread-api"]),
    ("store-postgres", &["tread-api", "tread-store"]),
    ("store-sqlite", &["tread-api", "tread-store"]),
    (
        "db",
        &[
            "tread-api",
            "tread-store",
            "tread-store-postgres",
            "tread-store-sqlite",
        ],
    ),
    (
        "server",
        &[
            "tread-api",
            "tread-control",
            "tread-db",
            "tread-store",
            "tread-telemetry",
        ],
    ),
    ("cli", &["tread-agent", "tread-api", "tread-server"]),
    (
        "lab",
        &["tread-agent", "tread-api", "tread-control", "tread-ros2"],
    ),
];

/// Crates that are shipped. None of them may contain the agent's test support.
const SHIPPED: [&str; 11] = [
    "api",
    "cli",
    "control",
    "db",
    "robot-agent",
    "ros2",
    "server",
    "store",
    "store-postgres",
    "store-sqlite",
    "telemetry",
];

/// Modules of the server that a module must not name.
const SERVER_RULES: [(&str, &[&str]); 28] = [
    ("app", &["http", "fleet"]),
    ("archive", &["app", "db", "fleet", "http"]),
    ("authority", &["app", "db", "fleet", "http"]),
    ("backup", &["app", "db", "fleet", "http"]),
    ("certificate", &["app", "db", "fleet", "http"]),
    ("clock", &["app", "db", "fleet", "http"]),
    ("config", &["app", "db", "fleet", "http"]),
    ("connections", &["app", "db", "fleet", "http"]),
    ("counters", &["app", "db", "fleet", "http"]),
    ("db", &["app", "fleet", "http"]),
    ("error_text", &["app", "db", "fleet", "http"]),
    ("file_error", &["app", "db", "fleet", "http"]),
    ("file_owner", &["app", "db", "fleet", "http"]),
    ("fleet", &["db", "http"]),
    ("formats", &["app", "db", "fleet", "http"]),
    ("friction", &["app", "db", "fleet", "http"]),
    ("health", &["app", "db", "fleet", "http"]),
    ("http", &["db", "fleet"]),
    ("identity", &["app", "db", "fleet", "http"]),
    ("liveness", &["app", "db", "fleet", "http"]),
    ("logging", &["app", "db", "fleet", "http"]),
    ("maintenance", &["fleet", "http"]),
    ("metrics", &["app", "db", "fleet", "http"]),
    ("oidc", &["app", "db", "fleet", "http"]),
    ("paths", &["app", "db", "fleet", "http"]),
    ("rate_limit", &["app", "db", "fleet", "http"]),
    ("supervisor", &["app", "db", "fleet", "http"]),
    ("webhooks", &["app", "db", "fleet", "http"]),
];

/// Most imports that lead from a path to where its end is defined.
const IMPORTS_MAX: usize = 16;

/// Returns the module of what a path names; the root of the crate is empty.
fn module_of<'path>(modules: &Modules, path: &'path [String]) -> &'path [String] {
    let mut lengths = (1..=path.len()).rev();
    let length = lengths.find(|&length| modules.contains_key(&path[..length]));
    &path[..length.unwrap_or_default()]
}

/// Follows a path through imports to where its end is defined.
fn defined_at(modules: &Modules, path: &[String]) -> Vec<String> {
    let mut path = path.to_vec();
    for _ in 0..IMPORTS_MAX {
        let module = module_of(modules, &path);
        let Some((name, rest)) = path[module.len()..].split_first() else {
            break;
        };
        let of = modules.get(module);
        let Some(import) = of.and_then(|of| of.imports.get(name)) else {
            break;
        };
        path = [&import[..], rest].concat();
    }
    path
}

/// Which module each module names, by full paths; with `follow`, by where things are defined.
fn edges(modules: &Modules, follow: bool) -> BTreeSet<(Vec<String>, Vec<String>)> {
    let mut edges = BTreeSet::new();
    for (from, module) in modules {
        for named in &module.names {
            let named = if follow {
                defined_at(modules, named)
            } else {
                named.clone()
            };
            let to = module_of(modules, &named);
            if !to.is_empty() {
                edges.insert((from.clone(), to.to_vec()));
            }
        }
    }
    edges
}

/// Siblings and what they name of each other, by their parent, with one example of full paths.
type Siblings =
    BTreeMap<Vec<String>, BTreeMap<String, BTreeMap<String, (Vec<String>, Vec<String>)>>>;

fn siblings(modules: &Modules) -> Siblings {
    let mut siblings = Siblings::new();
    for (from, to) in edges(modules, true) {
        let shared = from
            .iter()
            .zip(&to)
            .take_while(|(one, other)| one == other)
            .count();
        if shared < from.len() && shared < to.len() {
            let of = siblings.entry(from[..shared].to_vec()).or_default();
            let named = of.entry(from[shared].clone()).or_default();
            named.entry(to[shared].clone()).or_insert((from, to));
        }
    }
    siblings
}

/// Modules of one parent that need each other, with a shortest path from one of them to itself.
#[derive(Debug, PartialEq, Eq)]
struct Cycle {
    within: BTreeSet<String>,
    path: String,
}

/// Cycles by the parent of their modules.
fn cycles(modules: &Modules) -> BTreeMap<String, Cycle> {
    let mut found = BTreeMap::new();
    for (parent, graph) in siblings(modules) {
        // A shortest path from a module to itself, by breadth-first search.
        let path_of = |start: &String| -> Option<Vec<String>> {
            let mut paths = VecDeque::from([vec![start.clone()]]);
            let mut seen = BTreeSet::new();
            while let Some(path) = paths.pop_front() {
                for next in graph.get(path.last()?).into_iter().flat_map(BTreeMap::keys) {
                    let longer = [&path[..], std::slice::from_ref(next)].concat();
                    if next == start {
                        return Some(longer);
                    }
                    if seen.insert(next.clone()) {
                        paths.push_back(longer);
                    }
                }
            }
            None
        };
        let paths: BTreeMap<&String, Vec<String>> = graph
            .keys()
            .filter_map(|name| Some((name, path_of(name)?)))
            .collect();
        let Some(shortest) = paths.values().min_by_key(|path| path.len()) else {
            continue;
        };
        let steps = shortest.windows(2).map(|pair| {
            let (from, to) = &graph[&pair[0]][&pair[1]];
            format!("{} names {}", from.join("::"), to.join("::"))
        });
        let path = steps.collect::<Vec<_>>().join(", ");
        let within = paths.keys().map(|name| (*name).clone()).collect();
        found.insert(parent.join("::"), Cycle { within, path });
    }
    found
}

/// The dependencies of a crate, tests aside.
fn dependencies_of(name: &str) -> toml::Table {
    let manifest = fs::read_to_string(root().join(name).join("Cargo.toml"));
    let manifest: toml::Table = manifest
        .expect("every crate has a manifest")
        .parse()
        .expect("a manifest is TOML");
    let dependencies = manifest.get("dependencies").and_then(toml::Value::as_table);
    dependencies.cloned().unwrap_or_default()
}

#[test]
fn nothing_shipped_contains_test_support() {
    for name in SHIPPED {
        for (dependency, wanted) in dependencies_of(name) {
            let features = wanted.get("features").and_then(toml::Value::as_array);
            assert!(
                features.is_none_or(|features| !features.contains(&toml::Value::from("testing"))),
                "{name} ships the feature `testing` of {dependency}"
            );
        }
    }
}

#[test]
fn no_crate_depends_on_one_that_it_must_not_know() {
    for (name, allowed) in CRATE_RULES {
        for dependency in dependencies_of(name).keys() {
            let is_ours = dependency.starts_with("tread-");
            assert!(
                !is_ours || allowed.contains(&dependency.as_str()),
                "{name} must not depend on {dependency}"
            );
        }
    }
}

/// Files in some folders that contain a word.
fn naming(folders: &[&str], word: &str) -> Vec<String> {
    let is_in = |name: &String| folders.iter().any(|folder| name.starts_with(*folder));
    let contains = |name: &String| {
        let text = fs::read(root().join(name)).expect("it can be read");
        String::from_utf8_lossy(&text).contains(word)
    };
    files()
        .into_iter()
        .filter(|name| is_in(name) && contains(name))
        .collect()
}

#[test]
fn only_the_engines_of_the_store_contain_sql_and_the_server_names_none() {
    for name in SHIPPED {
        let speaks_sql = dependencies_of(name).contains_key("sqlx");
        assert_eq!(speaks_sql, name.starts_with("store-"), "{name}");
    }
    assert_eq!(
        naming(&["server/src/", "cli/src/"], "tread_store_"),
        Vec::<String>::new()
    );
    // They have what they need of it from the use cases.
    let above = ["server/src/http/", "server/src/fleet/"];
    for of_database in ["tread_db", "tread_store"] {
        assert_eq!(naming(&above, of_database), Vec::<String>::new());
    }
}

#[test]
fn the_layers_of_the_server_name_only_those_below_them() {
    let edges = edges(&modules_of("server"), false);
    let mut wrong = Vec::new();
    for (layer, forbidden) in SERVER_RULES {
        for (from, to) in &edges {
            let is_of = from.first().is_some_and(|first| first == layer);
            let is_wrong = to
                .first()
                .is_some_and(|first| forbidden.contains(&first.as_str()));
            if is_of && is_wrong {
                wrong.push(format!("{} → {}", from.join("::"), to.join("::")));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Cargo does not compile a crate again in another clone that shares its target folder, so a path
/// that is compiled in leads out of the clone.
#[test]
fn no_code_reads_the_folder_in_which_it_was_compiled() {
    let compiled_in = concat!("env!(\"CARGO_", "MANIFEST_DIR\")");
    let names = files()
        .into_iter()
        .filter(|name| Path::new(name).extension().is_some_and(|end| end == "rs"));
    let is_wrong = |name: &String| {
        let text = fs::read_to_string(root().join(name)).expect("it can be read");
        text.contains(compiled_in)
    };
    let found: Vec<String> = names.filter(is_wrong).collect();
    assert!(found.is_empty(), "take the variable at run time: {found:?}");
}

#[test]
fn no_modules_need_each_other() {
    let mut wrong = Vec::new();
    for name in CRATES {
        for (parent, Cycle { within, path }) in cycles(&modules_of(name)) {
            wrong.push(format!("{name}, {parent:?}: {within:?} ({path})"));
        }
    }
    assert!(
        wrong.is_empty(),
        "modules need each other:\n{}",
        wrong.join("\n")
    );
}

#[test]
fn a_cycle_is_found_and_parents_do_not_count() {
    let module = |names: &[&str]| Module {
        names: names
            .iter()
            .map(|name| name.split("::").map(str::to_owned).collect())
            .collect(),
        imports: BTreeMap::new(),
    };
    let path = |name: &str| -> Vec<String> { name.split("::").map(str::to_owned).collect() };
    let modules = Modules::from([
        (Vec::new(), module(&["a", "b"])),
        (path("a"), module(&["a::x::Thing", "b::Thing"])),
        (path("a::x"), module(&["a::Thing", "c"])),
        (path("b"), module(&["c::Thing"])),
        (path("c"), module(&["a::x"])),
    ]);
    let within = BTreeSet::from(["a", "b", "c"].map(str::to_owned));
    let path = "a::x names c, c names a::x".to_owned();
    let expected = BTreeMap::from([(String::new(), Cycle { within, path })]);
    assert_eq!(cycles(&modules), expected);
}

#[test]
fn a_cycle_through_an_import_of_the_parent_is_found() {
    let path = |name: &str| -> Vec<String> { name.split("::").map(str::to_owned).collect() };
    let module = |of: &[String], text: &str| {
        let source = syn::parse_file(text).expect("Rust");
        (of.to_vec(), Module::of(&source, of))
    };
    let modules = Modules::from([
        module(&[], "mod a;"),
        module(&path("a"), "mod x; mod y; pub use x::Thing;"),
        module(&path("a::x"), "use super::y::Other;"),
        module(&path("a::y"), "use super::Thing;"),
    ]);
    let found = cycles(&modules);
    assert_eq!(found["a"].path, "a::x names a::y, a::y names a::x");
}
