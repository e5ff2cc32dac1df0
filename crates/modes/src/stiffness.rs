//! The stiffnesses of a structure with a model, from its declared modes.

use crate::error::ModesError;
use nalgebra::Complex;
use spandrel_bus::{CredibleInterval, ModeDisplay, ModeState, Name, ParameterDisplay};
use spandrel_modal::{
    ModalError, PartModel, SeenMode, StiffnessChange, StiffnessUpdate, UpdateReference,
    UpdateSettings, UpdateState,
};
use spandrel_structure::{Structure, UpdatePlan};

/// The stiffnesses that the declared modes of a structure update.
#[derive(Debug, Clone)]
pub struct Stiffnesses {
    structure: Name,
    names: Vec<Name>,
    /// Names of the channels of the model, in its order.
    channels: Vec<String>,
    update: StiffnessUpdate,
    last: Option<StiffnessChange>,
}

impl Stiffnesses {
    /// Creates the stiffnesses of a structure before its commissioning. `None` if natural
    /// frequencies do not update them.
    ///
    /// # Errors
    /// Returns an error if the name of a parameter cannot be a key, or if the matrices of the model
    /// do not fit, which reading the structure file has excluded.
    pub fn new(structure: &Structure) -> Result<Option<Self>, ModesError> {
        let Some(modal) = structure.modal() else {
            return Ok(None);
        };
        let (Some(plan), Some(model)) = (&modal.update, structure.part_model()) else {
            return Ok(None);
        };
        let name = Name::new(structure.name()).map_err(|source| ModesError::Name {
            found: structure.name().to_owned(),
            source,
        })?;
        Self::of_parts(name, plan, &modal.names, model?).map(Some)
    }

    fn of_parts(
        structure: Name,
        plan: &UpdatePlan,
        channels: &[String],
        model: PartModel,
    ) -> Result<Self, ModesError> {
        let names = plan.parts.iter().map(|part| {
            Name::new(part).map_err(|source| ModesError::Name {
                found: part.clone(),
                source,
            })
        });
        Ok(Self {
            structure,
            names: names.collect::<Result<_, _>>()?,
            channels: channels.to_vec(),
            update: StiffnessUpdate::new(model, plan.settings.clone())?,
            last: None,
        })
    }

    /// Returns the names of the updated stiffness parameters, one per part.
    #[must_use]
    pub fn names(&self) -> &[Name] {
        &self.names
    }

    /// Returns the reference that was learnt in the commissioning. `None` before the commissioning
    /// is over.
    #[must_use]
    pub fn reference(&self) -> Option<&UpdateReference> {
        self.update.reference()
    }

    /// Returns the model of the parts whose stiffnesses are updated.
    #[must_use]
    pub fn model(&self) -> &PartModel {
        self.update.model()
    }

    /// Returns the settings of the stiffness update.
    #[must_use]
    pub fn settings(&self) -> &UpdateSettings {
        self.update.settings()
    }

    /// Returns the number of epochs of the commissioning so far, and the total number that it
    /// needs.
    #[must_use]
    pub fn commissioning(&self) -> (usize, usize) {
        let all = self.update.settings().commissioning_epochs;
        match self.update.state() {
            UpdateState::Commissioning(epochs) => (epochs.len(), all),
            UpdateState::Following(_) => (all, all),
        }
    }

    /// Returns the change since the commissioning in the last epoch. `None` during the
    /// commissioning, and after an epoch without a usable mode.
    #[must_use]
    pub fn last(&self) -> Option<&StiffnessChange> {
        self.last.as_ref()
    }

    pub(crate) fn state(&self) -> &UpdateState {
        self.update.state()
    }

    pub(crate) fn restore(&mut self, state: UpdateState) {
        self.update.restore(state);
        self.last = None;
    }

    /// Processes the declared modes after an epoch, and returns the messages of the parameters.
    /// There are none during the commissioning, and none without a usable mode.
    ///
    /// # Errors
    /// Returns an error if the commissioning has no mode of the model and starts again, or if a
    /// decomposition fails.
    pub(crate) fn handle(
        &mut self,
        displays: &[ModeDisplay],
    ) -> Result<Vec<ParameterDisplay>, ModalError> {
        self.last = None;
        let epoch: Vec<Option<SeenMode>> = displays.iter().map(|mode| self.seen(mode)).collect();
        let (true, Some(first)) = (epoch.iter().any(Option::is_some), displays.first()) else {
            return Ok(Vec::new());
        };
        let time_ns = first.time_ns;
        let Some(change) = self.update.handle(epoch)? else {
            return Ok(Vec::new());
        };
        let names = self.names.iter().enumerate();
        let displays = names.map(|(part, name)| {
            let ratio = |probability| change.quantile(part, probability).exp();
            let mean = change.mean(part).exp();
            ParameterDisplay {
                structure: self.structure.clone(),
                parameter: name.clone(),
                time_ns,
                mean,
                std: mean * change.std(part),
                interval: CredibleInterval {
                    level: 0.95,
                    low: ratio(0.025),
                    high: ratio(0.975),
                },
            }
        });
        let displays = displays.collect();
        self.last = Some(change);
        Ok(displays)
    }

