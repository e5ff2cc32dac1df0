//! The page: files embedded in the program, and the headers of every response.

use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
    X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::response::{IntoResponse, Response};

/// Content security policy. The page may load its own files and connect to its own server, and
/// nothing else.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' \
                      data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
                      frame-ancestors 'none'";

/// Headers that prevent pages of other sites from opening or loading this page, and deny it the use
/// of devices.
const OTHERS: [(&str, &str); 3] = [
    ("cross-origin-opener-policy", "same-origin"),
    ("cross-origin-resource-policy", "same-origin"),
    (
        "permissions-policy",
        "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    ),
];

/// Header value that makes a browser use only TLS for a year (31 536 000 s).
pub(crate) const TRANSPORT_SECURITY: &str = "max-age=31536000";

/// A file of the page.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Asset {
    pub(crate) path: &'static str,
    content_type: &'static str,
    content: &'static str,
}

const SCRIPT: &str = "text/javascript; charset=utf-8";
const STYLE: &str = "text/css; charset=utf-8";

macro_rules! asset {
    ($path:literal, $content_type:expr, $file:literal) => {
        Asset {
            path: $path,
            content_type: $content_type,
            content: include_str!($file),
        }
    };
}

/// All files of the page.
pub(crate) const ASSETS: &[Asset] = &[
    asset!("/", "text/html; charset=utf-8", "../page/index.html"),
    asset!("/icon.svg", "image/svg+xml", "../page/icon.svg"),
    asset!("/style.css", STYLE, "../page/style.css"),
    asset!("/uplot.css", STYLE, "../vendor/uplot/uPlot.min.css"),
    asset!("/uplot.js", SCRIPT, "../vendor/uplot/uPlot.iife.min.js"),
    asset!(
        "/uplot-licence.txt",
        "text/plain; charset=utf-8",
        "../vendor/uplot/LICENSE"
    ),
    asset!("/app.js", SCRIPT, "../page/app.js"),
    asset!("/chart.js", SCRIPT, "../page/chart.js"),
    asset!("/compare.js", SCRIPT, "../page/compare.js"),
    asset!("/map.js", SCRIPT, "../page/map.js"),
    asset!("/report.js", SCRIPT, "../page/report.js"),
    asset!("/spectrogram.js", SCRIPT, "../page/spectrogram.js"),
    asset!("/entrance.js", SCRIPT, "../page/entrance.js"),
    asset!("/english.js", SCRIPT, "../page/english.js"),
    asset!("/german.js", SCRIPT, "../page/german.js"),
    asset!("/language.js", SCRIPT, "../page/language.js"),
    asset!("/course.js", SCRIPT, "../page/course.js"),
    asset!("/connection.js", SCRIPT, "../page/connection.js"),
    asset!("/dom.js", SCRIPT, "../page/dom.js"),
    asset!("/words.js", SCRIPT, "../page/words.js"),
    asset!("/overview.js", SCRIPT, "../page/overview.js"),
    asset!("/structure.js", SCRIPT, "../page/structure.js"),
    asset!("/drawing.js", SCRIPT, "../page/drawing.js"),
    asset!("/marks.js", SCRIPT, "../page/marks.js"),
    asset!("/nodes.js", SCRIPT, "../page/nodes.js"),
    asset!("/note.js", SCRIPT, "../page/note.js"),
    asset!("/plot.js", SCRIPT, "../page/plot.js"),
    asset!("/plots.js", SCRIPT, "../page/plots.js"),
    asset!("/span.js", SCRIPT, "../page/span.js"),
    asset!("/alerts.js", SCRIPT, "../page/alerts.js"),
    asset!("/address.js", SCRIPT, "../page/address.js"),
    asset!("/events.js", SCRIPT, "../page/events.js"),
    asset!("/groups.js", SCRIPT, "../page/groups.js"),
    asset!("/lasting.js", SCRIPT, "../page/lasting.js"),
    asset!("/log.js", SCRIPT, "../page/log.js"),
    asset!("/model.js", SCRIPT, "../page/model.js"),
    asset!("/now.js", SCRIPT, "../page/now.js"),
    asset!("/parameters.js", SCRIPT, "../page/parameters.js"),
    asset!("/ranges.js", SCRIPT, "../page/ranges.js"),
    asset!("/samples.js", SCRIPT, "../page/samples.js"),
    asset!("/search.js", SCRIPT, "../page/search.js"),
    asset!("/sensors.js", SCRIPT, "../page/sensors.js"),
    asset!("/sensorsmalls.js", SCRIPT, "../page/sensorsmalls.js"),
    asset!("/settings.js", SCRIPT, "../page/settings.js"),
    asset!("/shapes.js", SCRIPT, "../page/shapes.js"),
    asset!("/smalls.js", SCRIPT, "../page/smalls.js"),
    asset!("/sorting.js", SCRIPT, "../page/sorting.js"),
    asset!("/sparklines.js", SCRIPT, "../page/sparklines.js"),
    asset!("/spectra.js", SCRIPT, "../page/spectra.js"),
    asset!("/tabs.js", SCRIPT, "../page/tabs.js"),
    asset!("/time.js", SCRIPT, "../page/time.js"),
    asset!("/waveforms.js", SCRIPT, "../page/waveforms.js"),
    asset!("/year.js", SCRIPT, "../page/year.js"),
];

