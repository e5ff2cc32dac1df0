//! Settings of the notification service: receivers, formats and alert states.

use crate::error::NotifyError;
use crate::message::{MAIL_SUBJECT, MAIL_TEXT};
use crate::quiet::{Quiet, QuietHours};
use crate::samples::samples;
use crate::state::NoticeState;
use crate::template::Template;
use lettre::message::Mailbox;
use serde::Deserialize;
use spandrel_bus::read_small_text;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Longest delay of a notice, s: 30 days.
const LONGEST_S: f64 = 30.0 * 86_400.0;

/// The receivers of notices.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct NotifySettings {
    /// Public address of the page, for links. Without it, notices have no link.
    pub public_url: Option<String>,
    /// Time for which a structure must have been blind before a notice reports it, s. The default
    /// is 60.
    pub blind_after_s: f64,
    /// Time for which a structure must have been degraded before a notice reports it, s. The
    /// default is 900.
    pub degraded_after_s: f64,
    /// Time for which a structure must have been watched again before a notice reports it, s. The
    /// default is 60.
    pub watching_after_s: f64,
    /// Programs notified over HTTP.
    pub webhook: Vec<Webhook>,
    /// People notified by e-mail.
    pub email: Vec<Email>,
}

impl Default for NotifySettings {
    fn default() -> Self {
        Self {
            public_url: None,
            blind_after_s: 60.0,
            degraded_after_s: 900.0,
            watching_after_s: 60.0,
            webhook: Vec::new(),
            email: Vec::new(),
        }
    }
}

/// Times for which a state of the monitoring must last before its notice.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Delays {
    pub(crate) blind: Duration,
    pub(crate) degraded: Duration,
    pub(crate) watching: Duration,
}

/// When a receiver gets a notice: the settings that all receivers have.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Conditions<'s> {
    pub(crate) states: &'s [NoticeState],
    pub(crate) simulations: bool,
    pub(crate) after_s: f64,
    pub(crate) quiet: &'s [QuietHours],
}

/// A program notified over HTTP.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Webhook {
    /// URL of the receiver. It may contain a secret, so logs omit its path and query.
    pub url: String,
    /// Format of the body.
    #[serde(default)]
    pub format: WebhookFormat,
    /// File with a token that is sent as `Authorization: Bearer …`.
    pub token_file: Option<PathBuf>,
    /// Template of the body. A file that ends with `.json` is sent as JSON.
    pub template_file: Option<PathBuf>,
    /// States to send.
    #[serde(default = "usual_states")]
    pub states: Vec<NoticeState>,
    /// Whether simulated and replayed samples cause notices.
    #[serde(default)]
    pub simulations: bool,
    /// Time without reaction after which the receiver gets a notice, s.
    #[serde(default)]
    pub after_s: f64,
    /// Hours in which notices wait.
    #[serde(default)]
    pub quiet: Vec<QuietHours>,
}

/// The format of a webhook's body.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WebhookFormat {
    /// One alert per request, as on the bus, with a key and its time in ISO 8601.
    #[default]
    Spandrel,
    /// The format of Alertmanager's `POST /api/v2/alerts`. An active alert is repeated.
    Alertmanager,
}

/// People notified by e-mail.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Email {
    /// Mail server.
    pub server: String,
    /// Port of the server. `None` selects the default of the encryption.
    pub port: Option<u16>,
    /// Encryption of the connection.
    #[serde(default)]
    pub encryption: Encryption,
    /// User name, if the server requires a login.
    pub user: Option<String>,
    /// File with the password.
    pub password_file: Option<PathBuf>,
    /// Sender.
    pub from: String,
    /// Recipients.
    pub to: Vec<String>,
    /// Template of the subject.
    pub subject: Option<String>,
    /// Template of the text.
    pub template_file: Option<PathBuf>,
    /// States to send.
    #[serde(default = "usual_states")]
    pub states: Vec<NoticeState>,
    /// Whether simulated and replayed samples cause notices.
    #[serde(default)]
    pub simulations: bool,
    /// Time without reaction after which the receiver gets a notice, s.
    #[serde(default)]
    pub after_s: f64,
    /// Hours in which notices wait.
    #[serde(default)]
    pub quiet: Vec<QuietHours>,
}

