//! The samples of a packet.

use std::collections::BTreeMap;

use spandrel_record::{RecordedChannel, read_mini_seed};

use crate::packet::Packet;

/// The samples of one SeedLink packet.
#[derive(Debug)]
pub(super) struct Received {
    pub(super) packets: Vec<Packet>,
    ends_ns: BTreeMap<String, i64>,
}

impl Received {
    /// Returns the stations, as `NET.STA`, with the time of their last sample, ns.
    pub(super) fn stations(&self) -> impl Iterator<Item = (String, i64)> + '_ {
        self.ends_ns
            .iter()
            .map(|(station, end_ns)| (station.clone(), *end_ns))
    }
}

/// Decodes the miniSEED records of a packet.
pub(super) fn packets_of(payload: &[u8]) -> Result<Received, String> {
    let channels = read_mini_seed(payload).map_err(|fault| format!("miniSEED record: {fault}"))?;
    let mut received = Received {
        packets: Vec::new(),
        ends_ns: BTreeMap::new(),
    };
    for channel in &channels {
        for segment in channel.segments() {
            received.packets.push(Packet {
                label: channel.name().to_owned(),
                start_ns: Some(segment.start_ns()),
                rate_hz: channel.sampling_rate_hz(),
                clock_quality: channel.clock_quality(),
                values: segment.samples().to_vec(),
            });
        }
        let end_ns = RecordedChannel::end_ns(channel);
        let mut codes = channel.name().split('.');
        if let (Some(network), Some(station), Some(end_ns)) = (codes.next(), codes.next(), end_ns) {
            received
                .ends_ns
                .insert(format!("{network}.{station}"), end_ns);
        }
    }
    Ok(received)
}
