//! A running agent: starts all its parts, and stops them in order.
//!
//! ```text
//! loop thread ──events──► recorder ──► outbox ──► uploader ─┐
//!      ▲ └──snapshot──► reporter ───────────────────────────┼─► fleet (zenoh) ◄─► server
//!      └──commands── dispatcher ◄───────────────────────────┘
//! ```

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use jiff::SignedDuration;
use tokio::sync::watch;
use tracing::{error, info};
use tread_api::ids::BootId;
use tread_api::wire::state::{FrictionReport, RobotState};
use tread_control::robot::RobotModel;
use tread_telemetry::Telemetry;
use uuid::Uuid;

use crate::base::Base;
use crate::clock::{SharedClock, SystemClock};
use crate::config::AgentConfig;
use crate::control_loop::BRAKING_MAX;
use crate::control_loop::channels::{AgentEnds, LoopEnds, Shared, loop_channels};
use crate::control_loop::frame::notes;
use crate::control_loop::tick::LoopCore;
use crate::dispatcher::Dispatcher;
use crate::fleet::{self, Identity};
use crate::geometry::control_model;
use crate::knowledge::{Missions, SiteCell};
use crate::membership::{Membership, Renewal, ServerTrust};
use crate::missions::memory::Memory;
use crate::online::Online;
use crate::outbox::Outbox;
use crate::realtime::lock_memory;
use crate::recorder::Recorder;
use crate::recording::{RecordWriter, RunHead};
use crate::reporter::{Reporter, log_losses};
use crate::safety::Safety;
use crate::safety::latch_file::LatchFile;
use crate::service_manager::{self, NotifierInputs};
use crate::start_error::StartError;
use crate::state_rate::PublishRate;
use crate::supervisor::{PartEnded, Supervisor};

/// Longest time that a stopping agent waits for the server to accept its last records.
const LAST_UPLOAD_MAX: Duration = Duration::from_secs(1);
/// Interval of the checks for records that still wait.
const LAST_UPLOAD_POLL: Duration = Duration::from_millis(10);

/// Starts agents.
#[derive(Debug)]
pub struct Agent;

/// A running agent; several may run in one process.
#[derive(Debug)]
pub struct RunningAgent {
    identity: Identity,
    supervisor: Arc<Supervisor>,
    shared: Arc<Shared>,
    outbox: Outbox,
    reporter: Arc<Reporter>,
    is_connected: watch::Receiver<bool>,
    threads: Vec<JoinHandle<()>>,
    telemetry: Telemetry,
}

impl Agent {
    /// Starts an agent on the present multi-threaded runtime. It drives and measures at once, and
    /// connects in the background, retrying until it succeeds.
    ///
    /// # Errors
    /// [`StartError`]; nothing is left running then.
    pub fn start(config: AgentConfig) -> Result<RunningAgent, StartError> {
        let simulated = config.drive.simulated();
        let ahead = simulated.map_or(0, |simulated| simulated.clock_ahead_s);
        let ahead = SignedDuration::from_secs(ahead);
        Self::start_with_clock(config, Arc::new(SystemClock::new().ahead_by(ahead)))
    }

