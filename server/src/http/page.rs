//! The page for people at `/`: the files of `server/dashboard/dist`, part of this program.
//!
//! A browser asks again each time whether a file has changed ([`ETag`](header::ETAG)), so that a
//! new server never runs with parts of an old page.

use std::io::Write as _;
use std::sync::LazyLock;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use flate2::Compression;
use flate2::write::GzEncoder;
use sha2::{Digest as _, Sha256};
use tread_api::problem::ProblemType;

use super::problem::Problem;

/// The route of the page itself.
pub(in crate::http) const ROOT: &str = "/";
/// The route of everything that the page loads.
pub(in crate::http) const FILES: &str = "/page/{file}";
/// How the paths of what the page loads begin.
const FILES_PREFIX: &str = "/page/";
/// Content security policy of the page: it may load files from this server and send requests to it,
/// and nothing else.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
    connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; \
    frame-ancestors 'none'";

/// One file with its headers.
struct File {
    name: &'static str,
    media_type: HeaderValue,
    plain: &'static [u8],
    zipped: Bytes,
    tag: String,
}

macro_rules! file {
    ($name:literal, $media_type:literal) => {
        File::new(
            $name,
            HeaderValue::from_static($media_type),
            include_bytes!(concat!("../../dashboard/dist/", $name)),
        )
    };
}

/// The first is the page itself. Packed once, at the first request.
static DIST: LazyLock<[File; 4]> = LazyLock::new(|| {
    [
        file!("index.html", "text/html; charset=utf-8"),
        file!("app.js", "text/javascript; charset=utf-8"),
        file!("app.css", "text/css; charset=utf-8"),
        file!("icon.svg", "image/svg+xml"),
    ]
});

impl File {
    fn new(name: &'static str, media_type: HeaderValue, plain: &'static [u8]) -> Self {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        // Writing into memory does not fail.
        let zipped = encoder.write_all(plain).and_then(|()| encoder.finish());
        let hash = Sha256::digest(plain);
        let head = hash.first_chunk().copied().unwrap_or_default();
        let tag = format!("{:032x}", u128::from_be_bytes(head));
        Self {
            name,
            media_type,
            plain,
            zipped: zipped.unwrap_or_default().into(),
            tag,
        }
    }

    fn answer(&self, headers: &HeaderMap) -> Response {
        let zips = takes_gzip(headers) && !self.zipped.is_empty();
        // The compressed file is another representation with a tag of its own.
        let tag = format!("\"{}{}\"", self.tag, if zips { "-gz" } else { "" });
        let is_known = headers
            .get_all(header::IF_NONE_MATCH)
            .iter()
            .filter_map(|value| value.to_str().ok())
            .flat_map(|text| text.split(','))
            .any(|known| known.trim().trim_start_matches("W/") == tag);
        let mut response = if is_known {
            StatusCode::NOT_MODIFIED.into_response()
        } else if zips {
            Body::from(self.zipped.clone()).into_response()
        } else {
            Body::from(self.plain).into_response()
        };
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, self.media_type.clone());
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        headers.insert(header::VARY, HeaderValue::from_static("accept-encoding"));
        headers.insert(
            header::CONTENT_SECURITY_POLICY,
            HeaderValue::from_static(POLICY),
        );
        if zips && !is_known {
            let encoding = HeaderValue::from_static("gzip");
            headers.insert(header::CONTENT_ENCODING, encoding);
        }
        if let Ok(tag) = HeaderValue::try_from(tag) {
            headers.insert(header::ETAG, tag);
        }
        response
    }
}

/// Returns whether `Accept-Encoding` names gzip without `q=0`.
fn takes_gzip(headers: &HeaderMap) -> bool {
    headers
        .get_all(header::ACCEPT_ENCODING)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|text| text.split(','))
        .any(|offer| {
            let (name, weight) = offer.split_once(';').unwrap_or((offer, ""));
            let weight = weight.trim().strip_prefix("q=").unwrap_or("1");
            name.trim().eq_ignore_ascii_case("gzip") && weight.parse::<f32>().is_ok_and(|q| q > 0.0)
        })
}

/// The page and what it loads.
pub(in crate::http) fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    Router::new().route(ROOT, get(file)).route(FILES, get(file))
}

async fn file(request: Request) -> Response {
    let path = request.uri().path();
    let name = path.strip_prefix(FILES_PREFIX);
    let found = match name {
        None => DIST.first(),
        Some(name) => DIST.iter().skip(1).find(|file| file.name == name),
    };
    found.map_or_else(
        || {
            Problem::new(ProblemType::NotFound)
                .detail("the dashboard has no file of that name; it is at /")
                .into_response()
        },
        |file| file.answer(request.headers()),
    )
}

/// Returns a refusal as a page for people, without styles and scripts, with a link back.
pub(in crate::http) fn plain(response: Response, kind: ProblemType, detail: &str) -> Response {
    let (title, detail) = (escaped(kind.title()), escaped(detail));
    let text = format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><title>{title}</title>\
         <meta name=\"viewport\" content=\"width=device-width\"></head><body><main><h1>{title}</h1>\
         <p>{detail}.</p><p><a href=\"/\">Back to the sign-in</a></p></main></body></html>"
    );
    let (mut parts, _problem) = response.into_parts();
    let media_type = HeaderValue::from_static("text/html; charset=utf-8");
    parts.headers.insert(header::CONTENT_TYPE, media_type);
    parts.headers.remove(header::CONTENT_LENGTH);
    Response::from_parts(parts, Body::from(text))
}

fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            letter => escaped.push(letter),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asking(encodings: &str) -> HeaderMap {
        let mut headers = HeaderMap::new();
        headers.insert(header::ACCEPT_ENCODING, encodings.parse().unwrap());
        headers
    }

    #[test]
    fn only_those_who_take_gzip_get_it() {
        for (encodings, takes) in [
            ("gzip", true),
            ("br, GZIP;q=0.5", true),
            ("gzip;q=0", false),
            ("gzip; q=0.0, br", false),
            ("br", false),
            ("xgzip", false),
            ("", false),
        ] {
            assert_eq!(takes_gzip(&asking(encodings)), takes, "{encodings}");
        }
    }

    #[test]
    fn what_a_page_says_is_text() {
        let said = "<script>alert('a' & \"b\")</script>";
        let text = escaped(said);
        assert_eq!(
            text,
            "&lt;script&gt;alert(&#39;a&#39; &amp; &quot;b&quot;)&lt;/script&gt;"
        );
    }

    #[test]
    fn the_whole_page_is_small_when_packed() {
        let sum: usize = DIST.iter().map(|file| file.zipped.len()).sum();
        assert!(DIST.iter().all(|file| !file.zipped.is_empty()));
        assert!(sum <= 150 * 1024, "{sum} bytes");
    }
}
