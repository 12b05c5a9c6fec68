//! Looks after the router: a client of its own asks it something, as a robot would, and when it
//! does not answer for long the router is closed and opened again.
//!
//! A router may cease to accept connections without any error. Only a client can see that.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tracing::{error, warn};
use zenoh::{Config, Session, Wait as _};

use super::inbox::Channels;
use crate::app::App;
use crate::supervisor::Supervisor;

/// The key that the router answers itself on.
const PROBE_KEY: &str = "tread/self/probe";
/// Time between two looks.
pub(super) const PROBE_PERIOD: Duration = Duration::from_secs(10);
/// How long one look may take, connection and all.
const PROBE_TIMEOUT: Duration = Duration::from_secs(3);
/// Looks in a row without an answer after which the router is opened again.
const FAILURES_MAX: u32 = 3;

/// The session that is open now.
#[derive(Debug)]
pub(super) struct Current(Mutex<Session>);

impl Current {
    pub(super) fn new(session: Session) -> Self {
        Self(Mutex::new(session))
    }

    pub(super) fn get(&self) -> Session {
        let session = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        session.clone()
    }

    fn set(&self, session: Session) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = session;
    }
}

/// Declares what the look asks. Blocks its thread.
pub(super) fn declare_probe(session: &Session) -> zenoh::Result<()> {
    session
        .declare_queryable(PROBE_KEY)
        .complete(true)
        .callback(|query| {
            // A full link drops the answer; the look counts that as none.
            let _ = query.reply(PROBE_KEY, [1_u8]).wait();
        })
        .background()
        .wait()
}

/// What the watch works on.
pub(super) struct Watch {
    pub(super) app: App,
    pub(super) session: Arc<Current>,
    pub(super) channels: Channels,
    pub(super) supervisor: Supervisor,
    pub(super) address: SocketAddr,
    /// Time between two looks.
    pub(super) period: Duration,
    pub(super) stop: CancellationToken,
}

/// Watches until the stop.
pub(super) async fn watch(watch: Watch) {
    let mut failures = 0;
    loop {
        tokio::select! {
            biased;
            () = watch.stop.cancelled() => return,
            () = tokio::time::sleep(watch.period) => {}
        }
        let looking = watch.supervisor.blocking({
            let address = watch.address;
            move || probe(address)
        });
        let looked = tokio::time::timeout(2 * PROBE_TIMEOUT, looking).await;
        if matches!(looked, Ok(Some(true))) {
            failures = 0;
            continue;
        }
        failures += 1;
        watch.app.counters().router_probes_failed.one();
        warn!("the zenoh router did not answer, {failures} of {FAILURES_MAX} times");
        if failures >= FAILURES_MAX && !watch.stop.is_cancelled() {
            failures = 0;
            reopen(&watch).await;
        }
    }
}

async fn reopen(watch: &Watch) {
    super::close(watch.session.get()).await;
    let opened = super::open_session(watch.address, &watch.supervisor).await;
    let session = match opened {
        Ok(session) => session,
        // It stays closed, so the next looks fail too and it is tried again.
        Err(failed) => return error!("cannot open the zenoh router again: {failed}"),
    };
    watch.session.set(session.clone());
    watch.app.counters().router_reopened.one();
    let declared = super::declare(session, &watch.channels, watch.address, &watch.supervisor).await;
    match declared {
        Ok(()) => warn!("the zenoh router was opened again"),
        Err(failed) => error!("cannot listen on the router that was opened again: {failed}"),
    }
}

/// Asks the router something over a connection of its own. Blocks its thread.
fn probe(address: SocketAddr) -> bool {
    let asked = || -> zenoh::Result<bool> {
        let mut config = Config::default();
        let timeout_ms = PROBE_TIMEOUT.as_millis();
        for (key, value) in [
            ("mode", "\"client\"".to_owned()),
            ("connect/endpoints", format!("[\"tcp/{address}\"]")),
            ("connect/timeout_ms", timeout_ms.to_string()),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
        ] {
            config.insert_json5(key, &value)?;
        }
        let session = zenoh::open(config).wait()?;
        let replies = session.get(PROBE_KEY).timeout(PROBE_TIMEOUT).wait()?;
        let answered = replies.recv().is_ok_and(|reply| reply.result().is_ok());
        session.close().wait()?;
        Ok(answered)
    };
    asked().unwrap_or(false)
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use tokio::sync::mpsc;
    use zenoh::Wait as _;

    use super::super::Fleet;
    use super::*;
    use crate::clock::Clock;
    use crate::config::FrictionConfig;
    use crate::db::Db;

    const PATIENCE: Duration = Duration::from_secs(30);

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_router_that_no_longer_answers_is_opened_again_and_takes_robots() {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&folder.path().join("tread.db")).await.unwrap();
        let app = App::new(db, Clock::system(), FrictionConfig::default());
        let supervisor = Supervisor::new();
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let mut fleet = Fleet::open(address, supervisor.clone()).await.unwrap();
        fleet.probe_period = Duration::from_millis(50);
        let (uploads, _uploads_in) = mpsc::channel(1);
        fleet.listen(&app, uploads).await.unwrap();
        let answers = async |wanted: bool| {
            let address = fleet.address();
            let looking = async {
                while tokio::task::spawn_blocking(move || probe(address))
                    .await
                    .unwrap()
                    != wanted
                {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
            };
            tokio::time::timeout(PATIENCE, looking).await.unwrap();
        };
        answers(true).await;
        assert_eq!(app.counters().router_reopened.get(), 0);
        let session = fleet.session.get();
        tokio::task::spawn_blocking(move || session.close().wait())
            .await
            .unwrap()
            .unwrap();
        let reopened = async {
            while app.counters().router_reopened.get() == 0 {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        tokio::time::timeout(PATIENCE, reopened).await.unwrap();
        assert!(app.counters().router_probes_failed.get() >= u64::from(FAILURES_MAX));
        answers(true).await;
        supervisor.stop().await.unwrap();
        fleet.close().await;
    }
}