/// The encryption of the connection to a mail server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Encryption {
    /// TLS from the start of the connection (port 465).
    #[default]
    Tls,
    /// TLS after the STARTTLS command (port 587). Sending fails if the server does not support it.
    Starttls,
    /// No encryption (port 25), for a server on the same machine. A password is rejected.
    None,
}

fn usual_states() -> Vec<NoticeState> {
    vec![
        NoticeState::Raised,
        NoticeState::Cleared,
        NoticeState::Blind,
        NoticeState::Watching,
        NoticeState::LastingLoss,
        NoticeState::ClockWrong,
        NoticeState::ClockRight,
    ]
}

impl Webhook {
    /// Returns the conditions of a notice.
    pub(crate) fn conditions(&self) -> Conditions<'_> {
        Conditions {
            states: &self.states,
            simulations: self.simulations,
            after_s: self.after_s,
            quiet: &self.quiet,
        }
    }

    /// Returns the template of the body, if there is one. `place` names this table.
    pub(crate) fn template(&self, place: &str) -> Result<Option<Template>, NotifyError> {
        let path = self.template_file.as_deref();
        let place = format!("{place}.template-file");
        path.map(|path| read_template(path, place)).transpose()
    }

    /// Checks the settings of this table, which `place` names.
    fn check(&self, place: &str) -> Result<(), NotifyError> {
        let setting = |what: &str, found: String, allowed| NotifyError::Setting {
            place: format!("{place}.{what}"),
            found,
            allowed,
        };
        if !is_http(&self.url) {
            let found = format!("{:?}", shown(&self.url));
            return Err(setting("url", found, "http://… or https://…"));
        }
        read_secret(self.token_file.as_deref(), &format!("{place}.token-file"))?;
        self.conditions().check(place)?;
        self.template(place)?;
        let is_template = self.template_file.is_some();
        let is_held = !self.quiet.is_empty() || self.after_s > 0.0;
        if self.format == WebhookFormat::Alertmanager && (is_template || is_held) {
            let found = "alertmanager, with template-file, quiet or after-s".to_owned();
            let allowed = "spandrel with these settings; Alertmanager has its own";
            return Err(setting("format", found, allowed));
        }
        Ok(())
    }
}

impl Email {
    /// Returns the conditions of a notice.
    pub(crate) fn conditions(&self) -> Conditions<'_> {
        Conditions {
            states: &self.states,
            simulations: self.simulations,
            after_s: self.after_s,
            quiet: &self.quiet,
        }
    }

    /// Returns the templates of subject and text. `place` names this table.
    pub(crate) fn templates(&self, place: &str) -> Result<[Template; 2], NotifyError> {
        let subject = self.subject.as_deref().unwrap_or(MAIL_SUBJECT);
        let place_of_subject = format!("{place}.subject");
        let subject = parse_template(subject, &place_of_subject, place_of_subject.clone())?;
        let text = match &self.template_file {
            None => parse_template(MAIL_TEXT, "mail.txt", place.to_owned())?,
            Some(path) => read_template(path, format!("{place}.template-file"))?,
        };
        Ok([subject, text])
    }

    /// Checks the settings of this table, which `place` names.
    fn check(&self, place: &str) -> Result<(), NotifyError> {
        let setting = |what: &str, found: String, allowed| NotifyError::Setting {
            place: format!("{place}.{what}"),
            found,
            allowed,
        };
        let addresses = std::iter::once(&self.from).chain(&self.to);
        for (number, address) in addresses.enumerate() {
            if address.parse::<Mailbox>().is_err() {
                let what = if number == 0 { "from" } else { "to" };
                let allowed = "an address such as Bridges <bridges@site.example>";
                return Err(setting(what, format!("{address:?}"), allowed));
            }
        }
        if self.to.is_empty() {
            return Err(setting("to", "empty".to_owned(), "at least one address"));
        }
        if self.user.is_some() != self.password_file.is_some() {
            let found = "only one of user and password-file".to_owned();
            return Err(setting("user", found, "both or none"));
        }
        if self.encryption == Encryption::None && self.user.is_some() {
            let found = "none, with a password".to_owned();
            return Err(setting(
                "encryption",
                found,
                "tls or starttls if user is set",
            ));
        }
        let place_of_password = format!("{place}.password-file");
        read_secret(self.password_file.as_deref(), &place_of_password)?;
        self.conditions().check(place)?;
        self.templates(place)?;
        Ok(())
    }
}

