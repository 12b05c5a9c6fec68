//! The routes that the documentation names are those of the API's description, and the page about
//! the API names all of them.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use serde_json::Value;
use tread_tests::markdown::documents;
use tread_tests::repository::root;

const METHODS: [&str; 5] = ["GET", "POST", "PUT", "DELETE", "PATCH"];
/// The page that names every route.
const PAGE: &str = "docs/rest.md";
/// What stands for the beginning of a path.
const SHORTENED: char = '…';

/// A path whose parameters have no names.
fn plain(path: &str) -> Vec<String> {
    let parts = path.trim_start_matches(SHORTENED).split('/').skip(1);
    let part = |part: &str| if part.starts_with('{') { "{}" } else { part }.to_owned();
    parts.map(part).collect()
}

/// The paths that some code may mean, of those that there are.
fn meant<'api>(
    named: &str,
    routes: &'api BTreeMap<Vec<String>, Vec<String>>,
) -> Vec<&'api Vec<String>> {
    let parts = plain(named);
    let is_same = |known: &[String]| {
        known.len() == parts.len()
            && known
                .iter()
                .zip(&parts)
                .all(|(known, part)| known == part || (known == "{}" && part != "{}"))
    };
    let fits = |known: &&Vec<String>| {
        let begin = known.len().checked_sub(parts.len());
        let is_end = named.starts_with(SHORTENED);
        begin.is_some_and(|begin| is_same(&known[begin..]) && (is_end || begin == 0))
    };
    routes.keys().filter(fits).collect()
}

#[test]
fn the_documentation_names_the_routes_that_there_are() {
    let api = std::fs::read_to_string(root().join("server/openapi.json")).unwrap();
    let api: Value = serde_json::from_str(&api).unwrap();
    let routes = api["paths"].as_object().unwrap().iter();
    let routes: BTreeMap<Vec<String>, Vec<String>> = routes
        .map(|(path, operations)| {
            let methods = operations.as_object().unwrap().keys();
            (
                plain(path),
                methods.map(|name| name.to_uppercase()).collect(),
            )
        })
        .collect();
    let (mut faults, mut named) = (String::new(), BTreeSet::new());
    for document in documents() {
        for code in &document.codes {
            let words: Vec<&str> = code.text.split_whitespace().collect();
            let Some((path, methods)) = words.split_last() else {
                continue;
            };
            let is_route = !methods.is_empty() && methods.iter().all(|word| METHODS.contains(word));
            if !is_route || !path.starts_with(['/', SHORTENED]) {
                continue;
            }
            let path = path.split('?').next().unwrap_or_default();
            let (without, with) = match path.split_once('[') {
                Some((begin, end)) => {
                    (begin.to_owned(), format!("{begin}{}", end.replace(']', "")))
                }
                None => (path.to_owned(), path.to_owned()),
            };
            for path in BTreeSet::from([without, with]) {
                if path.ends_with(SHORTENED) {
                    continue;
                }
                let meant = meant(&path, &routes);
                for method in methods {
                    let mut with_method = meant
                        .iter()
                        .filter(|route| routes[**route].iter().any(|known| known == method))
                        .peekable();
                    if with_method.peek().is_none() {
                        let (name, line) = (&document.name, code.line);
                        let _ = writeln!(faults, "{name}:{line}: there is no `{method} {path}`");
                    }
                    if document.name == PAGE {
                        named.extend(with_method.map(|route| ((*method).to_owned(), *route)));
                    }
                }
            }
        }
    }
    for (route, methods) in &routes {
        for method in methods {
            if !named.contains(&(method.clone(), route)) {
                let _ = writeln!(faults, "{PAGE}: `{method} /{}` is missing", route.join("/"));
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
    assert!(!named.is_empty(), "no route was found");
}
