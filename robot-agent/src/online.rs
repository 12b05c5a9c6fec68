//! The agent's network task: connects, introduces the robot, publishes, uploads and answers
//! commands; reopens the link for a new certificate or other credentials.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use futures_util::StreamExt as _;
use futures_util::stream::FuturesUnordered;
use jiff::{SignedDuration, Timestamp};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::robot::Capabilities;
use tread_api::wire::hello::Hello;

use crate::config::AgentConfig;
use crate::control_loop::channels::Shared;
use crate::dispatcher::Dispatcher;
use crate::fleet::uploader::{self, Backoff};
use crate::fleet::{
    self, Attempt, COMMANDS_MAX, FleetLink, Identity, LinkError, LinkEvent, LinkEventHandler,
    Listeners, Rotation, Server,
};
use crate::membership::{Membership, ServerTrust};
use crate::outbox::Outbox;
use crate::reporter::{Reporter, every, publish_states};

/// Time for the last state to be sent before the session closes.
const LAST_STATE_WAIT: Duration = Duration::from_millis(100);

/// Difference between the robot's clock and the server's from which it is logged: that from which
/// the server raises an alert.
const CLOCK_WRONG_AFTER: SignedDuration = SignedDuration::from_secs(10);
/// Pause after the link failed for a reason of this machine, such as no free port.
const LINK_FAILED_REST: Duration = Duration::from_secs(1);

/// Silence after which one of several servers is left if its link has broken too: a server that changes
/// its router takes less.
const LOST_GRACE: Duration = Duration::from_millis(300);
/// Interval between two looks at the silence of the server.
const SILENCE_POLL_EVERY: Duration = Duration::from_millis(50);

/// Waits for the next certificate; never returns without a membership.
async fn renewed(membership: &mut Option<watch::Receiver<Arc<Membership>>>) {
    if let Some(membership) = membership
        && membership.changed().await.is_ok()
    {
        return;
    }
    std::future::pending::<()>().await;
}

/// State of the network task.
pub(crate) struct Online {
    pub(crate) config: AgentConfig,
    pub(crate) identity: Identity,
    pub(crate) reporter: Arc<Reporter>,
    pub(crate) dispatcher: Arc<Dispatcher>,
    pub(crate) outbox: Outbox,
    pub(crate) stop: CancellationToken,
    pub(crate) connected: watch::Sender<bool>,
    /// Certificate, which changes with each renewal; `None` for a robot without one.
    pub(crate) membership: Option<watch::Receiver<Arc<Membership>>>,
    /// The server's statements on the authorities that robots shall trust.
    pub(crate) server_trust: watch::Sender<ServerTrust>,
}

/// What lasts from link to link.
struct Links {
    servers: Rotation,
    listeners: Listeners,
    membership: Option<watch::Receiver<Arc<Membership>>>,
    /// The certificate of the attempt before.
    presented: Option<Arc<Membership>>,
    /// Whether the present link has broken and no server has been heard since.
    is_lost: Arc<AtomicBool>,
    /// Links to servers that were left, while they are closed.
    closing: JoinSet<()>,
}

fn set_trust(server_trust: &watch::Sender<ServerTrust>, trust: ServerTrust) {
    server_trust.send_if_modified(|present| std::mem::replace(present, trust) != trust);
}

impl Online {
    /// Runs until requested to stop.
    pub(crate) async fn run(mut self) {
        let (shared, clock) = (&self.dispatcher.shared, &self.dispatcher.clock);
        let (shared, clock) = (Arc::clone(shared), Arc::clone(clock));
        let server_trust = self.server_trust.clone();
        let publish_rate = Arc::clone(&self.reporter.publish_rate);
        let is_lost = Arc::new(AtomicBool::new(false));
        let lost = Arc::clone(&is_lost);
        let on_event: LinkEventHandler = Arc::new(move |event| match event {
            LinkEvent::ServerMessage => {
                lost.store(false, Ordering::Relaxed);
                shared.record_server_message(clock.monotonic());
            }
            LinkEvent::CommandLost => Shared::count(&shared.lost_commands),
            LinkEvent::ServerLost => {
                lost.store(true, Ordering::Relaxed);
                publish_rate.end_request();
            }
            LinkEvent::Trust(trust) => set_trust(&server_trust, ServerTrust::Is(trust)),
            LinkEvent::Distrusted => set_trust(&server_trust, ServerTrust::Distrusted),
        });
        tokio::select! {
            // Spreads the connections of robots that are switched on together.
            () = tokio::time::sleep(fleet::start_jitter(self.identity.boot)) => {}
            () = self.stop.cancelled() => return,
        }
        let (commands, commands_in) = mpsc::channel(COMMANDS_MAX);
        let listeners = Listeners {
            on_event,
            urgent: {
                let safety = Arc::clone(&self.dispatcher.safety);
                Arc::new(move |urgent| safety.handle_urgent(urgent))
            },
            commands,
        };
        let answering = Arc::clone(&self.dispatcher).run(commands_in, self.stop.clone());
        let mut links = Links {
            servers: Rotation::new(self.config.servers.endpoints()),
            listeners,
            membership: self.membership.take(),
            presented: None,
            is_lost,
            closing: JoinSet::new(),
        };
        let linking = async { while self.link(&mut links).await.is_continue() {} };
        tokio::join!(answering, linking);
    }

