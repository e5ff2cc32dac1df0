//! Location and retention times of the history.

use crate::error::HistoryError;
use serde::Deserialize;
use spandrel_bus::is_loopback;
use sqlx::postgres::{PgConnectOptions, PgSslMode};
use std::fmt;
use std::path::{Path, PathBuf};

const DAY_S: u64 = 86_400;

/// Retention time of each resolution, in s of measurement time.
///
/// `None` means no limit. By default, display values are kept for an hour, minutes for 92 days and
/// hours for five years. Days and the log are kept without limit.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Keep {
    /// Retention of display values (s of measurement time). `None` keeps them without limit.
    pub display_s: Option<u64>,
    /// Retention of values aggregated per minute (s of measurement time). `None` keeps them without
    /// limit.
    pub minute_s: Option<u64>,
    /// Retention of values aggregated per hour (s of measurement time). `None` keeps them without
    /// limit.
    pub hour_s: Option<u64>,
    /// Retention of values aggregated per day (s of measurement time). `None` keeps them without
    /// limit.
    pub day_s: Option<u64>,
    /// Retention of alerts, acknowledgements and events (s of measurement time). `None` keeps them
    /// without limit.
    pub log_s: Option<u64>,
}

impl Default for Keep {
    fn default() -> Self {
        Self {
            display_s: Some(3_600),
            minute_s: Some(92 * DAY_S),
            hour_s: Some(5 * 366 * DAY_S),
            day_s: None,
            log_s: None,
        }
    }
}

/// The address of a database.
#[derive(Clone, PartialEq, Eq)]
pub enum Address {
    /// A SQLite file.
    Sqlite(PathBuf),
    /// URL of a PostgreSQL server, which may contain a password.
    Postgres(String),
}

impl Address {
    /// Parses the configured address.
    ///
    /// # Errors
    /// Returns an error if the text is not a file, `sqlite:FILE` or `postgres://…`.
    pub fn parse(text: &str) -> Result<Self, HistoryError> {
        if text.starts_with("postgres://") || text.starts_with("postgresql://") {
            return Ok(Self::Postgres(text.to_owned()));
        }
        let refused = || HistoryError::Address {
            found: without_password(text),
        };
        let path = match text.split_once(':') {
            Some(("sqlite", path)) => path.strip_prefix("//").unwrap_or(path),
            Some((scheme, rest)) if rest.starts_with("//") || scheme.contains('=') => {
                return Err(refused());
            }
            Some(_) | None => text,
        };
        if path.is_empty() || path.contains(['?', '#', '%']) {
            return Err(refused());
        }
        Ok(Self::Sqlite(PathBuf::from(path)))
    }

    /// Resolves a relative file path against `folder`.
    #[must_use]
    pub fn below(self, folder: &Path) -> Self {
        match self {
            Self::Sqlite(path) => Self::Sqlite(folder.join(path)),
            Self::Postgres(url) => Self::Postgres(url),
        }
    }

    /// Returns the URL for the database driver.
    pub(crate) fn url(&self) -> String {
        match self {
            Self::Sqlite(path) => format!("sqlite://{}?mode=rwc", path.display()),
            Self::Postgres(url) => url.clone(),
        }
    }

    /// Returns `true` for a remote server whose identity is not verified, which permits a
    /// man-in-the-middle attack.
    pub(crate) fn believes_the_network(&self) -> bool {
        let Self::Postgres(url) = self else {
            return false;
        };
        let Ok(options) = url.parse::<PgConnectOptions>() else {
            return false;
        };
        let host = options.get_host();
        let is_near = options.get_socket().is_some() || host.starts_with('/') || is_loopback(host);
        !is_near
            && !matches!(
                options.get_ssl_mode(),
                PgSslMode::VerifyCa | PgSslMode::VerifyFull
            )
    }
}

/// Returns a URL without user, password and query parameters, because the query can also contain a
/// password.
fn without_password(text: &str) -> String {
    match (text.split_once("://"), text.rsplit_once('@')) {
        (Some((scheme, _)), Some((_, host))) => {
            format!(
                "{scheme}://…@{}",
                host.split_once('?').map_or(host, |(host, _)| host)
            )
        }
        _ => text.to_owned(),
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sqlite(path) => write!(f, "{}", path.display()),
            Self::Postgres(url) => f.write_str(&without_password(url)),
        }
    }
}

impl fmt::Debug for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Address({self})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_files_and_servers_are_distinguished() {
        for (text, path) in [
            ("history.sqlite", "history.sqlite"),
            ("sqlite:history.sqlite", "history.sqlite"),
            (
                "sqlite:///var/lib/spandrel/history.sqlite",
                "/var/lib/spandrel/history.sqlite",
            ),
            ("/var/lib/a:b", "/var/lib/a:b"),
        ] {
            assert_eq!(
                Address::parse(text).unwrap(),
                Address::Sqlite(path.into()),
                "{text}"
            );
        }
        let server = "postgres://spandrel:secret@db.site:5432/history";
        assert_eq!(
            Address::parse(server).unwrap(),
            Address::Postgres(server.to_owned())
        );
        for wrong in [
            "",
            "mysql://db/history",
            "sqlite:",
            "a.sqlite?mode=ro",
            "host=db password=secret",
        ] {
            let error = Address::parse(wrong);
            assert!(error.is_err() || wrong.contains("host="), "{wrong}");
        }
    }

    #[test]
    fn passwords_are_never_written() {
        let address = Address::parse("postgres://spandrel:s3cr@t@db.site/history").unwrap();
        for text in [address.to_string(), format!("{address:?}")] {
            assert!(
                !text.contains("s3cr") && text.contains("db.site/history"),
                "{text}"
            );
        }
        let late =
            Address::parse("postgres://spandrel@db.site/history?sslmode=require&password=s3cr3t")
                .unwrap();
        assert!(!late.to_string().contains("s3cr3t"), "{late}");
        let refused = Address::parse("mysql://root:secret@db/history")
            .unwrap_err()
            .to_string();
        assert!(
            !refused.contains("secret") && refused.contains("mysql"),
            "{refused}"
        );
    }

    #[test]
    fn remote_server_without_certificate_verification_is_detected() {
        for (text, expected) in [
            ("postgres://spandrel@db.site/history", true),
            (
                "postgres://spandrel@10.0.0.21/history?sslmode=require",
                true,
            ),
            (
                "postgres://spandrel@10.0.0.21/history?sslmode=verify-full",
                false,
            ),
            ("postgres://spandrel@127.0.0.1/history", false),
            ("postgres://spandrel@localhost/history", false),
            ("postgres://spandrel@%2Frun%2Fpostgresql/history", false),
            ("history.sqlite", false),
        ] {
            assert_eq!(
                Address::parse(text).unwrap().believes_the_network(),
                expected,
                "{text}"
            );
        }
    }

    #[test]
    fn relative_path_is_resolved_beside_the_configuration() {
        let file = Address::parse("history.sqlite")
            .unwrap()
            .below("/etc/spandrel".as_ref());
        assert_eq!(file, Address::Sqlite("/etc/spandrel/history.sqlite".into()));
    }
}
