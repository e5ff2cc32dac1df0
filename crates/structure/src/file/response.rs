//! Reads `[[response]]`: displacements and velocities to estimate.

use super::check_unique;
use super::node::read_sensed;
use crate::estimated_response::EstimatedResponse;
use crate::linear_system::LinearSystem;
use crate::node::Quantity;
use crate::section::Section;
use toml::Spanned;

const QUANTITIES: [(&str, Quantity); 3] = [
    ("displacement", Quantity::Displacement),
    ("velocity", Quantity::Velocity),
    ("strain", Quantity::Strain),
];

/// Reads every `[[response]]`.
///
/// `taken` are the names of the parameters, which share the namespace of a table of estimates.
pub(super) fn read_responses(
    file: &mut Section<'_>,
    system: Option<&LinearSystem>,
    taken: impl Iterator<Item = Spanned<String>>,
) -> Vec<EstimatedResponse> {
    let read: Vec<_> = file
        .tables("response")
        .into_iter()
        .filter_map(|section| read_response(section, system))
        .collect();
    let names: Vec<_> = taken
        .chain(read.iter().map(|(name, _)| name.clone()))
        .collect();
    if !read.is_empty() {
        check_unique(file, "response.name", &names);
    }
    read.into_iter().map(|(_, response)| response).collect()
}

fn read_response(
    mut section: Section<'_>,
    system: Option<&LinearSystem>,
) -> Option<(Spanned<String>, EstimatedResponse)> {
    let name = section.required_name("name");
    let quantity = section
        .required_choice("quantity", &QUANTITIES)
        .map(Spanned::into_inner);
    if let Some(quantity @ (Quantity::Displacement | Quantity::Strain)) = quantity
        && system.is_some_and(|system| system.hysteresis.is_some())
    {
        let allowed =
            "must be a velocity for the kind bouc-wen, which does not follow displacements";
        section.diagnostics().report(
            section.span(),
            section.key("quantity"),
            format!("is \"{quantity}\""),
            allowed,
        );
    }
    let sensed = quantity.and_then(|quantity| read_sensed(&mut section, quantity, system));
    if quantity.is_none() {
        section.leave_unread(&["dof", "dofs", "coefficients"]);
    }
    section.finish();
    let (name, sensed) = (name?, sensed?);
    let first = if quantity? == Quantity::Velocity {
        system?.len()
    } else {
        0
    };
    let terms = sensed
        .into_iter()
        .map(|(dof, coefficient)| (first + dof, coefficient))
        .collect();
    Some((
        name.clone(),
        EstimatedResponse {
            name: name.into_inner(),
            terms,
        },
    ))
}
