//! Members of a plane frame: Euler-Bernoulli beams with axial stiffness.
//!
//! Degrees of freedom of an end: `x`, `y` (m) and the rotation `r` (rad), counter-clockwise. In
//! member directions they are `u` along the member and `w` across it.
//!
//! Matrices: Przemieniecki, *Theory of Matrix Structural Analysis* (1968), (5.116) and (11.27)
//! without shear and rotary inertia. Huang & Yuen (2023), §2.4.5, describes a bridge of such
//! members.

use crate::mesh::{ElementMatrices, MassForm, MemberSection};
use nalgebra::{DMatrix, Matrix6, Vector3, Vector6};

/// Degrees of freedom of each node.
pub(crate) const DIRECTIONS: &[&str] = &["x", "y", "r"];

/// Returns stiffness and mass of a member of `section` along a vector (m) in the plane.
pub(crate) fn element(
    section: &MemberSection,
    along: Vector3<f64>,
    form: MassForm,
) -> ElementMatrices {
    let l = along.norm();
    let local_from_global = rotation(along / l);
    let turned = |matrix: Matrix6<f64>| {
        let global = local_from_global.transpose() * matrix * local_from_global;
        DMatrix::from_column_slice(6, 6, global.as_slice())
    };
    let mass = match form {
        MassForm::Consistent => consistent_mass(section, l),
        MassForm::Lumped => lumped_mass(section, l),
    };
    ElementMatrices {
        stiffness: turned(stiffness(section, l)),
        mass: turned(mass),
    }
}

/// Returns the transformation from global to member directions (6 × 6) for a unit vector along the
/// member.
fn rotation(along: Vector3<f64>) -> Matrix6<f64> {
    let (cos, sin) = (along.x, along.y);
    let mut local_from_global = Matrix6::zeros();
    for end in [0, 3] {
        local_from_global[(end, end)] = cos;
        local_from_global[(end, end + 1)] = sin;
        local_from_global[(end + 1, end)] = -sin;
        local_from_global[(end + 1, end + 1)] = cos;
        local_from_global[(end + 2, end + 2)] = 1.0;
    }
    local_from_global
}

fn stiffness(section: &MemberSection, l: f64) -> Matrix6<f64> {
    let axial = section.modulus_pa * section.area_m2 / l;
    let bending = section.modulus_pa * section.second_moment_m4 / l.powi(3);
    let (a, b, c, d, e) = (
        axial,
        12.0 * bending,
        6.0 * l * bending,
        4.0 * l * l * bending,
        2.0 * l * l * bending,
    );
    #[rustfmt::skip]
    let matrix = Matrix6::new(
          a, 0.0, 0.0,  -a, 0.0, 0.0,
        0.0,   b,   c, 0.0,  -b,   c,
        0.0,   c,   d, 0.0,  -c,   e,
         -a, 0.0, 0.0,   a, 0.0, 0.0,
        0.0,  -b,  -c, 0.0,   b,  -c,
        0.0,   c,   e, 0.0,  -c,   d,
    );
    matrix
}

fn consistent_mass(section: &MemberSection, l: f64) -> Matrix6<f64> {
    let (p, q) = (22.0 * l, 13.0 * l);
    let (r, s) = (4.0 * l * l, 3.0 * l * l);
    #[rustfmt::skip]
    let shape = Matrix6::new(
        140.0,   0.0, 0.0,  70.0,   0.0, 0.0,
          0.0, 156.0,   p,   0.0,  54.0,  -q,
          0.0,     p,   r,   0.0,     q,  -s,
         70.0,   0.0, 0.0, 140.0,   0.0, 0.0,
          0.0,  54.0,   q,   0.0, 156.0,  -p,
          0.0,    -q,  -s,   0.0,    -p,   r,
    );
    shape * (section.density_kg_per_m3 * section.area_m2 * l / 420.0)
}

