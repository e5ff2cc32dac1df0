//! Sends one notice. The call blocks until the notice is sent or the attempt has failed.

use crate::error::NotifyError;
use crate::message::{for_alertmanager, mail, plain};
use crate::outbox::{Notice, Wish};
use crate::settings::{
    Email, Encryption, NotifySettings, Webhook, WebhookFormat, read_secret, shown,
};
use lettre::message::Mailbox;
use lettre::message::header::ContentType;
use lettre::transport::smtp::authentication::Credentials;
use lettre::{Message, SmtpTransport, Transport};
use spandrel_bus::AlertState;
use std::time::Duration;

/// Time limit for the reply of a receiver.
const ANSWER_WITHIN: Duration = Duration::from_secs(15);

/// A receiver of notices.
pub(crate) enum Receiver {
    Webhook {
        agent: ureq::Agent,
        webhook: Webhook,
        authorization: Option<String>,
    },
    Email {
        transport: Box<SmtpTransport>,
        from: Mailbox,
        to: Vec<Mailbox>,
        states: Vec<AlertState>,
    },
}

/// Returns the receivers of the settings, which must have been checked.
pub(crate) fn receivers(settings: &NotifySettings) -> Result<Vec<Receiver>, NotifyError> {
    let mut receivers = Vec::new();
    for (index, webhook) in settings.webhook.iter().enumerate() {
        let token = read_secret(
            webhook.token_file.as_deref(),
            &format!("webhook[{index}].token-file"),
        )?;
        let agent = ureq::Agent::config_builder()
            .timeout_global(Some(ANSWER_WITHIN))
            .max_redirects(0)
            .build();
        receivers.push(Receiver::Webhook {
            agent: agent.into(),
            webhook: webhook.clone(),
            authorization: token.map(|token| format!("Bearer {token}")),
        });
    }
    for (index, email) in settings.email.iter().enumerate() {
        receivers.push(by_mail(email, index)?);
    }
    Ok(receivers)
}

fn by_mail(email: &Email, index: usize) -> Result<Receiver, NotifyError> {
    let setting = |what: &str, found: String, allowed| NotifyError::Setting {
        place: format!("email[{index}].{what}"),
        found,
        allowed,
    };
    let builder = match email.encryption {
        Encryption::Tls => SmtpTransport::relay(&email.server),
        Encryption::Starttls => SmtpTransport::starttls_relay(&email.server),
        Encryption::None => Ok(SmtpTransport::builder_dangerous(&email.server)),
    };
    let mut builder = builder
        .map_err(|error| setting("server", error.to_string(), "the name of a mail server"))?;
    builder = builder.timeout(Some(ANSWER_WITHIN));
    if let Some(port) = email.port {
        builder = builder.port(port);
    }
    let password = read_secret(
        email.password_file.as_deref(),
        &format!("email[{index}].password-file"),
    )?;
    if let (Some(user), Some(password)) = (&email.user, password) {
        builder = builder.credentials(Credentials::new(user.clone(), password));
    }
    let mailbox = |text: &String| {
        text.parse::<Mailbox>().map_err(|_| {
            setting(
                "to",
                format!("{text:?}"),
                "an address such as ada@site.example",
            )
        })
    };
    Ok(Receiver::Email {
        transport: Box::new(builder.build()),
        from: mailbox(&email.from)?,
        to: email.to.iter().map(mailbox).collect::<Result<_, _>>()?,
        states: email.states.clone(),
    })
}

impl Receiver {
    /// Returns the request of this receiver under a name.
    pub(crate) fn wish(&self, name: String) -> Wish {
        match self {
            Self::Webhook { webhook, .. } => {
                let repeats = webhook.format == WebhookFormat::Alertmanager;
                Wish {
                    name,
                    states: webhook.states.clone(),
                    repeats,
                }
            }
            Self::Email { states, .. } => Wish {
                name,
                states: states.clone(),
                repeats: false,
            },
        }
    }

    /// Returns the receiver's address without secrets.
    pub(crate) fn shown(&self) -> String {
        match self {
            Self::Webhook { webhook, .. } => shown(&webhook.url),
            Self::Email { to, .. } => to
                .iter()
                .map(|mailbox| mailbox.email.to_string())
                .collect::<Vec<_>>()
                .join(", "),
        }
    }

    /// Sends a notice.
    ///
    /// # Errors
    /// Returns the reason for the failure, without secrets.
    pub(crate) fn send(&self, notice: &Notice) -> Result<(), String> {
        match self {
            Self::Webhook {
                agent,
                webhook,
                authorization,
            } => {
                let body = match webhook.format {
                    WebhookFormat::Spandrel => plain(notice),
                    WebhookFormat::Alertmanager => for_alertmanager(notice),
                };
                let mut request = agent
                    .post(&webhook.url)
                    .header("Content-Type", "application/json");
                request = request.header("Idempotency-Key", &notice.key);
                if let Some(authorization) = authorization {
                    request = request.header("Authorization", authorization);
                }
                match request.send(body.to_string()) {
                    Ok(answer) if answer.status().is_success() => Ok(()),
                    Ok(answer) => Err(format!("replied with {}", answer.status())),
                    // The messages of other errors could contain the whole URL.
                    Err(ureq::Error::StatusCode(code)) => Err(format!("replied with {code}")),
                    Err(ureq::Error::Timeout(_)) => {
                        Err(format!("no reply within {} s", ANSWER_WITHIN.as_secs()))
                    }
                    Err(ureq::Error::Io(error)) => Err(error.to_string()),
                    Err(ureq::Error::HostNotFound) => Err("unknown host".to_owned()),
                    Err(ureq::Error::ConnectionFailed) => Err("cannot connect".to_owned()),
                    Err(ureq::Error::Tls(reason)) => Err(format!("TLS: {reason}")),
                    Err(ureq::Error::Rustls(error)) => Err(format!("TLS: {error}")),
                    Err(_) => Err("the request failed".to_owned()),
                }
            }
            Self::Email {
                transport,
                from,
                to,
                ..
            } => {
                let (subject, text) = mail(notice);
                let mut message = Message::builder().from(from.clone()).subject(subject);
                // A message ID per change lets mail programs detect duplicates.
                message = message
                    .message_id(Some(format!("<{}@spandrel>", notice.key.replace('/', "."))));
                for mailbox in to {
                    message = message.to(mailbox.clone());
                }
                let message = message
                    .header(ContentType::TEXT_PLAIN)
                    .body(text)
                    .map_err(|error| error.to_string())?;
                transport
                    .send(&message)
                    .map(drop)
                    .map_err(|error| error.to_string())
            }
        }
    }
}
