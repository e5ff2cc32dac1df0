//! A client for SeedLink 3 and 4.
//!
//! No crate is used, for three reasons. `seedlink-rs-client` 0.4 allocates as many bytes as the
//! server claims, up to 4 GiB per packet. It cannot resume by time in version 4. It requires all
//! features of tokio and a second decoder of miniSEED.
//!
//! Source: IRIS and GFZ, *SeedLink protocol 3.1*; FDSN, *SeedLink protocol 4.0* (2022).

mod packet;
mod request;
mod wire;

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::connect::Outlet;
use crate::connect::retry::Retry;
use crate::core_input::Link;
use crate::source_plan::{SeedLinkServer, SeedLinkVersion};
use packet::packets_of;
use request::{Resume, Station, stations};
use wire::{Connection, WireError};

/// Timeout of an attempt to connect.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// How far a connection has come: per station, the sequence number of the last packet and the time
/// of its last sample (ns).
type Progress = BTreeMap<String, Received>;

/// The last packet of a station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Received {
    sequence: u64,
    end_ns: i64,
}

/// Connects until the feed stops.
pub(crate) async fn read(
    plan: SeedLinkServer,
    labels: Vec<String>,
    since_ns: Option<i64>,
    outlet: Outlet,
) {
    let stations = stations(&labels);
    let mut progress = Progress::new();
    let mut retry = Retry::new();
    while !outlet.is_closed() {
        outlet.link(Link::Connecting).await;
        let address = &plan.address;
        let before = progress.clone();
        let why = match timeout(CONNECT_TIMEOUT, TcpStream::connect(address)).await {
            Ok(Ok(stream)) => {
                let mut session = Session {
                    connection: Connection::new(stream),
                    newest: plan.newest,
                    stations: &stations,
                    since_ns,
                    progress: &mut progress,
                    outlet: &outlet,
                };
                match session.run().await {
                    Ok(()) => return,
                    Err(error) => format!("{address}: {error}"),
                }
            }
            Ok(Err(error)) => format!("cannot connect to {address}: {error}"),
            Err(_elapsed) => {
                let limit_s = CONNECT_TIMEOUT.as_secs();
                format!("cannot connect to {address}: no answer within {limit_s} s")
            }
        };
        if progress != before {
            retry.reset();
        }
        outlet.failed(why).await;
        retry.pause().await;
    }
}

/// One connection.
struct Session<'a> {
    connection: Connection,
    newest: SeedLinkVersion,
    stations: &'a [Station],
    since_ns: Option<i64>,
    progress: &'a mut Progress,
    outlet: &'a Outlet,
}

impl Session<'_> {
    /// Requests the stations and passes their packets on. Returns without an error if the feed
    /// stops.
    async fn run(&mut self) -> Result<(), WireError> {
        let version = self.connection.hello(self.newest).await?;
        let mut accepted = 0;
        for station in self.stations {
            match self.request(station, version).await {
                Ok(()) => accepted += 1,
                // Other stations of the server may be available.
                Err(WireError::Rejected { command, answer }) => {
                    let fault = format!("the server rejects {command}: {answer}");
                    if !self.outlet.malformed(fault).await {
                        return Ok(());
                    }
                }
                Err(error) => return Err(error),
            }
        }
        if accepted == 0 {
            return Err(WireError::NoStation);
        }
        self.connection.end().await?;
        self.outlet.link(Link::Open).await;
        loop {
            let Some(frame) = self.connection.frame(version).await? else {
                continue;
            };
            let packets = match packets_of(&frame.payload) {
                Ok(packets) => packets,
                Err(fault) => {
                    if !self.outlet.malformed(fault).await {
                        return Ok(());
                    }
                    continue;
                }
            };
            for (station, end_ns) in packets.stations() {
                let received = Received {
                    sequence: frame.sequence,
                    end_ns,
                };
                self.progress.insert(station, received);
            }
            if !self.outlet.packets(packets.packets).await {
                return Ok(());
            }
        }
    }

    /// Sends commands until the server accepts one.
    async fn first_accepted(&mut self, commands: &[String]) -> Result<(), WireError> {
        let mut last = Ok(());
        for command in commands {
            last = self.connection.command(command).await;
            if !matches!(last, Err(WireError::Rejected { .. })) {
                break;
            }
        }
        last
    }

    /// Sends all commands. One of them must be accepted.
    async fn any_accepted(&mut self, commands: &[String]) -> Result<(), WireError> {
        let mut result = None;
        for command in commands {
            match self.connection.command(command).await {
                Ok(()) => result = Some(Ok(())),
                Err(error @ WireError::Rejected { .. }) => {
                    result.get_or_insert(Err(error));
                }
                Err(error) => return Err(error),
            }
        }
        result.unwrap_or(Ok(()))
    }

    async fn request(
        &mut self,
        station: &Station,
        version: SeedLinkVersion,
    ) -> Result<(), WireError> {
        self.connection.command(&station.command(version)).await?;
        for channel in station.selections(version) {
            self.any_accepted(&channel).await?;
        }
        let resume = match (self.progress.get(&station.name()), self.since_ns) {
            (Some(last), _) => Resume::After {
                sequence: last.sequence,
                end_ns: last.end_ns,
            },
            (None, Some(since_ns)) => Resume::Since(since_ns),
            (None, None) => Resume::Now,
        };
        self.first_accepted(&resume.commands(version)).await
    }
}
