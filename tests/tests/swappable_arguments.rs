//! No function takes two arguments of one type, which a caller could exchange without an error of the
//! compiler: see `swappable-arguments.txt` for the exceptions. Nor does a parameter take apart a tuple
//! with two elements of one type.
//!
//! Functions of tests do not count, nor do implementations of traits: the trait's own function does.
//! Types are compared as they are written, but for those that take a text of any type, such as
//! `impl Into<String>`: they count as the same as `&str`, `String` and each other.

mod rust_source;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;

use syn::visit::{self, Visit};
use tread_tests::repository::{files, root};

use rust_source::is_for_tests;

/// A type as a text without lifetimes.
#[derive(Default)]
struct TypeText(String);

impl<'ast> Visit<'ast> for TypeText {
    fn visit_ident(&mut self, ident: &'ast syn::Ident) {
        let _ = write!(self.0, " {ident}");
    }

    fn visit_lifetime(&mut self, _: &'ast syn::Lifetime) {}

    fn visit_lit_int(&mut self, literal: &'ast syn::LitInt) {
        self.0.push_str(literal.base10_digits());
    }

    fn visit_angle_bracketed_generic_arguments(
        &mut self,
        arguments: &'ast syn::AngleBracketedGenericArguments,
    ) {
        self.0.push('<');
        visit::visit_angle_bracketed_generic_arguments(self, arguments);
        self.0.push('>');
    }

    fn visit_type(&mut self, of: &'ast syn::Type) {
        let (open, close) = if let syn::Type::Reference(of) = of {
            (
                if of.mutability.is_some() {
                    "&mut("
                } else {
                    "&("
                },
                ")",
            )
        } else if matches!(of, syn::Type::Tuple(_)) {
            ("(", ")")
        } else if matches!(of, syn::Type::Slice(_) | syn::Type::Array(_)) {
            ("[", "]")
        } else {
            ("", ",")
        };
        self.0.push_str(open);
        visit::visit_type(self, of);
        self.0.push_str(close);
    }
}

/// The types that take a text of any type, as they are written.
const ANY_TEXTS: [&str; 5] = [
    "impl Into<String>",
    "impl AsRef<str>",
    "impl Display",
    "impl fmt Display",
    "impl std fmt Display",
];
/// The types of a text itself. These two cannot be exchanged with each other.
const TEXTS: [&str; 2] = ["&(str)", "String"];

fn text_of(of: &syn::Type) -> String {
    let mut text = TypeText::default();
    text.visit_type(of);
    if let syn::Type::ImplTrait(_) = of {
        text.0.insert_str(0, "impl");
    }
    let plain = text.0.replace(',', "");
    let plain = plain.replace("( ", "(").replace("< ", "<");
    plain.trim().to_owned()
}

/// Whether an argument of one type can be passed as one of the other.
fn are_exchangeable(one: &str, other: &str) -> bool {
    let is_any = |of: &str| ANY_TEXTS.contains(&of);
    let is_text = |of: &str| is_any(of) || TEXTS.contains(&of);
    one == other || (is_any(one) && is_text(other)) || (is_text(one) && is_any(other))
}

/// Whether two values of these types could be exchanged.
fn has_exchangeable<'of>(types: impl IntoIterator<Item = &'of syn::Type>) -> bool {
    let types: Vec<String> = types.into_iter().map(text_of).collect();
    let mut pairs = types.iter().enumerate();
    pairs.any(|(place, one)| {
        let mut later = types[place + 1..].iter();
        later.any(|other| are_exchangeable(one, other))
    })
}

/// Whether a pattern takes apart a tuple whose elements could be exchanged.
fn takes_swappable_tuple(pattern: &syn::Pat, of: &syn::Type) -> bool {
    match (pattern, of) {
        (syn::Pat::Reference(pattern), syn::Type::Reference(of)) => {
            takes_swappable_tuple(&pattern.pat, &of.elem)
        }
        (syn::Pat::Tuple(_), syn::Type::Reference(of)) => takes_swappable_tuple(pattern, &of.elem),
        (syn::Pat::Tuple(pattern), syn::Type::Tuple(of)) => {
            let mut elements = pattern.elems.iter().zip(&of.elems);
            has_exchangeable(&of.elems)
                || elements.any(|(element, of)| takes_swappable_tuple(element, of))
        }
        _ => false,
    }
}

/// Finds the functions with two arguments of one type.
#[derive(Default)]
struct Swappable(Vec<String>);

impl Swappable {
    fn check(&mut self, signature: &syn::Signature) {
        let typed = || {
            signature.inputs.iter().filter_map(|input| match input {
                syn::FnArg::Typed(input) => Some(input),
                syn::FnArg::Receiver(_) => None,
            })
        };
        if has_exchangeable(typed().map(|input| &*input.ty))
            || typed().any(|input| takes_swappable_tuple(&input.pat, &input.ty))
        {
            self.0.push(signature.ident.to_string());
        }
    }
}