fn read_template(path: &Path, place: String) -> Result<Template, NotifyError> {
    match read_small_text(path) {
        Ok(source) => parse_template(&source, &path.display().to_string(), place),
        Err(source) => Err(NotifyError::TemplateFile {
            place,
            path: path.to_owned(),
            source,
        }),
    }
}

fn parse_template(source: &str, file: &str, place: String) -> Result<Template, NotifyError> {
    Template::parse(source, file, &samples("structure")).map_err(|fault| NotifyError::Template {
        place,
        file: file.to_owned(),
        line: fault.line.unwrap_or(1),
        found: fault.found,
        allowed: fault.allowed,
    })
}

impl Conditions<'_> {
    /// Returns the quiet hours with their time zones, which must have been checked.
    pub(crate) fn quiet(&self) -> Vec<Quiet> {
        self.quiet.iter().filter_map(Quiet::new).collect()
    }

    fn check(&self, place: &str) -> Result<(), NotifyError> {
        check_states(self.states, &format!("{place}.states"))?;
        check_delay(self.after_s, &format!("{place}.after-s"))?;
        for (index, hours) in self.quiet.iter().enumerate() {
            let setting = |what: &str, found: String, allowed| NotifyError::Setting {
                place: format!("{place}.quiet[{index}].{what}"),
                found,
                allowed,
            };
            if hours.days.is_empty() {
                let allowed = "one or more of mon, tue, wed, thu, fri, sat, sun";
                return Err(setting("days", "empty".to_owned(), allowed));
            }
            if Quiet::new(hours).is_none() {
                let allowed = "a time zone such as Europe/Zurich or UTC";
                return Err(setting("zone", format!("{:?}", hours.zone), allowed));
            }
        }
        Ok(())
    }
}

fn check_delay(seconds: f64, place: &str) -> Result<(), NotifyError> {
    match (0.0..=LONGEST_S).contains(&seconds) {
        true => Ok(()),
        false => Err(NotifyError::Setting {
            place: place.to_owned(),
            found: seconds.to_string(),
            allowed: "from 0 to 2592000 s (30 days)",
        }),
    }
}

impl NotifySettings {
    /// Returns `true` if there are no receivers.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.webhook.is_empty() && self.email.is_empty()
    }

    /// Resolves relative paths of secrets and templates against `folder`. Absolute paths remain.
    pub fn resolve(&mut self, folder: &Path) {
        let of_webhooks = self
            .webhook
            .iter_mut()
            .flat_map(|one| [&mut one.token_file, &mut one.template_file]);
        let of_emails = self
            .email
            .iter_mut()
            .flat_map(|one| [&mut one.password_file, &mut one.template_file]);
        let paths = of_webhooks.chain(of_emails).filter_map(Option::as_mut);
        paths.for_each(|path| *path = folder.join(&path));
    }

    /// Returns the public address of the page without a slash at the end.
    pub(crate) fn base_url(&self) -> Option<String> {
        let url = self.public_url.as_deref()?;
        Some(url.trim_end_matches('/').to_owned())
    }

    /// Returns the delays of the monitoring, which must have been checked.
    pub(crate) fn delays(&self) -> Delays {
        Delays {
            blind: Duration::from_secs_f64(self.blind_after_s),
            degraded: Duration::from_secs_f64(self.degraded_after_s),
            watching: Duration::from_secs_f64(self.watching_after_s),
        }
    }

    /// Checks the values that the types do not restrict, and that files with secrets are readable.
    ///
    /// # Errors
    /// Returns the first invalid setting.
    pub fn check(&self) -> Result<(), NotifyError> {
        if let Some(url) = &self.public_url {
            let has_query = url.contains(['?', '#']);
            if !is_http(url) || has_query {
                return Err(NotifyError::Setting {
                    place: "public-url".to_owned(),
                    found: format!("{url:?}"),
                    allowed: "http://… or https://…, without a query or a fragment",
                });
            }
        }
        check_delay(self.blind_after_s, "blind-after-s")?;
        check_delay(self.degraded_after_s, "degraded-after-s")?;
        check_delay(self.watching_after_s, "watching-after-s")?;
        for (index, webhook) in self.webhook.iter().enumerate() {
            webhook.check(&format!("webhook[{index}]"))?;
        }
        for (index, email) in self.email.iter().enumerate() {
            email.check(&format!("email[{index}]"))?;
        }
        Ok(())
    }
}

