//! Reads the kinds `frame` and `truss` of `[model]`.

use super::{check_unique, find_name};
use crate::linear_system::{Damping, LinearSystem};
use crate::section::{Allowed, Section};
use crate::skeleton::{Action, Direction, Member, Profile, Skeleton, SkeletonNode, Unsound};
use toml::Spanned;

const MASSES: [(&str, bool); 2] = [("consistent", true), ("lumped", false)];

/// Reads a frame or a truss; the damping of the result is still zero.
pub(super) fn read_skeleton(section: &mut Section<'_>, action: Action) -> Option<LinearSystem> {
    let consistent_mass = match action {
        Action::Frame => true, // rotations have no lumped mass
        Action::Truss => section.choice("mass", &MASSES).is_some_and(Spanned::into_inner),
    };
    let profiles = read_profiles(section, action);
    let nodes = read_nodes(section, action);
    let (profiles, nodes) = (profiles?, nodes?);
    let (groups, members) = read_groups(section, &profiles, &nodes)?;
    let skeleton = Skeleton { action, consistent_mass, nodes, groups, members };
    let (mass, substructures) = match skeleton.assemble() {
        Ok(assembled) => assembled,
        Err(Unsound { found, allowed }) => {
            section.diagnostics().report(section.span(), section.key("kind"), found, allowed);
            return None;
        }
    };
    let (degrees_of_freedom, directions) = skeleton.degrees_of_freedom().into_iter().unzip();
    Some(LinearSystem {
        mass,
        substructures,
        damping: Damping::Rayleigh { alpha_per_s: 0.0, beta_s: 0.0 },
        degrees_of_freedom,
        directions,
    })
}

/// Reads every `[[model.section]]`: what members are made of.
fn read_profiles(section: &mut Section<'_>, action: Action) -> Option<Vec<(String, Profile)>> {
    let sections = section.tables("section");
    let declared = sections.len();
    let (mut profiles, mut names) = (Vec::new(), Vec::new());
    for mut profile in sections {
        let name = profile.required_name("name");
        let number = |profile: &mut Section<'_>, key| profile.required_number(key, Allowed::POSITIVE);
        let modulus = number(&mut profile, "modulus-pa");
        let density = number(&mut profile, "density-kg-per-m3");
        let area = number(&mut profile, "area-m2");
        let second_moment = match action {
            Action::Frame => number(&mut profile, "second-moment-m4").map(Spanned::into_inner),
            Action::Truss => Some(0.0),
        };
        profile.finish();
        if let (Some(name), Some(modulus), Some(density), Some(area), Some(second_moment_m4)) =
            (name, modulus, density, area, second_moment)
        {
            let profile = Profile {
                modulus_pa: modulus.into_inner(),
                density_kg_per_m3: density.into_inner(),
                area_m2: area.into_inner(),
                second_moment_m4,
            };
            profiles.push((name.get_ref().clone(), profile));
            names.push(name);
        }
    }
    check_unique(section, "section.name", &names);
    let given = (declared > 0).then_some(());
    section.require("section", "must say what members are made of: [[model.section]]", given)?;
    (profiles.len() == declared).then_some(profiles)
}

/// Reads every `[[model.node]]`.
fn read_nodes(section: &mut Section<'_>, action: Action) -> Option<Vec<SkeletonNode>> {
    let sections = section.tables("node");
    let declared = sections.len();
    let (mut nodes, mut names): (Vec<SkeletonNode>, Vec<_>) = (Vec::new(), Vec::new());
    for mut node in sections {
        let name = node.required_name("name");
        let at = node.numbers("at", Allowed::ANY);
        let at = node.require("at", "must list the coordinates of the node (m)", at);
        let mass = node.number_or("mass-kg", Allowed::NOT_NEGATIVE, 0.0);
        let fixed = read_fixed(&mut node, action, at.as_ref().map_or(3, |at| at.get_ref().len()));
        let expected = nodes.first().map(|node| node.at.len());
        let at = at.filter(|at| {
            let found = at.get_ref().len();
            let fits = match (action, expected) {
                (Action::Frame, _) => found == 2,
                (Action::Truss, None) => found == 2 || found == 3,
                (Action::Truss, Some(expected)) => found == expected,
            };
            if !fits {
                let allowed = match (action, expected) {
                    (Action::Truss, Some(expected)) => format!("must have {expected} as the first node"),
                    (Action::Truss, None) => "must have two in a plane or three in space".to_owned(),
                    (Action::Frame, _) => "must have two, x and y".to_owned(),
                };
                let found = format!("has {found} coordinates");
                node.diagnostics().report(at.span(), node.key("at"), found, allowed);
            }
            fits
        });
        node.finish();
        if let (Some(name), Some(at), Some(fixed)) = (name, at, fixed) {
            nodes.push(SkeletonNode { name: name.get_ref().clone(), at: at.into_inner(), fixed, mass_kg: mass });
            names.push(name);
        }
    }
    check_unique(section, "node.name", &names);
    let given = (declared > 0).then_some(());
    section.require("node", "must list the nodes: [[model.node]]", given)?;
    (nodes.len() == declared).then_some(nodes)
}