impl<'ast> Visit<'ast> for Swappable {
    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_for_tests(&item.attrs) {
            self.check(&item.sig);
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
        if !is_for_tests(&item.attrs) {
            self.check(&item.sig);
            visit::visit_impl_item_fn(self, item);
        }
    }

    fn visit_trait_item_fn(&mut self, item: &'ast syn::TraitItemFn) {
        self.check(&item.sig);
        visit::visit_trait_item_fn(self, item);
    }

    fn visit_item_impl(&mut self, item: &'ast syn::ItemImpl) {
        if item.trait_.is_none() {
            visit::visit_item_impl(self, item);
        }
    }

    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        if !is_for_tests(&item.attrs) {
            visit::visit_item_mod(self, item);
        }
    }
}

fn swappable_of(text: &str) -> Vec<String> {
    let mut found = Swappable::default();
    found.visit_file(&syn::parse_file(text).expect("Rust"));
    found.0
}

/// Returns the lines on which functions of a name begin, with `/` between them.
fn lines_of(text: &str, function: &str) -> String {
    let begins = [format!("fn {function}("), format!("fn {function}<")];
    let numbered = text.lines().zip(1_u32..);
    let found = numbered.filter(|(line, _)| begins.iter().any(|begin| line.contains(begin)));
    let found: Vec<String> = found.map(|(_, number)| number.to_string()).collect();
    found.join("/")
}

/// Whether a file is compiled into the product or the lab, by its path.
fn is_of_product(name: &str) -> bool {
    let mut folders = name.split('/');
    let is_rust = name.strip_suffix(".rs").is_some();
    let last = name.rsplit('/').next().unwrap_or(name);
    is_rust
        && folders.all(|folder| !["tests", "examples", "benches"].contains(&folder))
        && !last.contains("tests")
}

#[test]
fn two_arguments_of_one_type_are_found_and_others_are_not() {
    let text = "
        fn swapped(from_m: f64, to_m: f64) {}
        fn fine(from_m: f64, at: Duration, list: &[f64], all: [f64; 2], two: Option<f64>) {}
        fn borrowed<'a>(one: &'a str, other: &str) {}
        fn texts(one: &str, other: impl Into<String>) {}
        fn shown(one: String, other: impl Display) {}
        fn owned(one: String, other: &str) {}
        fn sizes(one: [f64; 2], other: [f64; 3]) {}
        impl Trait for X { fn fixed(&self, a: u8, b: u8) {} }
        impl X { fn method(&self, a: u8, b: u8) {} }
        trait T { fn of_trait(&self, a: &mut Vec<u8>, b: &mut Vec<u8>); }
        #[cfg(test)] mod tests { fn helper(a: u8, b: u8) {} }
        fn tuple((from_m, mut to_m): (f64, f64), at: Duration) {}
        fn of_references((one, two): &(u8, u8), &(_, _, last): &(u8, bool, u8)) {}
        fn nested((at, (x, y)): (u8, (f64, f64))) {}
        fn mixed((x, at): (f64, Duration), pair: (u8, u8), (list, _): (&[(u8, u8)], u8)) {
            let closure = |(a, b): (u8, u8)| a + b;
        }
    ";
    let expected = [
        "swapped",
        "borrowed",
        "texts",
        "shown",
        "method",
        "of_trait",
        "tuple",
        "of_references",
        "nested",
    ];
    assert_eq!(swappable_of(text), expected);
    assert_eq!(lines_of(text, "swapped"), "2");
    assert_eq!(
        lines_of("fn a() {}\nfn ab() {}\nasync fn a<T>()", "a"),
        "1/3"
    );
}

#[test]
fn no_function_takes_two_arguments_that_could_be_exchanged() {
    let listed = root().join("tests/swappable-arguments.txt");
    let listed = fs::read_to_string(listed).expect("the list");
    let mut reasons: BTreeMap<(String, String), bool> = BTreeMap::new();
    for line in listed.lines().filter(|line| !line.starts_with('#')) {
        let parts: Vec<&str> = line.split('\t').collect();
        let [file, function, reason] = parts[..] else {
            panic!("a file, a tab, a function, a tab, a reason: {line}");
        };
        assert!(reason.len() > 10, "{line}");
        reasons.insert((file.to_owned(), function.to_owned()), false);
    }
    let mut faults = String::new();
    let names: Vec<String> = files()
        .into_iter()
        .filter(|name| is_of_product(name))
        .collect();
    assert!(names.len() > 300, "the sources are here");
    for name in &names {
        let text = fs::read_to_string(root().join(name)).unwrap();
        for function in swappable_of(&text) {
            let lines = lines_of(&text, &function);
            let key = (name.clone(), function);
            if let Some(is_used) = reasons.get_mut(&key) {
                *is_used = true;
            } else {
                let _ = writeln!(faults, "{name}:{lines}: {}", key.1);
            }
        }
    }
    for ((file, function), _) in reasons.iter().filter(|(_, is_used)| !**is_used) {
        let _ = writeln!(faults, "{file}: {function} needs no exception");
    }
    assert!(faults.is_empty(), "\n{faults}");
}
