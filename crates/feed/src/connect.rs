//! Connections to sources. Each connection is a task that reads packets and passes them on.

mod folder;
mod growing_file;
mod lines;
mod mqtt;
mod outlet;
mod retry;
mod seedlink;
mod stdin;
mod tcp;
mod udp;

use spandrel_bus::BoxedFuture;

use crate::source_plan::{SourceKind, SourcePlan};

pub(crate) use outlet::{Arrivals, Arrived, Clocks, Outlet};

/// Reads a source until it ends. Most sources never end, because the connection is retried.
///
/// `since_ns` is the time of the last recorded frame (ns since the Unix epoch). A source that can
/// repeat its samples delivers everything since then.
pub(crate) fn read(
    source: &SourcePlan,
    since_ns: Option<i64>,
    outlet: Outlet,
) -> BoxedFuture<'static, ()> {
    match source.kind.clone() {
        SourceKind::Udp { listen, format } => Box::pin(udp::read(listen, format, outlet)),
        SourceKind::Tcp { address, format } => Box::pin(tcp::connect(address, format, outlet)),
        SourceKind::TcpServer { listen, format } => Box::pin(tcp::serve(listen, format, outlet)),
        SourceKind::Stdin { format } => Box::pin(stdin::read(format, outlet)),
        SourceKind::SeedLink(server) => {
            Box::pin(seedlink::read(server, source.labels(), since_ns, outlet))
        }
        SourceKind::Mqtt(topic) => Box::pin(mqtt::read(topic, outlet)),
        SourceKind::File(file) => Box::pin(growing_file::read(file, since_ns, outlet)),
        SourceKind::Folder(folder) => Box::pin(folder::read(folder, since_ns, outlet)),
    }
}
