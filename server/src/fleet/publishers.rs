//! What the server publishes for each site, on every router that is open.

use std::collections::HashMap;

use tracing::warn;
use tread_api::ids::SiteId;
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

use super::routers::Routers;

/// Declared publishers of one kind of key: publishing without costs more with every key there is.
pub(super) struct Publishers {
    key_of: fn(&SiteId) -> String,
    version: Option<u64>,
    /// By router and site; publishers belong to one router.
    declared: HashMap<u64, HashMap<SiteId, Publisher<'static>>>,
}

impl Publishers {
    /// None yet.
    pub(super) fn new(key_of: fn(&SiteId) -> String) -> Self {
        Self {
            key_of,
            version: None,
            declared: HashMap::new(),
        }
    }

    /// Forgets routers that are no more; whether there are others than before.
    pub(super) fn look_again(&mut self, routers: &Routers) -> bool {
        if self.version == Some(routers.version()) {
            return false;
        }
        self.version = Some(routers.version());
        let open = routers.all();
        self.declared
            .retain(|number, _| open.iter().any(|router| router.number == *number));
        true
    }

    /// Declares those of these sites that are missing.
    pub(super) fn declare(&mut self, routers: &Routers, sites: &[SiteId]) {
        for router in routers.all() {
            let of_router = self.declared.entry(router.number).or_default();
            for site in sites {
                if of_router.contains_key(site) {
                    continue;
                }
                let key = (self.key_of)(site);
                // What does not fit on a link is dropped: the next word comes soon.
                let declared = router
                    .session
                    .declare_publisher(key.clone())
                    .congestion_control(CongestionControl::Drop)
                    .wait();
                match declared {
                    Ok(publisher) => {
                        of_router.insert(site.clone(), publisher);
                    }
                    Err(error) => warn!("cannot declare the publisher of `{key}`: {error}"),
                }
            }
        }
    }

    /// Those of all sites.
    pub(super) fn all(&self) -> impl Iterator<Item = &Publisher<'static>> {
        self.declared.values().flat_map(HashMap::values)
    }

    /// Those of one site.
    pub(super) fn of(&self, site: &SiteId) -> impl Iterator<Item = &Publisher<'static>> {
        let routers = self.declared.values();
        routers.filter_map(move |of_router| of_router.get(site))
    }
}
