//! Dependencies point one way. This reads what every module names of its own crate, and fails on a
//! direction that `ARCHITECTURE.md` forbids and on modules that need each other.
//!
//! A folder counts as one module among its siblings; what a parent and its children name of each
//! other does not count. Code that is compiled for tests alone does not either.

mod rust_source;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs;
use std::path::Path;

use syn::visit::Visit;
use tread_tests::repository::{files, root};

use rust_source::is_for_tests;

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
const SERVER_RULES: [(&str, &[&str]); 19] = [
    ("app", &["http", "fleet"]),
    ("archive", &["app", "db", "fleet", "http"]),
    ("authority", &["app", "db", "fleet", "http"]),
    ("clock", &["app", "db", "fleet", "http"]),
    ("config", &["app", "db", "fleet", "http"]),
    ("connections", &["app", "db", "fleet", "http"]),
    ("counters", &["app", "db", "fleet", "http"]),
    ("db", &["app", "fleet", "http"]),
    ("fleet", &["db", "http"]),
    ("formats", &["app", "db", "fleet", "http"]),
    ("friction", &["app", "db", "fleet", "http"]),
    ("http", &["db", "fleet"]),
    ("identity", &["app", "db", "fleet", "http"]),
    ("logging", &["app", "db", "fleet", "http"]),
    ("metrics", &["app", "db", "fleet", "http"]),
    ("oidc", &["app", "db", "fleet", "http"]),
    ("rate_limit", &["app", "db", "fleet", "http"]),
    ("supervisor", &["app", "db", "fleet", "http"]),
    ("webhooks", &["app", "db", "fleet", "http"]),
];

/// What one module names.
#[derive(Debug, Default)]
struct Module {
    names: BTreeSet<Vec<String>>,
}

type Modules = BTreeMap<Vec<String>, Module>;

/// Collects the paths within the crate that a module's items name.
struct Names<'module> {
    module: &'module [String],
    found: BTreeSet<Vec<String>>,
}

impl Names<'_> {
    fn add(&mut self, path: &[String]) {
        let Some(first) = path.first() else { return };
        let absolute = match first.as_str() {
            "crate" => path[1..].to_vec(),
            "self" => [self.module, &path[1..]].concat(),
            "super" => {
                let ups = path.iter().take_while(|part| *part == "super").count();
                let depth = self.module.len().saturating_sub(ups);
                [&self.module[..depth], &path[ups..]].concat()
            }
            _ => return,
        };
        self.found.insert(absolute);
    }

    fn add_tree(&mut self, before: &mut Vec<String>, tree: &syn::UseTree) {
        match tree {
            syn::UseTree::Path(path) => {
                before.push(path.ident.to_string());
                self.add_tree(before, &path.tree);
                before.pop();
            }
            syn::UseTree::Name(name) => {
                self.add(&[&before[..], &[name.ident.to_string()]].concat());
            }
            syn::UseTree::Rename(name) => {
                self.add(&[&before[..], &[name.ident.to_string()]].concat());
            }
            syn::UseTree::Glob(_) => self.add(before),
            syn::UseTree::Group(group) => {
                for tree in &group.items {
                    self.add_tree(before, tree);
                }
            }
        }
    }
}

impl<'ast> Visit<'ast> for Names<'_> {
    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        if !is_for_tests(&item.attrs) {
            self.add_tree(&mut Vec::new(), &item.tree);
        }
    }

    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        // Modules in a file of their own are read there; those in braces are for tests.
        let _ = item;
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let parts: Vec<String> = path
            .segments
            .iter()
            .map(|part| part.ident.to_string())
            .collect();
        self.add(&parts);
        syn::visit::visit_path(self, path);
    }
}

/// Returns the file of a module that an attribute names: the engines of the store share some.
fn path_of(attributes: &[syn::Attribute]) -> Option<String> {
    let named = attributes.iter().find(|one| one.path().is_ident("path"))?;
    let syn::Meta::NameValue(named) = &named.meta else {
        return None;
    };
    let syn::Expr::Lit(literal) = &named.value else {
        return None;
    };
    let syn::Lit::Str(path) = &literal.lit else {
        return None;
    };
    Some(path.value())
}

/// Reads a module's file and those of its children.
fn read(file: &Path, folder: &Path, module: &[String], modules: &mut Modules) {
    let text =
        fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let parsed =
        syn::parse_file(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let mut names = Names {
        module,
        found: BTreeSet::new(),
    };
    names.visit_file(&parsed);
    modules.insert(module.to_vec(), Module { names: names.found });
    for item in &parsed.items {
        let syn::Item::Mod(child) = item else {
            continue;
        };
        if child.content.is_some() || is_for_tests(&child.attrs) {
            continue;
        }
        let name = child.ident.to_string();
        if let (Some(path), Some(beside)) = (path_of(&child.attrs), file.parent()) {
            let file = beside.join(path);
            // Its children lie beside it, as those of a `mod.rs`.
            let folder = file.parent().unwrap_or(beside);
            read(&file, folder, &[module, &[name]].concat(), modules);
            continue;
        }
        let beside = folder.join(format!("{name}.rs"));
        let below = folder.join(&name);
        let within = below.join("mod.rs");
        let file = if beside.exists() { beside } else { within };
        read(&file, &below, &[module, &[name]].concat(), modules);
    }
}

fn modules_of(name: &str) -> Modules {
    let folder = root().join(name).join("src");
    let mut modules = Modules::new();
    for main in ["lib.rs", "main.rs"] {
        let file = folder.join(main);
        if file.exists() {
            read(&file, &folder, &[], &mut modules);
        }
    }
    modules
}

/// Which module each module names, by full paths.
fn edges(modules: &Modules) -> BTreeSet<(Vec<String>, Vec<String>)> {
    let mut edges = BTreeSet::new();
    for (from, module) in modules {
        for named in &module.names {
            let lengths = (1..=named.len()).rev();
            let to = lengths.map(|length| &named[..length]);
            if let Some(to) = to.into_iter().find(|path| modules.contains_key(*path)) {
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
    for (from, to) in edges(modules) {
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

#[test]
fn only_the_engines_of_the_store_contain_sql_and_the_server_names_none() {
    for name in SHIPPED {
        let speaks_sql = dependencies_of(name).contains_key("sqlx");
        assert_eq!(speaks_sql, name.starts_with("store-"), "{name}");
    }
    let naming: Vec<String> = files()
        .into_iter()
        .filter(|name| name.starts_with("server/src/") || name.starts_with("cli/src/"))
        .filter(|name| {
            let text = fs::read(root().join(name)).expect("it can be read");
            String::from_utf8_lossy(&text).contains("tread_store_sqlite")
        })
        .collect();
    assert_eq!(naming, Vec::<String>::new());
}

#[test]
fn the_layers_of_the_server_name_only_those_below_them() {
    let edges = edges(&modules_of("server"));
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
