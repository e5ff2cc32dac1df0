//! Frames and trusses: nodes in space, joined by straight members.
//!
//! A plane frame has Euler–Bernoulli members that resist stretching and bending, with three degrees of freedom per node
//! (x, y, and the rotation r) and consistent mass; Huang & Yuen (2023), §2.4.2. A truss, plane or in space, has bars that
//! resist stretching only; §4.6.2 (plane) and §5.6.3 (space). Members of a group make one substructure.

use crate::linear_system::{LARGEST_MODEL, Mass, Substructure};
use nalgebra::{Cholesky, DMatrix, DVector};
use nalgebra_sparse::{CooMatrix, CsrMatrix};

/// What the members resist.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Action {
    /// Stretching and bending in the plane.
    Frame,
    /// Stretching.
    Truss,
}

/// A direction in which a node can move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Direction {
    X,
    Y,
    Z,
    /// Rotation in the plane, anticlockwise.
    Rotation,
}

impl Direction {
    /// Words for the directions, as in the structure file.
    pub(crate) const WORDS: [(&'static str, Self); 4] =
        [("x", Self::X), ("y", Self::Y), ("z", Self::Z), ("r", Self::Rotation)];

    fn word(self) -> &'static str {
        match self {
            Self::X => "x",
            Self::Y => "y",
            Self::Z => "z",
            Self::Rotation => "r",
        }
    }
}

/// A node.
#[derive(Debug, Clone)]
pub(crate) struct SkeletonNode {
    pub(crate) name: String,
    /// Two or three coordinates (m), as many for every node.
    pub(crate) at: Vec<f64>,
    pub(crate) fixed: Vec<Direction>,
    /// Mass of what the node carries besides its members (kg).
    pub(crate) mass_kg: f64,
}

/// What a member is made of.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Profile {
    pub(crate) modulus_pa: f64,
    pub(crate) density_kg_per_m3: f64,
    pub(crate) area_m2: f64,
    /// 0 in a truss.
    pub(crate) second_moment_m4: f64,
}

/// A member from one node to another (numbers from 0), and the group it belongs to.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Member {
    pub(crate) ends: [usize; 2],
    pub(crate) group: usize,
    pub(crate) profile: Profile,
}

/// All of a frame or truss; members have a length, checked where the file is read.
#[derive(Debug, Clone)]
pub(crate) struct Skeleton {
    pub(crate) action: Action,
    pub(crate) consistent_mass: bool,
    pub(crate) nodes: Vec<SkeletonNode>,
    pub(crate) groups: Vec<String>,
    pub(crate) members: Vec<Member>,
}

/// Why a skeleton is no structure.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Unsound {
    pub(crate) found: String,
    pub(crate) allowed: String,
}

impl Skeleton {
    /// Directions in which its nodes move unless they are fixed.
    pub(crate) fn directions(action: Action, dimensions: usize) -> Vec<Direction> {
        match (action, dimensions) {
            (Action::Frame, _) => vec![Direction::X, Direction::Y, Direction::Rotation],
            (Action::Truss, 2) => vec![Direction::X, Direction::Y],
            (Action::Truss, _) => vec![Direction::X, Direction::Y, Direction::Z],
        }
    }

    fn node_directions(&self) -> Vec<Direction> {
        Self::directions(self.action, self.nodes.first().map_or(2, |node| node.at.len()))
    }

    /// Returns the number of each node's degrees of freedom, in the order of its directions; `None` where it is fixed.
    fn numbers(&self) -> (Vec<Vec<Option<usize>>>, usize) {
        let directions = self.node_directions();
        let mut free = 0;
        let numbers = self.nodes.iter().map(|node| {
            let number = |direction: &Direction| {
                (!node.fixed.contains(direction)).then(|| {
                    free += 1;
                    free - 1
                })
            };
            directions.iter().map(number).collect()
        });
        (numbers.collect(), free)
    }

    /// Returns the names `NODE-DIRECTION` of the degrees of freedom with their directions.
    pub(crate) fn degrees_of_freedom(&self) -> Vec<(String, Direction)> {
        let directions = self.node_directions();
        let of_node = |node: &SkeletonNode| {
            let free = directions.iter().filter(|direction| !node.fixed.contains(direction));
            free.map(|direction| (format!("{}-{}", node.name, direction.word()), *direction)).collect::<Vec<_>>()
        };
        self.nodes.iter().flat_map(of_node).collect()
    }

