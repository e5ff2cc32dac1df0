//! Reads the kinds `frame` and `truss` of `[model]`: nodes, members in groups, and supports.

use super::{check_unique, find_name};
use crate::diagnostics::counted;
use crate::linear_system::{LARGEST_MODEL, LinearSystem};
use crate::matrix_file;
use crate::mesh::{MassForm, MemberGroup, MemberSection, Mesh, MeshNode};
use crate::section::{Allowed, NumberOrName, Section, is_name};
use crate::skeleton::{Line, Skeleton, Up};
use crate::{frame, truss};
use nalgebra::Vector3;
use toml::Spanned;

/// Kind of the members of a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum MeshKind {
    Frame,
    Truss,
}

pub(super) const MASS_FORMS: [(&str, MassForm); 2] = [
    ("consistent", MassForm::Consistent),
    ("lumped", MassForm::Lumped),
];

impl MeshKind {
    /// Returns the usual form: shape functions for beams, halves for bars.
    fn default_mass(self) -> MassForm {
        match self {
            Self::Frame => MassForm::Consistent,
            Self::Truss => MassForm::Lumped,
        }
    }

    fn directions(self, dimension: usize) -> &'static [&'static str] {
        match (self, dimension) {
            (Self::Frame, _) => frame::DIRECTIONS,
            (Self::Truss, 2) => truss::PLANE,
            (Self::Truss, _) => truss::SPACE,
        }
    }

    fn coordinates(self) -> &'static [usize] {
        match self {
            Self::Frame => &[2],
            Self::Truss => &[2, 3],
        }
    }
}

/// Nodes by name, in the order of their appearance in the file.
#[derive(Default)]
struct Places {
    names: Vec<String>,
    at: Vec<Vector3<f64>>,
    /// Number of coordinates of each node, 0 before the first node.
    dimension: usize,
}

impl Places {
    fn find(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|known| known == name)
    }
}

fn node_name(node: &NumberOrName) -> String {
    match node {
        NumberOrName::Number(number) => number.to_string(),
        NumberOrName::Name(name) => name.clone(),
    }
}

pub(super) fn read_mesh(section: &mut Section<'_>, kind: MeshKind) -> Option<LinearSystem> {
    let mass = section
        .choice("mass", &MASS_FORMS)
        .map_or(kind.default_mass(), Spanned::into_inner);
    let sections = read_sections(section, kind);
    let places = read_places(section, kind.coordinates());
    let groups = section.tables("group");
    let supports = section.tables("support");
    if groups.is_empty() {
        section.require(
            "group",
            "must list the members: [[model.group]]",
            None::<()>,
        );
    }
    let (mut places, sections) = match (places, sections) {
        (Some(places), Some(sections)) => (places, sections),
        _ => return None, // groups and supports cannot be resolved
    };
    let declared = groups.len();
    let groups: Vec<_> = groups
        .into_iter()
        .filter_map(|group| read_group(group, &sections, &mut places))
        .collect();
    let names: Vec<_> = groups.iter().map(|(name, _)| name.clone()).collect();
    check_unique(section, "model.group.name", &names);
    let complete = groups.len() == declared && declared > 0;
    let directions = kind.directions(places.dimension);
    let mut fixed = vec![vec![false; directions.len()]; places.names.len()];
    let supported: Vec<_> = supports
        .into_iter()
        .map(|support| read_support(support, complete.then_some(&places), directions, &mut fixed))
        .collect();
    if !complete || supported.contains(&None) {
        return None;
    }
    let nodes = places.names.into_iter().zip(places.at).zip(fixed);
    let nodes = nodes
        .map(|((name, at), fixed)| MeshNode { name, at, fixed })
        .collect();
    let mesh = Mesh {
        directions,
        nodes,
        groups: groups.into_iter().map(|(_, group)| group).collect(),
        mass,
    };
    check_members(section, &mesh)?;
    let mesh = in_natural_order(mesh);
    let system = mesh.system(|section, along, form| match kind {
        MeshKind::Frame => frame::element(section, along, form),
        MeshKind::Truss => truss::element(section, along, form, directions.len()),
    });
    check_held(section, system)
}

