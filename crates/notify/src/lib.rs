//! Sends notices of alerts, blind structures and wrong clocks to webhooks, to an Alertmanager and
//! by e-mail.
//!
//! - `sight` decides when a blind or degraded structure requires a notice.
//! - `clocks` decides when the wrong clock of a node requires a notice.
//! - `lasting` decides when a lasting change requires a notice.
//! - `origin` distinguishes measured samples from replayed and simulated ones.
//! - `content` composes a notice from a change and its circumstances, with `advice`.
//! - `outbox` selects the receivers of each notice, drops duplicates, and schedules each notice and
//!   its retries. It observes `quiet` hours, maintenance (`muting`) and escalation.
//! - `template` and `message` write the texts.
//! - The shell, in `service` and `send`, sends the notices. Undelivered notices survive a restart
//!   in the `memory`.
//!
//! This crate makes no decisions about alerts: that is the responsibility of the alert service.

mod advice;
mod clocks;
mod content;
mod error;
mod lasting;
mod memory;
mod message;
mod muting;
mod origin;
mod outbox;
mod quiet;
mod samples;
mod send;
mod service;
mod settings;
mod sight;
mod state;
mod template;
mod trial;

#[cfg(test)]
mod testing;

pub use error::NotifyError;
pub use quiet::{Day, QuietHours};
pub use service::{NotifyPlan, NotifyService};
pub use settings::{Email, Encryption, NotifySettings, Webhook, WebhookFormat};
pub use state::NoticeState;
pub use trial::{Trial, try_receivers};
