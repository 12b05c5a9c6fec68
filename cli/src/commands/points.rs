//! Points from a file, for paths and borders of terrains.

use std::path::Path;

use anyhow::Context as _;
use tread_api::geometry::Point;
use tread_api::trajectory::Waypoint;

use crate::args::waypoint;

/// Reads points from a file: lines `x,y`, with `#` for comments, or a JSON list.
pub(super) fn read_waypoints(file: &Path) -> anyhow::Result<Vec<Waypoint>> {
    let name = file.display();
    let text = std::fs::read_to_string(file).with_context(|| format!("cannot read {name}"))?;
    if text.trim_start().starts_with('[') {
        return serde_json::from_str(&text).with_context(|| format!("{name} is no list of points"));
    }
    let is_point = |line: &str| !line.trim().is_empty() && !line.trim_start().starts_with('#');
    text.lines()
        .enumerate()
        .filter(|(_, line)| is_point(line))
        .map(|(index, line)| {
            waypoint(line).map_err(|error| anyhow::anyhow!("{name}, line {}: {error}", index + 1))
        })
        .collect()
}

/// Returns the positions of [`read_waypoints`] if a file is given, else the given points.
pub(super) fn read_corners(file: Option<&Path>, given: Vec<Point>) -> anyhow::Result<Vec<Point>> {
    match file {
        None => Ok(given),
        Some(file) => {
            let read = read_waypoints(file)?;
            Ok(read.iter().map(Waypoint::position).collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn points_of(text: &str) -> anyhow::Result<Vec<Waypoint>> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        read_waypoints(file.path())
    }

    #[test]
    fn points_are_read_from_lines_and_from_json() {
        let lines = points_of("# a path\n0,0\n\n 1.5 , -2\n").unwrap();
        let json = points_of(r#"[{"x_m":0,"y_m":0},{"x_m":1.5,"y_m":-2}]"#).unwrap();
        assert_eq!(lines, json);
    }

    #[test]
    fn a_wrong_line_is_named() {
        let error = points_of("0,0\n1;2\n").unwrap_err();
        assert!(error.to_string().contains("line 2"), "{error}");
    }
}