/// Returns the lumped mass matrix, with half of the mass at each end.
///
/// The rotations keep their share of the consistent diagonal (Hinton, Rock & Zienkiewicz 1976,
/// *Earthquake Eng. Struct. Dyn.* 4, 245), since a zero mass has no acceleration.
fn lumped_mass(section: &MemberSection, l: f64) -> Matrix6<f64> {
    let mass = section.density_kg_per_m3 * section.area_m2 * l;
    let (half, rotation) = (mass / 2.0, mass * l * l / 78.0);
    Matrix6::from_diagonal(&Vector6::new(half, half, rotation, half, half, rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Structure;
    use std::f64::consts::PI;
    use std::path::Path;

    const SECTION: MemberSection = MemberSection {
        area_m2: 0.02,
        second_moment_m4: 3e-4,
        modulus_pa: 2.1e11,
        density_kg_per_m3: 7850.0,
    };

    fn frequencies(text: &str) -> Vec<f64> {
        let structure = Structure::parse(text, Path::new("bridge.toml"))
            .unwrap_or_else(|error| panic!("{error}"));
        structure
            .modes
            .angular_frequencies
            .iter()
            .map(|omega| omega / (2.0 * PI))
            .collect()
    }

    const BRIDGE: &str = include_str!("../../../docs/examples/three-pier-bridge.toml");

    /// Huang & Yuen (2023), §2.4.5 and §3.4.2, with the second moment of the deck from chapters 3
    /// and 6.
    #[test]
    fn the_published_bridge_has_its_frequencies() {
        let found = frequencies(BRIDGE);
        assert_eq!(found.len(), 59);
        for (found, expected) in found.iter().zip([0.466, 0.531, 0.699, 0.890, 1.332]) {
            assert!(
                (found - expected).abs() < 0.001,
                "{found} instead of {expected}"
            );
        }
        assert!((found[58] - 36.3).abs() < 0.05, "{}", found[58]);
    }

    /// Returns the first frequency of a pinned beam with `members` members.
    ///
    /// Without axial extension it is `f₁ = π/2 √(EI/ρA)/L²` (L = 10 m).
    fn beam(members: usize, form: &str) -> f64 {
        let nodes: Vec<String> = (1..=members + 1).map(|node| node.to_string()).collect();
        let channel = "quantity = \"velocity\"\ndof = 1\nunit = \"m/s\"\nnoise-std = 1";
        let text = format!(
            r#"
            structure = {{ name = "beam", sampling-rate-hz = 100 }}
            damping = {{ kind = "rayleigh", ratio = 0.01 }}
            parameter = [{{ name = "beam", scales = "stiffness", of = ["beam"] }}]
            excitation = [{{ name = "ground", kind = "ground", direction = "y", std = 1 }}]
            [model]
            kind = "frame"
            mass = "{form}"
            nodes = {{ 1 = [0, 0], {last} = [6, 8] }}
            group = [{{ name = "beam", section = "steel", paths = [[{nodes}]] }}]
            support = [{{ nodes = [1, {last}], fixed = ["x", "y"] }}]
            section = [{{ name = "steel", area-m2 = 0.02, second-moment-m4 = 3e-4, modulus-pa = 2.1e11, density-kg-per-m3 = 7850 }}]
            [[node]]
            name = "foot"
            [[node.channel]]
            name = "foot"
            {channel}
            "#,
            last = members + 1,
            nodes = nodes.join(", "),
        );
        frequencies(&text)[0]
    }

    /// Lumped masses converge with the square of the member length. Consistent masses converge from
    /// above with the fourth power: Archer (1963), *J. Struct. Div.* 89, 161.
    #[test]
    fn frequency_of_a_pinned_beam_converges_to_the_textbook() {
        let exact = PI / 2.0 * (2.1e11_f64 * 3e-4 / (7850.0 * 0.02)).sqrt() / 100.0;
        let error = |members, form| beam(members, form) / exact - 1.0;
        let [coarse, fine] = [4, 8].map(|members| error(members, "consistent"));
        assert!(
            fine > 0.0 && (coarse / fine - 16.0).abs() < 1.0,
            "{coarse:e}, {fine:e}"
        );
        let [coarse, fine] = [4, 8].map(|members| error(members, "lumped"));
        assert!(
            fine.abs() < 0.01 && (coarse / fine - 4.0).abs() < 0.5,
            "{coarse:e}, {fine:e}"
        );
    }

    /// A rigid motion has no strain energy, and its kinetic energy includes the whole mass.
    #[test]
    fn a_rigid_motion_moves_the_whole_mass_without_force() {
        let along = Vector3::new(3.0, -4.0, 0.0);
        let mass = 7850.0 * 0.02 * 5.0;
        for form in [MassForm::Consistent, MassForm::Lumped] {
            let matrices = element(&SECTION, along, form);
            for direction in [0, 1] {
                let moved =
                    nalgebra::DVector::from_fn(
                        6,
                        |dof, _| if dof % 3 == direction { 1.0 } else { 0.0 },
                    );
                assert!((&matrices.stiffness * &moved).norm() < 1e-6 * matrices.stiffness.norm());
                assert!(((&matrices.mass * &moved).dot(&moved) - mass).abs() < 1e-9 * mass);
            }
            // Rotation about the first end: the second end moves across by the length.
            let turned = nalgebra::DVector::from_column_slice(&[0.0, 0.0, 1.0, 4.0, 3.0, 1.0]);
            assert!((&matrices.stiffness * &turned).norm() < 1e-9 * matrices.stiffness.norm());
        }
        let turned = nalgebra::DVector::from_column_slice(&[0.0, 0.0, 1.0, 4.0, 3.0, 1.0]);
        let inertia = (element(&SECTION, along, MassForm::Consistent).mass * &turned).dot(&turned);
        assert!(
            (inertia / (mass * 25.0 / 3.0) - 1.0).abs() < 1e-12,
            "{inertia}"
        );
    }

    /// A cantilever under a force and a moment at its tip.
    ///
    /// `w = F L³/3EI + M L²/2EI`, `φ = F L²/2EI + M L/EI`, `u = N L/EA`.
    #[test]
    fn tip_deflection_of_a_cantilever_equals_the_textbook() {
        let (l, ei, ea) = (5.0, 2.1e11 * 3e-4, 2.1e11 * 0.02);
        let stiffness =
            element(&SECTION, Vector3::new(l, 0.0, 0.0), MassForm::Consistent).stiffness;
        let tip = stiffness.view((3, 3), (3, 3)).into_owned();
        let (n, f, m) = (7e4, 3e3, 2e3);
        let found = tip
            .lu()
            .solve(&nalgebra::DVector::from_column_slice(&[n, f, m]))
            .unwrap();
        let expected = [
            n * l / ea,
            f * l.powi(3) / (3.0 * ei) + m * l * l / (2.0 * ei),
            f * l * l / (2.0 * ei) + m * l / ei,
        ];
        for (found, expected) in found.iter().zip(expected) {
            assert!(
                (found / expected - 1.0).abs() < 1e-12,
                "{found} instead of {expected}"
            );
        }
    }
}
