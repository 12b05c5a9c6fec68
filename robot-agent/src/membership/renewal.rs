//! Renews the certificate after two thirds of its lifetime, or at once when the server states that
//! robots shall trust other authorities than this one does; retries until it succeeds.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::enrolment::TrustId;

use super::{Membership, MembershipError};
use crate::clock::SharedClock;

/// First pause after a renewal that failed.
const RETRY_FIRST: Duration = Duration::from_secs(1);
/// Longest pause between two attempts, also for a robot that was removed from the fleet.
const RETRY_MAX: Duration = Duration::from_mins(5);
/// Longest uninterrupted wait, since the wall clock may be set meanwhile.
const CHECK_EVERY: Duration = Duration::from_mins(10);
/// Time over which the renewals of a fleet are spread when all robots must renew at once.
const JITTER_MAX: Duration = Duration::from_secs(5);

/// The server's statement on the authorities that robots shall trust.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) enum ServerTrust {
    /// None so far.
    #[default]
    Unknown,
    /// Identifier stated by the server, over a mutually authenticated link.
    Is(TrustId),
    /// The robots' port shows a certificate of an authority that this robot does not trust.
    Distrusted,
}

/// Next action of the renewal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Due {
    /// None for this time.
    In(Duration),
    /// Renew, because the certificate's time is over.
    Now,
    /// Renew, because the server states other authorities.
    OtherTrust,
}

/// Decides the next action.
fn due(present: &Membership, server_trust: ServerTrust, now: Timestamp) -> Due {
    let left = present.renewal_due_in(now);
    if left == Duration::ZERO {
        return Due::Now;
    }
    match server_trust {
        ServerTrust::Unknown => Due::In(left),
        ServerTrust::Is(trust) if present.trust_id() == Some(trust) => Due::In(left),
        ServerTrust::Is(_) | ServerTrust::Distrusted => Due::OtherTrust,
    }
}

/// Returns the pause of a robot before a renewal of the whole fleet, the same each time.
fn spread(present: &Membership) -> Duration {
    let names = [present.site.as_str(), present.robot.as_str()];
    let bits = TrustId::of(names.map(str::as_bytes)).bits();
    let share = f64::from(u32::try_from(bits >> 32).unwrap_or_default()) / f64::from(u32::MAX);
    JITTER_MAX.mul_f64(share)
}

/// State of the renewal task.
pub(crate) struct Renewal {
    pub(crate) folder: PathBuf,
    pub(crate) clock: SharedClock,
    pub(crate) present: watch::Sender<Arc<Membership>>,
    pub(crate) server_trust: watch::Sender<ServerTrust>,
}

impl Renewal {
    /// Renews until requested to stop.
    pub(crate) async fn run(self, stop: CancellationToken) {
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.renew_for_ever() => {}
        }
    }

    async fn renew_for_ever(&self) {
        let mut pause = RETRY_FIRST;
        let mut is_first = true;
        // An impostor at the port may show another certificate indefinitely.
        let mut distrust_backoff = Duration::ZERO;
        let mut trust_changes = self.server_trust.subscribe();
        loop {
            let present = Arc::clone(&self.present.borrow());
            let server_trust = *trust_changes.borrow_and_update();
            match due(&present, server_trust, self.clock.wall()) {
                Due::In(left) => {
                    (pause, is_first) = (RETRY_FIRST, true);
                    tokio::select! {
                        () = tokio::time::sleep(left.min(CHECK_EVERY)) => {}
                        _ = trust_changes.changed() => {}
                    }
                    continue;
                }
                Due::OtherTrust if is_first => {
                    info!("the server trusts other authorities than this robot: it renews");
                    tokio::time::sleep(spread(&present)).await;
                    is_first = false;
                    continue;
                }
                Due::OtherTrust if server_trust == ServerTrust::Distrusted => {
                    tokio::time::sleep(distrust_backoff).await;
                }
                Due::Now | Due::OtherTrust => {}
            }
            match self.renew(&present).await {
                Ok(()) => {
                    // The port's certificate was checked against the former membership.
                    self.server_trust.send_if_modified(|server_trust| {
                        let was_distrusted = *server_trust == ServerTrust::Distrusted;
                        if was_distrusted {
                            *server_trust = ServerTrust::Unknown;
                        }
                        was_distrusted
                    });
                    // The answer may be older than the statement, so the renewal may be due again.
                    let trust_before = present.trust_id();
                    let present = Arc::clone(&self.present.borrow());
                    distrust_backoff = if present.trust_id() == trust_before {
                        (2 * distrust_backoff).max(RETRY_FIRST).min(RETRY_MAX)
                    } else {
                        Duration::ZERO
                    };
                    let server_trust = *self.server_trust.borrow();
                    if matches!(due(&present, server_trust, self.clock.wall()), Due::In(_)) {
                        continue;
                    }
                }
                Err(cause) => {
                    warn!(
                        error = &*cause as &dyn std::error::Error,
                        "the certificate was not renewed; another try in {} s",
                        pause.as_secs()
                    );
                    if server_trust == ServerTrust::Distrusted && is_refusal(&*cause) {
                        error!(
                            "the fleet's authority is another one than this robot trusts, and the \
                             server gives no certificate for the present one: it was changed while \
                             this robot was away. Join again, by `tread-agent enroll` with a join \
                             token that names `{}`",
                            present.robot
                        );
                    }
                }
            }
            tokio::time::sleep(pause).await;
            pause = (2 * pause).min(RETRY_MAX);
        }
    }

    async fn renew(
        &self,
        present: &Membership,
    ) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        let now = self.clock.wall();
        let next: Result<Membership, MembershipError> = present.renewed(now).await;
        let (next, folder) = (Arc::new(next?), self.folder.clone());
        let saved = Arc::clone(&next);
        // On disk first, so that a restart finds the certificate that the link uses.
        tokio::task::spawn_blocking(move || saved.save(&folder)).await??;
        info!("the certificate was renewed, for {} s", next.lifetime_s);
        self.present.send_replace(next);
        Ok(())
    }
}

