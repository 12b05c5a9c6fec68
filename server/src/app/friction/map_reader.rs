//! Reads the map on a blocking thread, so that computing under the map's lock does not block other
//! requests. Blocks of cells that are needed and not in memory are loaded from the database first,
//! without a turn to compute.

use std::cell::RefCell;
use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinError;
use tokio_util::sync::CancellationToken;

use super::{App, AppError};
use crate::app::map::Pins;
use crate::db::sites::SiteRow;
use crate::friction::index::{Cells, MissingBlocks, SiteMap};

/// Maximum number of answers that are computed at once.
const COMPUTING_MAX: usize = 4;
/// Maximum number of requests that compute or wait for blocks, and of robots' missions. Each has a
/// thread, so both together are far fewer than the runtime has.
const READERS_MAX: usize = 64;

/// Limits of the number of map readers.
#[derive(Debug)]
pub(in crate::app) struct ReaderSlots {
    computing: Arc<Semaphore>,
    requests: Arc<Semaphore>,
    robots: Arc<Semaphore>,
}

impl Default for ReaderSlots {
    fn default() -> Self {
        Self {
            computing: Arc::new(Semaphore::new(COMPUTING_MAX)),
            requests: Arc::new(Semaphore::new(READERS_MAX)),
            robots: Arc::new(Semaphore::new(READERS_MAX)),
        }
    }
}

impl ReaderSlots {
    /// Waits for a turn to compute. `None` cannot occur, since the semaphore is never closed.
    async fn computing(&self) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.computing).acquire_owned().await.ok()
    }

    /// Waits for a slot for a request or a robot's mission, as [`Self::computing`].
    async fn slot(&self, is_for_robot: bool) -> Option<OwnedSemaphorePermit> {
        let slots = if is_for_robot {
            &self.robots
        } else {
            &self.requests
        };
        Arc::clone(slots).acquire_owned().await.ok()
    }
}

/// Reads maps on a blocking thread.
pub(in crate::app) struct MapReader<'app> {
    app: &'app App,
    runtime: Handle,
    /// The turn to compute; `None` while blocks are loaded.
    turn: RefCell<Option<OwnedSemaphorePermit>>,
    /// Whether the map is read for a robot's mission, which waits for no request.
    is_for_robot: bool,
    /// Cancelled when nobody waits for the answer any more.
    abandoned: CancellationToken,
}

impl<'app> MapReader<'app> {
    /// Returns the use cases.
    pub(in crate::app) fn app(&self) -> &'app App {
        self.app
    }

    /// Reads a site's map without its cells.
    pub(super) fn map<T>(&self, row: &SiteRow, read: impl FnOnce(&SiteMap) -> T) -> T {
        self.app.maps().with_map(row, read)
    }

    /// Reads the cells of a site's map. If `read` needs blocks that are not in memory, they are loaded and
    /// `read` is called again, so it must have no side effects.
    ///
    /// # Errors
    /// The database failed; [`AppError::MapReadTooLarge`] if it needs too many blocks at once;
    /// [`AppError::Abandoned`] if the request was abandoned.
    pub(super) fn cells<T>(
        &self,
        row: &SiteRow,
        read: impl Fn(Cells<'_>) -> T,
    ) -> Result<T, AppError> {
        let mut pins = Pins::default();
        let found = self.cells_with(row, read, &mut pins);
        if !pins.is_empty() {
            drop(pins);
            self.app.maps().evict();
        }
        found
    }

    fn cells_with<T>(
        &self,
        row: &SiteRow,
        read: impl Fn(Cells<'_>) -> T,
        pins: &mut Pins,
    ) -> Result<T, AppError> {
        let mut turn = None;
        loop {
            let absent = MissingBlocks::default();
            let answer = self.app.maps().read_cells(row, &absent, &read);
            let absent = absent.into_blocks();
            if absent.is_empty() {
                return Ok(answer);
            }
            if self.abandoned.is_cancelled() {
                return Err(AppError::Abandoned);
            }
            // Others compute meanwhile.
            drop(self.turn.take());
            let loading = async {
                if turn.is_none() {
                    turn = self.app.maps().load_turn(self.is_for_robot).await;
                }
                let loaded = self.app.load_blocks(row, &absent, pins).await;
                (loaded, self.app.reader_slots().computing().await)
            };
            let (loaded, computing) = self.runtime.block_on(loading);
            *self.turn.borrow_mut() = computing;
            loaded?;
        }
    }
}

impl App {
    fn reader_slots(&self) -> &ReaderSlots {
        &self.inner.reader_slots
    }

    /// Runs work on the map on a blocking thread.
    pub(in crate::app) async fn with_map_reader<T: Send + 'static>(
        &self,
        work: impl FnOnce(&MapReader<'_>) -> T + Send + 'static,
    ) -> T {
        self.run_map_reader(false, work).await
    }

    /// Runs work on the map for a robot's mission on a blocking thread.
    pub(super) async fn with_map_reader_for_robot<T: Send + 'static>(
        &self,
        work: impl FnOnce(&MapReader<'_>) -> T + Send + 'static,
    ) -> T {
        self.run_map_reader(true, work).await
    }

    /// Runs work that reads no blocks of the map on a blocking thread.
    pub(super) async fn compute<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> T {
        let turn = self.reader_slots().computing().await;
        let computing = move || {
            let done = work();
            drop(turn);
            done
        };
        done(tokio::task::spawn_blocking(computing).await).await
    }

    async fn run_map_reader<T: Send + 'static>(
        &self,
        is_for_robot: bool,
        work: impl FnOnce(&MapReader<'_>) -> T + Send + 'static,
    ) -> T {
        let slots = self.reader_slots();
        let slot = slots.slot(is_for_robot).await;
        let turn = slots.computing().await;
        let abandoned = CancellationToken::new();
        let _waiting = abandoned.clone().drop_guard();
        let (app, runtime) = (self.clone(), Handle::current());
        let reading = move || {
            let reader = MapReader {
                app: &app,
                runtime,
                turn: RefCell::new(turn),
                is_for_robot,
                abandoned,
            };
            let done = work(&reader);
            drop(slot);
            done
        };
        done(tokio::task::spawn_blocking(reading).await).await
    }
}

/// Returns what a blocking thread has returned.
async fn done<T>(ended: Result<T, JoinError>) -> T {
    match ended {
        Ok(done) => done,
        Err(broken) => match broken.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            // The runtime is shutting down, and this task with it.
            Err(_cancelled) => std::future::pending().await,
        },
    }
}

/// Reads fewer things at once as long as they need too much memory.
pub(super) fn smaller<T>(
    at_once: &mut usize,
    read: impl Fn(usize) -> Result<T, AppError>,
) -> Result<T, AppError> {
    loop {
        match read(*at_once) {
            Err(AppError::MapReadTooLarge { .. }) if *at_once > 1 => *at_once = at_once.div_ceil(8),
            found => return found,
        }
    }
}

/// Returns what is found for each of some places, a number of them at once or fewer.
pub(super) fn in_parts<P, T>(
    places: &[P],
    mut at_once: usize,
    read: impl Fn(&[P]) -> Result<Vec<T>, AppError>,
) -> Result<Vec<T>, AppError> {
    let mut found = Vec::with_capacity(places.len());
    let mut rest = places;
    while !rest.is_empty() {
        let some = smaller(&mut at_once, |at_once| {
            let some = rest.get(..at_once).unwrap_or(rest);
            Ok((some.len(), read(some)?))
        });
        let (count, some) = some?;
        found.extend(some);
        rest = rest.get(count..).unwrap_or_default();
    }
    Ok(found)
}
