//! The Markdown of this repository as tests read it: links, anchors, code, and fenced blocks with
//! the comment that stands directly above them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crate::repository::{files, root};
use pulldown_cmark::{CodeBlockKind, Event, Options, Parser, Tag, TagEnd};

/// One Markdown file.
#[derive(Debug, Clone, Default)]
pub struct Document {
    /// Its path from the repository's root.
    pub name: String,
    /// Links and images.
    pub links: Vec<Piece>,
    /// Code within sentences.
    pub codes: Vec<Piece>,
    /// Blocks of code.
    pub blocks: Vec<Block>,
    /// What a link may name behind `#`: the headings, by GitHub's rules.
    pub anchors: BTreeSet<String>,
}

/// A piece of a document.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Piece {
    /// Its line, from 1.
    pub line: usize,
    /// The address of a link, or the code.
    pub text: String,
}

/// A block of code.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    /// The line of its fence, from 1.
    pub line: usize,
    /// The language behind the fence; empty when there is none.
    pub language: String,
    /// The HTML comment directly above, which readers do not see.
    pub note: Option<String>,
    /// Its lines.
    pub text: String,
}

impl Document {
    /// Reads a document; `name` is its path from the repository's root.
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "most of what Markdown has does not matter here"
    )]
    pub fn read(name: &str, text: &str) -> Self {
        let starts: Vec<usize> = std::iter::once(0)
            .chain(text.match_indices('\n').map(|(at, _)| at + 1))
            .collect();
        let line_at = |offset: usize| starts.partition_point(|&start| start <= offset);
        let mut document = Self {
            name: name.to_owned(),
            ..Self::default()
        };
        let mut slugs = BTreeMap::new();
        let (mut heading, mut block, mut note) = (None::<String>, None::<Block>, None);
        let options = Options::ENABLE_TABLES | Options::ENABLE_STRIKETHROUGH;
        for (event, range) in Parser::new_ext(text, options).into_offset_iter() {
            let line = line_at(range.start);
            match event {
                Event::Html(html) => {
                    let comment = html.trim().strip_prefix("<!--");
                    let comment = comment.and_then(|comment| comment.strip_suffix("-->"));
                    note = comment.map(|comment| comment.trim().to_owned());
                }
                Event::Start(Tag::CodeBlock(kind)) => {
                    let language = match kind {
                        CodeBlockKind::Fenced(language) => language.to_string(),
                        CodeBlockKind::Indented => String::new(),
                    };
                    block = Some(Block {
                        line,
                        language,
                        note: note.take(),
                        text: String::new(),
                    });
                }
                Event::End(TagEnd::CodeBlock) => document.blocks.extend(block.take()),
                Event::Start(Tag::Heading { .. }) => (heading, note) = (Some(String::new()), None),
                Event::End(TagEnd::Heading(_)) => {
                    let slug = slug(&heading.take().unwrap_or_default());
                    document.anchors.insert(numbered(slug, &mut slugs));
                }
                Event::Start(Tag::Link { dest_url, .. } | Tag::Image { dest_url, .. }) => {
                    let text = dest_url.to_string();
                    document.links.push(Piece { line, text });
                }
                Event::Start(Tag::Paragraph | Tag::List(_) | Tag::Table(_)) => note = None,
                Event::Code(code) => {
                    if let Some(heading) = &mut heading {
                        heading.push_str(&code);
                    }
                    let text = code.to_string();
                    document.codes.push(Piece { line, text });
                }
                Event::Text(text) => {
                    if let Some(block) = &mut block {
                        block.text.push_str(&text);
                    } else if let Some(heading) = &mut heading {
                        heading.push_str(&text);
                    }
                }
                _ => {}
            }
        }
        document
    }
}

/// A heading as GitHub makes an anchor of it.
fn slug(heading: &str) -> String {
    let kept = heading.trim().chars().filter_map(|letter| match letter {
        ' ' | '-' => Some('-'),
        '_' => Some('_'),
        letter if letter.is_alphanumeric() => Some(letter),
        _ => None,
    });
    kept.flat_map(char::to_lowercase).collect()
}

/// The anchor of a heading; those of equal headings are numbered.
fn numbered(slug: String, seen: &mut BTreeMap<String, usize>) -> String {
    let before = seen.entry(slug.clone()).or_default();
    *before += 1;
    match *before - 1 {
        0 => slug,
        number => format!("{slug}-{number}"),
    }
}

/// Every Markdown file of the repository.
///
/// # Panics
/// If one cannot be read.
pub fn documents() -> Vec<Document> {
    let names = files().into_iter().filter(|name| {
        let end = Path::new(name).extension();
        end.is_some_and(|end| end.eq_ignore_ascii_case("md"))
    });
    let read = |name: String| {
        let text = std::fs::read_to_string(root().join(&name));
        Document::read(&name, &text.expect("a listed file can be read"))
    };
    names.map(read).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn anchors_are_those_of_github() {
        let text =
            "# The API, v1: `GET /x`\n## Stop\n## Stop\n## What is kept?\n## θ_hat – a [b](c.md)\n";
        let document = Document::read("a.md", text);
        let expected = [
            "the-api-v1-get-x",
            "stop",
            "stop-1",
            "what-is-kept",
            "θ_hat--a-b",
        ];
        assert_eq!(
            document.anchors,
            expected.map(str::to_owned).into_iter().collect()
        );
    }

    #[test]
    fn a_block_has_the_comment_directly_above_it_alone() {
        let text = "<!-- far -->\ntext\n\n```sh\nls\n```\n\n* item\n\n  <!-- not run: why -->\n  ```sh\n  cat\n  ```\n";
        let blocks = Document::read("a.md", text).blocks;
        let seen: Vec<_> = blocks
            .iter()
            .map(|block| (block.line, block.note.as_deref(), block.text.as_str()))
            .collect();
        let expected = [(4, None, "ls\n"), (11, Some("not run: why"), "cat\n")];
        assert_eq!(seen, expected);
    }
}
