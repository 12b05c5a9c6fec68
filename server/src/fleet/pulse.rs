//! Heartbeat of the server, by which robots measure how long they have not received anything from
//! it.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Notify, watch};
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::ids::SiteId;
use tread_api::wire::state::{PULSE_PERIOD_MS, ServerPulse};
use tread_api::{keys, wire};
use zenoh::Wait as _;

use super::publishers::Publishers;
use super::routers::Routers;
use crate::app::App;

/// Interval at which the list of sites is read again.
const SITES_EVERY: Duration = Duration::from_secs(5);

/// Publishes heartbeats until the stop.
pub(super) async fn run(app: App, routers: Arc<Routers>, stop: CancellationToken) {
    let (listing, mut sites) = watch::channel(Vec::new());
    // Beside the beats, which must not wait for the database: a robot would think the server gone.
    let again = Notify::new();
    let reading = async {
        loop {
            match app.all_sites().await {
                Ok(sites) => {
                    listing.send_replace(sites);
                }
                Err(error) => warn!("cannot read the sites for the pulse: {error:?}"),
            }
            tokio::select! {
                () = again.notified() => {}
                () = tokio::time::sleep(SITES_EVERY) => {}
            }
        }
    };
    let beating = publish_heartbeats(&app, &routers, (&mut sites, &again));
    tokio::select! {
        () = stop.cancelled() => {}
        () = reading => {}
        () = beating => {}
    }
}

/// Publishes heartbeats for the sites that are listed, and asks for the list when there are new routers.
async fn publish_heartbeats(
    app: &App,
    routers: &Routers,
    (sites, again): (&mut watch::Receiver<Vec<SiteId>>, &Notify),
) {
    let mut publishers = Publishers::new(keys::pulse);
    let mut ticks = tokio::time::interval(Duration::from_millis(PULSE_PERIOD_MS));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let has_new_routers = publishers.refresh(routers);
        if has_new_routers {
            again.notify_one();
        }
        if has_new_routers || sites.has_changed().unwrap_or(false) {
            publishers.declare(routers, &sites.borrow_and_update());
        }
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