fn read_sections(
    section: &mut Section<'_>,
    kind: MeshKind,
) -> Option<Vec<(Spanned<String>, MemberSection)>> {
    let tables = section.tables("section");
    let declared = tables.len();
    if tables.is_empty() {
        section.require(
            "section",
            "must say what members are made of: [[model.section]]",
            None::<()>,
        );
    }
    let read: Vec<_> = tables
        .into_iter()
        .filter_map(|table| read_section(table, kind))
        .collect();
    let names: Vec<_> = read.iter().map(|(name, _)| name.clone()).collect();
    check_unique(section, "model.section.name", &names);
    (declared > 0 && read.len() == declared).then_some(read)
}

fn read_section(
    mut section: Section<'_>,
    kind: MeshKind,
) -> Option<(Spanned<String>, MemberSection)> {
    let name = section.required_name("name");
    let [area, modulus, density] = ["area-m2", "modulus-pa", "density-kg-per-m3"].map(|key| {
        section
            .required_number(key, Allowed::POSITIVE)
            .map(Spanned::into_inner)
    });
    let second_moment = match kind {
        MeshKind::Frame => section
            .required_number("second-moment-m4", Allowed::POSITIVE)
            .map(Spanned::into_inner),
        MeshKind::Truss => Some(0.0),
    };
    section.finish();
    let section = MemberSection {
        area_m2: area?,
        second_moment_m4: second_moment?,
        modulus_pa: modulus?,
        density_kg_per_m3: density?,
    };
    Some((name?, section))
}

/// Reads the places of the sensors of a structure without a model, and the lines between them.
///
/// Both are optional. Without nodes, there is no skeleton.
pub(super) fn read_skeleton(section: &mut Section<'_>) -> Option<Option<Skeleton>> {
    let places = match section.contains("nodes") {
        true => read_places(section, &[2, 3]),
        false => Some(Places::default()),
    };
    let paths = match section.contains("paths") {
        true => section.paths("paths"),
        false => Some(Vec::new()),
    };
    section.leave_unread(&["nodes", "paths"]);
    let (mut places, paths) = (places?, paths?);
    let ends = paths
        .iter()
        .map(|path| read_path(section, path, &mut places));
    let ends = ends
        .collect::<Vec<_>>()
        .into_iter()
        .collect::<Option<Vec<_>>>()?;
    if places.names.is_empty() {
        return Some(None);
    }
    let up = match places.dimension {
        2 => Up::Y,
        _ => Up::Z,
    };
    Some(Some(Skeleton {
        is_held: vec![false; places.names.len()],
        points: places.names.into_iter().zip(places.at).collect(),
        lines: ends
            .concat()
            .into_iter()
            .map(|ends| Line { ends, parts: 0..0 })
            .collect(),
        up,
    }))
}

/// Reads the nodes with given coordinates, of which `coordinates` are allowed numbers.
fn read_places(section: &mut Section<'_>, coordinates: &[usize]) -> Option<Places> {
    let entries = section.entries("nodes");
    section.require(
        "nodes",
        "must give the coordinates (m) of nodes: { 1 = [0, 0], ... }",
        Some(()),
    );
    let mut places = Places::default();
    let declared = entries.len();
    for (name, value) in entries {
        let Some(at) = section.entry_numbers("nodes", &name, value, Allowed::ANY) else {
            continue;
        };
        let key = section.key(&format!("nodes.{}", name.get_ref()));
        if !is_name(name.get_ref()) {
            let allowed = "must have a name of 1 to 64 lower-case letters, digits and hyphens";
            section
                .diagnostics()
                .report(name.span(), key, "is not a name", allowed);
            continue;
        }
        let found = at.get_ref().len();
        let fits =
            coordinates.contains(&found) && (places.dimension == 0 || places.dimension == found);
        if !fits {
            let allowed = match (places.dimension, coordinates) {
                (0, [only]) => format!("must have {only}"),
                (0, several) => format!("must have one of {several:?}"),
                (dimension, _) => format!("must have {dimension} like the previous nodes"),
            };
            section.diagnostics().report(
                at.span(),
                key,
                format!("has {found} coordinates"),
                allowed,
            );
            continue;
        }
        places.dimension = found;
        let coordinate = |index: usize| at.get_ref().get(index).copied().unwrap_or(0.0);
        places
            .at
            .push(Vector3::new(coordinate(0), coordinate(1), coordinate(2)));
        places.names.push(name.into_inner());
    }
    (declared > 0 && places.names.len() == declared).then_some(places)
}

