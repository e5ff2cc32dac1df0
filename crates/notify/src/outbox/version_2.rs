//! The state of notices in version 2 of the checkpoint of notify, which knew alerts only.
//!
//! Anyone who changes a type that is used directly must add its former layout here.

use crate::content::{Circumstances, Content, Report};
use serde::Deserialize;
use spandrel_bus::AlertMessage;

/// [`super::Remembered`] of version 2.
#[derive(Debug, Deserialize)]
pub(crate) struct Remembered {
    pub(super) keys: Vec<String>,
    pub(super) last: Vec<AlertMessage>,
    pub(super) waiting: Vec<Undelivered>,
    pub(super) told: Vec<AlertMessage>,
}

/// [`super::Undelivered`] of version 2.
#[derive(Debug, Deserialize)]
pub(crate) struct Undelivered {
    pub(super) receiver: String,
    pub(super) alert: AlertMessage,
    pub(super) age_s: u64,
}

/// The circumstances of a former notice are unknown.
fn content(alert: AlertMessage) -> Content {
    Content::new(Report::Alert(alert), Circumstances::default())
}

impl From<Remembered> for super::Remembered {
    fn from(former: Remembered) -> Self {
        let undelivered = |former: Undelivered| super::Undelivered {
            receiver: former.receiver,
            content: content(former.alert),
            age_s: former.age_s,
            held: None,
        };
        Self {
            keys: former.keys,
            last: former.last.into_iter().map(content).collect(),
            waiting: former.waiting.into_iter().map(undelivered).collect(),
            told: former.told,
            ..Self::default()
        }
    }
}
