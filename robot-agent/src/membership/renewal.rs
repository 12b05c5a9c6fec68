//! Renews the certificate when two thirds of its time are over, and again until it is renewed.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use super::{Membership, MembershipError};
use crate::clock::SharedClock;

/// First pause after a renewal that failed.
const RETRY_FIRST: Duration = Duration::from_secs(1);
/// Longest pause between two tries. A robot that was put out asks no more often either.
const RETRY_MAX: Duration = Duration::from_mins(5);
/// Longest sleep at once: the wall clock may be set meanwhile.
const LOOK_EVERY: Duration = Duration::from_mins(10);

/// What renewing works on.
pub(crate) struct Renewal {
    pub(crate) folder: PathBuf,
    pub(crate) clock: SharedClock,
    pub(crate) present: watch::Sender<Arc<Membership>>,
}

impl Renewal {
    /// Renews until the stop.
    pub(crate) async fn run(self, stop: CancellationToken) {
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.renew_for_ever() => {}
        }
    }

    async fn renew_for_ever(&self) {
        let mut pause = RETRY_FIRST;
        loop {
            let present = Arc::clone(&self.present.borrow());
            let left = present.renewal_due_in(self.clock.wall());
            if left > Duration::ZERO {
                tokio::time::sleep(left.min(LOOK_EVERY)).await;
                continue;
            }
            match self.renew(&present).await {
                Ok(()) => pause = RETRY_FIRST,
                Err(cause) => {
                    warn!(
                        error = &*cause as &dyn std::error::Error,
                        "the certificate was not renewed; another try in {} s",
                        pause.as_secs()
                    );
                    tokio::time::sleep(pause).await;
                    pause = (2 * pause).min(RETRY_MAX);
                }
            }
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
        // On the disk first: a restart in between must find what the link uses.
        tokio::task::spawn_blocking(move || saved.save(&folder)).await??;
        info!("the certificate was renewed, for {} s", next.lifetime_s);
        self.present.send_replace(next);
        Ok(())
    }
}
