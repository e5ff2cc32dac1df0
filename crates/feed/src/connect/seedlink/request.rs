//! The commands that request stations and their channels.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::wire::Version;

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
    /// After the packet with this number.
    After(u64),
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

    /// Returns the commands that select each channel. The first one that the server accepts counts.
    pub(super) fn selections(&self, version: Version) -> Vec<Vec<String>> {
        let commands = |(location, channel): &(String, String)| {
            // Two characters of the location and three of the channel; D is data.
            let three = format!("SELECT {location}{channel}.D");
            match version {
                Version::Three => vec![three],
                Version::Four => {
                    let codes: Vec<String> = channel.chars().map(String::from).collect();
                    // `seedlink-rs-server` 0.4 accepts only the form of version 3.
                    vec![format!("SELECT {location}_{}", codes.join("_")), three]
                }
            }
        };
        self.channels.iter().map(commands).collect()
    }
}

impl Resume {
    /// Returns the command.
    pub(super) fn command(self, version: Version) -> String {
        match (self, version) {
            (Self::After(sequence), Version::Three) => {
                format!("DATA {:06X}", (sequence + 1) & SEQUENCE_MASK)
            }
            (Self::After(sequence), Version::Four) => {
                format!("DATA {}", sequence.saturating_add(1))
            }
            (Self::Since(time_ns), Version::Three) => {
                format!("TIME {}", time(time_ns, "%Y,%m,%d,%H,%M,%S"))
            }
            (Self::Since(time_ns), Version::Four) => {
                format!("DATA ALL {}", time(time_ns, "%Y-%m-%dT%H:%M:%SZ"))
            }
            (Self::Now, _) => "DATA".to_owned(),
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
        let commands =
            |resume: Resume| [Version::Three, Version::Four].map(|version| resume.command(version));
        assert_eq!(
            commands(Resume::After(0xFF_FFFF)),
            ["DATA 000000", "DATA 16777216"]
        );
        assert_eq!(commands(Resume::After(0x1a)), ["DATA 00001B", "DATA 27"]);
        let by_time = ["TIME 2026,11,23,20,30,05", "DATA ALL 2026-11-23T20:30:05Z"];
        assert_eq!(commands(Resume::Since(TIME_NS)), by_time);
        assert_eq!(commands(Resume::Now), ["DATA", "DATA"]);
    }
}
