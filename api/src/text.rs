//! Texts that people and robots give: names, reasons, details. They have bounds, and nothing in them
//! that a terminal or a page would act on instead of showing it.

use std::borrow::Cow;

use serde::{Deserialize, Deserializer};

/// Whether a character shows as itself: none that moves a cursor, ends a line, turns the direction of
/// writing round, or cannot be seen.
pub fn is_printable(letter: char) -> bool {
    !letter.is_control()
        && !matches!(
            letter,
            '\u{ad}'
                | '\u{61c}'
                | '\u{180e}'
                | '\u{200b}'..='\u{200f}'
                | '\u{2028}'..='\u{202e}'
                | '\u{2060}'..='\u{206f}'
                | '\u{feff}'
                | '\u{fff9}'..='\u{fffb}'
                | '\u{e0000}'..='\u{e007f}'
        )
}

/// Why a text cannot be taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidText {
    /// It is empty or too long.
    #[error("it has 1 to {0} characters")]
    Length(usize),
    /// It has a character that does not show as itself.
    #[error("it has the character U+{:04X}, which cannot be seen", u32::from(*.0))]
    NotPrintable(char),
}

/// A line for people as it was given, without blanks around it.
///
/// # Errors
/// [`InvalidText`].
pub fn line(text: &str, length_max: usize) -> Result<&str, InvalidText> {
    let text = text.trim();
    if text.is_empty() || text.chars().count() > length_max {
        return Err(InvalidText::Length(length_max));
    }
    match text.chars().find(|letter| !is_printable(*letter)) {
        Some(letter) => Err(InvalidText::NotPrintable(letter)),
        None => Ok(text),
    }
}

/// What of a text can be shown, at most so many characters of it, without blanks around it: what is
/// not printable becomes a blank. For texts that must be taken whatever they are, as the reason of a
/// stop and what robots say.
pub fn cleaned(text: &str, length_max: usize) -> String {
    let shown = |letter| if is_printable(letter) { letter } else { ' ' };
    let text: String = text.trim().chars().map(shown).take(length_max).collect();
    text.trim().to_owned()
}

/// Reads a text for `#[serde(deserialize_with)]` and keeps what [`cleaned`] keeps of it.
///
/// # Errors
/// There is no text.
pub fn bounded<'de, D: Deserializer<'de>, const LENGTH_MAX: usize>(
    deserializer: D,
) -> Result<String, D::Error> {
    let text: Cow<'de, str> = Deserialize::deserialize(deserializer)?;
    Ok(cleaned(&text, LENGTH_MAX))
}

/// The same for a text that may be absent or `null`.
///
/// # Errors
/// There is something else than a text.
pub fn bounded_option<'de, D: Deserializer<'de>, const LENGTH_MAX: usize>(
    deserializer: D,
) -> Result<Option<String>, D::Error> {
    let text: Option<Cow<'de, str>> = Deserialize::deserialize(deserializer)?;
    Ok(text.map(|text| cleaned(&text, LENGTH_MAX)))
}

/// A text in which everything that is not printable stands as an escape such as `\u{1b}`.
pub fn escaped(text: &str) -> Cow<'_, str> {
    if text.chars().all(is_printable) {
        return Cow::Borrowed(text);
    }
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            letter if is_printable(letter) => escaped.push(letter),
            '\n' => escaped.push_str("\\n"),
            '\t' => escaped.push_str("\\t"),
            letter => escaped.extend(letter.escape_unicode()),
        }
    }
    Cow::Owned(escaped)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn what_moves_a_cursor_or_turns_writing_round_is_not_printable() {
        for letter in
            "\u{1b}\0\n\r\t\u{7f}\u{9b}\u{202e}\u{2066}\u{200b}\u{2028}\u{feff}\u{e0041}".chars()
        {
            assert!(!is_printable(letter), "{letter:?}");
            let name = format!("a{letter}b");
            assert_eq!(line(&name, 80), Err(InvalidText::NotPrintable(letter)));
            assert_eq!(cleaned(&name, 80), "a b");
        }
        for name in [
            "Wall screen",
            "Łąka 3",
            "北の庭",
            "حقل",
            "café",
            "a — b",
            "👷",
        ] {
            assert_eq!(line(name, 80), Ok(name));
        }
    }

    #[test]
    fn a_line_has_its_bound() {
        assert_eq!(line("  a ", 1), Ok("a"));
        assert_eq!(line(" \u{a0} ", 5), Err(InvalidText::Length(5)));
        assert_eq!(line("ab", 1), Err(InvalidText::Length(1)));
        assert_eq!(cleaned(&"x".repeat(5_000_000), 200).len(), 200);
        assert_eq!(escaped("a\u{1b}[2J\nb"), "a\\u{1b}[2J\\nb");
        assert!(matches!(escaped("plain"), Cow::Borrowed(_)));
    }

    proptest! {
        #[test]
        fn whatever_comes_what_is_shown_is_printable(text: String, length_max in 0_usize..50) {
            prop_assert!(escaped(&text).chars().all(is_printable));
            let clean = cleaned(&text, length_max);
            prop_assert!(clean.chars().count() <= length_max);
            prop_assert_eq!(cleaned(&clean, length_max), clean);
        }
    }
}
