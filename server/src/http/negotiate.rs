//! Chooses the format of a response: by `format=`, or else by the `Accept` header.

use axum::http::{HeaderMap, header};
use tread_api::problem::ProblemType;

use super::problem::Problem;

/// A format of a response.
pub(super) trait ResponseFormat: Copy {
    /// Returns its media type.
    fn media_type(self) -> &'static str;
}

/// Returns the requested format; the first offered one by default. Each has its name in `format=`.
pub(super) fn choose<T: ResponseFormat>(
    offered: &[(&'static str, T)],
    format: Option<&str>,
    headers: &HeaderMap,
) -> Result<T, Problem> {
    let names = || {
        let names: Vec<&str> = offered.iter().map(|(name, _)| *name).collect();
        names.join("`, `")
    };
    if let Some(format) = format {
        let found = offered.iter().find(|(name, _)| *name == format);
        return found.map(|(_, format)| *format).ok_or_else(|| {
            let short: String = format.chars().take(40).collect();
            let detail = format!("this route has no format `{short}`, only `{}`", names());
            Problem::new(ProblemType::InvalidQuery)
                .detail(detail)
                .field("format")
        });
    }
    let accepted = headers.get_all(header::ACCEPT).into_iter();
    let accepted: Vec<&str> = accepted
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .collect();
    let weighed = offered
        .iter()
        .map(|(_, format)| (*format, weight(&accepted, format.media_type())));
    // Of equal weights the first.
    let best = weighed
        .filter(|(_, weight)| *weight > 0.0)
        .fold(None::<(T, f64)>, |best, next| match best {
            Some(best) if best.1 >= next.1 => Some(best),
            Some(_) | None => Some(next),
        });
    best.map(|(format, _)| format).ok_or_else(|| {
        let detail = format!("request one of these formats with `format=`: `{}`", names());
        Problem::new(ProblemType::NotAcceptable).detail(detail)
    })
}

/// Returns the weight of a media type, 0 to 1: the most specific entry counts.
fn weight(accepted: &[&str], media_type: &str) -> f64 {
    if accepted.is_empty() {
        return 1.0;
    }
    let of_kind = media_type.split('/').next().unwrap_or_default();
    let mut found: Option<(u8, f64)> = None;
    for entry in accepted {
        let mut parts = entry.split(';').map(str::trim);
        let range = parts.next().unwrap_or_default().to_ascii_lowercase();
        let quality = parts.find_map(|part| part.strip_prefix("q="));
        let quality = quality.map_or(Some(1.0), |text| text.parse::<f64>().ok());
        let quality = quality.filter(|quality| (0.0..=1.0).contains(quality));
        let precision = match range.split_once('/') {
            Some(("*", "*")) => 0,
            Some((kind, "*")) if kind == of_kind => 1,
            Some(_) if range == media_type => 2,
            Some(_) | None => continue,
        };
        let quality = quality.unwrap_or(0.0);
        if found.is_none_or(|(most, _)| precision > most) {
            found = Some((precision, quality));
        }
    }
    found.map_or(0.0, |(_, quality)| quality)
}

#[cfg(test)]
mod tests {
    use super::*;

    const OFFERED: [(&str, char); 3] = [("json", 'j'), ("png", 'p'), ("csv", 'c')];

    impl ResponseFormat for char {
        fn media_type(self) -> &'static str {
            match self {
                'j' => "application/json",
                'p' => "image/png",
                _ => "text/csv",
            }
        }
    }

    fn chosen(format: Option<&str>, accept: Option<&str>) -> Result<char, Problem> {
        let mut headers = HeaderMap::new();
        if let Some(accept) = accept {
            headers.insert(header::ACCEPT, accept.parse().unwrap());
        }
        choose(&OFFERED, format, &headers)
    }

    #[test]
    fn the_parameter_wins_over_the_header_and_the_header_over_the_order() {
        assert_eq!(chosen(None, None), Ok('j'));
        assert_eq!(chosen(None, Some("*/*")), Ok('j'));
        assert_eq!(chosen(None, Some("image/png")), Ok('p'));
        assert_eq!(chosen(Some("csv"), Some("image/png")), Ok('c'));
        assert_eq!(chosen(None, Some("image/*, */*;q=0.1")), Ok('p'));
        assert_eq!(
            chosen(None, Some("text/html, text/csv;q=0.2, image/png;q=0.9")),
            Ok('p')
        );
        assert_eq!(chosen(None, Some("*/*, application/json;q=0")), Ok('p'));
    }

    #[test]
    fn what_is_not_there_is_refused_and_what_is_there_is_named() {
        let said = format!("{:?}", chosen(Some("gif"), None).unwrap_err());
        assert!(said.contains("gif") && said.contains("png") && said.contains("InvalidQuery"));
        let said = format!("{:?}", chosen(None, Some("image/gif")).unwrap_err());
        assert!(said.contains("NotAcceptable") && said.contains("csv"));
        assert!(chosen(None, Some("image/png;q=x")).is_err());
    }
}
