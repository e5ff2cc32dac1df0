//! Reads the kind `tower` of `[model]`: segments from the foot up.

use super::check_unique;
use super::mesh::{MASS_FORMS, check_held};
use crate::linear_system::{LARGEST_MODEL, LinearSystem};
use crate::mesh::MassForm;
use crate::section::{Allowed, Section};
use crate::tower::{self, Segment};
use toml::Spanned;

/// Number of degrees of freedom that each beam adds.
const PER_ELEMENT: usize = 5;

pub(super) fn read_tower(section: &mut Section<'_>) -> Option<LinearSystem> {
    let mass = section
        .choice("mass", &MASS_FORMS)
        .map_or(MassForm::Consistent, Spanned::into_inner);
    let tables = section.tables("segment");
    if tables.is_empty() {
        section.require(
            "segment",
            "must list the segments from the foot up: [[model.segment]]",
            None::<()>,
        );
    }
    let declared = tables.len();
    let read: Vec<(Spanned<String>, Segment)> =
        tables.into_iter().filter_map(read_segment).collect();
    let (names, segments): (Vec<_>, Vec<_>) = read.into_iter().unzip();
    check_unique(section, &section.key("segment.name"), &names);
    if segments.is_empty() || segments.len() < declared {
        return None;
    }
    let elements: usize = segments.iter().map(|segment| segment.elements).sum();
    if elements > LARGEST_MODEL / PER_ELEMENT {
        let found = format!("add up to {elements} elements");
        let allowed = format!("must add up to at most {}", LARGEST_MODEL / PER_ELEMENT);
        section
            .diagnostics()
            .report(section.span(), section.key("segment"), found, allowed);
        return None;
    }
    check_held(section, tower::system(&segments, mass))
}

fn read_segment(mut section: Section<'_>) -> Option<(Spanned<String>, Segment)> {
    let name = section.required_name("name");
    let elements = section.whole("elements", 1, LARGEST_MODEL / PER_ELEMENT);
    let elements = section.require(
        "elements",
        "must be the number of equal beams of the segment",
        elements,
    );
    let numbers = [
        "height-m",
        "mass-kg-per-m",
        "gyration-m2",
        "bending-x-n-m2",
        "bending-y-n-m2",
        "torsion-n-m2",
    ]
    .map(|key| {
        section
            .required_number(key, Allowed::POSITIVE)
            .map(Spanned::into_inner)
    });
    let top_share = section.number_or("top-share", Allowed::POSITIVE, 1.0);
    section.finish();
    let [height, mass, gyration, bending_x, bending_y, torsion] = numbers;
    let name = name?;
    let segment = Segment {
        name: name.get_ref().clone(),
        height_m: height?,
        elements: elements?.into_inner(),
        mass_kg_per_m: mass?,
        stiffnesses_n_m2: [bending_x?, bending_y?, torsion?],
        top_share,
        gyration_m2: gyration?,
    };
    Some((name, segment))
}

#[cfg(test)]
mod tests {
    use crate::Structure;
    use std::path::Path;

    const TOWER: &str = include_str!("../../../../docs/examples/tower.toml");

    #[track_caller]
    fn mistakes_after(replaced: &str, by: &str) -> Vec<String> {
        assert!(TOWER.contains(replaced), "the tower has no {replaced:?}");
        let read = Structure::parse(&TOWER.replacen(replaced, by, 1), Path::new("tower.toml"));
        let error = read.map(|_| ()).expect_err("the file should be refused");
        error
            .diagnostics()
            .iter()
            .map(|d| format!("{}: {}, {}", d.key(), d.found(), d.allowed()))
            .collect()
    }

    #[test]
    fn each_segment_has_three_substructures() {
        let tower = Structure::parse(TOWER, Path::new("tower.toml")).unwrap();
        let names: Vec<&str> = tower
            .system
            .substructures
            .iter()
            .map(|part| part.name.as_str())
            .collect();
        let expected = [
            "main-bending-x",
            "main-bending-y",
            "main-torsion",
            "mast-bending-x",
            "mast-bending-y",
            "mast-torsion",
        ];
        assert_eq!(names, expected);
        assert_eq!(
            tower.system.degrees_of_freedom[..5],
            ["x", "y", "rx", "ry", "rz"].map(|d| format!("node-1-{d}"))
        );
        assert_eq!(tower.system.ground_directions.len(), 2);
    }

    #[test]
    fn mistakes_of_a_segment_are_refused() {
        assert_eq!(
            mistakes_after("elements = 27", "elements = 0"),
            ["model.segment.elements: is 0, must be a whole number from 1 to 200"]
        );
        assert_eq!(
            mistakes_after("elements = 27", "elements = 195"),
            ["model.segment: add up to 205 elements, must add up to at most 200"]
        );
        assert_eq!(
            mistakes_after("height-m = 454", "height-m = -454"),
            ["model.segment.height-m: is -454, must be a finite number above 0"]
        );
        assert_eq!(
            mistakes_after("name = \"mast\"", "name = \"main\"")[0],
            "model.segment.name: repeats \"main\", must be unique"
        );
    }
}
