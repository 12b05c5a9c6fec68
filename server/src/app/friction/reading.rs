//! Parameters of a map request besides the place: configuration, normalisation and time.

use std::sync::Arc;

use jiff::Timestamp;
use tread_api::friction::FusedFriction;
use tread_api::ids::ConfigurationId;

use crate::app::{App, AppError};
use crate::config::FrictionConfig;
use crate::db::sites::SiteRow;
use crate::friction::index::{Choice, FusionContext, Group, Normalisation, PartialEpoch, Timeline};
use crate::friction::{Epoch, Ground, fuse};

/// Seconds of a minute.
const MINUTE_S: i64 = 60;

/// Parameters of a map request besides the place.
#[derive(Debug, Clone, Default)]
pub struct ReadingParameters {
    /// Only measurements made before this time; `None` for all.
    pub as_of: Option<Timestamp>,
    /// Only measurements of this configuration.
    pub configuration: Option<ConfigurationId>,
    /// Name of a declared normalisation.
    pub normalisation: Option<String>,
}

/// Checked parameters of a map request.
#[derive(Debug, Clone)]
pub(in crate::app) struct Reading {
    /// Only measurements made before this time; `None` for all that were received.
    pub(in crate::app) as_of: Option<Timestamp>,
    /// Measurements of the epoch that `as_of` divides.
    timeline: Option<Arc<Timeline>>,
    /// Sums of those of them from before `as_of`.
    partial: Option<Arc<PartialEpoch>>,
    configuration: Option<ConfigurationId>,
    normalisation: Option<Arc<Normalisation>>,
    config: FrictionConfig,
    /// Time to which ages refer, microseconds since 1970. The present is rounded down to whole
    /// minutes, so that equal requests within a minute get equal answers.
    pub(in crate::app) now_us: i64,
}

impl Reading {
    pub(in crate::app) fn new(app: &App, parameters: &ReadingParameters) -> Result<Self, AppError> {
        let now = app.clock().now();
        if let Some(as_of) = parameters.as_of.filter(|&as_of| as_of > now) {
            return Err(AppError::InvalidQuery {
                parameter: "as_of",
                detail: format!("as_of must not lie in the future; {as_of} does"),
            });
        }
        let normalisation = parameters.normalisation.as_ref().map(|name| {
            let known = app.normalisations().iter();
            let mut known = known.filter(|normalisation| normalisation.name == *name);
            known.next().cloned().ok_or_else(|| AppError::InvalidQuery {
                parameter: "normalisation",
                detail: format!("no normalisation `{name}` is declared here"),
            })
        });
        Ok(Self {
            as_of: parameters.as_of,
            timeline: None,
            partial: None,
            configuration: parameters.configuration,
            normalisation: normalisation.transpose()?,
            config: *app.friction_config(),
            now_us: parameters.as_of.unwrap_or(minute_of(now)).as_microsecond(),
        })
    }

    /// Rounds `as_of` down to a whole minute, or to the end of an epoch of this site's map where the
    /// raw measurements of the epoch are not all there: a sum cannot be divided in time.
    ///
    /// # Errors
    /// The database failed.
    pub(super) async fn of_site(&mut self, app: &App, row: &SiteRow) -> Result<(), AppError> {
        let Some(as_of) = self.as_of else {
            return Ok(());
        };
        let epoch = app.maps().with_map(row, |map| map.epoch_at(as_of));
        let timeline = if Self::divides(as_of, epoch) {
            app.timeline(row, epoch).await?
        } else {
            None
        };
        self.move_to(as_of, epoch, timeline);
        Ok(())
    }

    /// Returns whether a time, rounded down to a minute, divides the epoch that it lies in.
    pub(super) fn divides(at: Timestamp, epoch: Epoch) -> bool {
        minute_of(at) > epoch.begin()
    }

    /// Moves `as_of` to a time within `epoch`, rounded down: to a minute if the measurements of the
    /// epoch are given, else to its begin. Without [`sum`](Self::sum) nothing of the epoch counts.
    pub(super) fn move_to(&mut self, at: Timestamp, epoch: Epoch, timeline: Option<Arc<Timeline>>) {
        self.timeline = timeline.filter(|_| Self::divides(at, epoch));
        self.set_as_of(match self.timeline {
            Some(_) => minute_of(at),
            None => epoch.begin(),
        });
    }

    /// Sums what was measured before `as_of` in the epoch that it divides.
    pub(super) fn sum(&mut self, app: &App) {
        let timeline = self.timeline.as_ref();
        self.partial = timeline.map(|timeline| app.timelines().before(timeline, self.now_us));
    }

    /// Sums the same; fast for rising times of one epoch, if nobody else has these sums.
    pub(super) fn advance_sum(&mut self) {
        let Some(timeline) = &self.timeline else {
            self.partial = None;
            return;
        };
        let same = self.partial.as_mut().and_then(Arc::get_mut);
        let same = same.filter(|same| Arc::ptr_eq(same.timeline(), timeline));
        if let Some(same) = same {
            same.advance(self.now_us);
        } else {
            let partial = PartialEpoch::before(Arc::clone(timeline), self.now_us);
            self.partial = Some(Arc::new(partial));
        }
    }

    /// Returns the number of measurements of the epoch that `as_of` divides.
    pub(super) fn measurements_of_epoch(&self) -> Option<usize> {
        self.timeline.as_ref().map(|timeline| timeline.count())
    }

    fn set_as_of(&mut self, at: Timestamp) {
        self.as_of = Some(at);
        self.now_us = at.as_microsecond();
    }

    /// Returns these parameters for another time, which [`of_site`](Self::of_site) rounds.
    pub(in crate::app) fn at(&self, at: Timestamp) -> Self {
        let mut other = self.clone();
        (other.timeline, other.partial) = (None, None);
        other.set_as_of(at);
        other
    }

    pub(in crate::app) fn choice(&self) -> Choice<'_> {
        Choice {
            as_of: self.as_of,
            partial: self.partial.as_deref(),
            configuration: self.configuration,
            robot: None,
            normalisation: self.normalisation.as_deref(),
        }
    }

    pub(in crate::app) fn normalisation(&self) -> Option<String> {
        let normalisation = self.normalisation.as_ref();
        normalisation.map(|normalisation| normalisation.name.clone())
    }

    /// Returns the configuration to which θ of the answer refers; `None` if there are several.
    pub(in crate::app) fn reference(&self) -> Option<ConfigurationId> {
        let normalisation = self.normalisation.as_ref();
        let reference = normalisation.map(|normalisation| normalisation.reference);
        self.configuration.or(reference)
    }

    /// Returns the fusion's settings and the time to which ages refer.
    pub(in crate::app) fn fused_at(&self) -> FusionContext<'_> {
        FusionContext {
            config: &self.config,
            now_us: self.now_us,
        }
    }

    /// Fuses a group of measurements; `None` if they give no estimate.
    pub(in crate::app) fn fused(
        &self,
        mut group: Group<'_>,
        ground: Ground,
    ) -> Option<FusedFriction> {
        let fused = fuse(&mut group.seen, ground, &self.config, self.now_us);
        fused.map(|fused| {
            fused
                .with_uninformative(group.uninformative_passes)
                .to_api(self.now_us)
        })
    }
}

/// Returns a time rounded down to a whole minute.
fn minute_of(at: Timestamp) -> Timestamp {
    let second = at.as_second();
    Timestamp::from_second(second - second.rem_euclid(MINUTE_S)).unwrap_or(at)
}
