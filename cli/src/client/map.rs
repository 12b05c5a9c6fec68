//! Requests about terrains and the friction map.

use jiff::Timestamp;
use reqwest::Method;
use serde::Serialize;
use tread_api::friction::{
    CellDifference, CellFriction, CreateWithdrawal, PathFriction, PathFrictionRequest,
    PointFriction, PointHistory, RobotContribution, TerrainFriction, TerrainHistory,
    VisitSuggestion, Withdrawal,
};
use tread_api::geometry::Point;
use tread_api::ids::{ConfigurationId, RobotId, SiteId, TerrainId};
use tread_api::page::MapPage;
use tread_api::terrain::{CreateTerrain, ReplaceTerrain, Terrain};

use super::{Client, ClientError, Query};

/// Time as of which the map is read, and selection of robot models.
#[derive(Debug, Clone, Default)]
pub(crate) struct Reading {
    pub(crate) as_of: Option<Timestamp>,
    pub(crate) configuration: Option<ConfigurationId>,
    pub(crate) normalisation: Option<String>,
}

impl Reading {
    fn query(self) -> Query {
        let mut query = Query::new();
        query.extend(self.as_of.map(|at| ("as_of", at.to_string())));
        query.extend(
            self.configuration
                .map(|id| ("configuration", id.to_string())),
        );
        query.extend(self.normalisation.map(|name| ("normalisation", name)));
        query
    }
}

/// Times to which an answer of the map refers, as far as the server sent them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct MapTimes {
    /// Time up to which the first of two compared states includes measurements.
    pub(crate) from: Option<Timestamp>,
    /// Time up to which measurements are included; `None` if all are.
    pub(crate) as_of: Option<Timestamp>,
}

impl MapTimes {
    pub(crate) fn as_of(as_of: Option<Timestamp>) -> Self {
        Self { from: None, as_of }
    }
}

/// Entries of the map with the times to which they refer; JSON contains the entries alone.
#[derive(Debug, Serialize)]
#[serde(transparent)]
pub(crate) struct TimedEntries<T> {
    pub(crate) items: Vec<T>,
    #[serde(skip)]
    pub(crate) of: MapTimes,
}

/// Box of the map, metres in the site frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Area {
    pub(crate) lowest: Point,
    pub(crate) highest: Point,
}

impl Area {
    fn query(self) -> Query {
        vec![
            ("x_min_m", self.lowest.x_m.to_string()),
            ("y_min_m", self.lowest.y_m.to_string()),
            ("x_max_m", self.highest.x_m.to_string()),
            ("y_max_m", self.highest.y_m.to_string()),
        ]
    }
}

/// Equally spaced times of a history.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HistoryTimes {
    pub(crate) from: Timestamp,
    /// The present if absent.
    pub(crate) to: Option<Timestamp>,
    pub(crate) step_s: u64,
}

impl HistoryTimes {
    fn query(self) -> Vec<(&'static str, String)> {
        let mut query = vec![
            ("from", self.from.to_string()),
            ("step_s", self.step_s.to_string()),
        ];
        query.extend(self.to.map(|to| ("to", to.to_string())));
        query
    }
}

