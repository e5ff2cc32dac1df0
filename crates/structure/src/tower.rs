//! The tower: a slender cantilever in space that bends in two planes and twists.
//!
//! Axial deformation is neglected. Degrees of freedom of each node: the translations `x`, `y` (m)
//! and the rotations `rx`, `ry`, `rz` (rad) about the axes of a right-handed system with `z`
//! upwards. Bending along `x` rotates the tower by `ry = ∂x/∂z`, and bending along `y` by
//! `rx = −∂y/∂z`. Huang & Yuen (2023), §2.4.7, reduce a tower of 610 m to 37 such beams, after
//! Chen, Lu & others (2011).
//!
//! That source scales entries of the stiffness matrix, with one factor for translations and another
//! for all entries of rotations. Neither part is positive semidefinite: if the factors differ, a
//! rigid rotation has strain energy. A difference of a thousandth already gives negative
//! eigenvalues. The substructures here are bending along `x`, bending along `y`, and torsion of
//! each segment. Their energies are physical for any positive factors. A parameter that scales all
//! of them is the common factor.

use crate::finite_elements::{FiniteElements, Freedoms};
use crate::frame;
use crate::linear_system::LinearSystem;
use crate::mesh::{MassForm, MemberSection};
use crate::skeleton::Skeleton;
use nalgebra::{DMatrix, Vector3};

/// Degrees of freedom of each node.
const DIRECTIONS: &[&str] = &["x", "y", "rx", "ry", "rz"];

/// Ways of deformation, in the order of the substructures of a segment.
pub(crate) const WAYS: [&str; 3] = ["bending-x", "bending-y", "torsion"];

/// A part of the tower whose stiffnesses change linearly from its foot to its top, divided into
/// equal beams.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Segment {
    pub(crate) name: String,
    pub(crate) height_m: f64,
    pub(crate) elements: usize,
    pub(crate) mass_kg_per_m: f64,
    /// `EI` of bending along `x` and along `y`, and `GJ`, at the foot of the segment (N m²).
    pub(crate) stiffnesses_n_m2: [f64; 3],
    /// Share of the foot stiffnesses at the top of the segment.
    pub(crate) top_share: f64,
    /// Square of the radius of gyration about the axis (m²).
    pub(crate) gyration_m2: f64,
}

/// Returns the tower of `segments` from the foot up, fixed at the foot.
///
/// Returns `None` if its mass is not positive definite.
pub(crate) fn system(segments: &[Segment], form: MassForm) -> Option<LinearSystem> {
    let beams: usize = segments.iter().map(|segment| segment.elements).sum();
    let names: Vec<String> = (0..=beams).map(|node| node.to_string()).collect();
    let freedoms = Freedoms::new(names.iter().map(String::as_str), DIRECTIONS, |node, _| {
        node == 0
    });
    let parts = segments
        .iter()
        .flat_map(|segment| WAYS.map(|way| format!("{}-{way}", segment.name)));
    let mut elements = FiniteElements::new(freedoms, parts);
    let mut below = 0;
    for (index, segment) in segments.iter().enumerate() {
        let length = segment.height_m / segment.elements as f64;
        for beam in 0..segment.elements {
            let middle = (beam as f64 + 0.5) / segment.elements as f64;
            let share = 1.0 + (segment.top_share - 1.0) * middle;
            let [bending_x, bending_y, torsion] =
                segment.stiffnesses_n_m2.map(|at_foot| at_foot * share);
            let ends = [below, below + 1];
            let (along_x, along_y) = ([0, 3, 5, 8], [1, 2, 6, 7]);
            for (way, bending, dofs, turn) in
                [(0, bending_x, along_x, 1.0), (1, bending_y, along_y, -1.0)]
            {
                let (stiffness, mass) =
                    beam_matrices(bending, segment.mass_kg_per_m, length, turn, form);
                elements.add_stiffness(3 * index + way, ends, &placed(&stiffness, &dofs));
                elements.add_mass(ends, &placed(&mass, &dofs));
            }
            let twist = DMatrix::from_row_slice(2, 2, &[1.0, -1.0, -1.0, 1.0]) * (torsion / length);
            let shares = match form {
                MassForm::Consistent => [2.0, 1.0, 1.0, 2.0],
                MassForm::Lumped => [3.0, 0.0, 0.0, 3.0],
            };
            let inertia = segment.mass_kg_per_m * segment.gyration_m2 * length / 6.0;
            let turned = DMatrix::from_row_slice(2, 2, &shares) * inertia;
            elements.add_stiffness(3 * index + 2, ends, &placed(&twist, &[4, 9]));
            elements.add_mass(ends, &placed(&turned, &[4, 9]));
            below += 1;
        }
    }
    let system = elements.finish()?;
    Some(LinearSystem {
        skeleton: Some(Skeleton::of_tower(segments)),
        ..system
    })
}

/// Returns the stiffness and mass of bending in one plane (4 × 4).
///
/// The order is deflection and rotation of the lower end, then of the upper end. `turn` is the sign
/// of the rotation.
fn beam_matrices(
    bending_n_m2: f64,
    mass_kg_per_m: f64,
    length: f64,
    turn: f64,
    form: MassForm,
) -> (DMatrix<f64>, DMatrix<f64>) {
    // The beam of a frame with unit modulus and area.
    let section = MemberSection {
        area_m2: 1.0,
        second_moment_m4: bending_n_m2,
        modulus_pa: 1.0,
        density_kg_per_m3: mass_kg_per_m,
    };
    let beam = frame::element(&section, Vector3::new(length, 0.0, 0.0), form);
    let across = |matrix: &DMatrix<f64>| {
        let sense = |dof: usize| if dof % 2 == 1 { turn } else { 1.0 };
        let of_beam = [1, 2, 4, 5];
        DMatrix::from_fn(4, 4, |i, j| {
            sense(i) * sense(j) * matrix[(of_beam[i], of_beam[j])]
        })
    };
    (across(&beam.stiffness), across(&beam.mass))
}

