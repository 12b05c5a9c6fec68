//! TLS of the REST API: rustls with ring. The certificate comes from PEM files, which are read again
//! when they change, or from the fleet's own authority, which issues another one in time.

use std::path::Path;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

use jiff::SignedDuration;
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::app::App;
use crate::authority::{Authorities, PORT_CERTIFICATE_VALIDITY, Trusted};
use crate::certificate::Certificate;
use crate::clock::Clock;
use crate::config::TlsFiles;

/// Interval of checks whether the files have changed, or another certificate is due.
pub const POLL_INTERVAL: Duration = Duration::from_mins(1);

/// Reason why certificate and key cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or does not contain what it should.
    #[error(
        "cannot read the {what} in `{file}`: it must be PEM, and the user that the server runs as \
         must be able to read it"
    )]
    Unreadable {
        /// Expected content.
        what: &'static str,
        /// The file.
        file: String,
        /// The cause.
        #[source]
        cause: rustls::pki_types::pem::Error,
    },
    /// The file has no certificate.
    #[error("`{0}` holds no certificate: it must be PEM, with `BEGIN CERTIFICATE`")]
    Empty(String),
    /// They do not match, or are of an unsupported kind.
    #[error("certificate and key cannot be used: `{certificate}` and `{key}` must belong together")]
    Unusable {
        /// File of the certificate.
        certificate: String,
        /// File of the key.
        key: String,
        /// The cause.
        #[source]
        cause: rustls::Error,
    },
    /// The authority could not issue a certificate.
    #[error("the fleet's authority cannot issue the certificate of the REST API")]
    NotIssued(#[source] rcgen::Error),
    /// The certificate that the authority issued cannot be used.
    #[error("the certificate that the fleet's authority issued cannot be used")]
    IssuedUnusable(#[source] rustls::Error),
}

/// Origin of certificates that the fleet's authority issues.
#[derive(Debug, Clone)]
pub struct Issuer {
    /// The authorities.
    pub authorities: Arc<Authorities>,
    /// Names of the server in addition to `localhost`.
    pub names: Vec<String>,
    /// The clock.
    pub clock: Clock,
}

#[derive(Debug)]
enum Source {
    Files(TlsFiles),
    Issuer(Issuer),
}

#[derive(Debug, Clone)]
struct Present {
    config: Arc<ServerConfig>,
    /// The leaf, as it is read.
    certificate: Option<Certificate>,
    /// The authorities by which it was issued.
    trusted: Option<Arc<Trusted>>,
}

/// Certificate and key in use.
#[derive(Debug)]
pub struct Tls {
    source: Source,
    present: RwLock<Present>,
}

impl Tls {
    /// Reads certificate and key.
    ///
    /// # Errors
    /// [`TlsError`] names the file.
    pub fn load(files: TlsFiles) -> Result<Self, TlsError> {
        Self::of(Source::Files(files))
    }

    /// Has a certificate issued by the fleet's authority.
    ///
    /// # Errors
    /// A name is invalid, or the operating system provides no random numbers.
    pub fn issued(issuer: Issuer) -> Result<Self, TlsError> {
        Self::of(Source::Issuer(issuer))
    }

    fn of(source: Source) -> Result<Self, TlsError> {
        let present = RwLock::new(source.read()?);
        Ok(Self { source, present })
    }

    fn present(&self) -> Present {
        let present = self.present.read();
        present.unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns the TLS acceptor with the present certificate.
    pub fn acceptor(&self) -> TlsAcceptor {
        let present = self.present.read().unwrap_or_else(PoisonError::into_inner);
        TlsAcceptor::from(Arc::clone(&present.config))
    }

    /// Returns names and validity of the present certificate; `None` if it cannot be parsed.
    pub fn certificate(&self) -> Option<Certificate> {
        self.present().certificate
    }

    /// Returns where the certificate comes from, for messages.
    pub fn origin(&self) -> String {
        match &self.source {
            Source::Files(files) => format!("`{}`", files.certificate.display()),
            Source::Issuer(_) => "the fleet's authority".to_owned(),
        }
    }

    /// Reads the files again, or has another certificate issued; with an error the present
    /// certificate stays.
    ///
    /// # Errors
    /// As [`Self::load`] and [`Self::issued`].
    pub fn reload(&self) -> Result<(), TlsError> {
        let read = self.source.read()?;
        *self.present.write().unwrap_or_else(PoisonError::into_inner) = read;
        Ok(())
    }

    /// Returns whether the authority has to issue another certificate: a third of the validity of
    /// the present one is over, the clock was set back, or the authorities have changed.
    fn is_due(&self) -> bool {
        let Source::Issuer(issuer) = &self.source else {
            return false;
        };
        let present = self.present();
        let trusted = issuer.authorities.present();
        let is_same = |of: &Arc<Trusted>| Arc::ptr_eq(of, &trusted);
        let left = present.certificate.map(|certificate| {
            let now = issuer.clock.machine_time();
            certificate.not_after.duration_since(now)
        });
        let is_fresh = |left: SignedDuration| {
            left > PORT_CERTIFICATE_VALIDITY * 2 / 3 && left <= PORT_CERTIFICATE_VALIDITY
        };
        !(present.trusted.as_ref().is_some_and(is_same) && left.is_some_and(is_fresh))
    }

    fn changed_at(&self) -> [Option<SystemTime>; 2] {
        let time = |file: &Path| {
            std::fs::metadata(file)
                .and_then(|file| file.modified())
                .ok()
        };
        match &self.source {
            Source::Files(files) => [time(&files.certificate), time(&files.key)],
            Source::Issuer(_) => [None, None],
        }
    }
}

/// Keeps the certificate up to date until the stop, and raises an alert before it expires.
pub async fn watch(tls: Arc<Tls>, app: App, stop: CancellationToken) {
    reload_periodically(&tls, stop, |tls| {
        app.update_certificate_alert(tls.certificate().as_ref(), &tls.origin());
    })
    .await;
}

/// Keeps the certificate up to date until the stop, and calls `looked` after each look at it.
pub async fn reload_periodically(tls: &Tls, stop: CancellationToken, looked: impl Fn(&Tls)) {
    let mut seen = tls.changed_at();
    loop {
        looked(tls);
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(POLL_INTERVAL) => {}
        }
        let now = tls.changed_at();
        if now == seen && !tls.is_due() {
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

impl Source {
    fn read(&self) -> Result<Present, TlsError> {
        match self {
            Self::Files(files) => read(files),
            Self::Issuer(issuer) => issue(issuer),
        }
    }
}

fn issue(issuer: &Issuer) -> Result<Present, TlsError> {
    let trusted = issuer.authorities.present();
    let now = issuer.clock.machine_time();
    let identity = trusted.of_port().port_identity(&issuer.names, now);
    let identity = identity.map_err(TlsError::NotIssued)?;
    let certificate = identity.chain.first().and_then(Certificate::read);
    let config = server_config(identity.chain, identity.key).map_err(TlsError::IssuedUnusable)?;
    Ok(Present {
        config: Arc::new(config),
        certificate,
        trusted: Some(trusted),
    })
}

fn read(files: &TlsFiles) -> Result<Present, TlsError> {
    let (chain, key) = read_files(files)?;
    let certificate = chain.first().and_then(Certificate::read);
    let config = server_config(chain, key).map_err(|cause| TlsError::Unusable {
        certificate: files.certificate.display().to_string(),
        key: files.key.display().to_string(),
        cause,
    })?;
    Ok(Present {
        config: Arc::new(config),
        certificate,
        trusted: None,
    })
}

/// Reads certificate chain and private key.
///
/// # Errors
/// [`TlsError`] names the file.
pub fn read_files(
    files: &TlsFiles,
) -> Result<(Vec<CertificateDer<'static>>, PrivateKeyDer<'static>), TlsError> {
    let unreadable = |what, file: &Path| {
        let file = file.display().to_string();
        move |cause| TlsError::Unreadable { what, file, cause }
    };
    let chain: Vec<CertificateDer<'static>> = CertificateDer::pem_file_iter(&files.certificate)
        .and_then(Iterator::collect)
        .map_err(unreadable("certificate", &files.certificate))?;
    if chain.is_empty() {
        return Err(TlsError::Empty(files.certificate.display().to_string()));
    }
    let key = PrivateKeyDer::from_pem_file(&files.key).map_err(unreadable("key", &files.key))?;
    Ok((chain, key))
}

fn server_config(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
) -> Result<ServerConfig, rustls::Error> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ServerConfig::builder_with_provider(provider);
    let mut config = builder
        .with_safe_default_protocol_versions()?
        .with_no_client_auth()
        .with_single_cert(chain, key)?;
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(config)
}
