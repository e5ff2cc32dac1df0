//! `spandrel watch`: shows parameters and alerts of a running system in this terminal.

use crate::cli::WatchArguments;
use crate::error::AppError;
use crate::role_check::{Need, Work, cannot_acknowledge, check};
use crate::services::{block_on, interrupted};
use crate::settings::Settings;
use crate::watch::{self, Around};
use spandrel_bus::{Bus, BusConfig, DEFAULT_ENDPOINT, Mode, Name};

/// Shows one structure, or all, until the user quits or a signal stops the process.
///
/// # Errors
/// Returns an error if the configuration is not valid, or if no process replies on the bus.
pub fn run(arguments: WatchArguments) -> Result<(), AppError> {
    let bus = joining_by_default(Settings::load(&arguments.bus)?.bus);
    let root = Name::new(&*bus.root)?;
    let structure = arguments.structure.map(Name::new).transpose()?;
    block_on(async {
        let (config, bus) = (&bus, Bus::open(&bus).await?);
        let work = Work {
            subcommand: "watch",
            needs: &[Need::SEE_PARAMETERS],
            structures: Vec::new(),
            nodes: Vec::new(),
        };
        check(&bus, config, &work).await?;
        let around = Around {
            page: None,
            cannot_acknowledge: cannot_acknowledge(&bus, config).await?,
        };
        let shown = watch::show(&bus, &root, structure.as_ref(), around, interrupted()).await;
        let closed = bus.close().await;
        shown.and(closed.map_err(AppError::from))
    })
}

/// Shows the view on an open bus, with the address of the web page, until `stop` or until the user
/// quits.
///
/// # Errors
/// Returns an error if the structure's name is not valid in a key, the session is closed, or the
/// terminal has failed.
pub async fn show(
    bus: &Bus,
    root: &Name,
    structure: Option<&str>,
    page: Option<&str>,
    stop: impl Future<Output = ()>,
) -> Result<(), AppError> {
    let structure = structure.map(Name::new).transpose()?;
    let around = Around {
        page: page.map(str::to_owned),
        cannot_acknowledge: None,
    };
    watch::show(bus, root, structure.as_ref(), around, stop).await
}

/// Returns a configuration that connects to the system on this machine, unless the configuration
/// specifies an endpoint.
///
/// A view alone is useful only with a running system.
pub fn joining_by_default(bus: BusConfig) -> BusConfig {
    let nothing_said = bus.listen.is_empty() && bus.connect.is_empty() && bus.config_file.is_none();
    if !nothing_said {
        return bus;
    }
    BusConfig {
        mode: Mode::Client,
        connect: vec![DEFAULT_ENDPOINT.to_owned()],
        ..bus
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_bus_is_the_one_on_this_machine() {
        let joined = joining_by_default(BusConfig {
            root: "here".to_owned(),
            ..BusConfig::default()
        });
        assert_eq!(
            (joined.mode, joined.connect.as_slice()),
            (Mode::Client, [DEFAULT_ENDPOINT.to_owned()].as_slice())
        );
        assert_eq!((joined.root.as_str(), joined.listen.len()), ("here", 0));
    }

    #[test]
    fn explicit_bus_settings_are_kept() {
        let endpoint = || vec!["tcp/127.0.0.1:7000".to_owned()];
        for said in [
            BusConfig {
                listen: endpoint(),
                ..BusConfig::default()
            },
            BusConfig {
                connect: endpoint(),
                ..BusConfig::default()
            },
            BusConfig {
                config_file: Some("zenoh.json5".into()),
                ..BusConfig::default()
            },
        ] {
            assert_eq!(joining_by_default(said.clone()), said);
        }
    }
}
