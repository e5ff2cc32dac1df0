//! The power spectral densities of the latest samples of one node.

use serde::{Deserialize, Serialize};

use super::{Format, MAX_CHANNELS, Malformed, Message, check_count, check_range};
use crate::name::Name;

/// Maximum number of frequencies in one message.
pub const MAX_FREQUENCIES: usize = 256;

/// The power spectral density of one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelSpectrum {
    /// Name of the channel.
    pub channel: Name,
    /// Number of averaged windows.
    pub windows: u64,
    /// One-sided power spectral density at each frequency of the message, in the squared unit of
    /// the channel per Hz. Empty without a window.
    pub density: Vec<f32>,
}

/// The power spectral densities of the samples of one node in about the last minute.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpectrumDisplay {
    /// Name of the structure.
    pub structure: Name,
    /// Name of the node.
    pub node: Name,
    /// Time of the last frame, ns since the Unix epoch, UTC.
    pub time_ns: i64,
    /// Length of a window, s.
    pub window_s: f64,
    /// The frequencies, Hz, in ascending order.
    pub frequencies_hz: Vec<f32>,
    /// The channels of the node.
    pub channels: Vec<ChannelSpectrum>,
}

impl Message for SpectrumDisplay {
    const TYPE: &'static str = "spectrum";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        let expected = self.frequencies_hz.len();
        check_range("window_s", self.window_s, f64::MIN_POSITIVE, f64::MAX)?;
        check_count("channels", self.channels.len(), 1, MAX_CHANNELS)?;
        check_count("frequencies_hz", expected, 1, MAX_FREQUENCIES)?;
        let mut before = f64::MIN_POSITIVE;
        for frequency in self.frequencies_hz.iter().copied().map(f64::from) {
            check_range("frequency", frequency, before, f64::from(f32::MAX))?;
            before = frequency;
        }
        for channel in &self.channels {
            let found = channel.density.len();
            if found != 0 && found != expected {
                return Err(Malformed::Length {
                    what: "density",
                    found,
                    expected,
                });
            }
            for density in channel.density.iter().copied().map(f64::from) {
                check_range("density", density, 0.0, f64::from(f32::MAX))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_values_are_refused() {
        let display = SpectrumDisplay {
            structure: Name::new("tower").unwrap(),
            node: Name::new("roof").unwrap(),
            time_ns: 5,
            window_s: 20.48,
            frequencies_hz: vec![0.5, 1.0],
            channels: vec![ChannelSpectrum {
                channel: Name::new("roof-x").unwrap(),
                windows: 5,
                density: vec![1e-6, 0.0],
            }],
        };
        type Change = fn(&mut SpectrumDisplay);
        let changes: [Change; 8] = [
            |display| display.window_s = f64::NAN,
            |display| display.channels.clear(),
            |display| display.frequencies_hz.clear(),
            |display| display.frequencies_hz = vec![1.0; MAX_FREQUENCIES + 1],
            |display| display.frequencies_hz[1] = 0.25,
            |display| display.frequencies_hz[0] = 0.0,
            |display| display.channels[0].density[0] = -1.0,
            |display| display.channels[0].density.push(0.0),
        ];
        for change in changes {
            let mut wrong = display.clone();
            change(&mut wrong);
            assert!(wrong.check().is_err(), "{wrong:?}");
        }
        let decoded = SpectrumDisplay::decode("application/json", &display.encode().unwrap());
        assert_eq!(decoded.unwrap(), display);
        let mut empty = display;
        empty.channels[0].density.clear();
        assert_eq!(empty.check(), Ok(()));
    }
}
