//! Secrets that the service manager passes (systemd's `LoadCredential=`): a file that the
//! configuration names `credential:NAME` is `NAME` in the folder `$CREDENTIALS_DIRECTORY`.
//!
//! Only the server itself has that folder. Commands beside it (`init`, `health`) read the same
//! configuration without it, so a name is resolved where possible and refused at the server's start.
//! `doctor` looks where the unit of the Debian package takes them from.

use std::path::{Path, PathBuf};

use super::{Config, ConfigError, TlsSource};

/// Beginning of the name of a credential.
const PREFIX: &str = "credential:";
/// Environment variable with the folder of the credentials.
const FOLDER: &str = "CREDENTIALS_DIRECTORY";
/// Folder from which the unit takes the credentials, readable by root alone.
const STORE: &str = "/etc/credstore";

/// Returns the folder of the credentials; `None` if the service manager passes none.
pub(super) fn folder() -> Option<PathBuf> {
    std::env::var_os(FOLDER).map(PathBuf::from)
}

/// Returns whether a file is a credential, which is protected by its folder, whatever its mode.
pub(crate) fn is_passed(file: &Path) -> bool {
    file.starts_with(STORE) || folder().is_some_and(|folder| file.starts_with(folder))
}

fn name_of(file: &Path) -> Option<&str> {
    file.to_str()?.strip_prefix(PREFIX)
}

impl Config {
    /// Returns the files that may be credentials.
    fn secret_files(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let tls = match &mut self.tls {
            Some(TlsSource::Files(files)) => vec![&mut files.certificate, &mut files.key],
            Some(TlsSource::Authority) | None => Vec::new(),
        };
        let oidc = self.oidc.iter_mut();
        tls.into_iter()
            .chain(oidc.filter_map(|oidc| oidc.client_secret_file.as_mut()))
    }

    /// Replaces the names of credentials by their files in `folder`.
    ///
    /// # Errors
    /// [`ConfigError::CredentialName`] for a name that is none, such as a path.
    pub(super) fn resolve_credentials(&mut self, folder: Option<&Path>) -> Result<(), ConfigError> {
        for file in self.secret_files() {
            let Some(name) = name_of(file) else {
                continue;
            };
            if name.is_empty() || name.starts_with('.') || name.contains('/') {
                return Err(ConfigError::CredentialName(name.to_owned()));
            }
            if let Some(folder) = folder {
                *file = folder.join(name);
            }
        }
        Ok(())
    }

    /// Replaces the names of credentials by the files that the service manager passes to the server.
    pub(crate) fn find_credentials(&mut self) -> Result<(), ConfigError> {
        self.resolve_credentials(Some(Path::new(STORE)))
    }

    /// Checks that the service manager has passed all credentials that are named.
    ///
    /// # Errors
    /// [`ConfigError::NoCredential`] for the first that it has not.
    pub(crate) fn check_credentials(&mut self) -> Result<(), ConfigError> {
        let folder = folder();
        let missing = self.secret_files().find_map(|file| {
            let is_absent = folder
                .as_ref()
                .is_some_and(|folder| file.starts_with(folder) && !file.exists());
            let name = name_of(file).or_else(|| file.file_name()?.to_str().filter(|_| is_absent));
            name.map(str::to_owned)
        });
        missing.map_or(Ok(()), |name| Err(ConfigError::NoCredential(name)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::load;
    use super::*;

    const TLS: &str = "[tls]\ncertificate = \"credential:tread.tls-certificate\"\n\
                       key = \"/etc/tread/key.pem\"\n";

    #[test]
    fn a_credential_is_a_file_in_the_folder_of_the_service_manager() {
        let mut config = load(TLS).unwrap();
        config
            .resolve_credentials(Some(Path::new("/run/credentials/tread-server.service")))
            .unwrap();
        let Some(TlsSource::Files(tls)) = config.tls else {
            panic!("the certificate comes from files");
        };
        let expected = "/run/credentials/tread-server.service/tread.tls-certificate";
        assert_eq!(tls.certificate, Path::new(expected));
        assert_eq!(tls.key, Path::new("/etc/tread/key.pem"));
    }

    #[test]
    fn a_credential_that_nobody_passes_stops_the_server_and_no_command_beside_it() {
        let mut config = load(TLS).unwrap();
        let refused = config.check_credentials().unwrap_err().to_string();
        assert!(
            refused.contains("`credential:tread.tls-certificate`")
                && refused.contains("LoadCredential=tread.tls-certificate"),
            "{refused}"
        );
    }

    #[test]
    fn the_name_of_a_credential_is_no_path() {
        for name in ["", "../key", "folder/key"] {
            let text = format!("[tls]\ncertificate = \"c.pem\"\nkey = \"credential:{name}\"\n");
            let refused = load(&text).unwrap_err();
            assert!(
                matches!(refused, ConfigError::CredentialName(_)),
                "{refused}"
            );
        }
    }
}