    /// Assembles the mass and one stiffness matrix for each group.
    ///
    /// # Errors
    /// When the mass is not positive definite, or there is nothing that moves or too much.
    pub(crate) fn assemble(&self) -> Result<(Mass, Vec<Substructure>), Unsound> {
        let (numbers, len) = self.numbers();
        if len == 0 || len > LARGEST_MODEL {
            let allowed = format!("must have from 1 to {LARGEST_MODEL}");
            return Err(Unsound { found: format!("has {len} degrees of freedom"), allowed });
        }
        let mut stiffness = vec![CooMatrix::new(len, len); self.groups.len()];
        let mut mass = DMatrix::zeros(len, len);
        for member in &self.members {
            let dofs: Vec<Option<usize>> = member.ends.iter().flat_map(|end| numbers[*end].iter().copied()).collect();
            let (k, m) = self.matrices(member);
            for (i, row) in dofs.iter().enumerate() {
                for (j, column) in dofs.iter().enumerate() {
                    let (Some(row), Some(column)) = (row, column) else { continue };
                    if k[(i, j)] != 0.0 {
                        stiffness[member.group].push(*row, *column, k[(i, j)]);
                    }
                    mass[(*row, *column)] += m[(i, j)];
                }
            }
        }
        for (node, dofs) in self.nodes.iter().zip(&numbers) {
            let translations = dofs.iter().zip(self.node_directions()).filter(|(_, d)| *d != Direction::Rotation);
            for dof in translations.filter_map(|(dof, _)| *dof) {
                mass[(dof, dof)] += node.mass_kg;
            }
        }
        let mass = if self.consistent_mass {
            let factor = Cholesky::new(mass.clone()).ok_or_else(without_mass)?;
            Mass::Consistent { matrix: mass, factor }
        } else if mass.diagonal().iter().all(|mass| *mass > 0.0) {
            Mass::Lumped(DVector::from(mass.diagonal()))
        } else {
            return Err(without_mass());
        };
        let groups = self.groups.iter().zip(&stiffness);
        let groups =
            groups.map(|(name, matrix)| Substructure { name: name.clone(), stiffness: CsrMatrix::from(matrix) });
        Ok((mass, groups.collect()))
    }

    /// Length (m) and direction cosines of a member.
    pub(crate) fn span(&self, member: &Member) -> (f64, DVector<f64>) {
        let [from, to] = member.ends.map(|end| DVector::from_column_slice(&self.nodes[end].at));
        let between = to - from;
        let length = between.norm();
        (length, between / length)
    }

    /// Returns stiffness and mass of a member in global directions, both ends one after the other.
    fn matrices(&self, member: &Member) -> (DMatrix<f64>, DMatrix<f64>) {
        let (length, cosines) = self.span(member);
        match self.action {
            Action::Frame => bent(member.profile, length, cosines[0], cosines[1]),
            Action::Truss => stretched(member.profile, length, &cosines, self.consistent_mass),
        }
    }
}

fn without_mass() -> Unsound {
    Unsound {
        found: "has a node that moves and has no mass".to_owned(),
        allowed: "must join every node that is not fixed to a member".to_owned(),
    }
}

/// A bar: `E A / L` along itself, and its mass in all directions.
fn stretched(profile: Profile, length: f64, cosines: &DVector<f64>, consistent: bool) -> (DMatrix<f64>, DMatrix<f64>) {
    let n = cosines.len();
    let axial = cosines * cosines.transpose() * (profile.modulus_pa * profile.area_m2 / length);
    let total = profile.density_kg_per_m3 * profile.area_m2 * length;
    // lumped, half of the mass at each end; consistent, a third, and a sixth between the ends
    let (own, other) = if consistent { (total / 3.0, total / 6.0) } else { (total / 2.0, 0.0) };
    let stiffness = DMatrix::from_fn(2 * n, 2 * n, |i, j| {
        let sign = if i / n == j / n { 1.0 } else { -1.0 };
        sign * axial[(i % n, j % n)]
    });
    let mass = DMatrix::from_fn(2 * n, 2 * n, |i, j| match (i % n == j % n, i == j) {
        (_, true) => own,
        (true, false) => other,
        (false, _) => 0.0,
    });
    (stiffness, mass)
}

