//! The way of stops to their robots, and what becomes of them.

use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;
use tracing::{error, warn};
use tread_api::ids::StopId;
use tread_api::stop::Stop;
use tread_api::wire::reply::{Acknowledgement, CommandRefusalCode};
use tread_api::wire::safety::Stop as StopCommand;

use super::super::{App, AppError};
use crate::db;

/// What a robot has answered to a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::app) enum StopDelivery {
    /// It is in force, or was replaced by one that came later.
    Confirmed,
    /// It was in force and has been cleared since, perhaps with one that came later.
    Over,
    /// Nothing, or not what was hoped for.
    Unconfirmed,
}

/// Sends a stop to its robot.
pub(in crate::app) async fn send_stop(app: &App, stop: &Stop) -> StopDelivery {
    let command = StopCommand {
        stop: stop.id,
        by: stop.by.clone(),
        reason: stop.reason.clone(),
        at: stop.wanted_at,
    };
    let key = (stop.site.clone(), stop.robot.clone());
    app.counters().stops_sent.one();
    // Whatever runs under the robot's name stops; only its present run can confirm.
    let present = app.presences().get(&key).boot().map(|(boot, _since)| boot);
    let Ok(answer) = app.commands().send_to(&key, None, &command).await else {
        return StopDelivery::Unconfirmed;
    };
    if present.is_some_and(|boot| boot != answer.boot) {
        app.counters().commands_unanswered.one();
        return StopDelivery::Unconfirmed;
    }
    match answer.reply {
        Acknowledgement::Done => StopDelivery::Confirmed,
        Acknowledgement::Refused(refusal) if refusal.code == CommandRefusalCode::Ended => {
            StopDelivery::Over
        }
        Acknowledgement::Refused(refusal) => {
            let detail = refusal.detail;
            error!(robot.id = %stop.robot, "robot `{}` does not stop: {detail}", stop.robot);
            StopDelivery::Unconfirmed
        }
    }
}

/// A stop on its way to its robot.
pub(super) struct Outgoing {
    pub(super) app: App,
    pub(super) stop: Stop,
    pub(super) recorded: watch::Receiver<bool>,
}

impl Outgoing {
    /// Sends until the robot has confirmed, or the database has the stop: then the reconciler goes
    /// on.
    pub(super) async fn deliver(self, tell_of: mpsc::Sender<(StopId, Timestamp)>) {
        let ending = self.app.supervisor().stop_token();
        let unrecorded = self.app.unrecorded();
        loop {
            let delivery = send_stop(&self.app, &self.stop).await;
            if delivery != StopDelivery::Unconfirmed {
                // What is over was in force; the reconciler hears that it is over. Nobody listens
                // only when the server stops.
                let _ = tell_of.send((self.stop.id, self.app.clock().now())).await;
                return;
            }
            tokio::select! {
                () = ending.cancelled() => return,
                () = tokio::time::sleep(UNRECORDED_RETRY) => {}
            }
            let is_newest = !unrecorded
                .newest_of(std::slice::from_ref(&self.stop))
                .is_empty();
            if *self.recorded.borrow() || !is_newest {
                return;
            }
        }
    }
}

/// Stops that were sent: what becomes of them, and the database.
pub(super) struct Settling {
    pub(super) app: App,
    pub(super) stops: Vec<Stop>,
    pub(super) stop: CancellationToken,
    pub(super) confirm_max: Duration,
}

impl Settling {
    pub(super) async fn run(
        self,
        mut confirmations: mpsc::Receiver<(StopId, Timestamp)>,
        shown: oneshot::Sender<Vec<(StopId, Timestamp)>>,
        recorded: watch::Sender<bool>,
    ) {
        let recording = async {
            let mut waiting = self.stops.clone();
            while !self.record(&waiting).await {
                tokio::select! {
                    () = self.stop.cancelled() => return,
                    () = tokio::time::sleep(UNRECORDED_RETRY) => {}
                }
                // A newer stop of a robot has replaced this one there, and need alone be kept.
                waiting = self.app.unrecorded().newest_of(&self.stops);
            }
            recorded.send_replace(true);
        };
        let (done, mut is_done) = oneshot::channel();
        let recording = async {
            recording.await;
            let _ = done.send(());
        };
        let collecting = async {
            let mut confirmed = self.collect(&mut confirmations, shown).await;
            self.app.unrecorded().confirm(&confirmed);
            // Shown also as long as the database does not take it.
            loop {
                tokio::select! {
                    biased;
                    _ = &mut is_done => return confirmed,
                    Some(late) = confirmations.recv() => {
                        self.app.unrecorded().confirm(&[late]);
                        confirmed.push(late);
                    }
                }
            }
        };
        let ((), confirmed) = tokio::join!(recording, collecting);
        self.note(&confirmed).await;
        let is_open = |stop: &&Stop| !confirmed.iter().any(|(id, _)| *id == stop.id);
        let open: Vec<&Stop> = self.stops.iter().filter(is_open).collect();
        if !open.is_empty() {
            warn!("{} robots have not confirmed a stop", open.len());
            self.app.counters().stops_unconfirmed.add(open.len() as u64);
            if let Err(error) = db::limited(self.app.note_unconfirmed(&open)).await {
                self.app
                    .log_failure("write down that stops are unconfirmed", &error);
            }
        }
        self.app.wake();
        while let Some(late) = confirmations.recv().await {
            self.note(&[late]).await;
        }
    }

    /// Writes stops down; whether that is done.
    async fn record(&self, stops: &[Stop]) -> bool {
        if stops.is_empty() {
            return true;
        }
        let writing = async {
            let mut tx = self.app.db().write("stops").await?;
            self.app.record_stops(&mut tx, stops).await?;
            tx.commit().await?;
            Ok::<(), AppError>(())
        };
        match db::limited(writing).await {
            Ok(()) => {
                self.app.unrecorded().remove(stops);
                true
            }
            Err(error) => {
                self.app
                    .log_failure("write down a stop; it is sent all the same", &error);
                false
            }
        }
    }

    /// Waits until all robots have confirmed or the bound has passed, and says which have.
    async fn collect(
        &self,
        confirmations: &mut mpsc::Receiver<(StopId, Timestamp)>,
        shown: oneshot::Sender<Vec<(StopId, Timestamp)>>,
    ) -> Vec<(StopId, Timestamp)> {
        let mut confirmed = Vec::with_capacity(self.stops.len());
        let mut bound = std::pin::pin!(tokio::time::sleep(self.confirm_max));
        while confirmed.len() < self.stops.len() {
            tokio::select! {
                biased;
                Some(confirmation) = confirmations.recv() => confirmed.push(confirmation),
                () = bound.as_mut() => break,
                else => break,
            }
        }
        // Whoever asked may be gone.
        let _ = shown.send(confirmed.clone());
        confirmed
    }

    async fn note(&self, confirmed: &[(StopId, Timestamp)]) {
        if confirmed.is_empty() {
            return;
        }
        self.app.unrecorded().confirm(confirmed);
        let noting = self.app.note_confirmed(&self.stops, confirmed);
        if let Err(error) = db::limited(noting).await {
            // The reconciler asks the robot again, which says the same.
            self.app
                .log_failure("write down that stops are confirmed", &error);
        }
    }
}

/// Wait between two tries of a stop that could not be written down, so that nobody else repeats it.
const UNRECORDED_RETRY: Duration = Duration::from_millis(250);
