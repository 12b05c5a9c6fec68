//! Metrics of the friction map in memory.

use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::{Registry, Unit};

use super::{App, AppError, count};

impl App {
    /// Registers the sums that are not stored yet.
    pub(super) fn register_sums(&self, registry: &mut Registry) {
        let unwritten = self.unwritten_sums();
        let help = "Sums of the map with measurements that are not in the database's sums yet";
        let sums = ConstGauge::new(count(unwritten.sums));
        registry.register("tread_map_sums_unwritten", help, sums);
        let help = "Measurements in these sums";
        let segments = ConstGauge::new(unwritten.segments);
        registry.register("tread_map_segments_unwritten", help, segments);
        let now = self.clock().elapsed();
        let age = unwritten.oldest_at.map(|at| now.saturating_sub(at));
        let age = ConstGauge::new(age.unwrap_or_default().as_secs_f64());
        let help = "Age of the oldest of these sums";
        registry.register_with_unit("tread_map_sums_unwritten_age", help, Unit::Seconds, age);
    }

    /// Registers the blocks of the map's cells.
    pub(super) fn register_map_blocks(&self, registry: &mut Registry) {
        let blocks = self.map_blocks();
        let help = "Blocks of 64 by 64 cells of the map with measurements";
        let driven = ConstGauge::new(count(blocks.driven));
        registry.register("tread_map_blocks", help, driven);
        let help = "Blocks of the map whose cells are in memory";
        let in_memory = ConstGauge::new(count(blocks.in_memory));
        registry.register("tread_map_blocks_in_memory", help, in_memory);
        let help = "Memory of the map's cells, about";
        let bytes = ConstGauge::new(count(blocks.bytes));
        registry.register_with_unit("tread_map_cells", help, Unit::Bytes, bytes);
        let help =
            "Blocks of the map that were read from the database because a request needed them";
        registry.register(
            "tread_map_blocks_read",
            help,
            ConstCounter::new(blocks.read),
        );
        let help = "Blocks of the map that left memory because others needed the room";
        let evicted = ConstCounter::new(blocks.evicted);
        registry.register("tread_map_blocks_evicted", help, evicted);
    }

    /// Registers how many standbys follow the database, or, in a standby, how old its map is.
    pub(super) async fn register_standbys(&self, registry: &mut Registry) -> Result<(), AppError> {
        if let Some(age) = self.map_age() {
            let help = "Time since the map of this standby was up to date";
            let age = ConstGauge::new(age.as_secs_f64());
            registry.register_with_unit("tread_standby_map_age", help, Unit::Seconds, age);
        } else if let Some(standbys) = self.standbys().await? {
            let help = "Standbys that follow the database of this server";
            registry.register("tread_standbys", help, ConstGauge::new(standbys));
        }
        Ok(())
    }
}
