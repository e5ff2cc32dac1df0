//! Layered configuration: defaults, file, variables `SPANDREL_…`, flags.

use crate::cli::{BusArguments, PageArguments};
use crate::error::AppError;
use crate::state::StateSettings;
use config::{Config, Environment, File, FileFormat};
use serde::Deserialize;
use spandrel_bus::{BusConfig, Mode, TlsConfig, read_small_file};
use spandrel_dashboard::{DashboardError, Listen, PageCertificate, PageSettings, Tokens};
use spandrel_feed::FeedSettings;
use spandrel_history::{Address, Keep};
use spandrel_notify::NotifySettings;
use spandrel_structure::text_encoding::decode;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

/// Prefix of the environment variables.
const PREFIX: &str = "SPANDREL";

/// Configuration of a process.
#[derive(Debug, Clone, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Settings for joining the bus.
    pub bus: BusConfig,
    /// Whether `spandrel run` refuses what only its own services may do.
    pub isolated: bool,
    /// Structure files. Paths in a configuration file are relative to that file.
    pub structures: Vec<PathBuf>,
    /// Baseline file of each structure by its name. Paths in a configuration file are relative to
    /// that file.
    pub baselines: BTreeMap<String, PathBuf>,
    /// Number of filter threads. `None` means one per processor.
    pub threads: Option<NonZeroUsize>,
    /// Settings of the web page.
    pub dashboard: DashboardSettings,
    /// Settings of the history.
    pub history: HistorySettings,
    /// Instruments that the feed connects to the bus.
    pub feed: FeedSettings,
    /// Recipients of notifications.
    pub notify: NotifySettings,
    /// Settings of persistent state.
    pub state: StateSettings,
}

/// Location of the history and its retention periods.
#[derive(Debug, Clone, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct HistorySettings {
    /// Database of the history, or [`NOTHING`].
    ///
    /// `None` means a file in the folder of the state, or in the system's folder for persistent
    /// state if the state is switched off. A path in a configuration file is relative to that file.
    pub database: Option<String>,
    /// Retention period of each resolution.
    pub keep: Keep,
    /// Folder of the configuration file.
    #[serde(skip)]
    folder: PathBuf,
}

/// File name of the history in the folder for persistent state.
const HISTORY_FILE: &str = "history.sqlite";

impl HistorySettings {
    /// Returns the database, or `None` if the history is switched off.
    ///
    /// # Errors
    /// Returns an error if the database is not valid, or if there is no folder for it.
    pub fn address(&self, state: &StateSettings) -> Result<Option<Address>, AppError> {
        match self.database.as_deref() {
            Some(NOTHING) => Ok(None),
            Some(text) => Ok(Some(Address::parse(text)?.below(&self.folder))),
            None => {
                let folder = state.root()?.map_or_else(default_folder, Ok)?;
                Ok(Some(Address::Sqlite(folder.join(HISTORY_FILE))))
            }
        }
    }
}

/// Returns the system's folder for persistent state.
///
/// # Errors
/// Returns an error if no variable names a folder.
pub(crate) fn default_folder() -> Result<PathBuf, AppError> {
    state_folder(|name| std::env::var_os(name).filter(|value| !value.is_empty()))
        .ok_or(AppError::NoStateFolder)
}

/// Returns the folder for persistent state: the folder set by systemd, or else the user's folder.
fn state_folder(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let of_service = || variable("STATE_DIRECTORY").map(PathBuf::from);
    let of_user =
        || variable("XDG_STATE_HOME").map(|folder| PathBuf::from(folder).join("spandrel"));
    let at_home = || variable("HOME").map(|home| PathBuf::from(home).join(".local/state/spandrel"));
    of_service().or_else(of_user).or_else(at_home)
}

/// Settings of the web page.
#[derive(Debug, Clone, Default, Deserialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct DashboardSettings {
    /// Address of the page, or [`NOTHING`]. `None` means the default address.
    pub listen: Option<String>,
    /// Certificate (PEM) for TLS. A path in a configuration file is relative to that file.
    pub certificate: Option<PathBuf>,
    /// Private key of the certificate (PEM). `None` means the file next to the certificate with
    /// extension `.key`.
    pub key: Option<PathBuf>,
    /// Token file as `spandrel token` writes it. A path in a configuration file is relative to that
    /// file.
    pub tokens: Option<PathBuf>,
}

/// Word that switches off the page, the history or the state.
pub(crate) const NOTHING: &str = "none";

impl DashboardSettings {
    /// Returns the address of the page, or `None` if the page is switched off. Flags override the
    /// configuration.
    pub fn listen(&self, arguments: &PageArguments) -> Option<Listen> {
        match arguments.http.as_ref().or(self.listen.as_ref()) {
            None => Some(Listen::Default),
            Some(address) if address == NOTHING => None,
            Some(address) => Some(Listen::At(address.clone())),
        }
    }