impl IntoResponse for Asset {
    fn into_response(self) -> Response {
        ([(CONTENT_TYPE, self.content_type)], self.content).into_response()
    }
}

/// Adds the headers that every response has.
pub(crate) async fn with_headers(mut response: Response) -> Response {
    let headers: &mut HeaderMap = response.headers_mut();
    // A report of an earthquake has a stricter policy of its own.
    headers
        .entry(CONTENT_SECURITY_POLICY)
        .or_insert(HeaderValue::from_static(POLICY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(X_FRAME_OPTIONS, HeaderValue::from_static("DENY"));
    for (name, value) in OTHERS {
        headers.insert(
            HeaderName::from_static(name),
            HeaderValue::from_static(value),
        );
    }
    // Browsers must not show cached files of an earlier program version.
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    response
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::{BTreeMap, BTreeSet};

    #[test]
    fn page_requests_only_its_own_files() {
        for asset in ASSETS
            .iter()
            .filter(|asset| !asset.path.starts_with("/uplot"))
        {
            for line in asset
                .content
                .lines()
                .filter(|line| !line.contains("http://www.w3.org/"))
            {
                assert!(
                    !line.contains("http://") && !line.contains("https://"),
                    "{}: {line}",
                    asset.path
                );
                assert!(!line.contains("innerHTML"), "{}: {line}", asset.path);
            }
        }
    }

    #[test]
    fn every_file_that_the_page_names_is_served() {
        let served = |path: &str| ASSETS.iter().any(|asset| asset.path == path);
        for asset in ASSETS
            .iter()
            .filter(|asset| asset.path == "/" || asset.content_type == SCRIPT)
        {
            let names = asset.content.split(['"', '\'']).filter(|text| {
                let is_file =
                    text.ends_with(".js") || text.ends_with(".css") || text.ends_with(".svg");
                is_file && (text.starts_with('/') || text.starts_with("./")) && !text.contains(' ')
            });
            for name in names {
                let path = name.strip_prefix('.').unwrap_or(name);
                assert!(served(path), "{} names {name}", asset.path);
            }
        }
    }

    /// Returns the keys of a table of words, each with its words.
    fn table(path: &str) -> BTreeMap<&'static str, &'static str> {
        let asset = ASSETS.iter().find(|asset| asset.path == path).unwrap();
        let entry = |line: &'static str| {
            let (key, words) = line.trim().strip_prefix('"')?.split_once("\": \"")?;
            Some((key, words.strip_suffix("\",")?))
        };
        let entries: Vec<_> = asset.content.lines().filter_map(entry).collect();
        let table: BTreeMap<_, _> = entries.iter().copied().collect();
        assert_eq!(table.len(), entries.len(), "{path} has a key twice");
        table
    }

    /// Returns the places for values in some words.
    fn places(words: &str) -> Vec<&str> {
        let mut places: Vec<&str> = words
            .split('{')
            .skip(1)
            .filter_map(|rest| rest.split('}').next())
            .collect();
        places.sort_unstable();
        places
    }

    #[test]
    fn every_language_has_the_same_words_with_the_same_values() {
        let (english, german) = (table("/english.js"), table("/german.js"));
        assert!(english.len() > 400, "{} words", english.len());
        let keys = |table: &BTreeMap<&'static str, &'static str>| -> Vec<&'static str> {
            table.keys().copied().collect()
        };
        assert_eq!(keys(&english), keys(&german));
        for (key, words) in &english {
            assert_eq!(places(words), places(german[key]), "{key}");
        }
    }

    #[test]
    fn every_word_of_the_page_is_in_the_tables_and_used() {
        let english = table("/english.js");
        let mut used = BTreeSet::new();
        for asset in ASSETS
            .iter()
            .filter(|asset| !asset.path.starts_with("/uplot"))
        {
            for (start, _) in asset.content.match_indices("t(\"") {
                let is_word = !asset.content[..start].ends_with(|one: char| one.is_alphanumeric());
                let key = asset.content[start + 3..].split('"').next().unwrap();
                if is_word {
                    assert!(english.contains_key(key), "{}: {key}", asset.path);
                    used.insert(key);
                }
            }
            let by_helpers = asset.content.split("data-words=\"").skip(1);
            for rest in by_helpers.chain(asset.content.split("told(\"").skip(1)) {
                let key = rest.split('"').next().unwrap();
                assert!(english.contains_key(key), "{}: {key}", asset.path);
                used.insert(key);
            }
        }
        let unused: Vec<_> = english
            .keys()
            .filter(|key| !key.starts_with("word-") && !used.contains(*key))
            .collect();
        assert!(unused.is_empty(), "{unused:?}");
    }
}
