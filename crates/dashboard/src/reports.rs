//! Requests for reports of earthquakes.

use crate::api::Mistake;
use axum::http::StatusCode;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use spandrel_bus::{Name, ReportPage};

/// What the page of a report may do: it has a style sheet of its own, and no script.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

/// A requested report, and its form.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct WantedReport {
    pub(crate) report: Name,
    form: Form,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    Html,
    Json,
}

impl WantedReport {
    /// Parses the name of a file, such as `2022-12-20t10-34-01z.html`. The list names the files
    /// with their structure, as `spandrel earthquake` does.
    pub(crate) fn parse(structure: &str, file: &str) -> Result<Self, Mistake> {
        let unknown = || {
            Mistake::new(
                StatusCode::NOT_FOUND,
                format!("{file} is not the name of a report"),
                "must be index.html, or NAME.html or NAME.json of a report",
            )
        };
        let (stem, form) = match (file.strip_suffix(".html"), file.strip_suffix(".json")) {
            (Some(stem), _) => (stem, Form::Html),
            (None, Some(stem)) => (stem, Form::Json),
            (None, None) => return Err(unknown()),
        };
        let of_structure = stem.strip_prefix(structure);
        let time = of_structure.and_then(|rest| rest.strip_prefix('_'));
        let report = Name::new(time.unwrap_or(stem).to_lowercase());
        report
            .map(|report| Self { report, form })
            .map_err(|_| unknown())
    }

    /// Returns the response with a report. `None` if no service has it.
    pub(crate) fn response(&self, page: Option<ReportPage>) -> Result<Response, Mistake> {
        let Some(page) = page else {
            return Err(Mistake::new(
                StatusCode::NOT_FOUND,
                format!("no service has the report {}", self.report),
                "must be a stored report of a structure with a table [earthquakes]; the service \
                 reports must run",
            ));
        };
        Ok(match self.form {
            Form::Html => {
                let headers = [
                    (CONTENT_TYPE, "text/html; charset=utf-8"),
                    (CONTENT_SECURITY_POLICY, POLICY),
                ];
                (headers, page.html).into_response()
            }
            Form::Json => ([(CONTENT_TYPE, "application/json")], page.json).into_response(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(file: &str) -> Option<(String, Form)> {
        let wanted = WantedReport::parse("tower", file).ok()?;
        Some((wanted.report.to_string(), wanted.form))
    }

    #[test]
    fn files_have_the_names_of_the_bus_or_of_the_offline_command() {
        let time = "2022-12-20t10-34-01z".to_owned();
        let html = Some((time.clone(), Form::Html));
        assert_eq!(wanted("2022-12-20t10-34-01z.html"), html);
        assert_eq!(wanted("tower_2022-12-20T10-34-01Z.html"), html);
        assert_eq!(
            wanted("2022-12-20t10-34-01z.json"),
            Some((time, Form::Json))
        );
        for wrong in [
            "report",
            "../x.html",
            "a b.html",
            ".html",
            "x.csv",
            "*.html",
        ] {
            assert_eq!(wanted(wrong), None, "{wrong}");
        }
    }
}
