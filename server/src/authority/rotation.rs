//! Which authorities are trusted, and how another takes the place of one.
//!
//! ```text
//!  A signs, A is trusted ──start──► B signs, A and B are trusted ──finish──► B signs, B is trusted
//! ```
//!
//! While both are trusted the robots' port shows a certificate of A, which robots that know A alone
//! accept, and those that know both. Each renewal brings a robot both authorities and a certificate
//! of B. From the finish on the port shows one of B. A key that is new for the fleet is in use as soon
//! as it is there: B signs, and what is derived from the authority's key derives from B's.
//!
//! ```text
//!  A is trusted, or A and B are ──replace──► C signs, C alone is trusted
//! ```
//!
//! A replacement is for a key that was stolen: no certificate of before opens anything, and every robot
//! joins again.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use jiff::Timestamp;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject as _;
use tokio::sync::watch;
use tread_api::enrolment::TrustId;
use webpki::EndEntityCert;

use super::file::{Folder, Settled, Started};
use super::{
    Authority, AuthorityError, CertificateError, PresentCertificate, RENEWAL_GRACE, fingerprint,
    is_signed_by, later, named_in,
};

/// Why a rotation is neither started nor finished.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RotationRefused {
    /// One is under way.
    #[error("a rotation of the authority is under way; finish it first")]
    UnderWay,
    /// None is under way.
    #[error("no rotation of the authority is under way")]
    None,
    /// Another one is under way.
    #[error(
        "rotation `{named}` is not the one that is under way, which is `{under_way}`: look at that one \
         first"
    )]
    Other {
        /// The one that was named.
        named: TrustId,
        /// The one that is under way.
        under_way: TrustId,
    },
    /// Another authority signs.
    #[error(
        "authority `{named}` is not the one that signs, which is `{signing}`: somebody else has \
         rotated or replaced it"
    )]
    OtherAuthority {
        /// The one that was named.
        named: String,
        /// The one that signs.
        signing: String,
    },
}

