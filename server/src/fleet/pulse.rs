//! Heartbeat of the server, by which robots measure how long they have not received anything from
//! it.

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::wire::state::{PULSE_PERIOD_MS, ServerPulse};
use tread_api::{keys, wire};
use zenoh::Wait as _;

use super::publishers::Publishers;
use super::routers::Routers;
use crate::app::App;

/// Number of heartbeats after which the list of sites is read again.
const SITES_EVERY: u64 = 20;

/// Publishes heartbeats until the stop.
pub(super) async fn run(app: App, routers: Arc<Routers>, stop: CancellationToken) {
    let mut publishers = Publishers::new(keys::pulse);
    let mut beat: u64 = 0;
    let mut ticks = tokio::time::interval(Duration::from_millis(PULSE_PERIOD_MS));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            _ = ticks.tick() => {}
        }
        if publishers.look_again(&routers) {
            beat = 0;
        }
        if beat.is_multiple_of(SITES_EVERY) {
            match app.all_sites().await {
                Ok(sites) => publishers.declare(&routers, &sites),
                Err(error) => warn!("cannot read the sites for the pulse: {error:?}"),
            }
        }
        beat += 1;
        let pulse = ServerPulse {
            server_time: app.clock().now(),
            trust: app.trust_id(),
        };
        let Ok(payload) = wire::encode(&pulse) else {
            continue;
        };
        for publisher in publishers.all() {
            if let Err(error) = publisher.put(payload.clone()).wait() {
                debug!("a beat did not go out: {error}");
            }
        }
    }
}
