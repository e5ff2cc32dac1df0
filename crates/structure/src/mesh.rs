//! Nodes joined by straight members of uniform section, common to frames and trusses.

use crate::finite_elements::{FiniteElements, Freedoms};
use crate::linear_system::LinearSystem;
use crate::skeleton::Skeleton;
use nalgebra::{DMatrix, Vector3};

/// A point at which members meet.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MeshNode {
    pub(crate) name: String,
    /// Coordinates (m); unused dimensions of the mesh are zero.
    pub(crate) at: Vector3<f64>,
    /// `true` for each direction that cannot move, in the order of the directions of the mesh.
    pub(crate) fixed: Vec<bool>,
}

/// Cross-section and material of a member.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MemberSection {
    pub(crate) area_m2: f64,
    /// `I` (m⁴); zero for the bars of a truss.
    pub(crate) second_moment_m4: f64,
    /// `E` (Pa).
    pub(crate) modulus_pa: f64,
    /// `ρ` (kg/m³).
    pub(crate) density_kg_per_m3: f64,
}

/// Members of one section whose stiffness is scaled together, as one substructure.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MemberGroup {
    pub(crate) name: String,
    pub(crate) section: MemberSection,
    /// Nodes that each member joins (from 0).
    pub(crate) members: Vec<[usize; 2]>,
}

/// Distribution of the mass of a member to its nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MassForm {
    /// By the shape functions of its stiffness matrix.
    Consistent,
    /// Half of the mass to each node.
    Lumped,
}

/// Stiffness and mass of a member in global directions.
pub(crate) struct ElementMatrices {
    pub(crate) stiffness: DMatrix<f64>,
    pub(crate) mass: DMatrix<f64>,
}

/// A structure of members.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Mesh {
    /// Names of the degrees of freedom of each node.
    pub(crate) directions: &'static [&'static str],
    pub(crate) nodes: Vec<MeshNode>,
    pub(crate) groups: Vec<MemberGroup>,
    pub(crate) mass: MassForm,
}

impl Mesh {
    /// Returns the number of free degrees of freedom.
    pub(crate) fn free_len(&self) -> usize {
        self.nodes
            .iter()
            .flat_map(|node| &node.fixed)
            .filter(|fixed| !**fixed)
            .count()
    }

    /// Assembles the members. `element` returns the matrices of a member along a vector (m) from
    /// end to end.
    ///
    /// Returns `None` if the mass is not positive definite.
    pub(crate) fn system(
        &self,
        element: impl Fn(&MemberSection, Vector3<f64>, MassForm) -> ElementMatrices,
    ) -> Option<LinearSystem> {
        let names = self.nodes.iter().map(|node| node.name.as_str());
        let freedoms = Freedoms::new(names, self.directions, |node, direction| {
            self.nodes[node].fixed[direction]
        });
        let mut elements =
            FiniteElements::new(freedoms, self.groups.iter().map(|group| group.name.clone()));
        for (part, group) in self.groups.iter().enumerate() {
            for &[from, to] in &group.members {
                let along = self.nodes[to].at - self.nodes[from].at;
                let ElementMatrices { stiffness, mass } = element(&group.section, along, self.mass);
                elements.add_stiffness(part, [from, to], &stiffness);
                elements.add_mass([from, to], &mass);
            }
        }
        let system = elements.finish()?;
        Some(LinearSystem {
            skeleton: Some(Skeleton::of_mesh(self)),
            ..system
        })
    }
}
