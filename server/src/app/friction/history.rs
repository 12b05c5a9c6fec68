//! Friction of a terrain or at a point, as known at equally spaced times.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use tread_api::friction::{FrictionAt, ModelFriction, PointHistory, TerrainHistory};
use tread_api::geometry::Point;
use tread_api::ids::{SiteId, TerrainId};

use super::cells::measured_at_point;
use super::present_terrains::PresentTerrains;
use super::timelines::MEASUREMENTS_MAX;
use super::{
    App, AppError, MOVED, MapReader, READS_MAX, Reading, ReadingParameters, SiteView, terrain_ref,
};
use crate::friction::Epoch;
use crate::friction::index::{SiteMap, Timeline};

/// Maximum number of times in one history.
const TIMES_MAX: i64 = 1_000;
/// Maximum number of epochs that a history divides, a day by hours; a history over more, or over
/// more than [`MEASUREMENTS_MAX`] measurements in them, has whole epochs alone.
const DIVIDED_MAX: usize = 25;

/// Equally spaced times, the last of which is `to`.
#[derive(Debug, Clone, Copy)]
pub struct Times {
    /// The oldest one is at this time or less than a step after it.
    pub from: Timestamp,
    /// The newest one; `None` for the present.
    pub to: Option<Timestamp>,
    /// Time between two of them.
    pub step: SignedDuration,
}

/// Checked times of a history, the oldest first.
#[derive(Debug)]
struct Checked {
    times: Vec<Timestamp>,
    is_to_now: bool,
}

impl Times {
    fn checked(self, app: &App) -> Result<Checked, AppError> {
        let Self { from, to, step } = self;
        let now = app.clock().now();
        let invalid = |parameter, detail| AppError::InvalidQuery { parameter, detail };
        if let Some(to) = to.filter(|&to| to > now) {
            let detail = format!("to must not lie in the future; {to} does");
            return Err(invalid("to", detail));
        }
        let is_to_now = to.is_none();
        let to = to.unwrap_or(now);
        if to < from {
            return Err(invalid("to", "to lies before from".to_owned()));
        }
        let steps = to.duration_since(from).as_secs() / step.as_secs().max(1);
        if steps >= TIMES_MAX {
            let detail = format!(
                "the history would have {} times; at most {TIMES_MAX} are allowed",
                steps.saturating_add(1)
            );
            return Err(invalid("step_s", detail));
        }
        let back = |index| step.saturating_mul(i32::try_from(steps - index).unwrap_or(i32::MAX));
        let times = (0..=steps).map(|index| to.checked_sub(back(index)).unwrap_or(from));
        Ok(Checked {
            times: times.collect(),
            is_to_now,
        })
    }
}

impl Checked {
    /// Returns the number of times before the present.
    fn past_count(&self) -> usize {
        self.times.len() - usize::from(self.is_to_now)
    }
}

