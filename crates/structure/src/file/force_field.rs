//! Reads the kind `force-field` of `[[excitation]]`: forces that grow and fade together, such as
//! wind on all floors.

use super::matrices::read_symmetric;
use super::node::degree_of_freedom;
use crate::excitation::ForceField;
use crate::linear_system::{LinearSystem, dense};
use crate::section::{Allowed, Section};
use nalgebra::{Cholesky, DMatrix};
use toml::Spanned;

/// Keys of a field in addition to the keys of every excitation.
pub(super) const KEYS: [&str; 8] = [
    "dofs",
    "mean",
    "std",
    "intensity",
    "level",
    "correlation-length",
    "positions",
    "covariance",
];

/// Keys that define the covariance of the forces if no file does.
const FORMULA_KEYS: [&str; 4] = ["std", "intensity", "correlation-length", "positions"];

/// Reads the field, except for its level.
pub(super) fn read_force_field(
    section: &mut Section<'_>,
    system: Option<&LinearSystem>,
) -> Option<ForceField> {
    let Some(dofs) = read_dofs(section, system) else {
        section.leave_unread(&KEYS);
        return None;
    };
    let len = dofs.len();
    let mean = section.number_for_each("mean", Allowed::ANY, len);
    if section.contains("mean") && system.is_some_and(|system| system.hysteresis.is_some()) {
        let allowed =
            "must not be given for the kind bouc-wen, whose springs have no rest position";
        section
            .diagnostics()
            .report(section.span(), section.key("mean"), "is given", allowed);
    }
    let mean_is_read = mean.is_some() || !section.contains("mean");
    let mean = mean.unwrap_or_else(|| vec![0.0; len]);
    let covariance = if section.contains("covariance") {
        for key in FORMULA_KEYS.into_iter().filter(|key| section.contains(key)) {
            let allowed = "must not be given together with covariance, which specifies the whole \
                field";
            section
                .diagnostics()
                .report(section.span(), section.key(key), "is given", allowed);
        }
        section.leave_unread(&FORMULA_KEYS);
        read_covariance(section, len)
    } else {
        section.leave_unread(&["covariance"]);
        let deviations = read_deviations(section, len, mean_is_read.then_some(&mean[..]));
        let correlation = read_correlation(section, len);
        correlation
            .zip(deviations)
            .map(|(r, stds)| DMatrix::from_fn(len, len, |i, j| r[(i, j)] * (stds[i] * stds[j])))
    };
    let covariance = covariance?;
    let Some(factor) = Cholesky::new(covariance.clone()) else {
        let allowed = "must have a positive definite covariance: no two forces may be identical";
        section.diagnostics().report(
            section.span(),
            section.key("covariance"),
            "has no Cholesky factor",
            allowed,
        );
        return None;
    };
    Some(ForceField {
        degrees_of_freedom: dofs,
        mean,
        covariance,
        factor: factor.unpack(),
    })
}

/// Reads the degrees of freedom of the forces: `"all"`, or a list without duplicates.
fn read_dofs(section: &mut Section<'_>, system: Option<&LinearSystem>) -> Option<Vec<usize>> {
    let rule = "must be \"all\" or a list of degrees of freedom, each once";
    if section.is_text("dofs") {
        let word = section.text("dofs")?;
        if word.get_ref() != "all" {
            let found = format!("is \"{}\"", word.get_ref());
            section
                .diagnostics()
                .report(word.span(), section.key("dofs"), found, rule);
            return None;
        }
        return system.map(|system| (0..system.len()).collect());
    }
    let listed = section.numbers_or_names("dofs");
    let listed = section.require("dofs", rule, listed)?;
    let found: Vec<_> = listed
        .get_ref()
        .iter()
        .map(|dof| degree_of_freedom(section, "dofs", dof, system))
        .collect();
    let dofs: Vec<usize> = found.into_iter().collect::<Option<_>>()?;
    let repeated = (0..dofs.len()).find(|index| dofs[..*index].contains(&dofs[*index]));
    if dofs.is_empty() || repeated.is_some() {
        let found = repeated.map_or("is empty".to_owned(), |index| {
            format!("repeats entry {}", index + 1)
        });
        section
            .diagnostics()
            .report(listed.span(), section.key("dofs"), found, rule);
        return None;
    }
    Some(dofs)
}

/// Reads the standard deviation of each force (N) at level 1, in newtons or as a share of the mean.
fn read_deviations(
    section: &mut Section<'_>,
    len: usize,
    mean: Option<&[f64]>,
) -> Option<Vec<f64>> {
    let stds = section.number_for_each("std", Allowed::DEVIATION, len);
    let intensity = section.number("intensity", Allowed::POSITIVE);
    if section.contains("std") == section.contains("intensity") {
        let found = if section.contains("std") {
            "is given together with intensity"
        } else {
            "is missing"
        };
        let allowed = "must give either std (of one sample of each force, N), intensity (a share \
                       of mean) or covariance";
        section
            .diagnostics()
            .report(section.span(), section.key("std"), found, allowed);
        return None;
    }
    let Some(intensity) = intensity else {
        return stds;
    };
    let mean = mean?;
    if let Some(calm) = mean.iter().position(|force| *force == 0.0) {
        let found = format!("is a share of a mean that is 0 at entry {}", calm + 1);
        section.diagnostics().report(
            intensity.span(),
            section.key("intensity"),
            found,
            "must have nonzero mean forces, or be given as std",
        );
        return None;
    }
    Some(
        mean.iter()
            .map(|force| intensity.get_ref() * force.abs())
            .collect(),
    )
}

/// Reads `R = exp(−|h_i − h_j|/H)` (N_f × N_f), or the identity for independent forces.
fn read_correlation(section: &mut Section<'_>, len: usize) -> Option<DMatrix<f64>> {
    let length = section.number("correlation-length", Allowed::POSITIVE);
    let positions = section.numbers("positions", Allowed::ANY);
    if section.contains("positions") && !section.contains("correlation-length") {
        let allowed = "must be given together with correlation-length, in the same unit";
        section.diagnostics().report(
            section.span(),
            section.key("positions"),
            "is given",
            allowed,
        );
        return None;
    }
    if !section.contains("correlation-length") {
        return Some(DMatrix::identity(len, len));
    }
    let places = match positions {
        Some(positions) if positions.get_ref().len() != len => {
            let found = format!("has {} entries", positions.get_ref().len());
            let allowed = format!("must have {len}, one per degree of freedom of dofs");
            section.diagnostics().report(
                positions.span(),
                section.key("positions"),
                found,
                allowed,
            );
            return None;
        }
        Some(positions) => positions.into_inner(),
        None if section.contains("positions") => return None,
        None => (1..=len).map(|number| number as f64).collect(),
    };
    let length = length?.into_inner();
    Some(DMatrix::from_fn(len, len, |i, j| {
        (-(places[i] - places[j]).abs() / length).exp()
    }))
}

/// Reads the covariance of the forces (N²) at level 1.
fn read_covariance(section: &mut Section<'_>, len: usize) -> Option<DMatrix<f64>> {
    let file: Spanned<String> = section.text("covariance")?;
    let read = read_symmetric(section, section.key("covariance"), &file)?;
    if read.matrix.nrows() != len {
        let found = format!("is {} × {}", read.matrix.nrows(), read.matrix.ncols());
        let allowed = format!("must have {len} rows, one per degree of freedom of dofs");
        section
            .diagnostics()
            .report(read.span, read.key, found, allowed);
        return None;
    }
    Some(dense(&read.matrix))
}
