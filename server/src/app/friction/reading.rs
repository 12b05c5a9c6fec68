//! What a question about the map asks for besides the place: whose measurements, as of when.

use std::sync::Arc;

use jiff::Timestamp;
use tread_api::friction::FusedFriction;
use tread_api::ids::ConfigurationId;

use crate::app::{App, AppError};
use crate::config::FrictionConfig;
use crate::db::sites::SiteRow;
use crate::friction::index::{At, Choice, Group, Normalisation};
use crate::friction::{Ground, fuse};

/// Microseconds of a minute.
const MINUTE_US: i64 = 60_000_000;

/// What is asked for besides the place.
#[derive(Debug, Clone, Default)]
pub struct Asked {
    /// As of when; now when absent.
    pub as_of: Option<Timestamp>,
    /// Only measurements of this configuration.
    pub configuration: Option<ConfigurationId>,
    /// Name of a declared normalisation.
    pub normalisation: Option<String>,
}

/// The same, checked.
#[derive(Debug, Clone)]
pub(in crate::app) struct Reading {
    /// As of when; `None` for all that has come.
    pub(in crate::app) as_of: Option<Timestamp>,
    configuration: Option<ConfigurationId>,
    normalisation: Option<Arc<Normalisation>>,
    config: FrictionConfig,
    /// The time at which ages are counted, microseconds since 1970. Now is rounded to whole minutes,
    /// so that an answer stays the same for as long as its parts do.
    pub(in crate::app) now_us: i64,
}

impl Reading {
    pub(in crate::app) fn new(app: &App, asked: &Asked) -> Result<Self, AppError> {
        let now = app.clock().now();
        if let Some(as_of) = asked.as_of.filter(|&as_of| as_of > now) {
            return Err(AppError::InvalidQuery {
                parameter: "as_of",
                detail: format!("as_of must not lie in the future; {as_of} does"),
            });
        }
        let normalisation = asked.normalisation.as_ref().map(|name| {
            let known = app.normalisations().iter();
            let mut known = known.filter(|normalisation| normalisation.name == *name);
            known.next().cloned().ok_or_else(|| AppError::InvalidQuery {
                parameter: "normalisation",
                detail: format!("no normalisation `{name}` is declared here"),
            })
        });
        let minute_us = now.as_microsecond().div_euclid(MINUTE_US) * MINUTE_US;
        Ok(Self {
            as_of: asked.as_of,
            configuration: asked.configuration,
            normalisation: normalisation.transpose()?,
            config: *app.friction_config(),
            now_us: asked.as_of.map_or(minute_us, Timestamp::as_microsecond),
        })
    }

    /// The same as of the newest time, not after the one that was asked for, at which an epoch of
    /// this site's map was over. Sums are kept per epoch, and nothing tells which part of one was
    /// measured before a time within it.
    pub(in crate::app) fn of_site(self, app: &App, row: &SiteRow) -> Self {
        let Some(as_of) = self.as_of else { return self };
        let effective = app.maps().look(row, |map| map.effective_as_of(as_of));
        self.at(effective)
    }

    /// The same as of another time.
    pub(in crate::app) fn at(&self, at: Timestamp) -> Self {
        Self {
            as_of: Some(at),
            now_us: at.as_microsecond(),
            ..self.clone()
        }
    }

    pub(in crate::app) fn choice(&self) -> Choice<'_> {
        Choice {
            as_of: self.as_of,
            configuration: self.configuration,
            robot: None,
            normalisation: self.normalisation.as_deref(),
        }
    }

    pub(in crate::app) fn normalisation(&self) -> Option<String> {
        let normalisation = self.normalisation.as_ref();
        normalisation.map(|normalisation| normalisation.name.clone())
    }

    /// The configuration in whose θ the answer is, if it is one.
    pub(in crate::app) fn reference(&self) -> Option<ConfigurationId> {
        let normalisation = self.normalisation.as_ref();
        let reference = normalisation.map(|normalisation| normalisation.reference);
        self.configuration.or(reference)
    }

    /// How measurements are weighed, and the time of it.
    pub(in crate::app) fn fused_at(&self) -> At<'_> {
        At {
            config: &self.config,
            now_us: self.now_us,
        }
    }

    /// What a group says together.
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