    /// Starts an agent with the caller's clock.
    ///
    /// # Errors
    /// As [`Agent::start`].
    pub fn start_with_clock(
        config: AgentConfig,
        clock: SharedClock,
    ) -> Result<RunningAgent, StartError> {
        config.realtime.lock_memory.then(lock_memory).transpose()?;
        let model = control_model(&config.model)?;
        fleet::check_endpoints(config.servers.endpoints())?;
        let base = Base::new(&config.drive, model, &clock)?;
        let boot = BootId::from_uuid(Uuid::new_v4());
        // Before anything else is written to the folder, whose files distinguish a first start from
        // a lost latch.
        let stops = LatchFile::new(&config.data_dir).load(&clock);
        let outbox_folder = config.data_dir.join("outbox");
        let outbox = Outbox::open(&outbox_folder, config.outbox, config.robot.clone(), boot)?;
        let memory = Memory::new(&config.data_dir);
        let missions = Missions::restore(memory, &outbox, clock.wall())?;
        let identity = identity_of(&config, boot);
        let (loop_ends, ends) = loop_channels();
        let AgentEnds {
            commands,
            events,
            shared,
        } = ends;
        let site = Arc::new(SiteCell::default());
        let supervisor = Arc::new(Supervisor::new());
        let telemetry = Telemetry::start(&config.tracing, "tread-agent")?;
        let recorder = Recorder {
            configuration: config.model.configuration(),
            missions: Arc::clone(&missions),
            outbox: outbox.clone(),
            telemetry: telemetry.clone(),
        };
        let safety = Safety::open(
            &config.data_dir,
            stops,
            boot,
            model,
            &config.required_owners,
            Arc::clone(&shared.safety),
            Arc::clone(&clock),
        );
        let no_thread = |part| move |source| StartError::Thread { part, source };
        let (core, writing) =
            loop_core(&config, boot, &base, model, loop_ends, &supervisor, &clock)?;
        let counts = base.counts();
        let saving = supervisor
            .spawn_thread("recorder", move || recorder.run(&events))
            .map_err(no_thread("recorder"))?;
        let mut threads = base.spawn(core, &config, &supervisor, &shared, &clock)?;
        threads.push(saving);
        threads.extend(writing);
        let stop = || supervisor.stop_token();
        supervisor.spawn("outbox", outbox.clone().keep_synced(stop()));
        let losses = log_losses(Arc::clone(&shared), counts.clone(), stop());
        supervisor.spawn("losses", losses);

        let reporter = Arc::new(Reporter {
            identity: identity.clone(),
            clock: Arc::clone(&clock),
            shared: Arc::clone(&shared),
            site: Arc::clone(&site),
            safety: Arc::clone(&safety),
            outbox: outbox.clone(),
            rate_hz: config.rate_hz,
            publish_rate: Arc::new(PublishRate::new(config.state_rate_hz)),
            states: AtomicU64::new(0),
            frictions: AtomicU64::new(0),
            alerts: Mutex::default(),
            base: counts,
        });
        let dispatcher = Arc::new(Dispatcher {
            boot,
            model,
            clock,
            missions,
            site,
            shared: Arc::clone(&shared),
            safety,
            publish_rate: Arc::clone(&reporter.publish_rate),
            to_loop: commands,
            telemetry: telemetry.clone(),
        });
        let (connected, is_connected) = watch::channel(false);
        let (server_trust, membership) = renew_membership(&supervisor, &config, &dispatcher.clock);
        let online = Online {
            config,
            identity: identity.clone(),
            reporter: Arc::clone(&reporter),
            dispatcher,
            outbox: outbox.clone(),
            stop: supervisor.stop_token(),
            connected,
            membership,
            server_trust,
        };
        supervisor.spawn("fleet link", online.run());
        info!(robot.id = %identity.robot, %boot, "agent of `{}` runs", identity.robot);
        Ok(RunningAgent {
            identity,
            supervisor,
            shared,
            outbox,
            reporter,
            is_connected,
            threads,
            telemetry,
        })
    }
}

fn identity_of(config: &AgentConfig, boot: BootId) -> Identity {
    Identity {
        site: config.site.clone(),
        robot: config.robot.clone(),
        boot,
    }
}

/// Creates the configured loop, and starts the thread that records it if records are configured.
fn loop_core(
    config: &AgentConfig,
    boot: BootId,
    base: &Base,
    model: RobotModel,
    ends: LoopEnds,
    supervisor: &Supervisor,
    clock: &SharedClock,
) -> Result<(LoopCore, Option<JoinHandle<()>>), StartError> {
    let mut core = LoopCore::new(model, ends)
        .with_blind_within_fence(config.blind_within_fence)
        .with_silent_after(base.silent_after())
        .with_prior(config.prior)
        .with_period(config.period());
    let part = "record of the loop";
    let Some((to, head)) = RunHead::of(config, boot, base.silent_after()) else {
        return Ok((core, None));
    };
    let writer = RecordWriter::new(to, head, model, Arc::clone(clock));
    let (record_sender, notes) = notes();
    let writing = supervisor.spawn_thread(part, move || writer.run(&notes));
    let writing = writing.map_err(|source| StartError::Thread { part, source })?;
    core.record_to(Some(record_sender));
    Ok((core, Some(writing)))
}

