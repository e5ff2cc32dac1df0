//! Connects the dashboard to the bus and to browsers.

use crate::about::About;
use crate::api::router;
use crate::door::{Door, PageCertificate};
use crate::error::DashboardError;
use crate::gate::Gate;
use crate::server::Server;
use crate::serving::serve;
use crate::store::Store;
use crate::tokens::Tokens;
use spandrel_bus::{BoxedFuture, Keys, LiveToken, Service};
use spandrel_listener::{DisplayTopic as T, Input, Listener, Needs};
use spandrel_service::{
    Audit, Monitored, Report, STATUS_EVERY, ServiceInstance, StatusPublisher, Stop,
};
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tracing::{info, warn};

/// Default address of a dashboard: port 8080 of the loopback interface, reachable only from this
/// machine. A second dashboard on the same machine needs another port.
pub const DEFAULT_ADDRESS: &str = "127.0.0.1:8080";

/// All topics for display, and the past from the history service and the service `judge`.
const NEEDS: Needs = Needs {
    topics: &[
        T::Ingested,
        T::Statuses,
        T::Parameters,
        T::Losses,
        T::Noise,
        T::Outliers,
        T::SensorHealth,
        T::Waveforms,
        T::Spectra,
        T::Conditions,
        T::Judgements,
        T::Modes,
        T::Classes,
        T::Nodes,
        T::Fit,
        T::Monitoring,
        T::Estimates,
        T::Acknowledgements,
        T::Alerts,
        T::Events,
    ],
    services: &Service::ALL,
    logs: &[Service::History, Service::Judge],
};
/// Interval at which messages from the bus are processed.
const GATHER_EVERY: Duration = Duration::from_millis(50);
/// Time limit for requests to end after a stop.
const END_WITHIN: Duration = Duration::from_secs(2);

/// Address at which the page is served.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Listen {
    /// [`DEFAULT_ADDRESS`], or a free port of the loopback interface if that port is in use.
    Default,
    /// Exactly this address. Port 0 means any free port.
    At(String),
}

/// Settings of the page.
#[derive(Clone, Debug)]
pub struct PageSettings {
    /// Address of the page.
    pub listen: Listen,
    /// Certificate for TLS. `None` means plain HTTP, on this machine only.
    pub certificate: Option<PageCertificate>,
    /// Tokens of the admitted visitors. Without tokens, everybody on this machine is admitted.
    pub tokens: Tokens,
    /// Reason why the router would drop an acknowledgement from this page, for the error response.
    /// `None` if it would not.
    pub cannot_acknowledge: Option<String>,
}

impl From<Listen> for PageSettings {
    /// Returns settings for a page on this machine, without certificate and tokens.
    fn from(listen: Listen) -> Self {
        Self {
            listen,
            certificate: None,
            tokens: Tokens::default(),
            cannot_acknowledge: None,
        }
    }
}

/// Start-up settings of the dashboard.
#[derive(Clone, Debug)]
pub struct DashboardPlan {
    /// Session, id and clock of the service.
    pub instance: ServiceInstance,
    /// The structures that the page shows.
    pub structures: Vec<Monitored>,
    /// Settings of the page.
    pub page: PageSettings,
}

/// The dashboard of one or more structures.
#[derive(Debug)]
pub struct DashboardService {
    door: Door,
    address: SocketAddr,
    server: Arc<Server>,
    sources: Vec<Source>,
}

/// Subscriptions and publishers of one structure.
#[derive(Debug)]
struct Source {
    keys: Keys,
    listener: Listener,
    status: StatusPublisher,
    token: LiveToken,
}

impl spandrel_service::Service for DashboardService {
    type Plan = DashboardPlan;
    type Error = DashboardError;

    /// Binds the address, subscribes to the bus and declares the liveliness tokens.
    ///
    /// # Errors
    /// - The process cannot listen on the address.
    /// - Other machines can reach the address, and the certificate or tokens are missing.
    /// - The bus rejects a declaration.
    fn start(plan: &DashboardPlan) -> BoxedFuture<'_, Result<Self, DashboardError>> {
        Self::start_from(plan)
    }

    /// Runs until `stop`.
    ///
    /// # Errors
    /// The bus is closed, or browsers cannot be served any further.
    fn run<'a>(self, stop: Stop<'a>) -> BoxedFuture<'a, Result<(), DashboardError>> {
        self.run_until(stop)
    }
}

