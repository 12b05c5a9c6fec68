//! What several parts of the agent know together: its missions, and its site.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tracing::error;
use tread_api::wire::hello::SiteDefinition;

use crate::control_loop::site_view::SiteView;
use crate::missions::MissionSlot;
use crate::missions::memory::Memory;

/// The robot's missions, shared by those who answer and those who record.
#[derive(Debug)]
pub(crate) struct Missions {
    slot: Mutex<MissionSlot>,
    memory: Memory,
}

impl Missions {
    pub(crate) fn new(slot: MissionSlot, memory: Memory) -> Arc<Self> {
        Arc::new(Self {
            slot: Mutex::new(slot),
            memory,
        })
    }

    pub(crate) fn slot(&self) -> MutexGuard<'_, MissionSlot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes what is known safe from a crash. Blocks.
    pub(crate) fn save(&self) {
        // The lock is not held while the disk is waited for.
        let slot = self.slot().clone();
        if let Err(cause) = self.memory.save(&slot) {
            error!(
                error = &cause as &dyn std::error::Error,
                "cannot save the missions"
            );
        }
    }
}

/// Where the site's definition is kept for those outside the loop.
#[derive(Debug, Default)]
pub(crate) struct SiteCell {
    view: Mutex<Option<(SiteDefinition, Arc<SiteView>)>>,
}

impl SiteCell {
    pub(crate) fn lock(&self) -> MutexGuard<'_, Option<(SiteDefinition, Arc<SiteView>)>> {
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The view that was last handed to the loop.
    pub(crate) fn view(&self) -> Option<Arc<SiteView>> {
        self.lock().as_ref().map(|(_, view)| Arc::clone(view))
    }
}
