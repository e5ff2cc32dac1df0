//! Settings of the notification service: receivers, formats and alert states.

use crate::error::NotifyError;
use lettre::message::Mailbox;
use serde::Deserialize;
use spandrel_bus::AlertState;
use std::path::{Path, PathBuf};

/// The receivers of notices.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NotifySettings {
    /// Programs notified over HTTP.
    pub webhook: Vec<Webhook>,
    /// People notified by e-mail.
    pub email: Vec<Email>,
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
    /// Alert states to send.
    #[serde(default = "usual_states")]
    pub states: Vec<AlertState>,
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
    /// Alert states to send.
    #[serde(default = "usual_states")]
    pub states: Vec<AlertState>,
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

fn usual_states() -> Vec<AlertState> {
    vec![AlertState::Raised, AlertState::Cleared]
}

impl NotifySettings {
    /// Returns `true` if there are no receivers.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.webhook.is_empty() && self.email.is_empty()
    }

    /// Makes relative paths of secret files relative to `folder`.
    pub fn resolve(&mut self, folder: &Path) {
        let tokens = self
            .webhook
            .iter_mut()
            .filter_map(|webhook| webhook.token_file.as_mut());
        let passwords = self
            .email
            .iter_mut()
            .filter_map(|email| email.password_file.as_mut());
        tokens
            .chain(passwords)
            .for_each(|path| *path = folder.join(&path));
    }

    /// Checks the values that the types do not restrict, and that files with secrets are readable.
    ///
    /// # Errors
    /// Returns the first invalid setting.
    pub fn check(&self) -> Result<(), NotifyError> {
        for (index, webhook) in self.webhook.iter().enumerate() {
            let place = |what: &str| format!("webhook[{index}].{what}");
            let is_http = ["http://", "https://"]
                .iter()
                .any(|scheme| webhook.url.starts_with(scheme));
            if !is_http || host(&webhook.url).is_empty() {
                let found = format!("{:?}", shown(&webhook.url));
                return Err(NotifyError::Setting {
                    place: place("url"),
                    found,
                    allowed: "http://… or https://…",
                });
            }
            read_secret(webhook.token_file.as_deref(), &place("token-file"))?;
            check_states(&webhook.states, &place("states"))?;
        }
        for (index, email) in self.email.iter().enumerate() {
            let place = |what: &str| format!("email[{index}].{what}");
            let addresses = std::iter::once(&email.from).chain(&email.to);
            for (number, address) in addresses.enumerate() {
                if address.parse::<Mailbox>().is_err() {
                    let place = place(if number == 0 { "from" } else { "to" });
                    let allowed = "an address such as Bridges <bridges@site.example>";
                    return Err(NotifyError::Setting {
                        place,
                        found: format!("{address:?}"),
                        allowed,
                    });
                }
            }
            if email.to.is_empty() {
                let (found, allowed) = ("empty".to_owned(), "at least one address");
                return Err(NotifyError::Setting {
                    place: place("to"),
                    found,
                    allowed,
                });
            }
            if email.user.is_some() != email.password_file.is_some() {
                let (found, allowed) = (
                    "only one of user and password-file".to_owned(),
                    "both or none",
                );
                return Err(NotifyError::Setting {
                    place: place("user"),
                    found,
                    allowed,
                });
            }
            if email.encryption == Encryption::None && email.user.is_some() {
                let (found, allowed) = (
                    "none, with a password".to_owned(),
                    "tls or starttls if user is set",
                );
                return Err(NotifyError::Setting {
                    place: place("encryption"),
                    found,
                    allowed,
                });
            }
            read_secret(email.password_file.as_deref(), &place("password-file"))?;
            check_states(&email.states, &place("states"))?;
        }
        Ok(())
    }
}

fn check_states(states: &[AlertState], place: &str) -> Result<(), NotifyError> {
    if !states.is_empty() {
        return Ok(());
    }
    let (found, allowed) = (
        "empty".to_owned(),
        "one or more of learning, undecided, normal, pending, raised, unconfirmed, acknowledged, \
         cleared",
    );
    Err(NotifyError::Setting {
        place: place.to_owned(),
        found,
        allowed,
    })
}

/// Returns the secret in a file, without the line ending.
pub(crate) fn read_secret(path: Option<&Path>, place: &str) -> Result<Option<String>, NotifyError> {
    let Some(path) = path else { return Ok(None) };
    let text = std::fs::read_to_string(path);
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
            states: usual_states(),
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
            states: usual_states(),
        }
    }

    fn refused(settings: &NotifySettings) -> String {
        settings.check().unwrap_err().to_string()
    }

    #[test]
    fn what_cannot_be_used_is_named_and_no_secret_is() {
        let good = NotifySettings {
            webhook: vec![webhook("https://hooks.example/s3cret")],
            email: vec![email()],
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
    fn an_address_is_shown_without_what_may_be_secret() {
        assert_eq!(
            shown("https://user:pw@hooks.example:8443/T0/B1?key=abc"),
            "https://hooks.example:8443/…"
        );
    }
}