    /// Runs one link until requested to stop, until it must be reopened with another certificate, or
    /// until the server is left for another one. The robot goes on driving in between, as in every outage.
    async fn link(&self, links: &mut Links) -> ControlFlow<()> {
        // The server that requested it was that of the link before.
        self.reporter.publish_rate.end_request();
        let began = self.dispatcher.clock.monotonic();
        let membership = &mut links.membership;
        let presented = membership
            .as_mut()
            .map(|it| Arc::clone(&it.borrow_and_update()));
        let before = std::mem::replace(&mut links.presented, presented.clone());
        if before.as_ref().map(Arc::as_ptr) != presented.as_ref().map(Arc::as_ptr) {
            links.servers.reset_failures();
        }
        let connecting = self.connect(&mut links.servers, presented.as_deref(), &links.listeners);
        let connected = tokio::select! {
            connected = connecting => connected,
            () = self.stop.cancelled() => return ControlFlow::Break(()),
            // The present certificate may be the reason why no server is reached.
            () = renewed(membership) => return ControlFlow::Continue(()),
        };
        let link: Arc<FleetLink> = match connected {
            Ok(Attempt::Reached(link)) => Arc::from(link),
            Ok(Attempt::Failed { is_distrusted }) => {
                let now = self.dispatcher.clock.monotonic();
                let pause = links.servers.failed(&(began..now), is_distrusted);
                return self.rest(&mut links.membership, pause).await;
            }
            Err(cause) => {
                error!(
                    error = &cause as &dyn std::error::Error,
                    "the fleet link failed; it is tried again"
                );
                // It is of this machine, and no fault of the server.
                let now = self.dispatcher.clock.monotonic();
                let pause = links.servers.failed(&(now..now), false);
                let pause = pause.max(LINK_FAILED_REST);
                return self.rest(&mut links.membership, pause).await;
            }
        };
        let server = links.servers.endpoint();
        info!(server, "connected to `{server}`");
        links.servers.reached();
        links.is_lost.store(false, Ordering::Relaxed);
        let (welcomed, is_welcome) = watch::channel(false);
        let _ = self.connected.send(true);
        let reporter = &self.reporter;
        let uploading = uploader::run(
            Arc::clone(&link),
            self.outbox.clone(),
            Arc::clone(&self.dispatcher.clock),
            is_welcome,
            self.stop.clone(),
        );
        let working = async {
            tokio::join!(
                self.introduce(Arc::clone(&link), welcomed),
                uploading,
                publish_states(Arc::clone(&link), reporter),
                every(self.config.friction_rate_hz, Arc::clone(&link), |link| {
                    link.publish_friction(&reporter.friction());
                }),
            );
        };
        let next = tokio::select! {
            () = working => ControlFlow::Break(()),
            () = self.stop.cancelled() => ControlFlow::Break(()),
            () = renewed(&mut links.membership) => ControlFlow::Continue(()),
            () = link.lost_for_good() => ControlFlow::Continue(()),
            silence = self.silent(&links.servers, &links.is_lost) => {
                let silent = links.servers.endpoint().to_owned();
                links.servers.leave(self.dispatcher.clock.monotonic());
                warn!(
                    "the server at {silent} has been silent for {:.1} s; the next one is {}",
                    silence.as_secs_f64(), links.servers.endpoint(),
                );
                link.leave();
                // What does not answer takes its time to close.
                links.closing.spawn(async move { link.close().await });
                while links.closing.try_join_next().is_some() {}
                return ControlFlow::Continue(());
            }
        };
        if self.stop.is_cancelled() {
            self.announce_departure(&link).await;
        }
        link.close().await;
        next
    }

    /// Makes one attempt to connect to the server whose turn it is. If that takes long, the others are tried
    /// in parallel with it, and whichever is reached first is the one.
    async fn connect(
        &self,
        servers: &mut Rotation,
        membership: Option<&Membership>,
        listeners: &Listeners,
    ) -> Result<Attempt, LinkError> {
        let has_others = servers.has_others();
        let attempt = async |server: &mut Server| {
            let (identity, listeners) = (self.identity.clone(), listeners.clone());
            FleetLink::connect(server, has_others, membership, identity, listeners).await
        };
        let now = || self.dispatcher.clock.monotonic();
        let (present, others) = servers.attempts(now());
        let parallel = others.into_iter().map(async |mut parallel| {
            loop {
                tokio::time::sleep(parallel.pause).await;
                let began = now();
                let is_distrusted = match attempt(parallel.server).await {
                    Ok(Attempt::Reached(link)) => return (parallel.at, link),
                    Ok(Attempt::Failed { is_distrusted }) => is_distrusted,
                    // Its own turn shows it.
                    Err(_) => false,
                };
                parallel.failed(&(began..now()), is_distrusted);
            }
        });
        let mut parallel: FuturesUnordered<_> = parallel.collect();
        let (at, link) = tokio::select! {
            biased;
            connected = attempt(present) => return connected,
            Some(reached) = parallel.next() => reached,
        };
        drop(parallel);
        servers.select(at);
        Ok(Attempt::Reached(link))
    }