    /// Returns the settings of the page, or `None` if the page is switched off.
    ///
    /// The caller must set `cannot_acknowledge` once the bus is open.
    ///
    /// # Errors
    /// Returns an error if the token file cannot be read or contains no token.
    pub fn page(&self, arguments: &PageArguments) -> Result<Option<PageSettings>, AppError> {
        let Some(listen) = self.listen(arguments) else {
            return Ok(None);
        };
        let certificate = self.certificate.clone().map(|certificate| PageCertificate {
            key: self
                .key
                .clone()
                .unwrap_or_else(|| certificate.with_extension("key")),
            certificate,
        });
        let tokens = match self.tokens.as_deref() {
            None => Tokens::default(),
            // An empty file must not open the page to everybody.
            Some(path) => match Tokens::read(path)? {
                tokens if tokens.is_empty() => {
                    return Err(DashboardError::NoTokens {
                        path: path.to_owned(),
                    }
                    .into());
                }
                tokens => tokens,
            },
        };
        Ok(Some(PageSettings {
            listen,
            certificate,
            tokens,
            cannot_acknowledge: None,
        }))
    }
}

impl Settings {
    /// Reads and combines the layers.
    ///
    /// # Errors
    /// Returns an error if the configuration is not valid. The error names the file or variable and
    /// the key.
    pub fn load(arguments: &BusArguments) -> Result<Self, AppError> {
        Self::layered(arguments, None)
    }

    /// Combines the layers. Tests pass `variables` instead of the environment.
    fn layered(
        arguments: &BusArguments,
        variables: Option<config::Map<String, String>>,
    ) -> Result<Self, AppError> {
        let mut builder = Config::builder();
        if let Some(path) = &arguments.config {
            check_file(path)?;
            builder = builder.add_source(File::from(path.clone()).format(FileFormat::Toml));
        }
        let environment = Environment::with_prefix(PREFIX)
            .prefix_separator("_")
            .separator("__")
            .list_separator(",")
            .with_list_parse_key("bus.listen")
            .with_list_parse_key("bus.connect")
            .with_list_parse_key("structures")
            .try_parsing(true)
            .ignore_empty(true)
            .source(variables);
        let read = builder
            .add_source(environment)
            .build()
            .and_then(Config::try_deserialize::<Self>);
        let mut settings = read.map_err(|source| AppError::Configuration {
            path: arguments.config.clone(),
            source: Box::new(source),
        })?;
        if let Some(file) = &arguments.config {
            settings.feed.resolve(file);
        }
        if let Some(folder) = arguments.config.as_deref().and_then(Path::parent) {
            settings.resolve_paths(folder);
        }
        if let Some(root) = &arguments.root {
            settings.bus.root.clone_from(root);
        }
        if !arguments.listen.is_empty() {
            settings.bus.listen.clone_from(&arguments.listen);
        }
        if !arguments.connect.is_empty() {
            settings.bus.connect.clone_from(&arguments.connect);
        }
        if let Some(certificate) = &arguments.certificate {
            settings.bus.tls = Some(TlsConfig::beside(certificate.clone()));
            if settings.bus.listen.is_empty() {
                settings.bus.mode = Mode::Client;
            }
        }
        if arguments.zenoh_config.is_some() {
            settings.bus.config_file.clone_from(&arguments.zenoh_config);
        }
        Ok(settings)
    }

    fn resolve_paths(&mut self, folder: &Path) {
        let page = &mut self.dashboard;
        let of_page = page
            .certificate
            .iter_mut()
            .chain(&mut page.key)
            .chain(&mut page.tokens);
        let paths = self
            .structures
            .iter_mut()
            .chain(self.baselines.values_mut())
            .chain(&mut self.bus.config_file);
        let paths = paths.chain(of_page);
        for path in paths {
            *path = folder.join(&path);
        }
        if let Some(tls) = &mut self.bus.tls {
            tls.resolve(folder);
        }
        folder.clone_into(&mut self.history.folder);
        folder.clone_into(&mut self.state.beside);
        self.notify.resolve(folder);
    }
}

