//! Bars of a plane or space truss. Pin joints transmit only axial forces.
//!
//! Degrees of freedom of an end: its translations (m). Huang & Yuen (2023) use a plane truss in
//! §4.4 and a dome in §5.6.3.

use crate::mesh::{ElementMatrices, MassForm, MemberSection};
use nalgebra::{DMatrix, Vector3};

/// Degrees of freedom of each node of a plane truss.
pub(crate) const PLANE: &[&str] = &["x", "y"];
/// Degrees of freedom of each node of a space truss.
pub(crate) const SPACE: &[&str] = &["x", "y", "z"];

/// Returns the stiffness and mass of a bar of `section` along a vector (m), for the first
/// `dimension` directions.
pub(crate) fn element(
    section: &MemberSection,
    along: Vector3<f64>,
    form: MassForm,
    dimension: usize,
) -> ElementMatrices {
    let l = along.norm();
    let axial = section.modulus_pa * section.area_m2 / l;
    let unit = along / l;
    let sign = |i: usize, j: usize| {
        if i / dimension == j / dimension {
            1.0
        } else {
            -1.0
        }
    };
    let stiffness = DMatrix::from_fn(2 * dimension, 2 * dimension, |i, j| {
        sign(i, j) * axial * unit[i % dimension] * unit[j % dimension]
    });
    let total = section.density_kg_per_m3 * section.area_m2 * l;
    let share = |i: usize, j: usize| match form {
        MassForm::Lumped if i == j => 1.0 / 2.0,
        MassForm::Consistent if i == j => 1.0 / 3.0,
        MassForm::Consistent if i % dimension == j % dimension => 1.0 / 6.0,
        MassForm::Lumped | MassForm::Consistent => 0.0,
    };
    let mass = DMatrix::from_fn(2 * dimension, 2 * dimension, |i, j| share(i, j) * total);
    ElementMatrices { stiffness, mass }
}

#[cfg(test)]
mod tests {
    use crate::Structure;
    use std::f64::consts::PI;
    use std::path::Path;

    fn frequencies(text: &str) -> Vec<f64> {
        let structure = Structure::parse(text, Path::new("truss.toml"))
            .unwrap_or_else(|error| panic!("{error}"));
        structure
            .modes
            .angular_frequencies
            .iter()
            .map(|omega| omega / (2.0 * PI))
            .collect()
    }

    #[track_caller]
    fn assert_frequencies(found: &[f64], expected: [f64; 5], tolerance: f64) {
        for (found, expected) in found.iter().zip(expected) {
            assert!(
                (found - expected).abs() < tolerance,
                "{found} instead of {expected}"
            );
        }
    }

    const BRIDGE: &str = include_str!("../../../docs/examples/fourteen-bay-truss.toml");
    const DOME: &str = include_str!("../../../docs/examples/dome.toml");

    /// Huang & Yuen (2023), §4.4: printed frequencies 0.43, 1.45, 2.10, 2.89, 4.44 Hz.
    #[test]
    fn the_published_truss_has_its_frequencies() {
        let found = frequencies(BRIDGE);
        assert_eq!(found.len(), 53);
        assert_frequencies(&found, [0.4250, 1.4477, 2.0950, 2.8924, 4.4374], 1e-4);
        assert!((found[52] - 39.657).abs() < 1e-3, "{}", found[52]);
    }

    /// The publication did not use consistent mass, which gives 0.427, 1.467, 2.104, 2.980,
    /// 4.664 Hz.
    #[test]
    fn consistent_masses_raise_the_frequencies_of_the_truss() {
        let found = frequencies(&BRIDGE.replace(
            "kind = \"truss\"",
            "kind = \"truss\"\nmass = \"consistent\"",
        ));
        assert_frequencies(&found, [0.427, 1.467, 2.104, 2.980, 4.664], 1e-3);
    }

    /// Substitute for the lost drawing of Huang & Yuen (2023), §5.6.3: highest frequency 66.9 Hz.
    #[test]
    fn the_substitute_dome_has_its_frequencies() {
        let found = frequencies(DOME);
        assert_eq!(found.len(), 42);
        assert_frequencies(&found, [0.234, 0.911, 5.092, 6.602, 6.622], 1e-3);
        assert!((found[41] - 66.9).abs() < 0.05, "{}", found[41]);
    }
}
