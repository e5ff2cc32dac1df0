//! Reads `[model]`: the kind and its keys.

use super::chain::{read_chain, read_hysteretic_chain};
use super::matrices::read_matrices;
use super::mesh::{MeshKind, read_mesh, read_skeleton};
use super::tower::read_tower;
use crate::linear_system::LinearSystem;
use crate::modes::Modes;
use crate::section::Section;

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    ShearBuilding,
    BoucWen,
    Frame,
    Truss,
    Tower,
    Matrices,
    Modal,
}

const KINDS: [(&str, Kind); 7] = [
    ("shear-building", Kind::ShearBuilding),
    ("bouc-wen", Kind::BoucWen),
    ("frame", Kind::Frame),
    ("truss", Kind::Truss),
    ("tower", Kind::Tower),
    ("matrices", Kind::Matrices),
    ("modal", Kind::Modal),
];

/// What is allowed of tables and keys that need a model.
pub(super) const WITHOUT_A_MODEL: &str = "must not be given with kind = \"modal\", which has no \
                                          model to identify";
/// What a command allows that needs a model.
pub(super) const WITH_A_MODEL: &str = "must be a kind with masses and stiffnesses: this command \
                                       needs a model";

/// A model and its modes, which take seconds for a thousand degrees of freedom.
pub(super) struct ModelRead {
    pub(super) system: LinearSystem,
    pub(super) modes: Modes,
}

/// Reads `[model]`; the damping of the result is still zero. The kind `modal` gives an empty
/// system.
pub(super) fn read_model(mut section: Section<'_>) -> Option<ModelRead> {
    let kind = section.required_choice("kind", &KINDS)?;
    let system = match kind.into_inner() {
        Kind::ShearBuilding => read_chain(&mut section),
        Kind::BoucWen => read_hysteretic_chain(&mut section),
        Kind::Frame => read_mesh(&mut section, MeshKind::Frame),
        Kind::Truss => read_mesh(&mut section, MeshKind::Truss),
        Kind::Tower => read_tower(&mut section),
        Kind::Matrices => read_matrices(&mut section),
        Kind::Modal => read_skeleton(&mut section).map(LinearSystem::empty),
    };
    let model = system.and_then(|system| {
        let modes = match system.is_empty() {
            true => Modes::none(),
            false => checked_modes(&section, &system)?,
        };
        Some(ModelRead { system, modes })
    });
    section.finish();
    model
}

/// Computes the modes, and checks that all natural frequencies are finite and positive. Finite
/// inputs do not guarantee this.
fn checked_modes(section: &Section<'_>, system: &LinearSystem) -> Option<Modes> {
    let modes = Modes::new(system.mass.to_dense(), system.nominal_stiffness());
    let is_sound = |modes: &Modes| {
        modes
            .angular_frequencies
            .iter()
            .all(|omega| omega.is_normal())
    };
    let modes = modes.filter(is_sound);
    if modes.is_none() {
        let allowed = "must have masses and stiffnesses of real structures";
        section.diagnostics().report(
            section.span(),
            section.key("kind"),
            "has no natural frequencies",
            allowed,
        );
    }
    modes
}
