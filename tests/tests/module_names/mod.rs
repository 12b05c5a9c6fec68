//! The modules of a crate, and what each of them names of its own crate.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::sync::LazyLock;

use regex::Regex;
use syn::visit::Visit;
use tread_tests::repository::root;

use crate::rust_source::is_for_tests;

/// A text in the tokens of a macro.
static TEXT: LazyLock<Regex> = LazyLock::new(|| pattern(r#"(?s)"(?:[^"\\]|\\.)*""#));
/// A path of the crate in the tokens of a macro.
static PATH: LazyLock<Regex> = LazyLock::new(|| pattern(r"\b(crate|self|super)(\s*::\s*\w+)+"));

fn pattern(text: &str) -> Regex {
    Regex::new(text).expect("a pattern")
}

/// What one module names.
#[derive(Debug, Default)]
pub(crate) struct Module {
    pub(crate) names: BTreeSet<Vec<String>>,
    /// What it imports: the paths, from the root of the crate, by the names that it gives them.
    pub(crate) imports: BTreeMap<String, Vec<String>>,
}

impl Module {
    /// Reads the source of the module at a path.
    pub(crate) fn of(source: &syn::File, module: &[String]) -> Self {
        let mut names = Names::of(module);
        names.visit_file(source);
        Self {
            names: names.found,
            imports: names.imports,
        }
    }
}

pub(crate) type Modules = BTreeMap<Vec<String>, Module>;

/// Collects the paths within the crate that a module's items name.
struct Names<'module> {
    module: &'module [String],
    found: BTreeSet<Vec<String>>,
    imports: BTreeMap<String, Vec<String>>,
}

impl<'module> Names<'module> {
    fn of(module: &'module [String]) -> Self {
        Self {
            module,
            found: BTreeSet::new(),
            imports: BTreeMap::new(),
        }
    }

    /// Returns a path from the root of the crate; `None` if it does not state where it begins.
    fn rooted(&self, path: &[String]) -> Option<Vec<String>> {
        match path.first()?.as_str() {
            "crate" => Some(path[1..].to_vec()),
            "self" => Some([self.module, &path[1..]].concat()),
            "super" => {
                let ups = path.iter().take_while(|part| *part == "super").count();
                let depth = self.module.len().saturating_sub(ups);
                Some([&self.module[..depth], &path[ups..]].concat())
            }
            _ => None,
        }
    }

    fn add(&mut self, path: &[String]) {
        let named = self.rooted(path);
        self.found.extend(named);
    }

    /// Adds what an import names, under the name that it gives it.
    fn import(&mut self, name: &str, path: &[String]) {
        self.add(path);
        // `a::{self}` is `a`.
        let path = match path {
            [before @ .., last] if last == "self" => before,
            path => path,
        };
        let Some(last) = path.last() else { return };
        let name = if name == "self" { last.as_str() } else { name };
        // Without a begin it is a path of a child, or of another crate.
        let rooted = self.rooted(path);
        let rooted = rooted.unwrap_or_else(|| [self.module, path].concat());
        self.imports.insert(name.to_owned(), rooted);
    }

    fn add_tree(&mut self, before: &mut Vec<String>, tree: &syn::UseTree) {
        match tree {
            syn::UseTree::Path(path) => {
                before.push(path.ident.to_string());
                self.add_tree(before, &path.tree);
                before.pop();
            }
            syn::UseTree::Name(name) => {
                let name = name.ident.to_string();
                let path = [&before[..], std::slice::from_ref(&name)].concat();
                self.import(&name, &path);
            }
            syn::UseTree::Rename(name) => {
                let path = [&before[..], &[name.ident.to_string()]].concat();
                self.import(&name.rename.to_string(), &path);
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
        // Modules in a file of their own are read there.
        if item.content.is_none() || is_for_tests(&item.attrs) {
            return;
        }
        let module = [self.module, &[item.ident.to_string()]].concat();
        let mut within = Names::of(&module);
        syn::visit::visit_item_mod(&mut within, item);
        self.found.extend(within.found);
    }

    fn visit_macro(&mut self, call: &'ast syn::Macro) {
        self.visit_path(&call.path);
        let tokens = call.tokens.to_string();
        let tokens = TEXT.replace_all(&tokens, "");
        for path in PATH.find_iter(&tokens) {
            let parts = path.as_str().split("::");
            let parts: Vec<String> = parts.map(|part| part.trim().to_owned()).collect();
            self.add(&parts);
        }
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
    modules.insert(module.to_vec(), Module::of(&parsed, module));
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

pub(crate) fn modules_of(name: &str) -> Modules {
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

#[test]
fn paths_are_found_in_macros_modules_in_braces_and_groups() {
    let text = r#"
        use super::{b::{self, One as Two}, c};
        mod within { use super::super::d; }
        #[cfg(test)]
        mod tests { use super::super::not_this; }
        fn f() { println!("crate::not_this {}", crate::e::X); self::x::y(); }
    "#;
    let source = syn::parse_file(text).expect("Rust");
    let module = Module::of(&source, &["a".to_owned()]);
    let found: Vec<String> = module.names.iter().map(|path| path.join("::")).collect();
    assert_eq!(found, ["a::x::y", "b::One", "b::self", "c", "d", "e::X"]);
    let imports = module.imports.iter();
    let imports: Vec<String> = imports
        .map(|(name, path)| format!("{name} = {}", path.join("::")))
        .collect();
    assert_eq!(imports, ["Two = b::One", "b = b", "c = c"]);
}
