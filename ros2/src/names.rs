//! Names of topics and nodes, checked and made absolute.

use std::fmt;

/// Longest name, bytes: ROS 2 allows no longer ones either.
pub const NAME_BYTES_MAX: usize = 247;

/// Why a name was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// There is nothing.
    #[error("a name is empty")]
    Empty,
    /// It is longer than [`NAME_BYTES_MAX`].
    #[error("`{0}` is longer than {NAME_BYTES_MAX} bytes")]
    TooLong(String),
    /// A part of it is no word of letters, digits and underscores that begins with no digit.
    #[error(
        "`{0}` is no name: words of letters, digits and `_`, none beginning with a digit, with `/` between"
    )]
    Malformed(String),
}

fn is_word(word: &str) -> bool {
    let is_inner = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'_';
    word.bytes().all(is_inner)
        && word
            .bytes()
            .next()
            .is_some_and(|byte| !byte.is_ascii_digit())
}

fn check(name: &str) -> Result<(), NameError> {
    if name.is_empty() {
        return Err(NameError::Empty);
    }
    if name.len() > NAME_BYTES_MAX {
        return Err(NameError::TooLong(name.to_owned()));
    }
    if name.split('/').all(is_word) {
        Ok(())
    } else {
        Err(NameError::Malformed(name.to_owned()))
    }
}

/// A namespace, or a topic's absolute name, without the slash before it; a namespace may be empty.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Name(String);

impl Name {
    /// A namespace; nothing and `/` are that of the root.
    ///
    /// # Errors
    /// [`NameError`].
    pub fn namespace(text: &str) -> Result<Self, NameError> {
        let bare = text.strip_prefix('/').unwrap_or(text);
        if !bare.is_empty() {
            check(bare)?;
        }
        Ok(Self(bare.to_owned()))
    }

    /// A topic: an absolute name begins with `/`, another is within the namespace.
    ///
    /// # Errors
    /// [`NameError`].
    pub fn topic(text: &str, namespace: &Self) -> Result<Self, NameError> {
        let name = match text.strip_prefix('/') {
            Some(absolute) => absolute.to_owned(),
            None if namespace.0.is_empty() => text.to_owned(),
            None => format!("{}/{text}", namespace.0),
        };
        check(&name)?;
        Ok(Self(name))
    }

    /// A node's name: one word.
    ///
    /// # Errors
    /// [`NameError`].
    pub fn node(text: &str) -> Result<Self, NameError> {
        check(text)?;
        if text.contains('/') {
            return Err(NameError::Malformed(text.to_owned()));
        }
        Ok(Self(text.to_owned()))
    }

    /// Without the slash before it.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// With the slash before it, as people write it.
impl fmt::Display for Name {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "/{}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_relative_name_is_within_the_namespace_and_an_absolute_one_is_not() {
        let root = Name::namespace("/").unwrap();
        let seventh = Name::namespace("/robot7").unwrap();
        for (text, within, name) in [
            ("odom", &root, "/odom"),
            ("odom", &seventh, "/robot7/odom"),
            ("imu/data", &seventh, "/robot7/imu/data"),
            ("/odom", &seventh, "/odom"),
        ] {
            let topic = Name::topic(text, within).unwrap();
            assert_eq!(topic.to_string(), name);
        }
        assert_eq!(Name::namespace(""), Ok(root));
    }

    #[test]
    fn what_would_be_another_key_is_refused() {
        let root = Name::default();
        for bad in [
            "", "/", "a//b", "a/", "2odom", "odom*", "a b", "~/x", "a/$*", "o#", "ö",
        ] {
            assert!(Name::topic(bad, &root).is_err(), "{bad}");
        }
        assert!(Name::topic(&"a".repeat(NAME_BYTES_MAX + 1), &root).is_err());
        assert!(Name::node("a/b").is_err());
    }
}
