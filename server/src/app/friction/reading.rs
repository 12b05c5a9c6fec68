//! Parameters of a map request besides the place: configuration, normalisation and time.

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

/// Parameters of a map request besides the place.
#[derive(Debug, Clone, Default)]
pub struct Asked {
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
    configuration: Option<ConfigurationId>,
    normalisation: Option<Arc<Normalisation>>,
    config: FrictionConfig,
    /// Time to which ages refer, microseconds since 1970. The present is rounded down to whole
    /// minutes, so that equal requests within a minute get equal answers.
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

    /// Returns these parameters with `as_of` moved back to the end of an epoch of this site's map.
    /// Sums are stored per epoch, so an epoch cannot be split at a time within it.
    pub(in crate::app) fn of_site(self, app: &App, row: &SiteRow) -> Self {
        let Some(as_of) = self.as_of else { return self };
        let effective = app.maps().look(row, |map| map.effective_as_of(as_of));
        self.at(effective)
    }

    /// Returns these parameters as of another time.
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

    /// Returns the configuration to which θ of the answer refers; `None` if there are several.
    pub(in crate::app) fn reference(&self) -> Option<ConfigurationId> {
        let normalisation = self.normalisation.as_ref();
        let reference = normalisation.map(|normalisation| normalisation.reference);
        self.configuration.or(reference)
    }

    /// Returns the fusion's settings and the time to which ages refer.
    pub(in crate::app) fn fused_at(&self) -> At<'_> {
        At {
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
