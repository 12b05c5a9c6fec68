//! Texts from people and robots: names, reasons, details. Their length is bounded, and they contain
//! no character that a terminal or a page would interpret instead of displaying it.

use std::borrow::Cow;

use serde::{Deserialize, Deserializer};

/// Whether a character is displayed as itself: it neither moves a cursor, nor ends a line, nor
/// changes the direction of writing, nor is invisible.
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

/// Reason why a text is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidText {
    /// The text is empty or too long; contains the maximum length, characters.
    #[error("it must have 1 to {0} characters")]
    Length(usize),
    /// The text contains a character that is not printable by [`is_printable`].
    #[error("it has the character U+{:04X}, which is not printable", u32::from(*.0))]
    NotPrintable(char),
}

/// Returns a single-line text without surrounding white space, otherwise unchanged.
///
/// # Errors
/// [`InvalidText`] if it is empty, longer than `length_max` characters, or not printable.
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

/// Returns at most `length_max` characters of a text, without surrounding white space and with a
/// space in place of each unprintable character. For texts that must not be refused, such as the
/// reason of a stop or a text from a robot.
pub fn cleaned(text: &str, length_max: usize) -> String {
    let shown = |letter| if is_printable(letter) { letter } else { ' ' };
    let text: String = text.trim().chars().map(shown).take(length_max).collect();
    text.trim().to_owned()
}

/// Reads a text, for `#[serde(deserialize_with)]`, and applies [`cleaned`] to it.
///
/// # Errors
/// The value is not a text.
pub fn bounded<'de, D: Deserializer<'de>, const LENGTH_MAX: usize>(
    deserializer: D,
) -> Result<String, D::Error> {
    let text: Cow<'de, str> = Deserialize::deserialize(deserializer)?;
    Ok(cleaned(&text, LENGTH_MAX))
}

/// Reads a text that may be absent or `null`, and applies [`cleaned`] to it.
///
/// # Errors
/// The value is neither a text nor `null`.
pub fn bounded_option<'de, D: Deserializer<'de>, const LENGTH_MAX: usize>(
    deserializer: D,
) -> Result<Option<String>, D::Error> {
    let text: Option<Cow<'de, str>> = Deserialize::deserialize(deserializer)?;
    Ok(text.map(|text| cleaned(&text, LENGTH_MAX)))
}

/// Returns the text with every unprintable character replaced by an escape such as `\u{1b}`.
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