/// Whether the server itself refused.
fn is_refusal(cause: &(dyn std::error::Error + Send + Sync + 'static)) -> bool {
    let cause = cause.downcast_ref::<MembershipError>();
    matches!(cause, Some(MembershipError::Refused { .. }))
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair};

    use super::super::Trust;
    use super::*;

    fn authority() -> String {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::default();
        params.self_signed(&key).unwrap().pem()
    }

    fn trusting(authority: String) -> Membership {
        Membership {
            site: "yard".parse().unwrap(),
            robot: "rover-1".parse().unwrap(),
            enrolment: 1,
            certificate: String::new(),
            key: String::new(),
            authority,
            server: "https://tread.example".to_owned(),
            trust: Trust::Machine,
            endpoint: "tls/tread.example:7447".to_owned(),
            issued_at: "2026-11-02T10:00:00Z".parse().unwrap(),
            lifetime_s: 90,
        }
    }

    #[test]
    fn a_certificate_is_renewed_in_time_and_at_once_when_the_server_trusts_others() {
        let (former, next) = (authority(), authority());
        let old = trusting(former.clone());
        let both = trusting(format!("{next}{former}"));
        let turned = trusting(format!("{former}{next}"));
        let id = |membership: &Membership| ServerTrust::Is(membership.trust_id().unwrap());
        let now = old.issued_at;
        let in_time = Due::In(Duration::from_mins(1));
        for (present, server_trust, expected) in [
            (&old, ServerTrust::Unknown, in_time),
            (&old, id(&old), in_time),
            (&both, id(&turned), in_time),
            (&old, id(&both), Due::OtherTrust),
            (&both, id(&trusting(next)), Due::OtherTrust),
            (&old, ServerTrust::Distrusted, Due::OtherTrust),
        ] {
            assert_eq!(
                due(present, server_trust, now),
                expected,
                "{server_trust:?}"
            );
        }
        let late = now + Duration::from_mins(1);
        assert_eq!(due(&old, ServerTrust::Unknown, late), Due::Now);
    }

    #[test]
    fn robots_that_are_all_to_renew_spread() {
        let robot = |number: u32| Membership {
            robot: format!("rover-{number}").parse().unwrap(),
            ..trusting(String::new())
        };
        let pauses: Vec<Duration> = (0..1_000).map(|number| spread(&robot(number))).collect();
        for tenth in 0..10 {
            let within = JITTER_MAX / 10 * tenth..JITTER_MAX / 10 * (tenth + 1);
            let count = pauses
                .iter()
                .filter(|pause| within.contains(*pause))
                .count();
            assert!((40..200).contains(&count), "{count} within {within:?}");
        }
    }
}