/// Checks that a configuration file is a small file in UTF-8. Other encodings are named with their
/// position.
fn check_file(path: &Path) -> Result<(), AppError> {
    let unreadable = |source| AppError::UnreadableConfiguration {
        path: path.to_owned(),
        source,
    };
    let bytes = read_small_file(path).map_err(unreadable)?;
    match decode(bytes) {
        Ok(_) => Ok(()),
        Err(wrong) => Err(AppError::WrongEncoding {
            path: path.to_owned(),
            wrong,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(
        file: &str,
        variables: &[(&str, &str)],
        arguments: &BusArguments,
    ) -> Result<Settings, AppError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("spandrel.toml");
        std::fs::write(&path, file).unwrap();
        let variables = variables
            .iter()
            .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
            .collect();
        let arguments = BusArguments {
            config: Some(path),
            ..arguments.clone()
        };
        Settings::layered(&arguments, Some(variables))
    }

    #[test]
    fn options_precede_variables_file_and_defaults() {
        let file = "threads = 3\nstructures = [\"a.toml\"]\n[bus]\nroot = \"from-file\"\n\
                    listen = [\"tcp/127.0.0.1:1\"]\n";
        let variables = [
            ("SPANDREL_BUS__ROOT", "from-variable"),
            ("SPANDREL_BUS__LISTEN", "tcp/127.0.0.1:2"),
        ];
        let flags = BusArguments {
            listen: vec!["tcp/127.0.0.1:3".into()],
            ..BusArguments::default()
        };
        let settings = load(file, &variables, &flags).unwrap();
        assert_eq!(settings.bus.root, "from-variable");
        assert_eq!(settings.bus.listen, ["tcp/127.0.0.1:3"]);
        assert_eq!(settings.threads.map(NonZeroUsize::get), Some(3));
        assert!(settings.structures[0].is_absolute() && settings.structures[0].ends_with("a.toml"));
        assert_eq!(settings.bus.connect, Vec::<String>::new());
    }

    #[test]
    fn option_for_the_page_precedes_the_configuration() {
        let settings = load(
            "[dashboard]\nlisten = \"127.0.0.1:1\"\n",
            &[],
            &BusArguments::default(),
        )
        .unwrap();
        let flag = |http: Option<&str>| PageArguments {
            http: http.map(str::to_owned),
            open: false,
        };
        let at = |address: &str| Some(Listen::At(address.to_owned()));
        assert_eq!(settings.dashboard.listen(&flag(None)), at("127.0.0.1:1"));
        assert_eq!(
            settings.dashboard.listen(&flag(Some("127.0.0.1:2"))),
            at("127.0.0.1:2")
        );
        assert_eq!(settings.dashboard.listen(&flag(Some("none"))), None);
        assert_eq!(
            DashboardSettings::default().listen(&flag(None)),
            Some(Listen::Default)
        );
        let off = load(
            "",
            &[("SPANDREL_DASHBOARD__LISTEN", "none")],
            &BusArguments::default(),
        )
        .unwrap();
        assert_eq!(off.dashboard.listen(&flag(None)), None);
    }

    #[test]
    fn history_is_beside_the_configuration_or_in_the_state_folder() {
        let settings = load(
            "[history]\ndatabase = \"bridge.sqlite\"\nkeep.day-s = 5\n",
            &[],
            &BusArguments::default(),
        );
        let Settings { history, state, .. } = settings.unwrap();
        let Some(Address::Sqlite(path)) = history.address(&state).unwrap() else {
            panic!("{history:?}")
        };
        assert!(
            path.is_absolute() && path.ends_with("bridge.sqlite"),
            "{}",
            path.display()
        );
        assert_eq!(
            (history.keep.day_s, history.keep.display_s),
            (Some(5), Some(3_600))
        );
        let off = load(
            "",
            &[("SPANDREL_HISTORY__DATABASE", "none")],
            &BusArguments::default(),
        )
        .unwrap();
        assert_eq!(off.history.address(&off.state).unwrap(), None);
        // Two runs with different state must not share a database.
        let with_folder = load(
            "[state]\nfolder = \"kept\"\n",
            &[],
            &BusArguments::default(),
        );
        let Settings { history, state, .. } = with_folder.unwrap();
        let Some(Address::Sqlite(path)) = history.address(&state).unwrap() else {
            panic!("{history:?}")
        };
        assert_eq!(path, state.beside.join("kept/history.sqlite"));
        let of = |known: &[(&str, &str)]| {
            state_folder(|name| {
                known
                    .iter()
                    .find(|(known, _)| *known == name)
                    .map(|(_, value)| value.into())
            })
        };
        assert_eq!(
            of(&[("HOME", "/root"), ("STATE_DIRECTORY", "/var/lib/spandrel")]),
            Some("/var/lib/spandrel".into())
        );
        assert_eq!(
            of(&[("HOME", "/root"), ("XDG_STATE_HOME", "/s")]),
            Some("/s/spandrel".into())
        );
        assert_eq!(
            of(&[("HOME", "/root")]),
            Some("/root/.local/state/spandrel".into())
        );
        assert_eq!(of(&[]), None);
    }

    #[test]
    fn error_names_file_and_key() {
        for (file, expected) in [
            ("thread = 3\n", "thread"),
            ("[bus]\nlisten = 7\n", "bus.listen"),
            ("threads = 0\n", "threads"),
            ("structures = \n", "spandrel.toml"),
        ] {
            let text = load(file, &[], &BusArguments::default())
                .unwrap_err()
                .report();
            assert!(
                text.contains(expected) && text.contains("spandrel.toml"),
                "{file:?}: {text}"
            );
        }
    }

    #[test]
    fn error_names_a_wrong_variable() {
        let text = load(
            "",
            &[("SPANDREL_THREADS", "many")],
            &BusArguments::default(),
        )
        .unwrap_err()
        .report();
        assert!(
            text.to_lowercase().contains("threads") && text.contains("many"),
            "{text}"
        );
    }

    #[test]
    fn error_names_a_missing_file() {
        let arguments = BusArguments {
            config: Some("nowhere.toml".into()),
            ..BusArguments::default()
        };
        let text = Settings::layered(&arguments, None).unwrap_err().report();
        assert!(text.contains("nowhere.toml"), "{text}");
    }
}
