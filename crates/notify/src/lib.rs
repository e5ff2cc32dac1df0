//! Sends alerts to webhooks, to an Alertmanager and by e-mail.
//!
//! The `outbox` selects the receivers of each alert, drops duplicates, and schedules each notice
//! and its retries. The shell sends the notices. Undelivered notices survive a restart in the
//! `memory`. This crate makes no decisions about alerts: that is the responsibility of the alert
//! service.

mod error;
mod memory;
mod message;
mod outbox;
mod send;
mod service;
mod settings;

pub use error::NotifyError;
pub use service::{NotifyPlan, NotifyService};
pub use settings::{Email, Encryption, NotifySettings, Webhook, WebhookFormat};
