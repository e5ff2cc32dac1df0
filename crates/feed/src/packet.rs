//! Consecutive samples of one channel, as a source delivers them.

/// Consecutive samples of one channel, in the unit of the source.
#[derive(Clone, Debug, PartialEq)]
pub struct Packet {
    /// Name of the channel in the source, such as `EHZ` or `AM.R1234.00.EHZ`.
    pub label: String,
    /// Time of the first sample, ns since the Unix epoch, UTC. `None` if the source states no time.
    pub start_ns: Option<i64>,
    /// Sampling rate that the packet states, Hz.
    pub rate_hz: Option<f64>,
    /// Quality of the time as the source states it, per cent. `None` if it states none.
    pub clock_quality: Option<u8>,
    /// Samples, mostly counts of an analogue-to-digital converter. NaN is missing.
    pub values: Vec<f64>,
}