fn read_group(
    mut section: Section<'_>,
    sections: &[(Spanned<String>, MemberSection)],
    places: &mut Places,
) -> Option<(Spanned<String>, MemberGroup)> {
    let name = section.required_name("name");
    let of = section.required_name("section");
    let known = sections.iter().map(|(name, _)| name.get_ref().as_str());
    let of = of.and_then(|of| find_name(&section, "section", &of, known));
    let paths = section.paths("paths");
    let allowed = "must list the members, each list of nodes a chain of them: [[1, 2, 3], ...]";
    let paths = section.require("paths", allowed, paths);
    if paths.as_ref().is_some_and(Vec::is_empty) {
        section
            .diagnostics()
            .report(section.span(), section.key("paths"), "is empty", allowed);
    }
    let members = paths.map(|paths| {
        paths
            .iter()
            .map(|path| read_path(&section, path, places))
            .collect::<Vec<_>>()
    });
    section.finish();
    let members = members?.into_iter().collect::<Option<Vec<_>>>()?.concat();
    let name = name?;
    Some((
        name.clone(),
        MemberGroup {
            name: name.into_inner(),
            section: sections[of?].1,
            members,
        },
    ))
}

/// Reads a chain of members.
///
/// Nodes without coordinates are spaced evenly between the two nearest nodes of the chain that have
/// coordinates. Their coordinates are then known to the following chains.
fn read_path(
    section: &Section<'_>,
    path: &Spanned<Vec<Spanned<NumberOrName>>>,
    places: &mut Places,
) -> Option<Vec<[usize; 2]>> {
    let names: Vec<String> = path
        .get_ref()
        .iter()
        .map(|node| node_name(node.get_ref()))
        .collect();
    if names.len() < 2 {
        let found = format!("has {} nodes", names.len());
        section.diagnostics().report(
            path.span(),
            section.key("paths"),
            found,
            "must have two or more in a chain",
        );
        return None;
    }
    let mut start = 0;
    while let Some(next) =
        (start + 1..names.len()).find(|next| places.find(&names[*next]).is_some())
    {
        let (Some(from), Some(to)) = (places.find(&names[start]), places.find(&names[next])) else {
            break;
        };
        let (from, to) = (places.at[from], places.at[to]);
        for (step, name) in names[start..next].iter().enumerate().skip(1) {
            if let Some(reason) = unfit_for_a_place(name, &names[start + 1..start + step]) {
                let node = &path.get_ref()[start + step];
                section.diagnostics().report(
                    node.span(),
                    section.key("paths"),
                    format!("has node {name}"),
                    reason,
                );
                return None;
            }
            places
                .at
                .push(from + (to - from) * (step as f64 / (next - start) as f64));
            places.names.push(name.clone());
        }
        start = next;
    }
    let placed: Vec<Option<usize>> = names.iter().map(|name| places.find(name)).collect();
    if let Some(unplaced) = placed.iter().position(Option::is_none) {
        let found = format!("ends in node {}, which has no coordinates", names[unplaced]);
        let allowed = "must begin and end with nodes of model.nodes or of a chain before";
        let span = path.get_ref()[unplaced].span();
        section
            .diagnostics()
            .report(span, section.key("paths"), found, allowed);
        return None;
    }
    let placed: Vec<usize> = placed.into_iter().flatten().collect();
    Some(placed.windows(2).map(|ends| [ends[0], ends[1]]).collect())
}

/// Returns the reason why a node cannot get its coordinates from a chain, or `None`.
fn unfit_for_a_place(name: &str, before: &[String]) -> Option<&'static str> {
    if before.iter().any(|other| other == name) {
        return Some("must not pass a node without coordinates twice");
    }
    (!is_name(name)).then_some(
        "must be a number from 0 or a name of 1 to 64 lower-case letters, digits and hyphens",
    )
}

