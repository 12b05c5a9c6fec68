//! Set of trusted certificate authorities, and the rotation to a new one.
//!
//! ```text
//!  A signs, A is trusted ──start──► B signs, A and B are trusted ──finish──► B signs, B is trusted
//! ```
//!
//! While both are trusted, the robots' port presents a certificate of A, which robots accept that
//! trust A alone or both. Each renewal gives a robot a certificate of B and both authorities to
//! trust. After the finish the port presents a certificate of B. From the start on, B signs the
//! certificates of robots, and secrets derived from the authority's key are derived from B's.
//!
//! ```text
//!  A is trusted, or A and B are ──replace──► C signs, C alone is trusted
//! ```
//!
//! A replacement is for a stolen key: it invalidates all earlier certificates at once, and every
//! robot has to join again.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use jiff::Timestamp;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject as _;
use tokio::sync::watch;
use tread_api::enrolment::TrustId;
use webpki::EndEntityCert;

use super::file::{Durability, Folder, Started};
use super::{
    Authority, AuthorityError, CertificateError, PresentCertificate, RENEWAL_GRACE, fingerprint,
    is_signed_by, later, named_in,
};

/// Reason for refusing to start or finish a rotation, or to replace the authority.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RotationRefused {
    /// A rotation is in progress.
    #[error("a rotation of the authority is under way; finish it first")]
    UnderWay,
    /// No rotation is in progress.
    #[error("no rotation of the authority is under way")]
    None,
    /// Another rotation than the requested one is in progress.
    #[error(
        "rotation `{named}` is not the one that is under way, which is `{under_way}`: look at that one \
         first"
    )]
    Other {
        /// Rotation in the request.
        named: TrustId,
        /// Rotation in progress.
        under_way: TrustId,
    },
    /// Another authority than the requested one signs certificates.
    #[error(
        "authority `{named}` is not the one that signs, which is `{signing}`: somebody else has \
         rotated or replaced it"
    )]
    OtherAuthority {
        /// Fingerprint in the request.
        named: String,
        /// Fingerprint of the signing authority.
        signing: String,
    },
}

