//! Where the archive is: a folder, or a bucket of S3-compatible storage.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use serde::Deserialize;

/// Beginning of the location of a bucket.
const SCHEME: &str = "s3://";
/// Lengths of the name of a bucket.
const BUCKET_CHARS: std::ops::RangeInclusive<usize> = 3..=63;
/// Maximum length of the prefix of names in a bucket, far below what a name may have.
const PREFIX_CHARS_MAX: usize = 512;

/// Where the files of the archive are.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub enum ArchiveLocation {
    /// In a folder.
    Folder(PathBuf),
    /// In a bucket.
    Bucket(BucketLocation),
}

/// A bucket, and what the names of the objects begin with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BucketLocation {
    /// Name of the bucket.
    pub bucket: String,
    /// Prefix of the names, without a slash at its ends; empty for none.
    pub prefix: String,
}

/// Reason why a text is no location.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LocationError {
    /// It is empty.
    #[error("the archive needs a folder, or s3://BUCKET/PREFIX")]
    Empty,
    /// It is an address of another kind.
    #[error("`{0}`: the archive is a folder, or s3://BUCKET/PREFIX")]
    Scheme(String),
    /// The name of the bucket is impossible.
    #[error(
        "`{0}` names no bucket: write s3://BUCKET/PREFIX with 3 to 63 lower-case letters, digits, hyphens \
         and dots as BUCKET"
    )]
    Bucket(String),
    /// The prefix is impossible.
    #[error(
        "`{0}`: PREFIX of s3://BUCKET/PREFIX has parts of letters, digits and -_.= between slashes"
    )]
    Prefix(String),
}

impl FromStr for ArchiveLocation {
    type Err = LocationError;

    fn from_str(text: &str) -> Result<Self, LocationError> {
        let Some(rest) = text.strip_prefix(SCHEME) else {
            return match text {
                "" => Err(LocationError::Empty),
                other if other.contains("://") => Err(LocationError::Scheme(other.to_owned())),
                folder => Ok(Self::Folder(folder.into())),
            };
        };
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        let is_lower = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit();
        if !BUCKET_CHARS.contains(&bucket.len())
            || !bucket
                .chars()
                .all(|c| is_lower(c) || matches!(c, '-' | '.'))
            || !bucket.starts_with(is_lower)
        {
            return Err(LocationError::Bucket(text.to_owned()));
        }
        let prefix = prefix.strip_suffix('/').unwrap_or(prefix);
        let is_part = |part: &str| {
            let is_allowed = |c: char| c.is_ascii_alphanumeric() || "-_.=".contains(c);
            !part.is_empty() && part.chars().all(is_allowed) && !matches!(part, "." | "..")
        };
        if !prefix.is_empty()
            && (prefix.len() > PREFIX_CHARS_MAX || !prefix.split('/').all(is_part))
        {
            return Err(LocationError::Prefix(text.to_owned()));
        }
        Ok(Self::Bucket(BucketLocation {
            bucket: bucket.to_owned(),
            prefix: prefix.to_owned(),
        }))
    }
}

impl TryFrom<String> for ArchiveLocation {
    type Error = LocationError;

    fn try_from(text: String) -> Result<Self, LocationError> {
        text.parse()
    }
}

impl From<PathBuf> for ArchiveLocation {
    fn from(folder: PathBuf) -> Self {
        Self::Folder(folder)
    }
}

impl fmt::Display for ArchiveLocation {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder(folder) => write!(out, "{}", folder.display()),
            Self::Bucket(bucket) => write!(out, "{bucket}"),
        }
    }
}

impl fmt::Display for BucketLocation {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { bucket, prefix } = self;
        match prefix.as_str() {
            "" => write!(out, "{SCHEME}{bucket}"),
            prefix => write!(out, "{SCHEME}{bucket}/{prefix}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn what_is_parsed_is_shown_and_parsed_again(
            text in "s3://[a-zA-Z.-]{0,6}(/[a-z.=/]{0,8})?|[ -~]{0,12}",
        ) {
            if let Ok(location) = text.parse::<ArchiveLocation>() {
                prop_assert_eq!(location.to_string().parse(), Ok(location));
            }
        }
    }

    #[test]
    fn a_bucket_has_a_name_and_perhaps_a_prefix() {
        let bucket = |bucket: &str, prefix: &str| {
            Ok(ArchiveLocation::Bucket(BucketLocation {
                bucket: bucket.to_owned(),
                prefix: prefix.to_owned(),
            }))
        };
        assert_eq!("s3://fleet".parse(), bucket("fleet", ""));
        assert_eq!("s3://fleet/".parse(), bucket("fleet", ""));
        assert_eq!("s3://fleet/north/1/".parse(), bucket("fleet", "north/1"));
        assert_eq!(
            "/var/lib/archive".parse(),
            Ok(ArchiveLocation::Folder("/var/lib/archive".into()))
        );
        for (text, expected) in [
            ("", LocationError::Empty),
            ("S3://abc", LocationError::Scheme("S3://abc".to_owned())),
            ("s3://", LocationError::Bucket("s3://".to_owned())),
            ("s3://No", LocationError::Bucket("s3://No".to_owned())),
            ("s3://-ab", LocationError::Bucket("s3://-ab".to_owned())),
            (
                "s3://abc//d",
                LocationError::Prefix("s3://abc//d".to_owned()),
            ),
            (
                "s3://abc/../d",
                LocationError::Prefix("s3://abc/../d".to_owned()),
            ),
            ("s3://abc/ä", LocationError::Prefix("s3://abc/ä".to_owned())),
        ] {
            assert_eq!(text.parse::<ArchiveLocation>(), Err(expected));
        }
    }
}
