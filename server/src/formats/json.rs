//! Writes entries as JSON in chunks: as a list of the REST API, or as GeoJSON features.
//!
//! GeoJSON (RFC 7946) allows WGS 84 only. For a georeferenced site each cell is a polygon of
//! longitudes and latitudes. For other sites `geometry` is `null`, so that metres are not mistaken
//! for degrees, and the polygon is in `place`, with `coordRefSys`, as in OGC JSON-FG.

use jiff::Timestamp;
use serde::Serialize;
use serde_json::{Value, json};
use tread_api::friction::CellFriction;
use tread_api::geometry::Point;
use tread_api::site::Site;

use super::geodesy::to_wgs84;
use super::table::{TableError, Writer};

/// Media type of GeoJSON.
pub const GEOJSON_MEDIA_TYPE: &str = "application/geo+json";

/// Function that converts an entry to JSON.
type Write<T> = Box<dyn Fn(&T) -> Result<Value, serde_json::Error> + Send>;

/// Writer of a JSON list, with the text before and after its entries.
struct List<T> {
    before: String,
    after: String,
    entry: Write<T>,
    is_first: bool,
}

impl<T> Writer<T> for List<T> {
    fn begin(&mut self) -> Result<Vec<u8>, TableError> {
        Ok(self.before.clone().into_bytes())
    }

    fn piece(&mut self, entries: &[T]) -> Result<Vec<u8>, TableError> {
        let mut bytes = Vec::new();
        for entry in entries {
            if !std::mem::take(&mut self.is_first) {
                bytes.push(b',');
            }
            bytes.push(b'\n');
            serde_json::to_writer(&mut bytes, &(self.entry)(entry)?)?;
        }
        Ok(bytes)
    }

    fn end(&mut self) -> Result<Vec<u8>, TableError> {
        Ok(self.after.clone().into_bytes())
    }
}

/// Returns a writer of all entries as one page of the REST API. `as_of` is the time to which ages
/// refer.
pub fn page<T: Serialize + 'static>(as_of: Option<Timestamp>) -> Box<dyn Writer<T>> {
    Box::new(List {
        before: "{\"items\":[".to_owned(),
        after: format!("],\"next_cursor\":null,\"as_of\":{}}}\n", json!(as_of)),
        entry: Box::new(|entry: &T| serde_json::to_value(entry)),
        is_first: true,
    })
}

/// Returns a writer of a site's cells as a GeoJSON `FeatureCollection`. `as_of` is the time to
/// which ages refer.
pub fn features(site: &Site, as_of: Option<Timestamp>) -> Box<dyn Writer<CellFriction>> {
    let origin = site.origin;
    let mut head = match origin {
        Some(_) => json!({
            "type": "FeatureCollection",
            "tread:frame": "WGS 84, longitude and latitude in degrees",
        }),
        None => json!({
            "type": "FeatureCollection",
            "conformsTo": ["http://www.opengis.net/spec/json-fg-1/1.0/conf/core"],
            "coordRefSys": format!("urn:tread:site:{}", site.id),
            "tread:frame": "metres in the site's own frame, which is not georeferenced",
        }),
    };
    head["tread:as_of"] = json!(as_of);
    let mut before = head.to_string();
    // Remove the closing brace: the list of features is the last member.
    before.pop();
    before.push_str(",\"features\":[");
    Box::new(List {
        before,
        after: "]}\n".to_owned(),
        entry: Box::new(move |entry: &CellFriction| {
            let (x, y) = (f64::from(entry.cell.ix), f64::from(entry.cell.iy));
            let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)];
            let corners = corners.map(|(right, up)| Point {
                x_m: (x + right) * entry.size_m,
                y_m: (y + up) * entry.size_m,
            });
            let ring = corners.map(|corner| match origin {
                Some(origin) => to_wgs84(origin, corner),
                None => [corner.x_m, corner.y_m],
            });
            let polygon = json!({"type": "Polygon", "coordinates": [ring]});
            let properties = serde_json::to_value(entry)?;
            Ok(match origin {
                Some(_) => {
                    json!({"type": "Feature", "geometry": polygon, "properties": properties})
                }
                None => json!({"type": "Feature", "geometry": null, "place": polygon,
                               "properties": properties}),
            })
        }),
        is_first: true,
    })
}
