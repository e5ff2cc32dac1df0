//! Stiffness of the parts of a structure with a model, from its modes.
//!
//! After a commissioning, the change of ln k of each part is estimated from the modes of each
//! epoch, with the sensitivities of a calibrated model. The theory is in `docs/theory/modal.md`.
//!
//! - `part_model`: the model, its modes and their derivatives
//! - `observation`: the modes of an epoch
//! - `scatter`: how much sound epochs scatter
//! - `reference`: the reference, from the epochs of the commissioning
//! - `change`: the change since then
//! - `comparison`: whether the modes of a model agree with measured ones

mod change;
mod comparison;
mod observation;
mod part_model;
mod reference;
mod scatter;

pub use change::{StiffnessChange, UpdatePrecision};
pub use comparison::Comparison;
pub use observation::SeenMode;
pub use part_model::{Entry, PartModel};
pub use reference::{UpdateReference, UpdateSettings};

use crate::ModalError;
use serde::{Deserialize, Serialize};

/// Follows the stiffnesses of a structure from epoch to epoch.
#[derive(Debug, Clone)]
pub struct StiffnessUpdate {
    model: PartModel,
    settings: UpdateSettings,
    state: UpdateState,
}

/// What changes from epoch to epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum UpdateState {
    /// The commissioning, with its epochs so far.
    Commissioning(Vec<Vec<Option<SeenMode>>>),
    /// The commissioning is over.
    Following(Box<UpdateReference>),
}

impl StiffnessUpdate {
    /// Starts the commissioning.
    ///
    /// # Errors
    /// Returns an error if the settings have another number of parts than the model.
    pub fn new(model: PartModel, settings: UpdateSettings) -> Result<Self, ModalError> {
        match settings.prior_std.len() == model.parts() {
            true => Ok(Self {
                model,
                settings,
                state: UpdateState::Commissioning(Vec::new()),
            }),
            false => Err(ModalError::Model),
        }
    }

    /// Returns the model.
    #[must_use]
    pub fn model(&self) -> &PartModel {
        &self.model
    }

    /// Returns the settings.
    #[must_use]
    pub fn settings(&self) -> &UpdateSettings {
        &self.settings
    }

    /// Returns the state.
    #[must_use]
    pub fn state(&self) -> &UpdateState {
        &self.state
    }

    /// Continues from a state, with which the results are bit-identical.
    pub fn restore(&mut self, state: UpdateState) {
        self.state = state;
    }

    /// Returns the reference. `None` during the commissioning.
    #[must_use]
    pub fn reference(&self) -> Option<&UpdateReference> {
        match &self.state {
            UpdateState::Commissioning(_) => None,
            UpdateState::Following(reference) => Some(reference),
        }
    }

    /// Processes the declared modes of an epoch, always in the same order. `None` stands for a
    /// missing mode. Returns the change of the stiffnesses, or `None` during the commissioning.
    ///
    /// An epoch without any mode does not count.
    ///
    /// # Errors
    /// Returns an error if a decomposition fails, or if no mode of the commissioning resembles a
    /// mode of the model. The commissioning then starts again.
    pub fn handle(
        &mut self,
        epoch: Vec<Option<SeenMode>>,
    ) -> Result<Option<StiffnessChange>, ModalError> {
        if epoch.iter().all(Option::is_none) {
            return Ok(None);
        }
        match &mut self.state {
            UpdateState::Following(reference) => reference.change(&self.model, &epoch).map(Some),
            UpdateState::Commissioning(epochs) => {
                epochs.push(epoch);
                if epochs.len() >= self.settings.commissioning_epochs {
                    let epochs = std::mem::take(epochs);
                    let reference = UpdateReference::learn(&self.model, &self.settings, &epochs)?;
                    self.state = UpdateState::Following(Box::new(reference));
                }
                Ok(None)
            }
        }
    }
}
