//! The server's pulse: robots measure by it how long they have not heard the server.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use tread_api::ids::SiteId;
use tread_api::wire::state::{PULSE_PERIOD_MS, ServerPulse};
use tread_api::{keys, wire};
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait as _};

use super::routers::Routers;
use crate::app::App;

/// Beats after which the sites are read afresh.
const SITES_EVERY: u64 = 20;

/// Publishers of one router, by site.
type Publishers = HashMap<SiteId, Publisher<'static>>;

/// Beats until the stop.
pub(super) async fn run(app: App, routers: Arc<Routers>, stop: CancellationToken) {
    let mut publishers: HashMap<u64, Publishers> = HashMap::new();
    let mut version = None;
    let mut beat: u64 = 0;
    let mut ticks = tokio::time::interval(Duration::from_millis(PULSE_PERIOD_MS));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            _ = ticks.tick() => {}
        }
        // Publishers belong to one router.
        if version != Some(routers.version()) {
            version = Some(routers.version());
            let open = routers.all();
            publishers.retain(|number, _| open.iter().any(|router| router.number == *number));
            beat = 0;
        }
        if beat.is_multiple_of(SITES_EVERY) {
            match app.all_sites().await {
                Ok(sites) => {
                    for router in routers.all() {
                        let of_router = publishers.entry(router.number).or_default();
                        declare(&router.session, &sites, of_router);
                    }
                }
                Err(error) => warn!("cannot read the sites for the pulse: {error:?}"),
            }
        }
        beat += 1;
        let pulse = ServerPulse {
            server_time: app.clock().now(),
        };
        let Ok(payload) = wire::encode(&pulse) else {
            continue;
        };
        for publisher in publishers.values().flat_map(HashMap::values) {
            // What does not fit on a link is dropped: the next beat comes soon.
            if let Err(error) = publisher.put(payload.clone()).wait() {
                debug!("a beat did not go out: {error}");
            }
        }
    }
}

fn declare(session: &Session, sites: &[SiteId], publishers: &mut Publishers) {
    for site in sites {
        if publishers.contains_key(site) {
            continue;
        }
        let declared = session
            .declare_publisher(keys::pulse(site))
            .congestion_control(CongestionControl::Drop)
            .wait();
        match declared {
            Ok(publisher) => {
                publishers.insert(site.clone(), publisher);
            }
            Err(error) => warn!("cannot declare the pulse of site `{site}`: {error}"),
        }
    }
}
