//! Where the database is: a file of SQLite, or the address of a PostgreSQL database.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::Deserialize;

/// Beginnings of the address of a PostgreSQL database.
const POSTGRES_SCHEMES: [&str; 2] = ["postgres://", "postgresql://"];
/// What is shown in place of a password.
const PASSWORD_SHOWN: &str = "…";

/// Where the database is.
#[derive(Clone, PartialEq, Eq, Deserialize)]
#[serde(from = "PathBuf")]
pub enum Location {
    /// A file of SQLite.
    File(PathBuf),
    /// A PostgreSQL database, `postgres://USER@HOST:PORT/NAME`, perhaps with a password.
    Postgres(String),
}

impl Location {
    /// Returns the path of the file; `None` for a PostgreSQL database.
    pub fn file(&self) -> Option<&Path> {
        match self {
            Self::File(path) => Some(path),
            Self::Postgres(_) => None,
        }
    }

    /// Returns whether it is a PostgreSQL database.
    pub fn is_postgres(&self) -> bool {
        matches!(self, Self::Postgres(_))
    }
}

impl From<PathBuf> for Location {
    /// Reads what a configuration or a flag names. Every text that does not begin as an address does
    /// is a path.
    fn from(named: PathBuf) -> Self {
        match named.to_str() {
            Some(text)
                if POSTGRES_SCHEMES
                    .iter()
                    .any(|scheme| text.starts_with(scheme)) =>
            {
                Self::Postgres(text.to_owned())
            }
            _ => Self::File(named),
        }
    }
}

impl From<&Location> for Location {
    fn from(location: &Location) -> Self {
        location.clone()
    }
}

impl From<&PathBuf> for Location {
    fn from(named: &PathBuf) -> Self {
        named.clone().into()
    }
}

impl From<&Path> for Location {
    fn from(named: &Path) -> Self {
        named.to_owned().into()
    }
}

impl FromStr for Location {
    type Err = std::convert::Infallible;

    fn from_str(named: &str) -> Result<Self, Self::Err> {
        Ok(PathBuf::from(named).into())
    }
}

impl Display for Location {
    /// Shows the path, or the address without its password.
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => path.display().fmt(formatter),
            Self::Postgres(address) => formatter.write_str(&without_password(address)),
        }
    }
}

impl fmt::Debug for Location {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "`{self}`")
    }
}

/// Returns an address whose password, and every parameter, which may hold one, is hidden.
fn without_password(address: &str) -> String {
    let (address, parameters) = match address.split_once('?') {
        Some((address, _parameters)) => (address, "?…"),
        None => (address, ""),
    };
    let Some((scheme, rest)) = address.split_once("://") else {
        return PASSWORD_SHOWN.to_owned();
    };
    let Some((user, place)) = rest.rsplit_once('@') else {
        return format!("{scheme}://{rest}{parameters}");
    };
    let user = match user.split_once(':') {
        Some((name, _password)) => format!("{name}:{PASSWORD_SHOWN}"),
        None => user.to_owned(),
    };
    format!("{scheme}://{user}@{place}{parameters}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scheme_makes_an_address_of_a_name() {
        for (text, is_postgres) in [
            ("postgres://tread@db.example.org/fleet", true),
            ("postgresql:///fleet", true),
            ("tread.db", false),
            ("/var/lib/tread/postgres://x", false),
            ("postgres:/x", false),
        ] {
            let location: Location = text.parse().unwrap();
            assert_eq!(location.is_postgres(), is_postgres, "{text}");
            assert_eq!(location.file().is_none(), is_postgres, "{text}");
        }
    }

    #[test]
    fn passwords_are_never_shown() {
        for (address, shown) in [
            ("postgres://u:secret@h:5432/d", "postgres://u:…@h:5432/d"),
            ("postgres://u:se@cret@h/d", "postgres://u:…@h/d"),
            ("postgres://u@h/d?password=secret", "postgres://u@h/d?…"),
            ("postgres://u@h/d", "postgres://u@h/d"),
            ("postgres:///d", "postgres:///d"),
        ] {
            let location: Location = address.parse().unwrap();
            assert_eq!(location.to_string(), shown);
            assert!(!format!("{location:?}").contains("secret"), "{address}");
        }
    }
}