impl App {
    /// Returns the friction of one terrain as known at several times.
    pub async fn history_of_terrain(
        &self,
        (site, id): (&SiteId, &TerrainId),
        parameters: &ReadingParameters,
        times: Times,
    ) -> Result<TerrainHistory, AppError> {
        let times = times.checked(self)?;
        let reading = Reading::new(self, parameters)?;
        let view = self.site_view(site).await?;
        let terrain = view.find(site, id)?.clone();
        let of_terrain = terrain_ref(&terrain);
        let known = move |reader: &MapReader<'_>, view: &SiteView, reading: &Reading| {
            Ok(reader.app().measured_models(view, reading, &terrain))
        };
        let items = self.known_at(&view, reading, times, known).await?;
        Ok(TerrainHistory {
            terrain: of_terrain,
            items,
        })
    }

    /// Returns the friction at a point as known at several times, from measurements on the terrain
    /// at this point alone.
    pub async fn history_of_point(
        &self,
        site: &SiteId,
        parameters: &ReadingParameters,
        point: Point,
        times: Times,
    ) -> Result<PointHistory, AppError> {
        let times = times.checked(self)?;
        let reading = Reading::new(self, parameters)?;
        let view = self.site_view(site).await?;
        let cell = view.cell_at(point)?;
        let terrain = PresentTerrains::new(&view.terrains).at(point).cloned();
        let of_terrain = terrain.as_ref().map(terrain_ref);
        let known = move |reader: &MapReader<'_>, view: &SiteView, reading: &Reading| {
            measured_at_point(reader, view, reading, cell, terrain.as_ref())
        };
        let items = self.known_at(&view, reading, times, known).await?;
        Ok(PointHistory {
            cell,
            terrain: of_terrain,
            items,
        })
    }

    /// Returns what is known at each time, the oldest first.
    async fn known_at(
        &self,
        view: &Arc<SiteView>,
        reading: Reading,
        times: Checked,
        models: impl Fn(&MapReader<'_>, &SiteView, &Reading) -> Result<Vec<ModelFriction>, AppError>
        + Send
        + Sync
        + 'static,
    ) -> Result<Vec<FrictionAt>, AppError> {
        let shared = Arc::new((reading, times, models));
        for _ in 0..READS_MAX {
            let stamp = self.maps().with_map(&view.row, SiteMap::stamp);
            let timelines = self.timelines_of(view, &shared.1).await?;
            let (view_then, shared) = (Arc::clone(view), Arc::clone(&shared));
            let looking = move |reader: &MapReader<'_>| {
                let (reading, times, models) = &*shared;
                let models = |reading: &Reading| models(reader, &view_then, reading);
                known_at(reader, &view_then, reading, times, &timelines, models)
            };
            let known = self.with_map_reader(looking).await?;
            if self.maps().with_map(&view.row, SiteMap::stamp) == stamp {
                return Ok(known);
            }
        }
        Err(AppError::Unwritable(MOVED.to_owned()))
    }

    /// Returns the measurements of the epochs that the times divide, as far as there are any.
    async fn timelines_of(
        &self,
        view: &SiteView,
        times: &Checked,
    ) -> Result<BTreeMap<Epoch, Arc<Timeline>>, AppError> {
        let row = &view.row;
        let (divided, count) = self.maps().with_map(row, |map| {
            let past = times.times.iter().copied().take(times.past_count());
            let epochs = past.map(|at| (at, map.epoch_at(at)));
            let divided = epochs.filter(|&(at, epoch)| Reading::divides(at, epoch));
            let divided: BTreeSet<Epoch> = divided.map(|(_, epoch)| epoch).collect();
            let some = divided.iter().take(DIVIDED_MAX);
            let count: u64 = some.map(|&epoch| map.measurements_of(epoch)).sum();
            (divided, count)
        });
        let mut timelines = BTreeMap::new();
        if divided.len() <= DIVIDED_MAX && count <= MEASUREMENTS_MAX as u64 {
            for epoch in divided {
                if let Some(timeline) = self.timeline(row, epoch).await? {
                    timelines.insert(epoch, timeline);
                }
            }
        }
        Ok(timelines)
    }
}

/// Returns what is known at each time, the oldest first.
fn known_at(
    reader: &MapReader<'_>,
    view: &SiteView,
    reading: &Reading,
    times: &Checked,
    timelines: &BTreeMap<Epoch, Arc<Timeline>>,
    models: impl Fn(&Reading) -> Result<Vec<ModelFriction>, AppError>,
) -> Result<Vec<FrictionAt>, AppError> {
    let mut then = reading.clone();
    let known = |(index, &at): (usize, &Timestamp)| {
        // The present is read without a time, so that all received measurements count.
        if index == times.past_count() {
            return Ok(FrictionAt {
                at,
                as_of: at,
                models: models(reading)?,
            });
        }
        let epoch = reader.map(&view.row, |map| map.epoch_at(at));
        then.move_to(at, epoch, timelines.get(&epoch).cloned());
        then.advance_sum();
        Ok(FrictionAt {
            at,
            as_of: then.as_of.unwrap_or(at),
            models: models(&then)?,
        })
    };
    times.times.iter().enumerate().map(known).collect()
}
