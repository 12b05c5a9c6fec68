//! Publishes the areas in which friction maps change, for programs on the network.

use std::collections::HashMap;
use std::sync::Arc;

use tokio::sync::broadcast::error::RecvError;
use tokio_util::sync::CancellationToken;
use tracing::debug;
use tread_api::friction::MapChange;
use tread_api::ids::SiteId;
use tread_api::{keys, wire};
use zenoh::Wait as _;

use super::publishers::Publishers;
use super::republish::Republisher;
use super::routers::Routers;
use crate::app::App;

/// Publishes until the stop.
pub(super) async fn run(
    app: App,
    routers: Arc<Routers>,
    republisher: Option<Republisher>,
    stop: CancellationToken,
) {
    let mut changes = app.map_changes();
    let mut publishers = Publishers::new(keys::map);
    // Number of changes that were missed, and number published by site.
    let mut missed: u64 = 0;
    let mut announced: HashMap<SiteId, u64> = HashMap::new();
    loop {
        let heard = tokio::select! {
            biased;
            () = stop.cancelled() => return,
            heard = changes.recv() => heard,
        };
        let mut change = match heard {
            Ok(change) => change,
            Err(RecvError::Lagged(words)) => {
                missed += words;
                continue;
            }
            Err(RecvError::Closed) => {
                stop.cancelled().await;
                return;
            }
        };
        if announced.insert(change.site.clone(), missed).unwrap_or(0) < missed {
            change.entire_map = true;
            change.boxes.clear();
        }
        publishers.refresh(&routers);
        publish(&change, &routers, &mut publishers, republisher.as_ref());
    }
}

fn publish(
    change: &MapChange,
    routers: &Routers,
    publishers: &mut Publishers,
    republisher: Option<&Republisher>,
) {
    let Ok(payload) = wire::encode(change) else {
        return;
    };
    if let Some(republisher) = republisher {
        republisher.publish(keys::map(&change.site), payload.clone());
    }
    publishers.declare(routers, std::slice::from_ref(&change.site));
    for publisher in publishers.of(&change.site) {
        if let Err(error) = publisher.put(payload.clone()).wait() {
            debug!("a change of the map did not go out: {error}");
        }
    }
}
