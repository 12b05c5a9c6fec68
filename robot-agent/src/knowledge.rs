//! State shared by several parts of the agent: its missions and its site.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tracing::error;
use tread_api::wire::hello::SiteDefinition;

use crate::control_loop::site_view::SiteView;
use crate::missions::MissionSlot;
use crate::missions::memory::Memory;

/// The robot's missions, shared by dispatcher and recorder.
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

    /// Saves the missions on disk. Blocks.
    pub(crate) fn save(&self) {
        // The lock is not held during the disk write.
        let slot = self.slot().clone();
        if let Err(cause) = self.memory.save(&slot) {
            error!(
                error = &cause as &dyn std::error::Error,
                "cannot save the missions"
            );
        }
    }
}

/// The active site definition, for the parts outside the loop.
#[derive(Debug, Default)]
pub(crate) struct SiteCell {
    view: Mutex<Option<(SiteDefinition, Arc<SiteView>)>>,
}

impl SiteCell {
    pub(crate) fn lock(&self) -> MutexGuard<'_, Option<(SiteDefinition, Arc<SiteView>)>> {
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the view that was given to the loop last.
    pub(crate) fn view(&self) -> Option<Arc<SiteView>> {
        self.lock().as_ref().map(|(_, view)| Arc::clone(view))
    }
}