/// Reads the directions in which a node cannot move.
fn read_fixed(node: &mut Section<'_>, action: Action, dimensions: usize) -> Option<Vec<Direction>> {
    let Some(words) = node.names("fixed") else { return (!node.contains("fixed")).then(Vec::new) };
    let allowed = Skeleton::directions(action, dimensions);
    let known: Vec<_> = Direction::WORDS.iter().filter(|(_, direction)| allowed.contains(direction)).collect();
    let find = |word: &Spanned<String>| {
        let index = find_name(node, "fixed", word, known.iter().map(|(word, _)| *word))?;
        Some(known[index].1)
    };
    words.get_ref().iter().map(find).collect()
}

/// Reads every `[[model.group]]`: members, and the substructure that they make.
fn read_groups(
    section: &mut Section<'_>,
    profiles: &[(String, Profile)],
    nodes: &[SkeletonNode],
) -> Option<(Vec<String>, Vec<Member>)> {
    let sections = section.tables("group");
    let (mut groups, mut members, mut sound) = (Vec::new(), Vec::new(), !sections.is_empty());
    section.require("group", "must list the members: [[model.group]]", sound.then_some(()))?;
    let mut names = Vec::new();
    for mut group in sections {
        let name = group.required_name("name");
        let profile = group.required_name("section");
        let profile = profile
            .and_then(|name| find_name(&group, "section", &name, profiles.iter().map(|(name, _)| name.as_str())));
        let paths = group.texts("members");
        let paths = group.require("members", "must list paths of node names, such as \"1 2 3\"", paths);
        let each = group.flag_or("each", false);
        let (Some(name), Some(profile), Some(paths)) = (name, profile, paths) else {
            sound = false;
            group.finish();
            continue;
        };
        let pairs: Option<Vec<[usize; 2]>> =
            paths.iter().map(|path| read_path(&group, path, nodes)).collect::<Option<Vec<_>>>().map(|p| p.concat());
        group.finish();
        sound &= pairs.is_some();
        for (number, ends) in pairs.unwrap_or_default().into_iter().enumerate() {
            if each || number == 0 {
                let of_member = format!("{}-{}", name.get_ref(), number + 1);
                groups.push(if each { of_member } else { name.get_ref().clone() });
            }
            members.push(Member { ends, group: groups.len() - 1, profile: profiles[profile].1 });
        }
        names.push(name);
    }
    check_unique(section, "group.name", &names);
    sound.then_some((groups, members))
}

/// Reads a path of node names: each joined to the next.
fn read_path(group: &Section<'_>, path: &Spanned<String>, nodes: &[SkeletonNode]) -> Option<Vec<[usize; 2]>> {
    let key = group.key("members");
    let find = |word: &str| {
        let word = Spanned::new(path.span(), word.to_owned());
        find_name(group, "members", &word, nodes.iter().map(|node| node.name.as_str()))
    };
    let along: Vec<usize> = path.get_ref().split_whitespace().map(find).collect::<Option<_>>()?;
    if along.len() < 2 {
        let found = format!("has {} nodes", along.len());
        group.diagnostics().report(path.span(), key, found, "must name at least two nodes with spaces between");
        return None;
    }
    let pairs: Vec<[usize; 2]> = along.windows(2).map(|pair| [pair[0], pair[1]]).collect();
    if let Some([from, to]) = pairs.iter().find(|[from, to]| nodes[*from].at == nodes[*to].at) {
        let found = format!("joins {} to {}, which are at one place", nodes[*from].name, nodes[*to].name);
        group.diagnostics().report(path.span(), key, found, "must join different places");
        return None;
    }
    Some(pairs)
}
