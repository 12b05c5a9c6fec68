//! TLS of the REST API: rustls with ring, from PEM files that are read again when they change.

use std::path::Path;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::config::TlsFiles;

/// Interval of checks whether the files have changed.
pub const LOOK_EVERY: Duration = Duration::from_mins(1);

/// Reason why certificate and key cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or does not contain what it should.
    #[error("cannot read the {what} in `{file}`")]
    Unreadable {
        /// What it should hold.
        what: &'static str,
        /// The file.
        file: String,
        /// The cause.
        #[source]
        cause: rustls::pki_types::pem::Error,
    },
    /// They do not match, or are of an unsupported kind.
    #[error("certificate and key cannot be used")]
    Unusable(#[source] rustls::Error),
}

/// Certificate and key in use.
#[derive(Debug)]
pub struct Tls {
    files: TlsFiles,
    config: RwLock<Arc<ServerConfig>>,
}

impl Tls {
    /// Reads certificate and key.
    ///
    /// # Errors
    /// [`TlsError`] names the file.
    pub fn load(files: TlsFiles) -> Result<Self, TlsError> {
        let config = RwLock::new(Arc::new(read(&files)?));
        Ok(Self { files, config })
    }

    /// Returns the TLS acceptor with the present certificate.
    pub fn acceptor(&self) -> TlsAcceptor {
        let config = self.config.read().unwrap_or_else(PoisonError::into_inner);
        TlsAcceptor::from(Arc::clone(&config))
    }

    /// Reads the files again; with an error the present certificate stays.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn reload(&self) -> Result<(), TlsError> {
        let config = Arc::new(read(&self.files)?);
        *self.config.write().unwrap_or_else(PoisonError::into_inner) = config;
        Ok(())
    }

    fn changed_at(&self) -> [Option<SystemTime>; 2] {
        let time = |file: &Path| {
            std::fs::metadata(file)
                .and_then(|file| file.modified())
                .ok()
        };
        [time(&self.files.certificate), time(&self.files.key)]
    }
}

/// Reads the files again whenever they change, until the stop.
pub async fn watch(tls: Arc<Tls>, stop: CancellationToken) {
    let mut seen = tls.changed_at();
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
        let now = tls.changed_at();
        if now == seen {
            continue;
        }
        match tls.reload() {
            Ok(()) => {
                info!("the REST API has a new certificate");
                seen = now;
            }
            // The other file may not be written yet; the next check tries again.
            Err(error) => warn!("{error}; the REST API keeps the certificate that it has"),
        }
    }
}

fn read(files: &TlsFiles) -> Result<ServerConfig, TlsError> {
    let unreadable = |what, file: &Path| {
        let file = file.display().to_string();
        move |cause| TlsError::Unreadable { what, file, cause }
    };
    let chain: Vec<CertificateDer<'static>> = CertificateDer::pem_file_iter(&files.certificate)
        .and_then(Iterator::collect)
        .map_err(unreadable("certificate", &files.certificate))?;
    let key = PrivateKeyDer::from_pem_file(&files.key).map_err(unreadable("key", &files.key))?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ServerConfig::builder_with_provider(provider);
    let versions = builder.with_safe_default_protocol_versions();
    let mut config = versions
        .map_err(TlsError::Unusable)?
        .with_no_client_auth()
        .with_single_cert(chain, key)
        .map_err(TlsError::Unusable)?;
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(config)
}
