//! Reads `[damping]`.

use super::matrices::{Named, read_symmetric};
use super::model::ModelRead;
use crate::diagnostics::counted;
use crate::linear_system::{Damping, LARGEST_MODEL, LinearSystem, dense};
use crate::matrix_file::{self, Unusable};
use crate::section::{Allowed, Section};
use crate::shear_building::chain;
use toml::Spanned;

#[derive(Clone, Copy)]
enum DampingKind {
    Rayleigh,
    Dashpots,
    Matrix,
}

const DAMPING_KINDS: [(&str, DampingKind); 3] = [
    ("rayleigh", DampingKind::Rayleigh),
    ("dashpots", DampingKind::Dashpots),
    ("matrix", DampingKind::Matrix),
];

/// The damping, and whether the file states that it is known.
pub(super) struct DampingRead {
    pub(super) damping: Damping,
    pub(super) is_known: bool,
}

/// Reads `[damping]`; converts a damping ratio to `α` and `β` with the modes of the model as
/// designed.
pub(super) fn read_damping(
    mut section: Section<'_>,
    model: Option<&ModelRead>,
) -> Option<DampingRead> {
    let system = model.map(|model| &model.system);
    let kind = section.required_choice("kind", &DAMPING_KINDS)?;
    let is_known = section.flag_or("known", false);
    let damping = match kind.into_inner() {
        DampingKind::Rayleigh => read_rayleigh(&mut section, model),
        DampingKind::Dashpots => read_dashpots(&mut section, system),
        DampingKind::Matrix => read_damping_matrix(&mut section, system),
    };
    section.finish();
    Some(DampingRead {
        damping: damping?,
        is_known,
    })
}

fn read_rayleigh(section: &mut Section<'_>, model: Option<&ModelRead>) -> Option<Damping> {
    let alpha = section.number("alpha-per-s", Allowed::NOT_NEGATIVE);
    let beta = section.number("beta-s", Allowed::NOT_NEGATIVE);
    let ratio = section.number("ratio", Allowed::INSIDE_UNIT);
    let coefficients = section.contains("alpha-per-s") || section.contains("beta-s");
    if section.contains("ratio") == coefficients {
        let found = if coefficients {
            "is given together with alpha-per-s or beta-s"
        } else {
            "is missing"
        };
        let allowed = "must give either ratio, or alpha-per-s and beta-s";
        section
            .diagnostics()
            .report(section.span(), section.key("ratio"), found, allowed);
    }
    if coefficients {
        let [alpha_per_s, beta_s] =
            [alpha, beta].map(|value| value.map_or(0.0, Spanned::into_inner));
        return Some(Damping::Rayleigh {
            alpha_per_s,
            beta_s,
        });
    }
    let len = model.map_or(LARGEST_MODEL, |model| model.system.len());
    let modes = read_modes(section, len)?;
    rayleigh_of_ratio(model?, ratio?.into_inner(), modes)
}

/// Reads the two modes (from 1) that have the damping ratio; by default the first two.
fn read_modes(section: &mut Section<'_>, len: usize) -> Option<[usize; 2]> {
    let Some(modes) = section.numbers("modes", Allowed::POSITIVE) else {
        return (!section.contains("modes")).then_some([1, 2.min(len)]);
    };
    let is_mode = |mode: f64| mode.fract() == 0.0 && mode >= 1.0 && mode <= len as f64;
    match modes.get_ref()[..] {
        [first, second] if first != second && is_mode(first) && is_mode(second) => {
            Some([first as usize, second as usize])
        }
        _ => {
            let found = format!("is {:?}", modes.get_ref());
            let allowed = format!("must be two different whole numbers from 1 to {len}");
            section
                .diagnostics()
                .report(modes.span(), section.key("modes"), found, allowed);
            None
        }
    }
}

/// Returns `α = 2ζ ω_i ω_j / (ω_i + ω_j)` and `β = 2ζ / (ω_i + ω_j)`.
///
/// They give both modes (from 1) the damping ratio `ζ`. With a single degree of freedom, both modes
/// are the same, and each term contributes half of the damping.
fn rayleigh_of_ratio(model: &ModelRead, ratio: f64, modes: [usize; 2]) -> Option<Damping> {
    let omegas = &model.modes.angular_frequencies;
    let [first, second] = modes.map(|mode| omegas.get(mode - 1).copied());
    let (first, second) = (first?, second?);
    let beta_s = 2.0 * ratio / (first + second);
    // β K uses the stiffness of the springs, ω² the stiffness against small motions.
    Some(Damping::Rayleigh {
        alpha_per_s: beta_s * first * second,
        beta_s: beta_s * model.system.initial_slope(),
    })
}

/// Reads one dashpot per storey of a chain; the storeys of a group share a substructure.
fn read_dashpots(section: &mut Section<'_>, system: Option<&LinearSystem>) -> Option<Damping> {
    let key = "coefficients-n-s-per-m";
    let Some(system) = system else {
        section.leave_unread(&[key]);
        return None;
    };
    if system.storeys.is_empty() {
        let allowed = "must be \"rayleigh\" or \"matrix\" for a model without storeys";
        section.diagnostics().report(
            section.span(),
            section.key("kind"),
            "is \"dashpots\"",
            allowed,
        );
        section.leave_unread(&[key]);
        return None;
    }
    let coefficients = section.number_for_each(key, Allowed::POSITIVE, system.len());
    let allowed =
        "must be the coefficient of the dashpot in every storey, or a list from the bottom up";
    let coefficients = section.require(key, allowed, coefficients)?;
    Some(Damping::Dashpots(chain(&system.storeys, &coefficients)))
}

fn read_damping_matrix(
    section: &mut Section<'_>,
    system: Option<&LinearSystem>,
) -> Option<Damping> {
    let file = section.text("file");
    let file = section.require(
        "file",
        "must name the Matrix Market file of the damping matrix",
        file,
    )?;
    let named: Named = read_symmetric(section, section.key("file"), &file)?;
    let len = system?.len();
    if named.matrix.nrows() != len {
        let found = format!(
            "has {}",
            counted(
                named.matrix.nrows(),
                "degree of freedom",
                "degrees of freedom"
            )
        );
        section.diagnostics().report(
            named.span,
            named.key,
            found,
            format!("must have {len} like the model"),
        );
        return None;
    }
    if let Err(Unusable { found, allowed }) = matrix_file::check_semidefinite(&dense(&named.matrix))
    {
        section
            .diagnostics()
            .report(named.span, named.key, found, allowed);
        return None;
    }
    Some(Damping::Matrix(named.matrix))
}