/// Why a rotation was not started or finished.
#[derive(Debug, thiserror::Error)]
pub enum RotationError {
    /// It is not the time for it.
    #[error(transparent)]
    Refused(#[from] RotationRefused),
    /// The folder cannot be written.
    #[error(transparent)]
    Files(#[from] AuthorityError),
    /// There are no random numbers.
    #[error("no key could be made")]
    Key(#[from] rcgen::Error),
}

/// The authority that a rotation retires.
#[derive(Debug, Clone)]
pub struct Retiring {
    /// The authority.
    pub authority: Arc<Authority>,
    /// When the rotation was started.
    pub started_at: Timestamp,
    /// Who started it.
    pub started_by: String,
}

/// Who is trusted at a time.
#[derive(Debug, Clone)]
pub struct Trusted {
    signing: Arc<Authority>,
    retiring: Option<Retiring>,
    retired: Vec<CertificateDer<'static>>,
}

impl Trusted {
    /// One authority alone.
    pub fn one(authority: Arc<Authority>) -> Self {
        Self {
            signing: authority,
            retiring: None,
            retired: Vec::new(),
        }
    }

    /// The authority that signs robots' certificates.
    pub fn signing(&self) -> &Arc<Authority> {
        &self.signing
    }

    /// The authority that is to be retired, if a rotation is under way.
    pub fn retiring(&self) -> Option<&Retiring> {
        self.retiring.as_ref()
    }

    /// The authority that signs the certificate of the robots' port: one that every robot trusts.
    pub fn of_port(&self) -> &Arc<Authority> {
        let retiring = self.retiring.as_ref().map(|retiring| &retiring.authority);
        retiring.unwrap_or(&self.signing)
    }

    /// All that are trusted, the one that signs first.
    pub fn all(&self) -> impl Iterator<Item = &Arc<Authority>> {
        let retiring = self.retiring.iter().map(|retiring| &retiring.authority);
        std::iter::once(&self.signing).chain(retiring)
    }

    /// Whether the authority with a fingerprint is trusted.
    pub fn is_trusted(&self, fingerprint: &str) -> bool {
        self.all().any(|one| one.fingerprint() == fingerprint)
    }

    /// What robots are to trust, PEM.
    pub fn bundle_pem(&self) -> String {
        self.all().map(|one| one.certificate_pem()).collect()
    }

    /// Whether an authority was ever retired.
    pub fn has_retired(&self) -> bool {
        !self.retired.is_empty()
    }

    /// The name of what robots are to trust, and so of the rotation that is under way.
    pub fn id(&self) -> TrustId {
        TrustId::of(self.all().map(|one| one.certificate().as_ref()))
    }

    /// What a rotation to another authority makes of this.
    ///
    /// # Errors
    /// One is under way.
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

    /// Refuses unless this rotation is under way.
    ///
    /// # Errors
    /// None is, or another one.
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

    /// What the end of the rotation makes of this.
    ///
    /// # Errors
    /// None is under way, or another one.
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

    /// What a replacement by another authority makes of this.
    fn replaced(&self, next: Arc<Authority>) -> Self {
        let mut retired = self.retired.clone();
        retired.extend(self.all().map(|one| one.certificate().clone()));
        Self {
            signing: next,
            retiring: None,
            retired,
        }
    }

    /// The fingerprint of the authority that signed a robot's certificate; `None` unless it is trusted.
    pub fn issuer_of(&self, certificate: &CertificateDer<'_>, now: Timestamp) -> Option<&str> {
        let leaf = EndEntityCert::try_from(certificate).ok()?;
        let issuer = self
            .all()
            .find(|authority| is_signed_by(&leaf, authority.certificate(), now));
        issuer.map(|authority| authority.fingerprint())
    }

    /// Whom a robot's certificate names, and who signed it: an authority that is trusted or, and then
    /// it counts for nothing, one that was retired. One that is over counts for another
    /// [`RENEWAL_GRACE`].
    ///
    /// # Errors
    /// [`CertificateError`].
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

/// The fleet's authorities, and the folder that keeps them.
#[derive(Debug)]
pub struct Authorities {
    /// Where they are kept; `None` for those in memory only.
    folder: Option<Folder>,
    present: watch::Sender<Arc<Trusted>>,
    /// One change at a time.
    turn: Mutex<()>,
    /// Whether the disk has not confirmed yet that an authority is retired.
    is_unsettled: AtomicBool,
}

impl Authorities {
    /// An authority that is in memory only.
    pub fn in_memory(authority: Arc<Authority>) -> Self {
        Self::new(None, Trusted::one(authority))
    }

    fn new(folder: Option<Folder>, trusted: Trusted) -> Self {
        Self {
            folder,
            present: watch::Sender::new(Arc::new(trusted)),
            turn: Mutex::new(()),
            is_unsettled: AtomicBool::new(false),
        }
    }

    /// Reads the folder, and completes what an earlier run of the server had begun there.
    ///
    /// # Errors
    /// There is none, others can read a key, or it cannot be used.
    pub fn load(folder: &Path) -> Result<Self, AuthorityError> {
        Self::load_from(Folder::new(folder))
    }

    pub(super) fn load_from(folder: Folder) -> Result<Self, AuthorityError> {
        folder.recover()?;
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

    /// Who is trusted now.
    pub fn present(&self) -> Arc<Trusted> {
        Arc::clone(&self.present.borrow())
    }

    /// Changes with each start and each end of a rotation.
    pub fn changes(&self) -> watch::Receiver<Arc<Trusted>> {
        self.present.subscribe()
    }

    fn take_turn(&self) -> MutexGuard<'_, ()> {
        self.turn.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts a rotation: makes the next authority, which signs from now on. Blocks.
    ///
    /// # Errors
    /// One is under way, or the folder cannot be written; nothing has changed then.
    pub fn start(&self, by: &str, now: Timestamp) -> Result<Arc<Trusted>, RotationError> {
        let _turn = self.take_turn();
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
            self.note_settled(Settled::Yes);
        }
        Ok(self.show(trusted))
    }

    /// Finishes a rotation: the former authority is no longer trusted, and its key is removed. It is
    /// decided as soon as the folder shows it; [`Self::is_settled`] says whether the disk has it. Blocks.
    ///
    /// # Errors
    /// None is under way, another one than was named is, or the folder cannot be written; nothing has
    /// changed then.
    pub fn finish(&self, rotation: TrustId) -> Result<Arc<Trusted>, RotationError> {
        let _turn = self.take_turn();
        let present = self.present();
        let trusted = present.finished(rotation)?;
        if let (Some(folder), Some(retiring)) = (&self.folder, present.retiring()) {
            self.note_settled(folder.finish(&retiring.authority)?);
        }
        Ok(self.show(trusted))
    }

    /// Puts another authority in the place of all that are trusted, whether a rotation is under way or
    /// not: from now on no certificate of before opens anything. Blocks.
    ///
    /// # Errors
    /// Another authority than was named signs, or the folder cannot be written; nothing has changed then.
    pub fn replace(&self, signing: &str, now: Timestamp) -> Result<Arc<Trusted>, RotationError> {
        let _turn = self.take_turn();
        let present = self.present();
        present.check_signing(signing)?;
        let next = next_authority(now)?;
        let trusted = present.replaced(Arc::clone(&next));
        if let Some(folder) = &self.folder {
            folder.replace(&next, |fingerprint| present.is_trusted(fingerprint))?;
            self.note_settled(Settled::Yes);
        }
        Ok(self.show(trusted))
    }

    /// Whether the disk has all that was decided.
    pub fn is_settled(&self) -> bool {
        !self.is_unsettled.load(Ordering::Relaxed)
    }

    fn note_settled(&self, settled: Settled) {
        let is_unsettled = settled == Settled::NotYet;
        self.is_unsettled.store(is_unsettled, Ordering::Relaxed);
    }

    /// Asks the disk again for what it has not confirmed. Blocks.
    ///
    /// # Errors
    /// It still does not confirm it.
    pub fn settle(&self) -> Result<(), AuthorityError> {
        let _turn = self.take_turn();
        if let Some(folder) = self.folder.as_ref().filter(|_| !self.is_settled()) {
            folder.settle()?;
            self.note_settled(Settled::Yes);
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
