//! Stores the user's tokens, one for each server, in a file that only the user can read. The same
//! folder has a file with the fingerprints of trusted servers, and one with the server of the last
//! login.
//!
//! Order of precedence of the sources of a token: `--token-file`, the environment variable
//! `TREAD_TOKEN`, this file.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};
use tread_agent::membership::Fingerprint;

/// Environment variable with a token.
const TOKEN_VARIABLE: &str = "TREAD_TOKEN";
/// Environment variable with the path of the credentials file, instead of the default path.
const FILE_VARIABLE: &str = "TREAD_CREDENTIALS";
/// File beside the credentials with the fingerprints by which servers are trusted.
const FINGERPRINTS_FILE: &str = "fingerprints.json";
/// File beside the credentials with the server of the last login.
const LAST_LOGIN_FILE: &str = "last-login.json";
/// Key in that file.
const LAST_SERVER: &str = "server";
/// Permission bits of a file that give access to others.
const OTHERS: u32 = 0o077;

/// Returns the token for a server; `None` if there is none.
pub(crate) fn find(address: &str, token_file: Option<&Path>) -> anyhow::Result<Option<String>> {
    if let Some(file) = token_file {
        return read_token(file).map(Some);
    }
    if let Some(token) = std::env::var_os(TOKEN_VARIABLE).filter(|token| !token.is_empty()) {
        let token = token.into_string().ok().context("TREAD_TOKEN is no text")?;
        return Ok(Some(token.trim().to_owned()));
    }
    match Store::of_user() {
        Some(store) => store.find(address),
        None => Ok(None),
    }
}

/// Returns the fingerprint by which a server is trusted; `None` if `tread login` was given none.
pub(crate) fn fingerprint(address: &str) -> anyhow::Result<Option<Fingerprint>> {
    let Some(store) = Store::of_user().map(|store| store.fingerprints()) else {
        return Ok(None);
    };
    let kept = store.find(address)?.map(|kept| kept.parse());
    let named = || format!("a fingerprint in {} does not read", store.path().display());
    kept.transpose().with_context(named)
}

/// Returns the server of the last login; `None` if there was none.
pub(crate) fn last_server() -> anyhow::Result<Option<String>> {
    Store::of_user().map_or(Ok(None), |store| store.last_login().find(LAST_SERVER))
}

/// Reads a token from a file without other content.
pub(crate) fn read_token(file: &Path) -> anyhow::Result<String> {
    let text = std::fs::read_to_string(file)
        .with_context(|| format!("cannot read the token in {}", file.display()))?;
    let token = text.trim();
    ensure!(!token.is_empty(), "{} holds no token", file.display());
    Ok(token.to_owned())
}

/// Credentials file.
#[derive(Debug, Clone)]
pub(crate) struct Store {
    file: PathBuf,
}

/// Entry of the file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Entry<'text> {
    /// Address of a server, or [`LAST_SERVER`].
    pub(crate) key: &'text str,
    /// What is stored for it.
    pub(crate) value: &'text str,
}

impl Store {
    /// Returns the credentials file of the user; `None` without a home directory.
    pub(crate) fn of_user() -> Option<Self> {
        let of = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
        let folder = || {
            let config = of("XDG_CONFIG_HOME").map(PathBuf::from);
            config.or_else(|| of("HOME").map(|home| PathBuf::from(home).join(".config")))
        };
        let named = of(FILE_VARIABLE).map(PathBuf::from);
        let file = named.or_else(|| Some(folder()?.join("tread").join("credentials.json")))?;
        Some(Self { file })
    }

    /// Returns the file beside it with the fingerprints of servers.
    pub(crate) fn fingerprints(&self) -> Self {
        let file = self.file.with_file_name(FINGERPRINTS_FILE);
        Self { file }
    }

    fn last_login(&self) -> Self {
        let file = self.file.with_file_name(LAST_LOGIN_FILE);
        Self { file }
    }

    /// Stores the server of the last login.
    pub(crate) fn keep_last_server(&self, address: &str) -> anyhow::Result<()> {
        self.last_login().save(Entry {
            key: LAST_SERVER,
            value: address,
        })
    }

    /// Deletes the server of the last login if it is this one.
    pub(crate) fn delete_last_server(&self, address: &str) -> anyhow::Result<()> {
        self.last_login().remove(LAST_SERVER, Some(address))
    }

    /// Returns the path of the file.
    pub(crate) fn path(&self) -> &Path {
        &self.file
    }

