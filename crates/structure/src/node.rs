//! Sensor nodes and their channels.

use std::fmt;

/// Measured quantity of a channel. The name of an acceleration includes its frame of reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quantity {
    /// Acceleration of a degree of freedom in an inertial frame (m/s²), as an accelerometer
    /// measures it.
    AbsoluteAcceleration,
    /// Acceleration of a degree of freedom relative to the ground (m/s²).
    RelativeAcceleration,
    /// `−M⁻¹(C ẋ + K x)` of a degree of freedom (m/s²), without the direct effect of a force on
    /// that mass.
    RestoringAcceleration,
    /// Acceleration of the ground (m/s²), a measured excitation.
    GroundAcceleration,
    /// Measured force (N), a measured excitation.
    Force,
    /// Velocity of a degree of freedom relative to the ground (m/s).
    Velocity,
    /// Displacement of a degree of freedom relative to the ground (m).
    Displacement,
    /// Weighted sum of displacements relative to the ground, such as a strain or a drift ratio (1).
    Strain,
}

impl Quantity {
    /// All quantities with their names in a structure file.
    pub(crate) const WORDS: [(&'static str, Self); 8] = [
        ("absolute-acceleration", Self::AbsoluteAcceleration),
        ("relative-acceleration", Self::RelativeAcceleration),
        ("restoring-acceleration", Self::RestoringAcceleration),
        ("ground-acceleration", Self::GroundAcceleration),
        ("force", Self::Force),
        ("velocity", Self::Velocity),
        ("displacement", Self::Displacement),
        ("strain", Self::Strain),
    ];

    /// Returns the SI unit in the notation of structure files.
    #[must_use]
    pub fn unit(self) -> &'static str {
        match self {
            Self::AbsoluteAcceleration
            | Self::RelativeAcceleration
            | Self::RestoringAcceleration
            | Self::GroundAcceleration => "m/s2",
            Self::Force => "N",
            Self::Velocity => "m/s",
            Self::Displacement => "m",
            Self::Strain => "1",
        }
    }

    /// Returns `true` if nodes exchange this quantity as a response.
    ///
    /// Responses depend on the state only. Excitations and accelerations are excluded.
    pub(crate) fn is_told_as_response(self) -> bool {
        matches!(self, Self::Displacement | Self::Velocity | Self::Strain)
    }

    /// Returns the allowed units of record columns, each with the conversion factor to the SI unit.
    /// A value in the unit times the factor is the value in the SI unit.
    #[must_use]
    pub fn record_units(self) -> &'static [(&'static str, f64)] {
        match self {
            Self::AbsoluteAcceleration
            | Self::RelativeAcceleration
            | Self::RestoringAcceleration
            | Self::GroundAcceleration => {
                // Standard gravity, exact by definition; 1 Gal = 1 cm/s².
                &[
                    ("m/s2", 1.0),
                    ("g", 9.806_65),
                    ("mg", 9.806_65e-3),
                    ("cm/s2", 0.01),
                    ("gal", 0.01),
                    ("mm/s2", 1e-3),
                ]
            }
            Self::Force => &[("N", 1.0), ("kN", 1e3), ("MN", 1e6)],
            Self::Velocity => &[("m/s", 1.0), ("cm/s", 0.01), ("mm/s", 1e-3)],
            Self::Displacement => &[("m", 1.0), ("cm", 0.01), ("mm", 1e-3), ("um", 1e-6)],
            Self::Strain => &[("1", 1.0), ("microstrain", 1e-6)],
        }
    }

    /// Returns the default absolute value (SI) above which a sample is implausible.
    ///
    /// It is far above any plausible response: 20 g, ten times the fastest ground motions, a
    /// displacement of metres, and a strain far beyond the yield of steel. A force of 1 GN exceeds
    /// any jack or shaker.
    pub(crate) fn default_range(self) -> f64 {
        match self {
            Self::AbsoluteAcceleration
            | Self::RelativeAcceleration
            | Self::RestoringAcceleration
            | Self::GroundAcceleration => 200.0,
            Self::Force => 1e9,
            Self::Velocity => 20.0,
            Self::Displacement => 10.0,
            Self::Strain => 0.1,
        }
    }

    /// Returns `true` if a channel of this quantity measures an excitation instead of a response.
    #[must_use]
    pub fn is_excitation(self) -> bool {
        matches!(self, Self::GroundAcceleration | Self::Force)
    }
}

impl fmt::Display for Quantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = Self::WORDS
            .iter()
            .find(|(_, quantity)| quantity == self)
            .map_or("", |(word, _)| word);
        f.write_str(word)
    }
}

/// Direction of a sensor in the coordinates of the structure file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Direction {
    /// Along the first axis.
    X,
    /// Along the second axis.
    Y,
    /// Along the third axis.
    Z,
}

/// One channel of a sensor node.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    pub(crate) name: String,
    pub(crate) quantity: Quantity,
    /// Degrees of freedom (from 0) with their coefficients; a single one with coefficient 1, except
    /// for a strain. Empty for excitations, and without a model.
    pub(crate) sensed: Vec<(usize, f64)>,
    /// Point (from 0) of a sensor of a structure without a model, if the file gives it.
    pub(crate) point: Option<usize>,
    /// Direction of such a sensor, if the file gives it.
    pub(crate) direction: Option<Direction>,
    /// 0 without a model, which needs none.
    pub(crate) noise_std: f64,
    pub(crate) range: f64,
}

impl Channel {
    /// Returns the name, unique in the structure.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the measured quantity.
    #[must_use]
    pub fn quantity(&self) -> Quantity {
        self.quantity
    }

    /// Returns the standard deviation of the measurement noise (SI unit of the quantity).
    #[must_use]
    pub fn noise_std(&self) -> f64 {
        self.noise_std
    }

    /// Returns the absolute value (SI unit of the quantity) above which a sample is implausible.
    #[must_use]
    pub fn range(&self) -> f64 {
        self.range
    }
}

/// A sensor node. Its channels are sampled together, and their samples arrive together.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    pub(crate) name: String,
    pub(crate) sampling_rate_hz: Option<f64>,
    pub(crate) channels: Vec<Channel>,
}

impl Node {
    /// Returns the name, unique in the structure.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the sampling rate of the node (Hz) if it is lower than the rate of the structure.
    ///
    /// The rate of the structure is an integer multiple of it.
    #[must_use]
    pub fn sampling_rate_hz(&self) -> Option<f64> {
        self.sampling_rate_hz
    }

    /// Returns the channels in the order of the node's samples.
    #[must_use]
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }
}
