//! Requests for the history of a judged quantity.

use crate::api::Mistake;
use crate::history::{Format, time};
use crate::store::Store;
use axum::http::StatusCode;
use serde::Deserialize;
use spandrel_bus::{JudgementCourse, Name, SpanQuery};

/// A request before validation.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Asked {
    /// Seconds since the Unix epoch (UTC), or ISO 8601.
    from: Option<String>,
    to: Option<String>,
    #[serde(default)]
    pub(crate) format: Format,
}

impl Asked {
    /// Returns the query to the service judge.
    pub(crate) fn query(&self) -> Result<SpanQuery, Mistake> {
        let query = SpanQuery {
            from_ns: time("from", self.from.as_ref(), i64::MIN)?,
            to_ns: time("to", self.to.as_ref(), i64::MAX)?,
            points: JudgementCourse::MOST_ROWS,
            ..SpanQuery::default()
        };
        if query.from_ns <= query.to_ns {
            return Ok(query);
        }
        Err(Mistake::new(
            StatusCode::BAD_REQUEST,
            "from is after to",
            "from must come before to",
        ))
    }
}

/// Returns the name of a quantity that is judged.
pub(crate) fn quantity(store: &Store, name: &str) -> Result<Name, Mistake> {
    let judged = &store.about.judged;
    let is_judged = judged.iter().any(|known| known == name);
    match Name::new(name) {
        Ok(name) if is_judged => Ok(name),
        Ok(_) | Err(_) => {
            let allowed = match judged.is_empty() {
                true => "the structure file must have a table [judge]".to_owned(),
                false => format!("must be one of: {}", judged.join(", ")),
            };
            let what = format!("quantity `{name}` is not judged");
            Err(Mistake::new(StatusCode::NOT_FOUND, what, allowed))
        }
    }
}