    /// Returns a mode as the update uses it. `None` if it is missing, cannot be distinguished from
    /// another one, or if a machine runs at its frequency.
    #[must_use]
    pub fn seen(&self, display: &ModeDisplay) -> Option<SeenMode> {
        let estimate = display.estimate.as_ref();
        let estimate =
            estimate.filter(|_| display.state == ModeState::Tracked && !display.machine)?;
        let seen = SeenMode::new(estimate.frequency_hz, estimate.frequency_std_hz);
        let of = |channel: &String| {
            estimate
                .shape
                .iter()
                .find(|value| value.channel == *channel)
        };
        let shape: Option<Vec<_>> = self.channels.iter().map(of).collect();
        let Some(shape) = shape else {
            return Some(seen); // a channel took no part
        };
        let complex = |[re, im]: [f64; 2]| Complex::new(re, im);
        let values: Vec<_> = shape.iter().map(|value| complex(value.value)).collect();
        let std: Vec<f64> = shape.iter().map(|value| value.std).collect();
        Some(seen.with_shape(&values, &std))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::name;
    use spandrel_bus::{ModeEstimate, ShapeValue};
    use std::path::Path;

    const FILE: &str = include_str!("../../../docs/examples/modes/stiffness.toml");

    fn stiffnesses() -> Stiffnesses {
        let structure = Structure::parse(FILE, Path::new("stiffness.toml")).unwrap();
        Stiffnesses::new(&structure).unwrap().unwrap()
    }

    /// Returns the declared modes of the model at some stiffnesses, after an epoch.
    fn epoch(of: &Stiffnesses, ln_stiffness: &[f64], number: i64) -> Vec<ModeDisplay> {
        let x = nalgebra::DVector::from_column_slice(ln_stiffness);
        let (frequencies, shapes) = of.model().modes(&x).unwrap();
        let modes = frequencies.iter().zip(shapes.column_iter()).zip(1..);
        let modes = modes.map(|((frequency_hz, shape), mode)| ModeDisplay {
            structure: name("stiffness"),
            mode: name(&format!("sway-{mode}")),
            time_ns: number,
            epoch_s: 300.0,
            epochs: 1,
            state: ModeState::Tracked,
            partner: None,
            estimate: Some(ModeEstimate {
                frequency_hz: *frequency_hz,
                frequency_std_hz: 0.002 * frequency_hz,
                damping: 0.02,
                damping_std: 0.002,
                shape: (1..)
                    .zip(shape.iter())
                    .map(|(floor, value): (u32, &f64)| ShapeValue {
                        channel: format!("floor-{floor}"),
                        value: [*value, 0.0],
                        std: 0.01 * shape.amax(),
                    })
                    .collect(),
                amplitude: 0.1,
            }),
            presence: 1.0,
            machine: false,
            declared_hz: *frequency_hz,
        });
        modes.collect()
    }

    /// Passes the commissioning of the example.
    fn commissioned() -> Stiffnesses {
        let mut of = stiffnesses();
        for number in 0..6 {
            assert_eq!(of.commissioning(), (number as usize, 6));
            let sound = epoch(&of, &[0.0; 5], number);
            assert_eq!(of.handle(&sound).unwrap(), []);
        }
        of
    }

    #[test]
    fn parameters_follow_the_commissioning_as_ratios_to_it() {
        let mut of = commissioned();
        let mut lossy = [0.0; 5];
        lossy[3] = f64::ln(0.8);
        let displays = epoch(&of, &lossy, 7);
        let parameters = of.handle(&displays).unwrap();
        assert_eq!(parameters.len(), 5);
        for (number, parameter) in parameters.iter().enumerate() {
            let expected = lossy[number].exp();
            assert_eq!(
                parameter.parameter.as_str(),
                format!("storey-{}", number + 1)
            );
            assert_eq!(parameter.time_ns, 7);
            let interval = parameter.interval;
            assert!(
                (interval.low..interval.high).contains(&expected),
                "{parameter:?}"
            );
            assert_eq!(interval.high < 1.0, number == 3, "{parameter:?}");
        }
    }

    #[test]
    fn a_restored_state_gives_the_same_bits() {
        let mut of = commissioned();
        let bytes = postcard::to_stdvec(of.state()).unwrap();
        let mut restored = stiffnesses();
        restored.restore(postcard::from_bytes(&bytes).unwrap());
        let displays = epoch(&of, &[-0.1, 0.0, 0.0, 0.05, 0.0], 7);
        assert_eq!(
            restored.handle(&displays).unwrap(),
            of.handle(&displays).unwrap()
        );
    }

    #[test]
    fn missing_paired_and_disturbed_modes_take_no_part() {
        let mut of = commissioned();
        let mut displays = epoch(&of, &[0.0; 5], 7);
        displays[0].estimate = None;
        displays[1].state = ModeState::Paired;
        displays[2].machine = true;
        let seen = displays.iter().map(|display| of.seen(display).is_some());
        assert_eq!(seen.collect::<Vec<_>>(), [false, false, false, true, true]);
        assert_eq!(of.handle(&displays[..3]).unwrap(), []);
        assert!(of.last().is_none());
    }
}