/// Error of starting or finishing a rotation, or of replacing the authority.
#[derive(Debug, thiserror::Error)]
pub enum RotationError {
    /// The present state does not allow the change.
    #[error(transparent)]
    Refused(#[from] RotationRefused),
    /// The authority's folder cannot be written.
    #[error(transparent)]
    Files(#[from] AuthorityError),
    /// The operating system provides no random numbers.
    #[error("no key could be made")]
    Key(#[from] rcgen::Error),
}

/// The authority that a rotation in progress is going to retire.
#[derive(Debug, Clone)]
pub struct Retiring {
    /// The authority itself.
    pub authority: Arc<Authority>,
    /// Start of the rotation.
    pub started_at: Timestamp,
    /// Name of the caller who started it.
    pub started_by: String,
}

/// Authorities trusted at one moment, and the retired ones.
#[derive(Debug, Clone)]
pub struct Trusted {
    signing: Arc<Authority>,
    retiring: Option<Retiring>,
    retired: Vec<CertificateDer<'static>>,
}

impl Trusted {
    /// Returns a set with one trusted authority.
    pub fn one(authority: Arc<Authority>) -> Self {
        Self {
            signing: authority,
            retiring: None,
            retired: Vec::new(),
        }
    }

    /// Returns the authority that signs robots' certificates.
    pub fn signing(&self) -> &Arc<Authority> {
        &self.signing
    }

    /// Returns the authority that the rotation in progress retires; `None` without a rotation.
    pub fn retiring(&self) -> Option<&Retiring> {
        self.retiring.as_ref()
    }

    /// Returns the authority that signs the certificate of the robots' port; every robot trusts it.
    pub fn of_port(&self) -> &Arc<Authority> {
        let retiring = self.retiring.as_ref().map(|retiring| &retiring.authority);
        retiring.unwrap_or(&self.signing)
    }

    /// Returns all trusted authorities, the signing one first.
    pub fn all(&self) -> impl Iterator<Item = &Arc<Authority>> {
        let retiring = self.retiring.iter().map(|retiring| &retiring.authority);
        std::iter::once(&self.signing).chain(retiring)
    }

    /// Returns whether the authority with this fingerprint is trusted.
    pub fn is_trusted(&self, fingerprint: &str) -> bool {
        self.all().any(|one| one.fingerprint() == fingerprint)
    }

    /// Returns the certificates that robots have to trust, PEM.
    pub fn bundle_pem(&self) -> String {
        self.all().map(|one| one.certificate_pem()).collect()
    }

    /// Returns whether any authority is retired.
    pub fn has_retired(&self) -> bool {
        !self.retired.is_empty()
    }

    /// Returns the identifier of the set of trusted authorities, which also identifies the rotation
    /// in progress.
    pub fn id(&self) -> TrustId {
        TrustId::of(self.all().map(|one| one.certificate().as_ref()))
    }

    /// Returns the set after the start of a rotation to `next`.
    ///
    /// # Errors
    /// [`RotationRefused::UnderWay`] if a rotation is in progress.
    fn started(&self, next: Arc<Authority>, started: Started) -> Result<Self, RotationRefused> {
        if self.retiring.is_some() {
            return Err(RotationRefused::UnderWay);
        }
        Ok(Self {
            signing: next,
            retiring: Some(Retiring {
                authority: Arc::clone(&self.signing),
                started_at: started.at,
                started_by: started.by,
            }),
            retired: self.retired.clone(),
        })
    }

    /// Checks that the rotation `named` is in progress.
    ///
    /// # Errors
    /// [`RotationRefused::None`] if no rotation is, [`RotationRefused::Other`] if another one is.
    pub fn check_rotation(&self, named: TrustId) -> Result<(), RotationRefused> {
        let under_way = self.id();
        if self.retiring.is_none() {
            Err(RotationRefused::None)
        } else if named == under_way {
            Ok(())
        } else {
            Err(RotationRefused::Other { named, under_way })
        }
    }

    fn check_signing(&self, named: &str) -> Result<(), RotationRefused> {
        let signing = self.signing.fingerprint();
        if named.eq_ignore_ascii_case(signing) {
            return Ok(());
        }
        Err(RotationRefused::OtherAuthority {
            named: named.to_owned(),
            signing: signing.to_owned(),
        })
    }

    /// Returns the set after the finish of `rotation`.
    ///
    /// # Errors
    /// As [`Self::check_rotation`].
    fn finished(&self, rotation: TrustId) -> Result<Self, RotationRefused> {
        self.check_rotation(rotation)?;
        let retiring = self.retiring.as_ref().ok_or(RotationRefused::None)?;
        let mut retired = self.retired.clone();
        retired.push(retiring.authority.certificate().clone());
        Ok(Self {
            signing: Arc::clone(&self.signing),
            retiring: None,
            retired,
        })
    }

    /// Returns the set after `next` has replaced all trusted authorities.
    fn replaced(&self, next: Arc<Authority>) -> Self {
        let mut retired = self.retired.clone();
        retired.extend(self.all().map(|one| one.certificate().clone()));
        Self {
            signing: next,
            retiring: None,
            retired,
        }
    }

    /// Returns the fingerprint of the trusted authority that signed a robot's certificate; `None`
    /// if none did or if the certificate is not valid at `now`.
    pub fn issuer_of(&self, certificate: &CertificateDer<'_>, now: Timestamp) -> Option<&str> {
        let leaf = EndEntityCert::try_from(certificate).ok()?;
        let issuer = self
            .all()
            .find(|authority| is_signed_by(&leaf, authority.certificate(), now));
        issuer.map(|authority| authority.fingerprint())
    }

    /// Reads a robot's certificate and verifies that a trusted or a retired authority signed it;
    /// see [`PresentCertificate::is_retired`]. An expired one is accepted for another
    /// [`RENEWAL_GRACE`].
    ///
    /// # Errors
    /// [`CertificateError::Unreadable`] if it cannot be parsed, [`CertificateError::Over`] if it
    /// expired too long ago, [`CertificateError::Foreign`] if no known authority signed it for a
    /// robot.
    pub fn read_robot(
        &self,
        certificate_pem: &str,
        now: Timestamp,
    ) -> Result<PresentCertificate, CertificateError> {
        let certificate = CertificateDer::from_pem_slice(certificate_pem.as_bytes())
            .map_err(|_| CertificateError::Unreadable)?;
        let (name, expires_at) = named_in(&certificate)?;
        if now > later(expires_at, RENEWAL_GRACE) {
            return Err(CertificateError::Over);
        }
        let leaf =
            EndEntityCert::try_from(&certificate).map_err(|_| CertificateError::Unreadable)?;
        let looked_at = now.min(expires_at);
        let trusted = self.all().map(|one| (one.certificate(), false));
        let retired = self.retired.iter().map(|certificate| (certificate, true));
        let issuer = trusted
            .chain(retired)
            .find(|(authority, _)| is_signed_by(&leaf, authority, looked_at));
        let (issuer, is_retired) = issuer.ok_or(CertificateError::Foreign)?;
        let issuer = fingerprint(issuer);
        Ok(PresentCertificate {
            certificate,
            name,
            issuer,
            is_retired,
        })
    }
}

/// The fleet's authorities, with the folder that stores them.
#[derive(Debug)]
pub struct Authorities {
    /// Folder of the files; `None` for authorities in memory only.
    folder: Option<Folder>,
    present: watch::Sender<Arc<Trusted>>,
    /// Held during a change, so that changes do not overlap.
    turn: Mutex<()>,
    /// Whether the retirement of an authority is not yet confirmed to be on the disk.
    is_sync_pending: AtomicBool,
}

impl Authorities {
    /// Returns authorities in memory only, of which `authority` is trusted.
    pub fn in_memory(authority: Arc<Authority>) -> Self {
        Self::new(None, Trusted::one(authority))
    }

    fn new(folder: Option<Folder>, trusted: Trusted) -> Self {
        Self {
            folder,
            present: watch::Sender::new(Arc::new(trusted)),
            turn: Mutex::new(()),
            is_sync_pending: AtomicBool::new(false),
        }
    }

    /// Reads the authorities from a folder, after completing or undoing an interrupted change.
    ///
    /// # Errors
    /// [`AuthorityError::Unreadable`] if there is no authority, [`AuthorityError::Open`] if other
    /// users can read a key, [`AuthorityError::Unusable`] if certificate and key do not fit.
    pub fn load(folder: &Path) -> Result<Self, AuthorityError> {
        Self::load_from(Folder::new(folder))
    }

    /// Reads the authorities from a folder that another program may change.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(folder: &Path) -> Result<Self, AuthorityError> {
        Self::read_from(Folder::new(folder))
    }

    pub(super) fn load_from(folder: Folder) -> Result<Self, AuthorityError> {
        folder.recover()?;
        Self::read_from(folder)
    }

    fn read_from(folder: Folder) -> Result<Self, AuthorityError> {
        let kept = folder.read()?;
        let mut trusted = Trusted::one(Arc::new(kept.present));
        trusted.retired = kept.retired;
        let trusted = match kept.next {
            None => trusted,
            Some((next, started)) => Trusted {
                signing: Arc::new(next),
                retiring: Some(Retiring {
                    authority: trusted.signing,
                    started_at: started.at,
                    started_by: started.by,
                }),
                retired: trusted.retired,
            },
        };
        Ok(Self::new(Some(folder), trusted))
    }

    /// Returns the present set of trusted authorities.
    pub fn present(&self) -> Arc<Trusted> {
        Arc::clone(&self.present.borrow())
    }

    /// Returns a receiver that is notified of each start and finish of a rotation and of each
    /// replacement.
    pub fn changes(&self) -> watch::Receiver<Arc<Trusted>> {
        self.present.subscribe()
    }

    fn wait_for_turn(&self) -> MutexGuard<'_, ()> {
        self.turn.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts a rotation on behalf of `by`: generates the next authority, which signs from now on.
    /// Blocks on the disk.
    ///
    /// # Errors
    /// A rotation is in progress, or the folder cannot be written; the set is unchanged then.
    pub fn start(&self, by: &str, now: Timestamp) -> Result<Arc<Trusted>, RotationError> {
        let _turn = self.wait_for_turn();
        let next = next_authority(now)?;
        let started = Started {
            at: now,
            by: by.to_owned(),
        };
        let present = self.present();
        let trusted = present.started(Arc::clone(&next), started.clone())?;
        if let Some(folder) = &self.folder {
            let is_trusted = |fingerprint: &str| present.is_trusted(fingerprint);
            folder.start(&next, &started, is_trusted)?;
            self.record_durability(Durability::Durable);
        }
        Ok(self.show(trusted))
    }

    /// Finishes a rotation: the former authority is no longer trusted, and its key is deleted. This
    /// takes effect even if the disk has not confirmed it yet ([`Self::is_durable`]). Blocks on the
    /// disk.
    ///
    /// # Errors
    /// `rotation` is not in progress, or the folder cannot be written; the set is unchanged then.
    pub fn finish(&self, rotation: TrustId) -> Result<Arc<Trusted>, RotationError> {
        let _turn = self.wait_for_turn();
        let present = self.present();
        let trusted = present.finished(rotation)?;
        if let (Some(folder), Some(retiring)) = (&self.folder, present.retiring()) {
            self.record_durability(folder.finish(&retiring.authority)?);
        }
        Ok(self.show(trusted))
    }

    /// Replaces all trusted authorities by a new one, also during a rotation. All earlier
    /// certificates are refused from now on. `signing` is the fingerprint of the authority that
    /// signs at present. Blocks on the disk.
    ///
    /// # Errors
    /// Another authority signs, or the folder cannot be written; the set is unchanged then.
    pub fn replace(&self, signing: &str, now: Timestamp) -> Result<Arc<Trusted>, RotationError> {
        let _turn = self.wait_for_turn();
        let present = self.present();
        present.check_signing(signing)?;
        let next = next_authority(now)?;
        let trusted = present.replaced(Arc::clone(&next));
        if let Some(folder) = &self.folder {
            folder.replace(&next, |fingerprint| present.is_trusted(fingerprint))?;
            self.record_durability(Durability::Durable);
        }
        Ok(self.show(trusted))
    }

    /// Returns whether the disk has confirmed all changes.
    pub fn is_durable(&self) -> bool {
        !self.is_sync_pending.load(Ordering::Relaxed)
    }

    fn record_durability(&self, settled: Durability) {
        let is_sync_pending = settled == Durability::Pending;
        self.is_sync_pending
            .store(is_sync_pending, Ordering::Relaxed);
    }

    /// Retries to write unconfirmed changes to the disk. Blocks on the disk.
    ///
    /// # Errors
    /// The disk still does not confirm them.
    pub fn retry_sync(&self) -> Result<(), AuthorityError> {
        let _turn = self.wait_for_turn();
        if let Some(folder) = self.folder.as_ref().filter(|_| !self.is_durable()) {
            folder.retry_sync()?;
            self.record_durability(Durability::Durable);
        }
        Ok(())
    }

    fn show(&self, trusted: Trusted) -> Arc<Trusted> {
        let trusted = Arc::new(trusted);
        self.present.send_replace(Arc::clone(&trusted));
        trusted
    }
}

fn next_authority(now: Timestamp) -> Result<Arc<Authority>, rcgen::Error> {
    let name = format!("Tread fleet since {now:.0}");
    Ok(Arc::new(Authority::generate(&name, now)?))
}