impl DashboardService {
    fn start_from(plan: &DashboardPlan) -> BoxedFuture<'_, Result<Self, DashboardError>> {
        Box::pin(async move {
            let DashboardPlan {
                instance,
                structures,
                page,
            } = plan;
            let bus = &instance.bus;
            let acceptor = page
                .certificate
                .as_ref()
                .map(PageCertificate::acceptor)
                .transpose()?;
            let listener = bind(page).await?;
            let address = listener
                .local_addr()
                .map_err(|source| DashboardError::Serve { source })?;
            let gate = Gate::new(page.tokens.clone(), acceptor.is_some());
            let door = Door::new(listener, acceptor);
            let mut stores = Vec::new();
            let mut sources = Vec::new();
            for Monitored {
                structure, keys, ..
            } in structures
            {
                stores.push((keys.clone(), Store::new(About::new(structure))));
                sources.push(Source {
                    listener: Listener::start(bus, keys.root(), Some(keys.structure()), NEEDS)
                        .await?,
                    status: instance.publish_status(Service::Dashboard, keys).await?,
                    token: instance.announce(Service::Dashboard, keys).await?,
                    keys: keys.clone(),
                });
            }
            let server = Arc::new(Server::new(
                bus.clone(),
                stores,
                gate,
                page.cannot_acknowledge.clone(),
            ));
            info!(address = %address, structures = structures.len(), "dashboard ready");
            Ok(Self {
                door,
                address,
                server,
                sources,
            })
        })
    }

    /// Returns the address of the page.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    fn run_until(
        mut self,
        stop: BoxedFuture<'_, ()>,
    ) -> BoxedFuture<'_, Result<(), DashboardError>> {
        Box::pin(async move {
            let mut browsers = JoinSet::new();
            browsers.spawn(serve(
                self.door,
                router(self.server.clone()),
                self.server.stopped(),
            ));
            let listened = tokio::select! {
                listened = listen(&mut self.sources, &self.server) => listened,
                Some(served) = browsers.join_next() => return Err(broken(served)),
                () = stop => Ok(()),
            };
            self.server.stop();
            if tokio::time::timeout(END_WITHIN, browsers.join_next())
                .await
                .is_err()
            {
                // A client that keeps its connection open must not block the program.
                browsers.abort_all();
            }
            for source in self.sources {
                source.token.withdraw().await?;
            }
            listened
        })
    }
}

fn broken(served: Result<(), tokio::task::JoinError>) -> DashboardError {
    let source = match served {
        Ok(()) => io::Error::other("ended unexpectedly"),
        Err(source) => io::Error::other(source),
    };
    DashboardError::Serve { source }
}

async fn bind(page: &PageSettings) -> Result<TcpListener, DashboardError> {
    let (address, may_move) = match &page.listen {
        Listen::Default => (DEFAULT_ADDRESS, true),
        Listen::At(address) => (address.as_str(), false),
    };
    let missing = match (&page.certificate, page.tokens.is_empty()) {
        (Some(_), false) => None,
        (None, _) => Some("certificate"),
        (Some(_), true) => Some("token"),
    };
    if let Some(missing) = missing {
        let listen = |source| DashboardError::Listen {
            address: address.to_owned(),
            source,
        };
        let mut all = tokio::net::lookup_host(address).await.map_err(listen)?;
        if !all.all(|address| address.ip().to_canonical().is_loopback()) {
            return Err(DashboardError::Unprotected {
                address: address.to_owned(),
                missing,
            });
        }
    }
    match TcpListener::bind(address).await {
        Ok(listener) => Ok(listener),
        Err(source) if may_move && source.kind() == io::ErrorKind::AddrInUse => {
            warn!(
                taken = address,
                "the default address of the page is in use; using a free port instead"
            );
            let free = "127.0.0.1:0";
            let listener = TcpListener::bind(free).await;
            listener.map_err(|source| DashboardError::Listen {
                address: free.to_owned(),
                source,
            })
        }
        Err(source) => Err(DashboardError::Listen {
            address: address.to_owned(),
            source,
        }),
    }
}

/// Processes messages from the bus and publishes the status, without end.
async fn listen(sources: &mut [Source], server: &Server) -> Result<(), DashboardError> {
    #[expect(
        clippy::disallowed_methods,
        reason = "silence is measured with the monotonic clock"
    )]
    let start = Instant::now();
    let mut gather = tokio::time::interval(GATHER_EVERY);
    gather.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut status = tokio::time::interval(STATUS_EVERY);
    loop {
        tokio::select! {
            _ = gather.tick() => for source in &mut *sources {
                let inputs = source.listener.gather();
                if let Some(mut store) = server.store(source.keys.structure().as_str()) {
                    store.handle(Input::Now(start.elapsed()));
                    inputs.into_iter().for_each(|input| store.handle(input));
                }
            },
            _ = status.tick() => {
                Audit::of_process().pass();
                for source in &*sources {
                    let store = server.store(source.keys.structure().as_str());
                    let report = Report {
                        done: source.listener.taken(),
                        processed_ns: store.and_then(|store| store.state.time_ns),
                        drops: source.listener.refused(),
                        ..Report::default()
                    };
                    source.status.put(report).await?;
                }
            }
        }
    }
}