/// Reads a support into `fixed`; `None` if it contains a mistake or some nodes are unknown.
fn read_support(
    mut section: Section<'_>,
    places: Option<&Places>,
    directions: &[&str],
    fixed: &mut [Vec<bool>],
) -> Option<()> {
    let nodes = section.nodes("nodes");
    let nodes = section.require("nodes", "must list the nodes that are held", nodes);
    let held = section.names("fixed");
    let held = section.require(
        "fixed",
        format!("must list directions of {directions:?}"),
        held,
    );
    let held = held.map(|held| {
        let find = |name| find_name(&section, "fixed", name, directions.iter().copied());
        held.get_ref().iter().map(find).collect::<Vec<_>>()
    });
    let names = || places.map(|places| places.names.iter().map(String::as_str));
    let nodes = nodes.map(|nodes| {
        let find = |node: &Spanned<NumberOrName>| {
            let name = Spanned::new(node.span(), node_name(node.get_ref()));
            find_name(&section, "nodes", &name, names()?)
        };
        nodes.get_ref().iter().map(find).collect::<Vec<_>>()
    });
    section.finish();
    let held = held?.into_iter().collect::<Option<Vec<_>>>()?;
    for node in nodes?.into_iter().collect::<Option<Vec<_>>>()? {
        held.iter()
            .for_each(|direction| fixed[node][*direction] = true);
    }
    Some(())
}

/// Checks the lengths of members, nodes without members, and the size of the model.
fn check_members(section: &Section<'_>, mesh: &Mesh) -> Option<()> {
    let report = |key: &str, found: String, allowed: &str| {
        section
            .diagnostics()
            .report(section.span(), section.key(key), found, allowed);
        None
    };
    let members = || {
        mesh.groups
            .iter()
            .flat_map(|group| group.members.iter().map(move |ends| (&group.name, ends)))
    };
    for (group, &[from, to]) in members() {
        let (from, to) = (&mesh.nodes[from], &mesh.nodes[to]);
        if from.at == to.at {
            let found = format!(
                "has a member of group \"{group}\" without length, from node {} to {}",
                from.name, to.name
            );
            return report("group", found, "must join nodes at different places");
        }
    }
    let alone = |node: &usize| !members().any(|(_, ends)| ends.contains(node));
    if let Some(alone) = (0..mesh.nodes.len()).find(alone) {
        return report(
            "nodes",
            format!("has node {}, which no member joins", mesh.nodes[alone].name),
            "must be joined",
        );
    }
    let len = mesh.free_len();
    if len == 0 || len > LARGEST_MODEL {
        let allowed = format!("must have from 1 to {LARGEST_MODEL}");
        return report(
            "nodes",
            format!(
                "has {}",
                counted(len, "degree of freedom", "degrees of freedom")
            ),
            &allowed,
        );
    }
    Some(())
}

/// Sorts numbered nodes by number. Other nodes follow in file order.
fn in_natural_order(mut mesh: Mesh) -> Mesh {
    let mut order: Vec<usize> = (0..mesh.nodes.len()).collect();
    order.sort_by_key(|node| mesh.nodes[*node].name.parse::<u64>().unwrap_or(u64::MAX));
    let mut position = vec![0; order.len()];
    for (new, old) in order.iter().enumerate() {
        position[*old] = new;
    }
    mesh.nodes = order.iter().map(|old| mesh.nodes[*old].clone()).collect();
    for ends in mesh.groups.iter_mut().flat_map(|group| &mut group.members) {
        *ends = ends.map(|node| position[node]);
    }
    mesh
}

/// Reports a structure that can move freely; returns any other structure unchanged.
pub(super) fn check_held(
    section: &Section<'_>,
    system: Option<LinearSystem>,
) -> Option<LinearSystem> {
    let stiffness = system.as_ref().map(LinearSystem::nominal_stiffness);
    let finite = stiffness.filter(|stiffness| stiffness.iter().all(|entry| entry.is_finite()));
    let (Some(system), Some(stiffness)) = (system, finite) else {
        let allowed = "must have masses and stiffnesses of real structures";
        section.diagnostics().report(
            section.span(),
            section.key("kind"),
            "has no natural frequencies",
            allowed,
        );
        return None;
    };
    // Scaled to a unit diagonal: forces and moments, and members of different lengths, differ by
    // orders of magnitude.
    let scale: Vec<f64> = stiffness
        .diagonal()
        .iter()
        .map(|k| if *k > 0.0 { 1.0 / k.sqrt() } else { 1.0 })
        .collect();
    let scaled = stiffness.map_with_location(|row, column, k| k * scale[row] * scale[column]);
    if let Some(free) = matrix_file::free_degree_of_freedom(&scaled) {
        let found = format!("leaves {} free to move", system.degrees_of_freedom[free]);
        let allowed = "must be held by its supports and members";
        section
            .diagnostics()
            .report(section.span(), section.key("support"), found, allowed);
        return None;
    }
    Some(system)
}

#[cfg(test)]
mod tests;