/// Returns an element matrix (10 × 10) with the entries of `part` at `dofs` and zeros elsewhere.
fn placed(part: &DMatrix<f64>, dofs: &[usize]) -> DMatrix<f64> {
    let mut matrix = DMatrix::zeros(2 * DIRECTIONS.len(), 2 * DIRECTIONS.len());
    for (i, row) in dofs.iter().enumerate() {
        for (j, column) in dofs.iter().enumerate() {
            matrix[(*row, *column)] = part[(i, j)];
        }
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modes::Modes;
    use std::f64::consts::PI;

    const TOWER: &str = include_str!("../../../docs/examples/tower.toml");

    /// Substitute for the unpublished matrices of Huang & Yuen (2023), §2.4.7: 0.111, 0.159, 0.356,
    /// 0.371, 0.549, 0.691 Hz.
    #[test]
    fn the_substitute_tower_has_its_frequencies() {
        let tower = crate::Structure::parse(TOWER, std::path::Path::new("tower.toml")).unwrap();
        let modes = &tower.modes;
        assert_eq!(modes.angular_frequencies.len(), 185);
        for (omega, expected) in modes
            .angular_frequencies
            .iter()
            .zip([0.111, 0.159, 0.356, 0.371, 0.549, 0.691])
        {
            let found = omega / (2.0 * PI);
            assert!(
                (found - expected).abs() < 0.001,
                "{found} instead of {expected}"
            );
        }
    }

    fn uniform(elements: usize) -> Segment {
        Segment {
            name: "shaft".to_owned(),
            height_m: 50.0,
            elements,
            mass_kg_per_m: 3000.0,
            stiffnesses_n_m2: [4e10, 1e10, 2e10],
            top_share: 1.0,
            gyration_m2: 2.0,
        }
    }

    /// Cantilevers bend at `(1.8751/L)² √(EI/m)` and twist at `π/2L √(GJ/m r²)`.
    #[test]
    fn a_uniform_tower_is_two_cantilevers_and_a_shaft() {
        let system = system(&[uniform(12)], MassForm::Consistent).unwrap();
        let modes = Modes::new(system.mass.to_dense(), system.nominal_stiffness()).unwrap();
        let bending = |ei: f64| (1.875_104_f64 / 50.0).powi(2) * (ei / 3000.0).sqrt();
        for expected in [
            bending(1e10),
            bending(4e10),
            PI / 100.0 * (2e10_f64 / 6000.0).sqrt(),
        ] {
            let nearest = modes
                .angular_frequencies
                .iter()
                .map(|omega| (omega / expected - 1.0).abs())
                .fold(1.0, f64::min);
            assert!(
                nearest < 1e-3,
                "nothing at {expected} rad/s, nearest off by {nearest:e}"
            );
        }
    }

    /// The mass above the middle of the lowest beam; with two beams, three quarters of the mass.
    #[test]
    fn lumped_masses_are_shared_by_the_ends_of_each_beam() {
        let system = system(&[uniform(2)], MassForm::Lumped).unwrap();
        let crate::linear_system::Mass::Lumped(masses) = &system.mass else {
            panic!("not lumped")
        };
        let whole = 3000.0 * 50.0;
        for (direction, share) in [(0, whole), (1, whole), (4, whole * 2.0)] {
            let sum = masses[direction] + masses[5 + direction];
            assert!(
                (sum - 0.75 * share).abs() < 1e-9 * share,
                "{direction}: {sum}"
            );
        }
    }

    /// Each substructure resists only the deformation in its name.
    #[test]
    fn substructures_resist_only_their_own_deformation() {
        let system = system(&[uniform(2)], MassForm::Consistent).unwrap();
        for (part, moved) in
            system
                .substructures
                .iter()
                .zip([["x", "ry"], ["y", "rx"], ["rz", "rz"]])
        {
            for (row, _, value) in part
                .stiffness
                .triplet_iter()
                .filter(|(_, _, value)| **value != 0.0)
            {
                let name = &system.degrees_of_freedom[row];
                assert!(
                    moved
                        .iter()
                        .any(|direction| name.ends_with(&format!("-{direction}"))),
                    "{name}: {value}"
                );
            }
        }
    }

    /// Under a force at the top, `x` and `ry` have the same sign, `y` and `rx` opposite signs.
    #[test]
    fn rotations_are_right_handed() {
        let system = system(&[uniform(1)], MassForm::Consistent).unwrap();
        let force = nalgebra::DVector::from_column_slice(&[1.0, 1.0, 0.0, 0.0, 0.0]);
        let bent = system.nominal_stiffness().cholesky().unwrap().solve(&force);
        let [x, y, rx, ry, rz] = bent.as_slice() else {
            panic!("five degrees of freedom")
        };
        // w = F L³/3EI, w' = F L²/2EI
        assert!(
            (x / (50.0_f64.powi(3) / 1.2e11) - 1.0).abs() < 1e-9
                && (ry / (2500.0 / 8e10) - 1.0).abs() < 1e-9
        );
        assert!(
            (y / (50.0_f64.powi(3) / 3e10) - 1.0).abs() < 1e-9
                && (rx / (-2500.0 / 2e10) - 1.0).abs() < 1e-9
        );
        assert_eq!(*rz, 0.0);
    }
}