fn at_point(point: Point) -> [(&'static str, String); 2] {
    [
        ("x_m", point.x_m.to_string()),
        ("y_m", point.y_m.to_string()),
    ]
}

impl Client {
    pub(crate) async fn terrains(&self, site: &SiteId) -> Result<Vec<Terrain>, ClientError> {
        self.all(&format!("/v1/sites/{site}/terrains")).await
    }

    pub(crate) async fn terrain(
        &self,
        site: &SiteId,
        terrain: &TerrainId,
    ) -> Result<Terrain, ClientError> {
        self.get(&format!("/v1/sites/{site}/terrains/{terrain}"))
            .await
    }

    pub(crate) async fn create_terrain(
        &self,
        site: &SiteId,
        terrain: &CreateTerrain,
    ) -> Result<Terrain, ClientError> {
        self.post(&format!("/v1/sites/{site}/terrains"), terrain)
            .await
    }

    pub(crate) async fn replace_terrain(
        &self,
        site: &SiteId,
        terrain: &TerrainId,
        replacement: &ReplaceTerrain,
    ) -> Result<Terrain, ClientError> {
        let path = format!("/v1/sites/{site}/terrains/{terrain}");
        self.send(self.request(Method::PUT, &path).json(replacement))
            .await
    }

    pub(crate) async fn delete_terrain(
        &self,
        site: &SiteId,
        terrain: &TerrainId,
    ) -> Result<(), ClientError> {
        let path = format!("/v1/sites/{site}/terrains/{terrain}");
        let request = self.request(Method::DELETE, &path);
        self.answered(request).await.map(|_done| ())
    }

    pub(crate) async fn terrain_friction(
        &self,
        site: &SiteId,
        terrain: Option<&TerrainId>,
        reading: Reading,
    ) -> Result<Vec<TerrainFriction>, ClientError> {
        let (path, query) = (
            format!("/v1/sites/{site}/friction/terrains"),
            reading.query(),
        );
        match terrain {
            Some(terrain) => {
                let one = self.get_with(&format!("{path}/{terrain}"), &query).await?;
                Ok(vec![one])
            }
            None => self.all_with(&path, &query).await,
        }
    }

    /// Requests the friction of a terrain at equally spaced times.
    pub(crate) async fn terrain_history(
        &self,
        (site, terrain): (&SiteId, &TerrainId),
        times: HistoryTimes,
        reading: Reading,
    ) -> Result<TerrainHistory, ClientError> {
        let mut query = reading.query();
        query.extend(times.query());
        let path = format!("/v1/sites/{site}/friction/terrains/{terrain}/history");
        self.get_with(&path, &query).await
    }

    /// Requests the friction at a point at equally spaced times.
    pub(crate) async fn point_history(
        &self,
        (site, point): (&SiteId, Point),
        times: HistoryTimes,
        reading: Reading,
    ) -> Result<PointHistory, ClientError> {
        let mut query = reading.query();
        query.extend(times.query());
        query.extend(at_point(point));
        let path = format!("/v1/sites/{site}/friction/point/history");
        self.get_with(&path, &query).await
    }

    /// Lists the friction of cells in a box or of the whole map, merged into squares of the given
    /// side.
    pub(crate) async fn cell_friction(
        &self,
        site: &SiteId,
        area: Option<Area>,
        resolution_m: Option<f64>,
        reading: Reading,
    ) -> Result<TimedEntries<CellFriction>, ClientError> {
        let mut query = reading.query();
        query.extend(area.map(Area::query).unwrap_or_default());
        query.extend(resolution_m.map(|side_m| ("resolution_m", side_m.to_string())));
        self.all_of_map(&format!("/v1/sites/{site}/friction/cells"), &query)
            .await
    }

    pub(crate) async fn point_friction(
        &self,
        site: &SiteId,
        point: Point,
        reading: Reading,
    ) -> Result<PointFriction, ClientError> {
        let mut query = reading.query();
        query.extend(at_point(point));
        self.get_with(&format!("/v1/sites/{site}/friction/point"), &query)
            .await
    }

    pub(crate) async fn path_friction(
        &self,
        site: &SiteId,
        path: &PathFrictionRequest,
    ) -> Result<PathFriction, ClientError> {
        self.post(&format!("/v1/sites/{site}/friction/path"), path)
            .await
    }

    /// Lists the friction before and after of cells that were measured between two times.
    pub(crate) async fn friction_difference(
        &self,
        site: &SiteId,
        (from, to): (Timestamp, Option<Timestamp>),
        area: Option<Area>,
        reading: Reading,
    ) -> Result<TimedEntries<CellDifference>, ClientError> {
        let mut query = reading.query();
        query.push(("from", from.to_string()));
        query.extend(to.map(|to| ("to", to.to_string())));
        query.extend(area.map(Area::query).unwrap_or_default());
        self.all_of_map(&format!("/v1/sites/{site}/friction/difference"), &query)
            .await
    }

    /// Lists the cells with the largest expected gain of a visit, the best first.
    pub(crate) async fn visits(
        &self,
        site: &SiteId,
        area: Area,
        limit: u32,
        reading: Reading,
    ) -> Result<MapPage<VisitSuggestion>, ClientError> {
        let mut query = reading.query();
        query.extend(area.query());
        query.push(("limit", limit.to_string()));
        self.get_with(&format!("/v1/sites/{site}/friction/visits"), &query)
            .await
    }

    /// Requests the map of one robot model as a PNG picture with its legend.
    pub(crate) async fn friction_picture(
        &self,
        site: &SiteId,
        area: Option<Area>,
        resolution_m: Option<f64>,
        scale: Option<u32>,
        reading: Reading,
    ) -> Result<Vec<u8>, ClientError> {
        let mut query = reading.query();
        query.push(("format", "png".to_owned()));
        query.extend(area.map(Area::query).unwrap_or_default());
        query.extend(resolution_m.map(|side_m| ("resolution_m", side_m.to_string())));
        query.extend(scale.map(|pixels| ("scale", pixels.to_string())));
        let path = format!("/v1/sites/{site}/friction/map");
        let request = self.request(Method::GET, &path).query(&query);
        let response = self.answered(request).await?;
        let body = response.bytes().await.map_err(|cause| self.lost(cause))?;
        Ok(body.to_vec())
    }

    pub(crate) async fn contributions(
        &self,
        site: &SiteId,
    ) -> Result<Vec<RobotContribution>, ClientError> {
        self.all(&format!("/v1/sites/{site}/friction/robots")).await
    }

    pub(crate) async fn withdrawals(&self, site: &SiteId) -> Result<Vec<Withdrawal>, ClientError> {
        self.all(&format!("/v1/sites/{site}/withdrawals")).await
    }

    /// Withdraws a robot's measurements of some hours from the map; this cannot be undone.
    pub(crate) async fn withdraw(
        &self,
        site: &SiteId,
        robot: &RobotId,
        withdrawal: &CreateWithdrawal,
    ) -> Result<Withdrawal, ClientError> {
        self.post(
            &format!("/v1/sites/{site}/robots/{robot}/withdrawals"),
            withdrawal,
        )
        .await
    }
}
