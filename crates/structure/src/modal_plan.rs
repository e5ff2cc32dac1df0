//! What `[modal]` states: channels, epochs, band, and the declared modes.

use spandrel_modal::{BandLadder, EpochStream, ModalError, ModalSettings, UpdateSettings};

/// The `[modal]` table.
#[derive(Debug, Clone, PartialEq)]
pub struct ModalPlan {
    /// Settings of the identification. They pass their own check.
    pub settings: ModalSettings,
    /// Whether the file gives a band. Without one, several bands are used.
    pub has_band: bool,
    /// Position of each channel in a frame of the structure.
    pub channels: Vec<usize>,
    /// Name of each channel.
    pub names: Vec<String>,
    /// The declared modes, in the order of the file.
    pub modes: Vec<DeclaredMode>,
    /// The stiffnesses that the modes update. `None` if the file does not request an update.
    pub update: Option<UpdatePlan>,
}

/// The stiffnesses that the declared modes update.
#[derive(Debug, Clone, PartialEq)]
pub struct UpdatePlan {
    /// Settings, with the priors of the parts.
    pub settings: UpdateSettings,
    /// Name of the parameter of each part.
    pub parts: Vec<String>,
    /// Prior mean of each parameter (ratio to nominal).
    pub means: Vec<f64>,
}

/// A mode that is followed under a name.
#[derive(Debug, Clone, PartialEq)]
pub struct DeclaredMode {
    /// Name of the mode.
    pub name: String,
    /// Middle of the frequency range in which the mode is initially searched (Hz).
    pub frequency_hz: f64,
    /// Half-width of this range, relative to its middle.
    pub within: f64,
}

impl ModalPlan {
    /// Default of `modal.mode.within`.
    pub const WITHIN: f64 = 0.05;
    /// Default of `modal.commissioning-epochs`: a day with epochs of ten minutes.
    pub const COMMISSIONING_EPOCHS: usize = 144;
    /// Largest number of channels.
    pub const MOST_CHANNELS: usize = 128;
    /// Largest number of declared modes.
    pub const MOST_MODES: usize = 64;

    /// Returns a stream without frames.
    ///
    /// # Errors
    /// Returns an error if the settings are not valid, which reading the file has excluded.
    pub fn stream(&self) -> Result<EpochStream, ModalError> {
        let ladder = match self.has_band {
            true => BandLadder::single(&self.settings)?,
            false => BandLadder::new(&self.settings)?,
        };
        Ok(EpochStream::new(ladder, self.settings.rate_hz))
    }
}