    fn find(&self, address: &str) -> anyhow::Result<Option<String>> {
        Ok(self.read()?.remove(address))
    }

    /// Stores an entry.
    pub(crate) fn save(&self, entry: Entry<'_>) -> anyhow::Result<()> {
        self.change(|kept| {
            kept.insert(entry.key.to_owned(), entry.value.to_owned());
            true
        })
    }

    /// Deletes the token of a server; with `only`, only if it equals that token.
    pub(crate) fn remove(&self, address: &str, only: Option<&str>) -> anyhow::Result<()> {
        self.change(|kept| {
            let stored = kept.get(address);
            let is_removed = stored.is_some_and(|kept| only.is_none_or(|only| only == kept));
            is_removed && kept.remove(address).is_some()
        })
    }

    fn read(&self) -> anyhow::Result<BTreeMap<String, String>> {
        let named = || format!("cannot read {}", self.file.display());
        let text = match std::fs::read_to_string(&self.file) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
            Err(error) => return Err(error).with_context(named),
        };
        let mode = std::fs::metadata(&self.file).with_context(named)?.mode();
        ensure!(
            mode & OTHERS == 0,
            "others can read {}: `chmod 600` it, and revoke the tokens in it if somebody has",
            self.file.display()
        );
        serde_json::from_str(&text).with_context(named)
    }

    /// Replaces the file atomically, under a lock against other processes.
    fn change(
        &self,
        change: impl FnOnce(&mut BTreeMap<String, String>) -> bool,
    ) -> anyhow::Result<()> {
        let named = || format!("cannot write {}", self.file.display());
        let folder = self.file.parent().context("the file has a folder")?;
        let mut making = std::fs::DirBuilder::new();
        making
            .recursive(true)
            .mode(0o700)
            .create(folder)
            .with_context(named)?;
        let private = || {
            let mut options = OpenOptions::new();
            options.write(true).create(true).truncate(true).mode(0o600);
            options
        };
        let lock: File = private().open(self.beside("lock")).with_context(named)?;
        lock.lock().with_context(named)?;
        let mut kept = self.read()?;
        if !change(&mut kept) {
            return Ok(());
        }
        let new = self.beside("new");
        let mut file = private().open(&new).with_context(named)?;
        file.write_all(&serde_json::to_vec_pretty(&kept)?)
            .with_context(named)?;
        file.sync_all().with_context(named)?;
        std::fs::rename(&new, &self.file).with_context(named)
    }

    fn beside(&self, ending: &str) -> PathBuf {
        let mut name = self.file.file_name().unwrap_or_default().to_owned();
        name.push(format!(".{ending}"));
        self.file.with_file_name(name)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn store() -> (tempfile::TempDir, Store) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("tread").join("credentials.json");
        (folder, Store { file })
    }

    fn keep(store: &Store, key: &str) {
        let entry = Entry { key, value: "one" };
        store.save(entry).unwrap();
    }

    #[test]
    fn a_token_is_kept_for_its_server_alone_and_nobody_else_can_read_it() {
        let (_folder, store) = store();
        assert_eq!(store.find("http://a").unwrap(), None);
        keep(&store, "http://a");
        store
            .save(Entry {
                key: "http://b",
                value: "two",
            })
            .unwrap();
        assert_eq!(store.find("http://a").unwrap().as_deref(), Some("one"));
        assert_eq!(std::fs::metadata(store.path()).unwrap().mode() & OTHERS, 0);
        store.remove("http://a", Some("another")).unwrap();
        assert!(store.find("http://a").unwrap().is_some());
        store.remove("http://a", Some("one")).unwrap();
        store.remove("http://b", None).unwrap();
        assert_eq!(store.read().unwrap(), BTreeMap::new());
    }

    #[test]
    fn a_file_that_others_can_read_is_not_used() {
        let (_folder, store) = store();
        keep(&store, "http://a");
        let open = std::fs::Permissions::from_mode(0o644);
        std::fs::set_permissions(store.path(), open).unwrap();
        let said = store.find("http://a").unwrap_err().to_string();
        assert!(said.contains("chmod 600"), "{said}");
    }

    #[test]
    fn many_at_once_lose_nothing() {
        let (_folder, store) = store();
        std::thread::scope(|scope| {
            for number in 0..8 {
                let store = &store;
                scope.spawn(move || keep(store, &format!("http://{number}")));
            }
        });
        assert_eq!(store.read().unwrap().len(), 8);
    }
}