/// An Euler–Bernoulli member with stretching: stiffness and consistent mass, turned from its own to global directions.
fn bent(profile: Profile, l: f64, c: f64, s: f64) -> (DMatrix<f64>, DMatrix<f64>) {
    let Profile { modulus_pa: e, density_kg_per_m3, area_m2, second_moment_m4: i } = profile;
    let axial = e * area_m2 / l;
    let (k2, k3, k4, k5) = (12.0 * e * i / l.powi(3), 6.0 * e * i / l.powi(2), 4.0 * e * i / l, 2.0 * e * i / l);
    #[rustfmt::skip]
    let k = DMatrix::from_row_slice(6, 6, &[
        axial, 0.0, 0.0, -axial, 0.0, 0.0,
        0.0, k2, k3, 0.0, -k2, k3,
        0.0, k3, k4, 0.0, -k3, k5,
        -axial, 0.0, 0.0, axial, 0.0, 0.0,
        0.0, -k2, -k3, 0.0, k2, -k3,
        0.0, k3, k5, 0.0, -k3, k4,
    ]);
    #[rustfmt::skip]
    let m = DMatrix::from_row_slice(6, 6, &[
        140.0, 0.0, 0.0, 70.0, 0.0, 0.0,
        0.0, 156.0, 22.0 * l, 0.0, 54.0, -13.0 * l,
        0.0, 22.0 * l, 4.0 * l * l, 0.0, 13.0 * l, -3.0 * l * l,
        70.0, 0.0, 0.0, 140.0, 0.0, 0.0,
        0.0, 54.0, 13.0 * l, 0.0, 156.0, -22.0 * l,
        0.0, -13.0 * l, -3.0 * l * l, 0.0, -22.0 * l, 4.0 * l * l,
    ]) * (density_kg_per_m3 * area_m2 * l / 420.0);
    let mut turn = DMatrix::identity(6, 6);
    for end in [0, 3] {
        turn[(end, end)] = c;
        turn[(end, end + 1)] = s;
        turn[(end + 1, end)] = -s;
        turn[(end + 1, end + 1)] = c;
    }
    (turn.transpose() * k * &turn, turn.transpose() * m * &turn)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modes::Modes;
    use std::f64::consts::PI;

    const STEEL: Profile =
        Profile { modulus_pa: 2e11, density_kg_per_m3: 7850.0, area_m2: 0.01, second_moment_m4: 1e-5 };

    fn line(action: Action, members: usize, length: f64, fix: impl Fn(usize) -> Vec<Direction>) -> Skeleton {
        let node = |number: usize| SkeletonNode {
            name: (number + 1).to_string(),
            at: vec![length * number as f64 / members as f64, 0.0],
            fixed: fix(number),
            mass_kg: 0.0,
        };
        let member = |number| Member { ends: [number, number + 1], group: 0, profile: STEEL };
        Skeleton {
            action,
            consistent_mass: true,
            nodes: (0..=members).map(node).collect(),
            groups: vec!["all".to_owned()],
            members: (0..members).map(member).collect(),
        }
    }

    fn lowest(skeleton: &Skeleton) -> Vec<f64> {
        let (mass, parts) = skeleton.assemble().unwrap();
        let stiffness = crate::linear_system::dense(&parts[0].stiffness);
        Modes::new(mass.to_dense(), stiffness).unwrap().angular_frequencies.as_slice().to_vec()
    }

    #[test]
    fn simply_supported_beam_has_the_frequencies_of_the_textbook() {
        // ω_n = (nπ/L)² √(EI/ρA)
        let members = 12;
        let supports = |number| match number {
            0 => vec![Direction::X, Direction::Y],
            12 => vec![Direction::Y],
            _ => vec![],
        };
        let omega = lowest(&line(Action::Frame, members, 6.0, supports));
        for (n, omega) in (1..=3).zip(omega) {
            let expected = (f64::from(n) * PI / 6.0).powi(2) * (2e11_f64 * 1e-5 / (7850.0 * 0.01)).sqrt();
            assert!((omega / expected - 1.0).abs() < 1e-3, "mode {n}: {omega}, expected {expected}");
        }
    }

    #[test]
    fn bar_fixed_at_one_end_has_the_frequencies_of_the_textbook() {
        // ω_n = (2n − 1) π/(2L) √(E/ρ)
        let supports = |number| if number == 0 { vec![Direction::X, Direction::Y] } else { vec![Direction::Y] };
        for consistent_mass in [true, false] {
            let skeleton = Skeleton { consistent_mass, ..line(Action::Truss, 40, 3.0, supports) };
            let expected = PI / 6.0 * (2e11_f64 / 7850.0).sqrt();
            let omega = lowest(&skeleton)[0];
            assert!((omega / expected - 1.0).abs() < 1e-3, "{consistent_mass}: {omega}, expected {expected}");
        }
    }

    #[test]
    fn turning_a_frame_changes_no_frequency() {
        let upright = line(Action::Frame, 4, 6.0, |n| {
            if n == 0 { vec![Direction::X, Direction::Y, Direction::Rotation] } else { vec![] }
        });
        let mut turned = upright.clone();
        for node in &mut turned.nodes {
            let x = node.at[0];
            node.at = vec![0.6 * x, 0.8 * x];
        }
        for (a, b) in lowest(&upright).iter().zip(lowest(&turned)) {
            assert!((a / b - 1.0).abs() < 1e-9, "{a} {b}");
        }
    }
}
