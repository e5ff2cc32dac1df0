//! Sends one notice. The call blocks until the notice is sent or the attempt has failed.

use crate::content::Content;
use crate::error::NotifyError;
use crate::message::{for_alertmanager, plain};
use crate::outbox::Wish;
use crate::settings::{
    Conditions, Email, Encryption, NotifySettings, Webhook, WebhookFormat, read_secret, shown,
};
use crate::template::Template;
use lettre::message::Mailbox;
use lettre::message::header::ContentType;
use lettre::transport::smtp::authentication::Credentials;
use lettre::{Message, SmtpTransport, Transport};
use std::time::Duration;

/// Time limit for the reply of a receiver.
const ANSWER_WITHIN: Duration = Duration::from_secs(15);

/// A receiver of notices.
pub(crate) enum Receiver {
    Webhook {
        agent: ureq::Agent,
        webhook: Webhook,
        authorization: Option<String>,
        template: Option<Box<Template>>,
    },
    Email {
        transport: Box<SmtpTransport>,
        from: Mailbox,
        to: Vec<Mailbox>,
        /// Templates of subject and text.
        templates: Box<[Template; 2]>,
        email: Box<Email>,
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
            template: webhook
                .template(&format!("webhook[{index}]"))?
                .map(Box::new),
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
        templates: Box::new(email.templates(&format!("email[{index}]"))?),
        email: Box::new(email.clone()),
    })
}

impl Receiver {
    /// Returns the request of this receiver under a name.
    pub(crate) fn wish(&self, name: String) -> Wish {
        let conditions: Conditions<'_> = match self {
            Self::Webhook { webhook, .. } => webhook.conditions(),
            Self::Email { email, .. } => email.conditions(),
        };
        Wish {
            name,
            states: conditions.states.to_vec(),
            repeats: self.is_alertmanager(),
            simulations: conditions.simulations,
            after: Duration::from_secs_f64(conditions.after_s),
            quiet: conditions.quiet(),
        }
    }

    fn is_alertmanager(&self) -> bool {
        match self {
            Self::Webhook { webhook, .. } => webhook.format == WebhookFormat::Alertmanager,
            Self::Email { .. } => false,
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
    pub(crate) fn send(&self, content: &Content) -> Result<(), String> {
        match self {
            Self::Webhook {
                agent,
                webhook,
                authorization,
                template,
            } => {
                let body = match (webhook.format, template) {
                    (WebhookFormat::Alertmanager, _) => for_alertmanager(content).to_string(),
                    (WebhookFormat::Spandrel, Some(template)) => template.render(content)?,
                    (WebhookFormat::Spandrel, None) => plain(content).to_string(),
                };
                let mut request = agent
                    .post(&webhook.url)
                    .header("Content-Type", content_type(webhook))
                    .header("Idempotency-Key", &content.key);
                if let Some(authorization) = authorization {
                    request = request.header("Authorization", authorization);
                }
                match request.send(body) {
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
                templates,
                ..
            } => {
                let [subject, text] = &**templates;
                let subject = subject.render(content)?;
                // A subject is one line.
                let subject = subject.split_whitespace().collect::<Vec<_>>().join(" ");
                let mut message = Message::builder().from(from.clone()).subject(subject);
                // A message ID per change lets mail programs detect duplicates.
                let id = content.key.replace('/', ".");
                message = message.message_id(Some(format!("<{id}@spandrel>")));
                for mailbox in to {
                    message = message.to(mailbox.clone());
                }
                let message = message
                    .header(ContentType::TEXT_PLAIN)
                    .body(text.render(content)?)
                    .map_err(|error| error.to_string())?;
                transport
                    .send(&message)
                    .map(drop)
                    .map_err(|error| error.to_string())
            }
        }
    }
}

/// Returns the media type of the body of a webhook.
fn content_type(webhook: &Webhook) -> &'static str {
    let is_json = |path: &std::path::PathBuf| path.extension().is_some_and(|end| end == "json");
    match webhook.template_file.as_ref().is_none_or(is_json) {
        true => "application/json",
        false => "text/plain; charset=utf-8",
    }
}
