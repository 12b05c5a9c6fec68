//! The book that `book/build` makes has every page for readers.

use tread_tests::markdown::{Document, documents};
use tread_tests::repository::root;

/// Pages that are for readers of the sources alone.
const LEFT_OUT: [&str; 1] = ["book/SUMMARY.md"];

#[test]
fn every_page_has_its_place_in_the_book() {
    let text = std::fs::read_to_string(root().join("book/SUMMARY.md")).unwrap();
    let chapters = Document::read("SUMMARY.md", &text).links;
    let chapters: Vec<&str> = chapters.iter().map(|link| link.text.as_str()).collect();
    for page in documents() {
        let is_left_out = LEFT_OUT.contains(&page.name.as_str());
        let times = chapters.iter().filter(|name| **name == page.name).count();
        let expected = usize::from(!is_left_out);
        assert_eq!(times, expected, "{} in book/SUMMARY.md", page.name);
    }
}
