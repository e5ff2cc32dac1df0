//! The model of a structure in the form that natural frequencies update.

use crate::modal_plan::ModalPlan;
use crate::node::{Channel, Quantity};
use crate::parameter::{Parameter, Scales};
use crate::structure::Structure;
use nalgebra::DMatrix;
use spandrel_modal::{Entry, ModalError, PartModel};

impl Structure {
    /// Returns the model whose parts are the stiffness parameters, in the order of
    /// [`UpdatePlan::parts`](crate::UpdatePlan::parts). The stiffnesses and masses are those of the
    /// prior means. `None` if natural frequencies do not update the structure.
    ///
    /// The sensors are the channels of `[modal]`. If these measure different derivatives of the
    /// motion, their shapes are not comparable, and the model has no sensors.
    ///
    /// # Errors
    /// Returns an error if the mass matrix is not positive definite, which reading the file has
    /// excluded.
    pub fn part_model(&self) -> Option<Result<PartModel, ModalError>> {
        let plan = self.modal.as_ref().filter(|plan| plan.update.is_some())?;
        Some(self.model_of_parts(plan))
    }

    /// Returns the same model to compare the estimates of the filter with the declared modes, if
    /// these do not update it. `None` without a declared mode, with hysteretic springs, without a
    /// stiffness parameter, and with a parameter that scales a mass.
    ///
    /// # Errors
    /// Returns the same errors as [`part_model`](Self::part_model).
    pub fn compared_model(&self) -> Option<Result<PartModel, ModalError>> {
        let plan = self.modal.as_ref().filter(|plan| plan.update.is_none())?;
        let scales_mass = |parameter: &Parameter| matches!(parameter.scales, Scales::Mass(_));
        let is_known = !plan.modes.is_empty()
            && self.system.hysteresis.is_none()
            && self.parameters.iter().any(Parameter::is_stiffness)
            && !self.parameters.iter().any(scales_mass);
        is_known.then(|| self.model_of_parts(plan))
    }

    fn model_of_parts(&self, plan: &ModalPlan) -> Result<PartModel, ModalError> {
        let len = self.system.len();
        let mut mass = self.system.mass.to_dense();
        let mut is_fixed = vec![true; self.system.substructures.len()];
        let mut parts = Vec::new();
        for parameter in &self.parameters {
            match &parameter.scales {
                Scales::Mass(dofs) => {
                    for dof in dofs {
                        mass[(*dof, *dof)] *= parameter.mean();
                    }
                }
                Scales::Stiffness(of) => {
                    let scaled = of.iter().filter_map(|part| {
                        *is_fixed.get_mut(*part)? = false;
                        self.system.substructures.get(*part)
                    });
                    let entries = scaled.flat_map(|part| part.stiffness.triplet_iter());
                    parts.push(
                        entries
                            .map(|(row, column, value)| Entry {
                                row,
                                column,
                                value: parameter.mean() * value,
                            })
                            .collect(),
                    );
                }
                _ => {}
            }
        }
        let factors: Vec<f64> = is_fixed.iter().map(|is| f64::from(u8::from(*is))).collect();
        let all: Vec<&Channel> = self.channels().collect();
        let channels = plan
            .channels
            .iter()
            .filter_map(|position| all.get(*position).copied());
        let channels: Vec<&Channel> = channels.collect();
        let mut derivatives = channels
            .iter()
            .map(|channel| derivative(channel.quantity()));
        let first = derivatives.next();
        let rows = match derivatives.all(|other| Some(other) == first) {
            true => channels.len(),
            false => 0,
        };
        let mut sensors = DMatrix::zeros(rows, len);
        for (mut row, channel) in sensors.row_iter_mut().zip(&channels) {
            for (dof, coefficient) in &channel.sensed {
                row[*dof] += coefficient;
            }
        }
        PartModel::new(mass, self.system.stiffness(&factors), parts, sensors)
    }

    /// Returns the damping ratio of the mode of the model that is nearest to a frequency (Hz).
    /// `None` without a model.
    #[must_use]
    pub fn damping_ratio_near(&self, frequency_hz: f64) -> Option<f64> {
        let ratios = self.modes.damping_ratios(&self.system);
        let distances = self.natural_frequencies_hz().into_iter().zip(ratios);
        let distances = distances.map(|(hz, ratio)| ((hz - frequency_hz).abs(), ratio));
        let nearest = distances.min_by(|(a, _), (b, _)| a.total_cmp(b));
        nearest.map(|(_, ratio)| ratio)
    }
}

/// Returns the number of derivatives of the displacement that a quantity measures.
fn derivative(quantity: Quantity) -> u8 {
    match quantity {
        Quantity::Displacement | Quantity::Strain => 0,
        Quantity::Velocity => 1,
        Quantity::AbsoluteAcceleration
        | Quantity::RelativeAcceleration
        | Quantity::RestoringAcceleration
        | Quantity::GroundAcceleration
        | Quantity::Force => 2,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;
    use std::path::Path;

    const FILE: &str = include_str!("../../../docs/examples/modes/stiffness.toml");

    #[test]
    fn model_has_the_frequencies_of_the_structure_at_any_stiffness() {
        let structure = Structure::parse(FILE, Path::new("stiffness.toml")).unwrap();
        let model = structure.part_model().unwrap().unwrap();
        let (found, shapes) = model.modes(&DVector::zeros(model.parts())).unwrap();
        for (found, expected) in found.iter().zip(structure.natural_frequencies_hz()) {
            assert!(
                (found - expected).abs() < 1e-9 * expected,
                "{found} {expected}"
            );
        }
        assert_eq!(shapes.nrows(), 5);
        let softer = FILE.replace("first-frequency-hz = 1.0", "first-frequency-hz = 0.5");
        let softer = Structure::parse(&softer, Path::new("stiffness.toml")).unwrap();
        let quarter = DVector::from_element(model.parts(), f64::ln(0.25));
        let (found, _) = model.modes(&quarter).unwrap();
        for (found, expected) in found.iter().zip(softer.natural_frequencies_hz()) {
            assert!(
                (found - expected).abs() < 1e-9 * expected,
                "{found} {expected}"
            );
        }
    }

    #[test]
    fn channels_of_different_derivatives_give_no_shapes() {
        let mixed = FILE.replacen("\"absolute-acceleration\"", "\"velocity\"", 1);
        let mixed = mixed.replacen("unit = \"m/s2\"", "unit = \"m/s\"", 1);
        let structure = Structure::parse(&mixed, Path::new("stiffness.toml")).unwrap();
        let model = structure.part_model().unwrap().unwrap();
        assert_eq!(model.channels(), 0);
    }
}
