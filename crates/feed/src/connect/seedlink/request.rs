//! The commands that request stations and their channels.

use std::collections::BTreeMap;

use jiff::Timestamp;

use crate::source_plan::SeedLinkVersion as Version;

/// Sequence numbers of version 3 have 24 bits.
const SEQUENCE_MASK: u64 = 0xFF_FFFF;

/// The requested channels of one station.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Station {
    network: String,
    station: String,
    /// Location and channel codes.
    channels: Vec<(String, String)>,
}

/// Where the transfer of a station starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Resume {
    /// With the packet of this number, the last that was received. Some servers send it again, and
    /// others send the next one. A request for the next number would lose a packet of the latter.
    After {
        /// Number of that packet.
        sequence: u64,
        /// Time of its last sample, ns.
        end_ns: i64,
    },
    /// At this time, ns.
    Since(i64),
    /// With the next packet.
    Now,
}

/// Returns the stations of channels `NET.STA.LOC.CHA`, each once.
pub(super) fn stations(labels: &[String]) -> Vec<Station> {
    let mut stations: BTreeMap<(String, String), Vec<(String, String)>> = BTreeMap::new();
    for label in labels {
        let codes: Vec<&str> = label.split('.').collect();
        // The check of the configuration requires four codes.
        let [network, station, location, channel] = codes[..] else {
            continue;
        };
        let channels = stations
            .entry((network.to_owned(), station.to_owned()))
            .or_default();
        let channel = (location.to_owned(), channel.to_owned());
        if !channels.contains(&channel) {
            channels.push(channel);
        }
    }
    stations
        .into_iter()
        .map(|((network, station), channels)| Station {
            network,
            station,
            channels,
        })
        .collect()
}

impl Station {
    /// Returns network and station, separated by a dot.
    pub(super) fn name(&self) -> String {
        format!("{}.{}", self.network, self.station)
    }

    /// Returns the command that selects the station.
    pub(super) fn command(&self, version: Version) -> String {
        let Self {
            network, station, ..
        } = self;
        match version {
            Version::Three => format!("STATION {station} {network}"),
            Version::Four => format!("STATION {network}_{station}"),
        }
    }

    /// Returns the commands that select each channel. The server must accept one per channel.
    pub(super) fn selections(&self, version: Version) -> Vec<Vec<String>> {
        let commands = |(location, channel): &(String, String)| {
            // Two characters of the location and three of the channel; D is data.
            let three = format!("SELECT {location}{channel}.D");
            match version {
                Version::Three => vec![three],
                Version::Four => {
                    let codes: Vec<String> = channel.chars().map(String::from).collect();
                    // `seedlink-rs-server` 0.4 accepts both, and understands that of version 3.
                    vec![format!("SELECT {location}_{}", codes.join("_")), three]
                }
            }
        };
        self.channels.iter().map(commands).collect()
    }
}

impl Resume {
    /// Returns the commands in the order of preference. The first one that the server accepts
    /// counts.
    pub(super) fn commands(self, version: Version) -> Vec<String> {
        let time_3 = |time_ns: i64| format!("TIME {}", time(time_ns, "%Y,%m,%d,%H,%M,%S"));
        let time_4 = |time_ns: i64| format!("DATA ALL {}", time(time_ns, "%Y-%m-%dT%H:%M:%SZ"));
        match (self, version) {
            // The server may have numbered its packets again.
            (Self::After { sequence, end_ns }, Version::Three) => vec![
                format!("DATA {:06X}", sequence & SEQUENCE_MASK),
                time_3(end_ns),
            ],
            (Self::After { sequence, end_ns }, Version::Four) => {
                vec![format!("DATA {sequence}"), time_4(end_ns)]
            }
            (Self::Since(time_ns), Version::Three) => vec![time_3(time_ns)],
            // `seedlink-rs-server` 0.4 accepts only the form of version 3.
            (Self::Since(time_ns), Version::Four) => vec![time_4(time_ns), time_3(time_ns)],
            (Self::Now, _) => vec!["DATA".to_owned()],
        }
    }
}

/// Formats a time in whole seconds, rounded down.
fn time(time_ns: i64, format: &str) -> String {
    let seconds = time_ns.div_euclid(1_000_000_000);
    Timestamp::from_second(seconds)
        .map(|time| time.strftime(format).to_string())
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 2026-11-23T20:30:05.7Z in ns.
    const TIME_NS: i64 = 1_795_465_805_700_000_000;

    fn station() -> Station {
        let labels = ["AM.R1.00.ENZ", "AM.R1.00.ENE", "AM.R1.00.ENZ"].map(str::to_owned);
        let mut all = stations(&labels);
        assert_eq!(all.len(), 1);
        all.remove(0)
    }

    #[test]
    fn station_and_channels_are_selected_as_each_version_requires() {
        assert_eq!(station().command(Version::Three), "STATION R1 AM");
        assert_eq!(station().command(Version::Four), "STATION AM_R1");
        let first = |version: Version| -> Vec<String> {
            let all = station().selections(version);
            all.into_iter()
                .map(|mut of_channel| of_channel.remove(0))
                .collect()
        };
        assert_eq!(first(Version::Three), ["SELECT 00ENZ.D", "SELECT 00ENE.D"]);
        assert_eq!(first(Version::Four), ["SELECT 00_E_N_Z", "SELECT 00_E_N_E"]);
    }

    #[test]
    fn transfer_resumes_by_number_or_by_time() {
        let after = Resume::After {
            sequence: 0x100_001a,
            end_ns: TIME_NS,
        };
        let by_time = ["TIME 2026,11,23,20,30,05", "DATA ALL 2026-11-23T20:30:05Z"];
        assert_eq!(after.commands(Version::Three), ["DATA 00001A", by_time[0]]);
        assert_eq!(after.commands(Version::Four), ["DATA 16777242", by_time[1]]);
        let since = Resume::Since(TIME_NS);
        assert_eq!(since.commands(Version::Three), [by_time[0]]);
        assert_eq!(since.commands(Version::Four), [by_time[1], by_time[0]]);
        assert_eq!(Resume::Now.commands(Version::Four), ["DATA"]);
    }
}
