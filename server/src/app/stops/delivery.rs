//! Delivery of stops to robots, and storage of the results.

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

/// A robot's answer to a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::app) enum StopDelivery {
    /// It is in force, or was replaced by a later one.
    Confirmed,
    /// It was in force and has been cleared since, possibly by clearing a later one.
    Over,
    /// No answer, or one that confirms nothing.
    Unconfirmed,
}

/// Sends a stop to its robot and returns the result.
pub(in crate::app) async fn send_stop(app: &App, stop: &Stop) -> StopDelivery {
    let command = StopCommand {
        stop: stop.id,
        by: stop.by.clone(),
        reason: stop.reason.clone(),
        at: stop.requested_at,
    };
    let key = (stop.site.clone(), stop.robot.clone());
    app.counters().stops_sent.one();
    // Every agent under the robot's name stops; only the present run can confirm.
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

/// A stop to be delivered to its robot.
pub(super) struct Outgoing {
    pub(super) app: App,
    pub(super) stop: Stop,
    pub(super) recorded: watch::Receiver<bool>,
}

impl Outgoing {
    /// Sends the stop until the robot has confirmed it, until a newer one replaces it, or until the
    /// database has it: then the reconciler continues.
    pub(super) async fn deliver(self, tell_of: mpsc::Sender<(StopId, Timestamp)>) {
        let ending = self.app.supervisor().stop_token();
        let unrecorded = self.app.unrecorded();
        loop {
            let delivery = send_stop(&self.app, &self.stop).await;
            if delivery != StopDelivery::Unconfirmed {
                // A stop that is over was in force; the reconciler learns that it is over. Sending
                // fails only when the server stops.
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

/// Awaits the confirmations of sent stops and stores both.
pub(super) struct StopRecorder {
    pub(super) app: App,
    pub(super) stops: Vec<Stop>,
    pub(super) stop: CancellationToken,
    pub(super) confirm_max: Duration,
}

impl StopRecorder {
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
                // A newer stop has replaced this one on its robot, and only the newer one must be
                // stored.
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
            // Confirmations are shown also while the database does not store them.
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
        self.record_confirmations(&confirmed).await;
        let is_open = |stop: &&Stop| !confirmed.iter().any(|(id, _)| *id == stop.id);
        let open: Vec<&Stop> = self.stops.iter().filter(is_open).collect();
        if !open.is_empty() {
            warn!("{} robots have not confirmed a stop", open.len());
            self.app.counters().stops_unconfirmed.add(open.len() as u64);
            if let Err(error) = db::limited(self.app.alert_unconfirmed(&open)).await {
                self.app
                    .log_failure("write down that stops are unconfirmed", &error);
            }
        }
        self.app.wake();
        while let Some(late) = confirmations.recv().await {
            self.record_confirmations(&[late]).await;
        }
    }

    /// Stores stops; returns whether that succeeded.
    async fn record(&self, stops: &[Stop]) -> bool {
        if stops.is_empty() {
            return true;
        }
        let writing = async {
            let mut tx = self.app.db().write("stops").await?;
            self.app.record_stops(&mut tx, stops).await?;
            Ok::<(), AppError>(self.app.commit_recalling(tx).await?)
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

    /// Waits until all robots have confirmed or the limit has passed; returns the confirmations.
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
        // Fails if the requester is gone.
        let _ = shown.send(confirmed.clone());
        confirmed
    }

    async fn record_confirmations(&self, confirmed: &[(StopId, Timestamp)]) {
        if confirmed.is_empty() {
            return;
        }
        self.app.unrecorded().confirm(confirmed);
        let recording = self.app.record_confirmed(&self.stops, confirmed);
        if let Err(error) = db::limited(recording).await {
            // The reconciler sends it again, and the robot gives the same answer.
            self.app
                .log_failure("write down that stops are confirmed", &error);
        }
    }
}

/// Wait between two attempts with a stop that is not stored yet, which nobody else repeats.
const UNRECORDED_RETRY: Duration = Duration::from_millis(250);