/// The server's statements on trusted authorities, and the certificate, which changes with each
/// renewal.
type MembershipRenewal = (
    watch::Sender<ServerTrust>,
    Option<watch::Receiver<Arc<Membership>>>,
);

/// Starts the renewal of the certificate, if there is one.
fn renew_membership(
    supervisor: &Supervisor,
    config: &AgentConfig,
    clock: &SharedClock,
) -> MembershipRenewal {
    let server_trust = watch::Sender::default();
    let Some(joined) = config.membership.clone() else {
        return (server_trust, None);
    };
    let (present, membership) = watch::channel(Arc::new(joined));
    let renewal = Renewal {
        folder: config.data_dir.clone(),
        clock: Arc::clone(clock),
        present,
        server_trust: server_trust.clone(),
    };
    supervisor.spawn("renewal", renewal.run(supervisor.stop_token()));
    (server_trust, Some(membership))
}

impl RunningAgent {
    /// Returns the identifier of this run of the agent.
    pub fn boot(&self) -> BootId {
        self.identity.boot
    }

    /// Returns the robot and its site.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Returns the state as it would be published now.
    pub fn state(&self) -> RobotState {
        self.reporter.state()
    }

    /// Returns both friction estimates as they would be published now.
    pub fn friction(&self) -> FrictionReport {
        self.reporter.friction()
    }

    /// Returns the numbers of records that wait, were dropped and were refused.
    #[cfg(any(test, feature = "testing"))]
    pub fn outbox_status(&self) -> tread_api::robot::OutboxStatus {
        self.outbox.status()
    }

    /// Tells the service manager that started this process, if any, that the agent is ready once its
    /// loop ticks, and from then on that the loop ticks, until the stop.
    ///
    /// # Errors
    /// The thread for it cannot be started.
    pub fn notify_service_manager(&mut self) -> Result<(), StartError> {
        if !service_manager::is_present() {
            return Ok(());
        }
        let notifier = NotifierInputs {
            identity: self.identity.clone(),
            shared: Arc::clone(&self.shared),
            clock: Arc::clone(&self.reporter.clock),
            has_connected: self.is_connected.clone(),
        };
        let part = "service manager";
        let notifying = self.supervisor.spawn_thread(part, move || notifier.run());
        let no_thread = move |source| StartError::Thread { part, source };
        self.threads.push(notifying.map_err(no_thread)?);
        Ok(())
    }

    /// Waits for the first part of the agent that ends unexpectedly, after which the agent must
    /// end.
    pub async fn failed(&self) -> PartEnded {
        self.supervisor.failed().await
    }

    /// Brakes to zero velocity, saves and sends the remaining records, closes the link, and ends.
    pub async fn stop(mut self) {
        info!("stopping");
        self.supervisor.begin_stop();
        self.shared.stop.store(true, Ordering::Relaxed);
        let threads = std::mem::take(&mut self.threads);
        let joining = tokio::task::spawn_blocking(move || {
            for thread in threads {
                // A panic was reported when it happened.
                let _ = thread.join();
            }
        });
        if tokio::time::timeout(2 * BRAKING_MAX, joining)
            .await
            .is_err()
        {
            error!("the control loop did not end in time");
        }
        if *self.is_connected.borrow() {
            let sent_all = async {
                while self.outbox.status().pending > 0 {
                    tokio::time::sleep(LAST_UPLOAD_POLL).await;
                }
            };
            if tokio::time::timeout(LAST_UPLOAD_MAX, sent_all)
                .await
                .is_err()
            {
                let pending = self.outbox.status().pending;
                info!(pending, "{pending} records wait for the next start");
            }
        }
        self.supervisor.end_tasks().await;
        let telemetry = self.telemetry.clone();
        // A collector that does not answer must not hold the runtime.
        let _ended = tokio::task::spawn_blocking(move || telemetry.stop()).await;
        let outbox = self.outbox.clone();
        match tokio::task::spawn_blocking(move || outbox.sync()).await {
            Ok(Ok(())) => info!("stopped"),
            Ok(Err(cause)) => {
                error!(
                    error = &cause as &dyn std::error::Error,
                    "the outbox is not synced"
                );
            }
            Err(_) => error!("the outbox is not synced"),
        }
    }
}
