//! Cuts the estimator's measurements into segments: one cell, one ground, one pass.
//!
//! ```text
//!              moved to a cell on one ground                 wheels on two grounds, no cell
//! unmapped ────────────────────────────────► measuring(cell, terrain) ───────► unmapped
//!                                              └ next cell, other terrain, changed ground,
//!                                                other mission, SEGMENT_MAX over: close, reopen
//! ```
//! A segment holds what was measured since the estimator's last close; what was measured while
//! unmapped is discarded. A segment without information on θ is discarded too.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use tread_api::ids::MissionId;
use tread_api::site::Cell;
use tread_control::estimation::Estimator;

use super::channels::ClosedSegment;
use super::site_view::SiteView;

/// Longest duration of a segment; at this age it is closed and the next one opened.
pub(crate) const SEGMENT_MAX: Duration = Duration::from_secs(30);

/// Cell and terrain at a robot's position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) cell: Cell,
    /// Index in the site's terrains; `None` where no terrain is drawn.
    pub(crate) terrain: Option<usize>,
}

/// Time of a tick, by both clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Moment {
    pub(crate) monotonic: Duration,
    pub(crate) wall: Timestamp,
}

#[derive(Debug, Clone, Copy)]
struct Open {
    place: Place,
    since: Moment,
    distance_m: f64,
}

/// Input of a tick.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CutInput<'tick> {
    pub(crate) now: Moment,
    /// Cell and terrain; `None` without a site or a pose, outside the grid, or with wheels on two
    /// grounds.
    pub(crate) place: Option<Place>,
    pub(crate) site: Option<&'tick Arc<SiteView>>,
    pub(crate) mission: Option<MissionId>,
    /// Distance travelled in this tick, metres.
    pub(crate) driven_m: f64,
    /// Whether the estimator detected a change of ground.
    pub(crate) ground_changed: bool,
}

/// Result of a tick.
#[derive(Debug, Default)]
pub(crate) struct Cut {
    /// Closed segment with information on θ.
    pub(crate) segment: Option<ClosedSegment>,
    /// Whether the estimator was reset for other ground.
    pub(crate) is_new_ground: bool,
}

/// Cuts segments.
#[derive(Debug, Default)]
pub(crate) struct SegmentCutter {
    open: Option<Open>,
    mission: Option<MissionId>,
}

impl SegmentCutter {
    /// Returns the cell of the open segment.
    pub(crate) fn cell(&self) -> Option<Cell> {
        self.open.map(|open| open.place.cell)
    }

    /// Processes one tick, after the estimator has taken its samples.
    pub(crate) fn step(&mut self, input: CutInput<'_>, estimator: &mut Estimator) -> Cut {
        let Some(open) = &mut self.open else {
            if input.ground_changed && input.place.is_none() {
                // It belongs to no cell, and is other ground all the same.
                estimator.begin_ground();
                return Cut {
                    segment: None,
                    is_new_ground: true,
                };
            }
            return self.start_at(input, estimator);
        };
        open.distance_m += input.driven_m;
        let is_same_place = input.place == Some(open.place);
        let is_same_mission = input.mission == self.mission;
        let is_full = input.now.monotonic.saturating_sub(open.since.monotonic) >= SEGMENT_MAX;
        if is_same_place && is_same_mission && !input.ground_changed && !is_full {
            return Cut::default();
        }
        let closed = *open;
        let mission = self.mission;
        let segment = close(closed, mission, input, estimator);
        let is_new_ground = input.ground_changed
            || input
                .place
                .is_none_or(|place| place.terrain != closed.place.terrain);
        if is_new_ground {
            estimator.begin_ground();
        }
        self.open = input.place.map(|place| Open {
            place,
            since: input.now,
            distance_m: 0.0,
        });
        self.mission = input.mission;
        Cut {
            segment,
            is_new_ground,
        }
    }

    fn start_at(&mut self, input: CutInput<'_>, estimator: &mut Estimator) -> Cut {
        if let Some(place) = input.place {
            // What was measured before belongs to no cell.
            estimator.begin_ground();
            self.open = Some(Open {
                place,
                since: input.now,
                distance_m: 0.0,
            });
            self.mission = input.mission;
        }
        Cut {
            segment: None,
            is_new_ground: input.place.is_some(),
        }
    }

    /// Discards the open segment, because the site definition was replaced.
    pub(crate) fn abandon(&mut self, estimator: &mut Estimator) {
        self.open = None;
        estimator.begin_ground();
    }
}

fn close(
    open: Open,
    mission: Option<MissionId>,
    input: CutInput<'_>,
    estimator: &mut Estimator,
) -> Option<ClosedSegment> {
    let statistics = estimator.close_segment();
    let site = input.site?;
    let is_informative = statistics.theta_information > 0.0
        && statistics.theta_weighted.is_finite()
        && statistics.samples > 0;
    if !is_informative {
        return None;
    }
    Some(ClosedSegment {
        site: Arc::clone(site),
        mission,
        started_at: open.since.wall,
        // By the monotonic clock: the wall clock may be set meanwhile, by any amount.
        ended_at: open
            .since
            .wall
            .checked_add(input.now.monotonic.saturating_sub(open.since.monotonic))
            .unwrap_or(open.since.wall),
        cell: open.place.cell,
        terrain: open.place.terrain,
        distance_m: open.distance_m,
        saturation_ratio: statistics.saturation_ratio,
        statistics,
    })
}
