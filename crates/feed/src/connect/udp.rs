//! Receives datagrams with lines.

use tokio::net::UdpSocket;

use crate::connect::Outlet;
use crate::connect::lines::parse_all;
use crate::connect::retry::Retry;
use crate::core_input::Link;
use crate::lines::{LineFormat, LineSplitter};

/// Maximum size of a datagram.
const DATAGRAM_BYTES: usize = 65_536;

/// Receives datagrams until the feed stops.
pub(crate) async fn read(listen: String, format: LineFormat, outlet: Outlet) {
    let mut retry = Retry::new();
    while !outlet.is_closed() {
        match UdpSocket::bind(&listen).await {
            Ok(socket) => {
                retry.reset();
                outlet.link(Link::Open).await;
                let error = receive(&socket, &format, &outlet).await;
                outlet
                    .failed(format!("cannot receive on {listen}: {error}"))
                    .await;
            }
            Err(error) => {
                outlet
                    .failed(format!("cannot listen on {listen}: {error}"))
                    .await;
            }
        }
        retry.pause().await;
    }
}

async fn receive(socket: &UdpSocket, format: &LineFormat, outlet: &Outlet) -> std::io::Error {
    let mut bytes = vec![0; DATAGRAM_BYTES];
    let mut dropped = 0;
    loop {
        let received = match socket.recv_from(&mut bytes).await {
            Ok((length, _sender)) => bytes.get(..length).unwrap_or_default(),
            Err(error) => return error,
        };
        let (mut splitter, mut lines) = (LineSplitter::default(), Vec::new());
        splitter.push(received, &mut lines);
        lines.extend(splitter.end());
        let (packets, faults) = parse_all(format, lines);
        for fault in faults {
            outlet.malformed(fault).await;
        }
        if dropped > 0 && outlet.dropped(dropped) {
            dropped = 0;
        }
        // A sender of datagrams does not wait.
        if !packets.is_empty() && !outlet.packets_or_drop(packets) {
            dropped += 1;
        }
        if outlet.is_closed() {
            return std::io::Error::other("the feed stops");
        }
    }
}
