//! `spandrel demo`: runs the whole chain in one process, with a building that is damaged in the
//! course of the record.

use super::print;
use super::run::serve_page;
use super::simulate::{Simulation, head_start_ns, simulate};
use crate::cli::{DemoArguments, Speed};
use crate::error::AppError;
use crate::services::{Running, Share, Watched, block_on, interrupted};
use crate::settings::Settings;
use crate::summary::{Collector, Summary};
use spandrel_alert::Watch;
use spandrel_bus::{
    AlertMessage, AlertState, Bus, Delivery, EstimateBlock, Event, EventKind, Keys, NodeDisplay,
    OutlierDisplay, Service, Start, StreamState, Subscription,
};
use spandrel_service::Clock;
use spandrel_structure::Structure;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// The built-in structure, which is also an example of the documentation.
const BUILT_IN: &str = include_str!("../../../../docs/examples/demo.toml");

/// File name for error messages about the built-in structure.
const BUILT_IN_NAME: &str = "docs/examples/demo.toml";

/// The built-in structure with distributed identification.
const DISTRIBUTED: &str = include_str!("../../../../docs/examples/demo-distributed.toml");
const DISTRIBUTED_NAME: &str = "docs/examples/demo-distributed.toml";

/// Queue length for alert messages, far above the number in a demo.
const ALERTS_WAITING: usize = 4096;

/// Queue length for messages of nodes and their channels. The collector reads them with each block
/// of estimates.
const NODES_WAITING: usize = 1 << 14;

/// Runs the demo and prints its result.
///
/// # Errors
/// Returns an error if the bus cannot be joined, or if a service fails.
pub fn run(arguments: DemoArguments) -> Result<(), AppError> {
    let settings = Settings::load(&arguments.bus)?;
    let structure = match &arguments.structure {
        Some(path) => Structure::read_with_model(path)?,
        None if arguments.distributed => {
            Structure::parse(DISTRIBUTED, Path::new(DISTRIBUTED_NAME))?
        }
        None => Structure::parse(BUILT_IN, Path::new(BUILT_IN_NAME))?,
    };
    let keys = settings.bus.keys(structure.name())?;
    let watched = [Watched {
        structure,
        keys,
        baseline: None,
        file: arguments
            .structure
            .clone()
            .unwrap_or_else(|| PathBuf::from(BUILT_IN_NAME)),
    }];
    block_on(async {
        let bus = Bus::open(&settings.bus).await?;
        let mut running = Running::new(&bus, &watched, None);
        let page = settings
            .dashboard
            .page(&arguments.page)?
            .filter(|_| !arguments.headless);
        let page = match page {
            Some(page) => Some(serve_page(&mut running, &page, &arguments.page).await?),
            None => None,
        };
        running.start_alert().await?;
        running.start_fuse().await?;
        running.start_identify(settings.threads, Share::ALL).await?;
        if watched
            .iter()
            .any(|watched| watched.structure.fusion().is_none())
        {
            running.start_ingest(None).await?;
        }
        let shown = !arguments.headless && std::io::stdout().is_terminal();
        let address = page.as_deref();
        let finished = tokio::select! {
            collected = show_and_collect(&bus, &watched[0], &arguments, shown.then_some(Shown { page: address })) => collected,
            failed = running.failed() => failed.map(|()| None),
            () = interrupted() => Ok(None),
        };
        let mut told = tell(&finished, &arguments);
        if let (Ok(Some(_)), Some(address)) = (&finished, address)
            && (arguments.stay || (shown && !arguments.json))
        {
            told = told.and_then(|()| {
                print(&format!(
                    "the page remains available at {address} until Ctrl-C\n"
                ))
            });
            let failed = tokio::select! {
                failed = running.failed() => failed,
                () = interrupted() => Ok(()),
            };
            told = told.and(failed);
        }
        let stopped = running.stop().await;
        bus.close().await?;
        finished.and(told).and(stopped)
    })
}

/// Prints the result, or nothing if the demo was stopped early.
fn tell(
    finished: &Result<Option<Summary>, AppError>,
    arguments: &DemoArguments,
) -> Result<(), AppError> {
    match finished {
        Ok(Some(summary)) if arguments.json => print(&summary.json()),
        Ok(Some(summary)) => print(&summary.text()),
        Ok(None) | Err(_) => Ok(()),
    }
}

/// The view on a terminal, and the address of the page.
#[derive(Debug, Clone, Copy)]
struct Shown<'p> {
    page: Option<&'p str>,
}

