//! Sends alerts to people who are not looking: to a webhook, to an Alertmanager, by e-mail.
//!
//! Alerts go into the `outbox`, which knows who wants which, leaves out what was sent already, and says when what is due,
//! again if it failed; the shell sends it. What has not been delivered outlives the process in the `memory`. The wrong room for decisions: whether there is an alert is for the alert service.

mod error;
mod memory;
mod message;
mod outbox;
mod send;
mod service;
mod settings;

pub use error::NotifyError;
pub use service::NotifyService;
pub use settings::{Email, Encryption, NotifySettings, Webhook, WebhookFormat};
