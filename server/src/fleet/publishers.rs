//! Publishers of the server for each site, on every open router.

use std::collections::HashMap;

use tracing::warn;
use tread_api::ids::SiteId;
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

use super::routers::Routers;

/// Declared publishers of one kind of key; publishing without a declaration becomes slower with the
/// number of keys.
pub(super) struct Publishers {
    key_of: fn(&SiteId) -> String,
    version: Option<u64>,
    /// Publishers by router and site.
    declared: HashMap<u64, HashMap<SiteId, Publisher<'static>>>,
}

impl Publishers {
    /// Creates an empty set.
    pub(super) fn new(key_of: fn(&SiteId) -> String) -> Self {
        Self {
            key_of,
            version: None,
            declared: HashMap::new(),
        }
    }

    /// Forgets closed routers; returns whether the list of routers has changed.
    pub(super) fn refresh(&mut self, routers: &Routers) -> bool {
        if self.version == Some(routers.version()) {
            return false;
        }
        self.version = Some(routers.version());
        let open = routers.all();
        self.declared
            .retain(|number, _| open.iter().any(|router| router.number == *number));
        true
    }

    /// Declares the missing publishers of these sites.
    pub(super) fn declare(&mut self, routers: &Routers, sites: &[SiteId]) {
        for router in routers.all() {
            let of_router = self.declared.entry(router.number).or_default();
            for site in sites {
                if of_router.contains_key(site) {
                    continue;
                }
                let key = (self.key_of)(site);
                // A message that does not fit on a link is dropped, since the next one follows
                // soon.
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

    /// Returns the publishers of all sites.
    pub(super) fn all(&self) -> impl Iterator<Item = &Publisher<'static>> {
        self.declared.values().flat_map(HashMap::values)
    }

    /// Returns the publishers of one site.
    pub(super) fn of(&self, site: &SiteId) -> impl Iterator<Item = &Publisher<'static>> {
        let routers = self.declared.values();
        routers.filter_map(move |of_router| of_router.get(site))
    }
}
