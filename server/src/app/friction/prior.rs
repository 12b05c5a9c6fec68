//! Prior of unmeasured ground, from terrains of the same class elsewhere on the site.
//!
//! It is returned separately from measurements, is marked as a prior, and never enters them.

use std::collections::{BTreeMap, BTreeSet};

use tread_api::friction::{ClassPrior, ModelFriction};
use tread_api::ids::{ConfigurationId, TerrainId};
use tread_api::terrain::{Terrain, TerrainClass};

use super::{Reading, SiteView};

/// Assumed standard deviation of θ between terrains of one class, as a fraction of θ, while few are measured.
const BETWEEN_TERRAINS_RATIO: f64 = 0.4;
/// Number of terrains by which this assumption is weighted.
const ASSUMED_TERRAINS: f64 = 2.0;

/// Measured friction of every terrain of a site.
pub(super) struct Classes {
    terrains: Vec<(TerrainId, TerrainClass, Vec<ModelFriction>)>,
}

impl Classes {
    pub(super) fn new(terrains: Vec<(TerrainId, TerrainClass, Vec<ModelFriction>)>) -> Self {
        Self { terrains }
    }

    /// Returns the friction of a terrain per robot model; a model without a measurement here gets
    /// the prior of the class, if there is one.
    pub(super) fn models(
        &self,
        view: &SiteView,
        reading: &Reading,
        terrain: &Terrain,
    ) -> Vec<ModelFriction> {
        let mut own: BTreeMap<ConfigurationId, ModelFriction> = self
            .terrains
            .iter()
            .filter(|(id, ..)| *id == terrain.id)
            .flat_map(|(_, _, models)| models.iter())
            .map(|model| (model.configuration, model.clone()))
            .collect();
        let elsewhere: BTreeSet<ConfigurationId> = self
            .of_class(terrain)
            .map(|model| model.configuration)
            .collect();
        for configuration in elsewhere {
            let entry = own.entry(configuration).or_insert_with(|| ModelFriction {
                configuration,
                model: view.model(configuration),
                friction: None,
                prior: None,
                normalisation: reading.normalisation(),
            });
            if entry.friction.is_none() {
                entry.prior = self.prior(terrain, configuration);
            }
        }
        own.into_values().collect()
    }

    fn of_class(&self, terrain: &Terrain) -> impl Iterator<Item = &ModelFriction> {
        let (own, wanted) = (terrain.id.clone(), terrain.class);
        self.terrains
            .iter()
            .filter(move |(id, class, _)| *id != own && *class == wanted)
            .flat_map(|(_, _, models)| models.iter())
            .filter(|model| model.friction.is_some())
    }

    /// Returns the mean θ of the class's other terrains, weighted by their spread and standard
    /// deviations.
    pub(super) fn prior(
        &self,
        terrain: &Terrain,
        configuration: ConfigurationId,
    ) -> Option<ClassPrior> {
        let known: Vec<(f64, f64)> = self
            .of_class(terrain)
            .filter(|model| model.configuration == configuration)
            .filter_map(|model| model.friction.map(|known| (known.theta, known.std_dev)))
            .collect();
        let terrains = u32::try_from(known.len()).ok().filter(|&count| count > 0)?;
        let count = f64::from(terrains);
        let plain = known.iter().map(|(theta, _)| theta).sum::<f64>() / count;
        let apart: f64 = known.iter().map(|(theta, _)| (theta - plain).powi(2)).sum();
        let assumed = ASSUMED_TERRAINS * (BETWEEN_TERRAINS_RATIO * plain).powi(2);
        let between_variance = (assumed + apart) / (ASSUMED_TERRAINS + count - 1.0);
        let weight = |std_dev: f64| (between_variance + std_dev * std_dev).recip();
        let sum: f64 = known.iter().map(|&(_, std_dev)| weight(std_dev)).sum();
        let theta = known
            .iter()
            .map(|&(theta, std_dev)| weight(std_dev) * theta)
            .sum::<f64>()
            / sum;
        Some(ClassPrior {
            class: terrain.class,
            theta,
            std_dev: (between_variance + sum.recip()).sqrt(),
            terrains,
        })
    }
}