fn check_states(states: &[NoticeState], place: &str) -> Result<(), NotifyError> {
    if !states.is_empty() {
        return Ok(());
    }
    let (found, allowed) = (
        "empty".to_owned(),
        "one or more of learning, undecided, normal, pending, raised, unconfirmed, acknowledged, \
         cleared, softening-in-motion, blind, degraded, watching, \
         lasting-loss, stiffer, earthquake-report, clock-wrong, clock-right",
    );
    Err(NotifyError::Setting {
        place: place.to_owned(),
        found,
        allowed,
    })
}

fn is_http(url: &str) -> bool {
    let mut schemes = ["http://", "https://"].iter();
    schemes.any(|scheme| url.starts_with(scheme)) && !host(url).is_empty()
}

/// Returns the secret in a file, without the line ending.
pub(crate) fn read_secret(path: Option<&Path>, place: &str) -> Result<Option<String>, NotifyError> {
    let Some(path) = path else { return Ok(None) };
    let text = read_small_text(path);
    let text = text.map_err(|source| NotifyError::Secret {
        place: place.to_owned(),
        path: path.to_owned(),
        source,
    })?;
    Ok(Some(text.trim_end_matches(['\r', '\n']).to_owned()))
}

/// Returns host and port of a URL.
pub(crate) fn host(url: &str) -> &str {
    let rest = url.split_once("://").map_or("", |(_, rest)| rest);
    let authority = rest.split(['/', '?', '#']).next().unwrap_or_default();
    authority.rsplit('@').next().unwrap_or_default()
}

/// Returns a URL without the parts that may be secret: user, path and query.
pub(crate) fn shown(url: &str) -> String {
    match url.split_once("://") {
        Some((scheme, _)) => format!("{scheme}://{}/…", host(url)),
        None => "…".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn webhook(url: &str) -> Webhook {
        Webhook {
            url: url.to_owned(),
            format: WebhookFormat::Spandrel,
            token_file: None,
            template_file: None,
            states: usual_states(),
            simulations: false,
            after_s: 0.0,
            quiet: Vec::new(),
        }
    }

    fn email() -> Email {
        Email {
            server: "mail.site.example".to_owned(),
            port: None,
            encryption: Encryption::Tls,
            user: None,
            password_file: None,
            from: "Bridges <bridges@site.example>".to_owned(),
            to: vec!["ada@site.example".to_owned()],
            subject: None,
            template_file: None,
            states: usual_states(),
            simulations: false,
            after_s: 0.0,
            quiet: Vec::new(),
        }
    }

    fn refused(settings: &NotifySettings) -> String {
        settings.check().unwrap_err().to_string()
    }

    #[test]
    fn error_names_an_unusable_setting_without_its_secret() {
        let good = NotifySettings {
            webhook: vec![webhook("https://hooks.example/s3cret")],
            email: vec![email()],
            ..NotifySettings::default()
        };
        assert!(good.check().is_ok());
        for wrong in [
            "ftp://user:s3cret@files.example/",
            "https://",
            "hooks.example/s3cret",
        ] {
            let text = refused(&NotifySettings {
                webhook: vec![webhook(wrong)],
                ..NotifySettings::default()
            });
            assert!(
                text.contains("webhook[0].url") && !text.contains("s3cret"),
                "{text}"
            );
        }
        let with = |change: fn(&mut Email)| {
            let mut email = email();
            change(&mut email);
            refused(&NotifySettings {
                email: vec![email],
                ..NotifySettings::default()
            })
        };
        assert!(with(|email| email.from = "bridges".into()).contains("email[0].from"));
        assert!(with(|email| email.to = vec![]).contains("email[0].to"));
        assert!(with(|email| email.user = Some("ada".into())).contains("email[0].user"));
        assert!(with(|email| email.states = vec![]).contains("email[0].states"));
        let text = with(|email| {
            email.user = Some("ada".into());
            email.password_file = Some("nowhere".into());
        });
        assert!(
            text.contains("nowhere") && text.contains("password-file"),
            "{text}"
        );
    }

    #[test]
    fn address_is_shown_without_possible_secrets() {
        assert_eq!(
            shown("https://user:pw@hooks.example:8443/T0/B1?key=abc"),
            "https://hooks.example:8443/…"
        );
    }
}