/// Simulates and collects until the last estimate and its alerts have arrived. Returns `None` if
/// the user quits earlier.
async fn show_and_collect(
    bus: &Bus,
    watched: &Watched,
    arguments: &DemoArguments,
    shown: Option<Shown<'_>>,
) -> Result<Option<Summary>, AppError> {
    let Watched {
        structure, keys, ..
    } = watched;
    let frames = (arguments.duration * structure.sampling_rate_hz()).round() as u64;
    let no_bar = indicatif::ProgressBar::hidden(); // the view already shows the progress
    let simulation = Simulation {
        speed: arguments.speed.into(),
        seed: arguments.seed,
        frames: Some(frames),
        start_ns: Clock::of_machine()
            .now_ns()
            .saturating_sub(head_start_ns(arguments.duration, arguments.speed)),
        nodes: (0..structure.nodes().len()).collect(),
    };
    let simulation = simulate(bus, structure, keys, &simulation, &no_bar);
    let collected = collect(bus, watched, arguments);
    let both =
        async { tokio::try_join!(collected, simulation).map(|(summary, _frames)| Some(summary)) };
    let Some(Shown { page }) = shown else {
        return both.await;
    };
    let (done, ended) = tokio::sync::oneshot::channel::<()>();
    let view = super::watch::show(bus, keys.root(), Some(structure.name()), page, async {
        let _ = ended.await; // even if the simulation failed
    });
    tokio::pin!(view);
    tokio::select! {
        result = both => {
            drop(done);
            view.await?; // restores the terminal
            result
        }
        quit = &mut view => quit.map(|()| None),
    }
}

async fn collect(
    bus: &Bus,
    watched: &Watched,
    arguments: &DemoArguments,
) -> Result<Summary, AppError> {
    let Watched {
        structure, keys, ..
    } = watched;
    let settings = bus.reading(Start::Beginning);
    let estimates = bus
        .follow::<EstimateBlock>(keys.estimates(), keys.estimates_buffer(), settings)
        .await?;
    let alerts = bus
        .subscribe::<AlertMessage>(keys.all_alerts(), ALERTS_WAITING)
        .await?;
    let nodes = match structure.fusion() {
        Some(_) => Some(NodeNews::listen(bus, keys).await?),
        None => None,
    };
    let mut decided = bus.watch_progress(keys.progress(Service::Alert)).await?;
    let mut collector = Collector::new(structure);
    // The alert service decides on the same estimates but does not publish the number of decided
    // frames.
    let mut watch = Watch::new(structure, None)?;
    loop {
        tokio::select! {
            delivery = estimates.deliveries().recv_async() => match delivery {
                Ok(Delivery::Block(block)) => {
                    collector.take_estimates(&block);
                    watch.handle_block(&block, &mut Vec::new())?;
                    if block.state == StreamState::Ended {
                        break;
                    }
                }
                Ok(Delivery::Gap(_)) => {}
                Err(flume::RecvError::Disconnected) => break,
            },
            message = alerts.messages().recv_async() => if let Ok((_, message)) = message {
                tell_alert(&message, &mut collector, arguments)?;
            },
        }
        if let Some(nodes) = &nodes {
            nodes.gather(&mut collector, arguments)?;
        }
    }
    let frames = collector.frames();
    decided.wait_for(|progress| progress.done >= frames).await;
    while let Ok((_, message)) = alerts.messages().try_recv() {
        tell_alert(&message, &mut collector, arguments)?;
    }
    if let Some(nodes) = &nodes {
        nodes.gather(&mut collector, arguments)?;
    }
    collector.take_decided(&watch);
    Ok(collector.finish())
}

/// Subscriptions to messages about nodes in distributed identification.
struct NodeNews {
    nodes: Subscription<NodeDisplay>,
    outliers: Subscription<OutlierDisplay>,
    events: Subscription<Event>,
}

impl NodeNews {
    async fn listen(bus: &Bus, keys: &Keys) -> Result<Self, AppError> {
        Ok(Self {
            nodes: bus.subscribe(keys.all_nodes(), NODES_WAITING).await?,
            outliers: bus.subscribe(keys.all_outliers(), NODES_WAITING).await?,
            events: bus.subscribe(keys.event(), ALERTS_WAITING).await?,
        })
    }

    /// Collects the messages received, and prints events of nodes if there is no view.
    fn gather(&self, collector: &mut Collector, arguments: &DemoArguments) -> Result<(), AppError> {
        self.nodes
            .messages()
            .try_iter()
            .for_each(|(_, display)| collector.take_node(&display));
        self.outliers
            .messages()
            .try_iter()
            .for_each(|(_, display)| collector.take_outliers(&display));
        for (_, event) in self.events.messages().try_iter() {
            let of_node = matches!(
                event.kind,
                EventKind::NodeSilent | EventKind::NodeExcluded | EventKind::NodeBack
            );
            if of_node && arguments.headless {
                print(&format!(
                    "{}: {} ({})\n",
                    event.subject, event.what, event.why
                ))?;
            }
        }
        Ok(())
    }
}

/// Collects an alert, and prints it if there is no view.
fn tell_alert(
    message: &AlertMessage,
    collector: &mut Collector,
    arguments: &DemoArguments,
) -> Result<(), AppError> {
    collector.take_message(message);
    let told =
        arguments.headless && matches!(message.state, AlertState::Raised | AlertState::Cleared);
    if told {
        print(&format!("{:?}: {}\n", message.state, message.why))
    } else {
        Ok(())
    }
}

impl From<Speed> for spandrel_sensor::Speed {
    fn from(speed: Speed) -> Self {
        match speed {
            Speed::Times(factor) => Self::Factor(factor),
            Speed::Max => Self::Max,
        }
    }
}