    /// Waits before another attempt to connect.
    async fn rest(
        &self,
        membership: &mut Option<watch::Receiver<Arc<Membership>>>,
        pause: Duration,
    ) -> ControlFlow<()> {
        tokio::select! {
            () = tokio::time::sleep(pause) => ControlFlow::Continue(()),
            () = renewed(membership) => ControlFlow::Continue(()),
            () = self.stop.cancelled() => ControlFlow::Break(()),
        }
    }

    /// Waits until the server of a new link is to be left for another one, and returns how long it was
    /// silent; never returns if there is no other.
    async fn silent(&self, servers: &Rotation, is_lost: &AtomicBool) -> Duration {
        if !servers.has_others() {
            return std::future::pending().await;
        }
        let clock = &self.dispatcher.clock;
        let begun = clock.monotonic();
        loop {
            tokio::time::sleep(SILENCE_POLL_EVERY).await;
            let now = clock.monotonic();
            let silence = self.dispatcher.shared.server_silence(now);
            let silence = silence.min(now.saturating_sub(begun));
            let timeout = self.config.server_timeout;
            let is_lost = is_lost.load(Ordering::Relaxed);
            if silence >= timeout || is_lost && silence >= LOST_GRACE.min(timeout) {
                return silence;
            }
        }
    }

    /// Publishes that the agent stops on purpose, so that the server raises no alert. If this
    /// message is lost, the server raises one, as for any robot that disappears.
    async fn announce_departure(&self, link: &FleetLink) {
        let mut last = self.reporter.state();
        last.leaving = true;
        link.publish_state(&last);
        tokio::time::sleep(LAST_STATE_WAIT).await;
    }

    /// Sends the introduction on every new connection until it is answered.
    async fn introduce(&self, link: Arc<FleetLink>, welcomed: watch::Sender<bool>) {
        let mut server_seen = link.server_seen();
        loop {
            server_seen.mark_unchanged();
            let mut backoff = Backoff::new();
            while !self.introduce_once(&link).await {
                tokio::time::sleep(backoff.grow()).await;
            }
            let _ = welcomed.send(true);
            if server_seen.changed().await.is_err() {
                return;
            }
        }
    }

    async fn introduce_once(&self, link: &Arc<FleetLink>) -> bool {
        let hello = Hello {
            robot: self.identity.robot.clone(),
            boot: self.identity.boot,
            agent_version: env!("CARGO_PKG_VERSION").to_owned(),
            model: self.config.model.clone(),
            robot_time: self.dispatcher.clock.wall(),
            capabilities: Capabilities {
                pause: true,
                replace: true,
                battery: self.config.drive.measures_battery(),
                wheel_torque: self.config.drive.measures_torque(),
                stop: true,
                teleop: true,
                rate_hz: Some(self.config.rate_hz),
                base: Some(self.config.drive.kind().to_owned()),
            },
        };
        match link.hello(&hello).await {
            Ok(welcome) => {
                info!("the server welcomes `{}`", self.identity.robot);
                let server = welcome.server_time;
                let ahead = self.dispatcher.clock.wall().duration_since(server);
                if let Some(text) = clock_warning(server, ahead) {
                    warn!("{text}");
                }
                self.dispatcher.handle_welcome(welcome.site)
            }
            Err(fleet::AskError::NoAnswer) => false,
            Err(cause) => {
                warn!(
                    error = &cause as &dyn std::error::Error,
                    "the server does not welcome us"
                );
                false
            }
        }
    }
}

/// Returns what is wrong with the clocks; `None` if they agree. `ahead` is by how much the robot's
/// is ahead of the server's.
fn clock_warning(server: Timestamp, ahead: SignedDuration) -> Option<String> {
    (ahead.abs() >= CLOCK_WRONG_AFTER).then(|| {
        let direction = if ahead.is_negative() {
            "behind"
        } else {
            "ahead of"
        };
        let own = server + ahead;
        format!(
            "this robot's clock is {} s {direction} the server's: it says {own:.0}, and the server \
             {server:.0}; set the wrong one, and have both synchronised (chrony); this agent takes \
             the robot's clock at its start, so start it again then",
            ahead.abs().as_secs()
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_an_hour_off_is_said_with_its_direction_and_what_to_do() {
        let server: Timestamp = "2026-11-02T10:00:00Z".parse().unwrap();
        let hour = SignedDuration::from_hours(1);
        assert_eq!(clock_warning(server, SignedDuration::ZERO), None);
        assert_eq!(clock_warning(server, SignedDuration::from_secs(9)), None);
        let behind = clock_warning(server, -hour).unwrap();
        assert!(behind.contains("3600 s behind the server's"), "{behind}");
        let ahead = clock_warning(server, hour).unwrap();
        assert!(
            ahead.contains("3600 s ahead of") && ahead.contains("chrony"),
            "{ahead}"
        );
    }
}
