//! Tests of valid frames and trusses, and of mistakes with line, key and text.

use crate::Structure;
use std::path::Path;

/// A portal: two columns of two members each, and a beam.
const PORTAL: &str = r#"
[structure]
name = "portal"
sampling-rate-hz = 100

[model]
kind = "frame"

[model.nodes]
1 = [0, 0]
3 = [0, 4]
10 = [6, 4]
foot = [6, 0]

[[model.section]]
name = "steel"
second-moment-m4 = 1e-4
area-m2 = 0.01
modulus-pa = 2.1e11
density-kg-per-m3 = 7850

[[model.group]]
name = "columns"
section = "steel"
paths = [[1, 2, 3], ["foot", "middle", 10]]

[[model.group]]
name = "beam"
section = "steel"
paths = [[3, 10]]

[[model.support]]
nodes = [1]
fixed = ["x", "y", "r"]

[[model.support]]
nodes = ["foot"]
fixed = ["x", "y"]

[damping]
kind = "rayleigh"
ratio = 0.01

[[parameter]]
name = "columns"
scales = "stiffness"
of = ["columns"]

[[excitation]]
name = "ground"
kind = "ground"
direction = "x"
std = 1

[[node]]
name = "corner"

[[node.channel]]
name = "corner"
quantity = "absolute-acceleration"
dof = "node-3-x"
unit = "m/s2"
noise-std = 0.01
"#;

fn read(text: &str) -> Result<Structure, crate::StructureError> {
    Structure::parse(text, Path::new("portal.toml"))
}

/// Reads `PORTAL` with one piece replaced and returns its mistakes as `line: key: found, allowed`.
#[track_caller]
fn mistakes_after(replaced: &str, by: &str) -> Vec<String> {
    assert!(PORTAL.contains(replaced), "the portal has no {replaced:?}");
    let error = read(&PORTAL.replacen(replaced, by, 1)).expect_err("the file should be refused");
    error
        .diagnostics()
        .iter()
        .map(|d| format!("{}: {}: {}, {}", d.line(), d.key(), d.found(), d.allowed()))
        .collect()
}

#[test]
fn degrees_of_freedom_are_named_by_node_and_direction_numbers_first() {
    let portal = read(PORTAL).unwrap();
    let expected = [
        "node-2-x",
        "node-2-y",
        "node-2-r",
        "node-3-x",
        "node-3-y",
        "node-3-r",
        "node-10-x",
        "node-10-y",
        "node-10-r",
        "node-foot-r",
        "node-middle-x",
        "node-middle-y",
        "node-middle-r",
    ];
    assert_eq!(portal.system.degrees_of_freedom, expected);
    let parts: Vec<&str> = portal
        .system
        .substructures
        .iter()
        .map(|part| part.name.as_str())
        .collect();
    assert_eq!(parts, ["columns", "beam"]);
}

#[test]
fn ground_moves_only_translations_in_its_direction() {
    let portal = read(PORTAL).unwrap();
    let [x, y] = &portal.system.ground_directions[..] else {
        panic!("two directions")
    };
    assert_eq!((x.name, y.name), ("x", "y"));
    assert_eq!(
        x.influence,
        [
            1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0
        ]
    );
    assert_eq!(
        y.influence,
        [
            0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0
        ]
    );
}

/// Nodes of a chain without coordinates have the same positions as nodes with the explicit
/// coordinates.
#[test]
fn nodes_of_a_chain_are_spaced_evenly() {
    let explicit =
        read(&PORTAL.replace("3 = [0, 4]\n", "2 = [0, 2]\n3 = [0, 4]\nmiddle = [6, 2]\n")).unwrap();
    let spaced = read(PORTAL).unwrap();
    // Named nodes follow the order of the file, so rows are compared by name.
    let entry = |structure: &Structure, row: &str, column: &str| {
        let index = |name| {
            structure
                .system
                .degrees_of_freedom
                .iter()
                .position(|known| known == name)
                .unwrap()
        };
        structure.system.nominal_stiffness()[(index(row), index(column))]
    };
    for row in &spaced.system.degrees_of_freedom {
        for column in &spaced.system.degrees_of_freedom {
            assert_eq!(
                entry(&explicit, row, column),
                entry(&spaced, row, column),
                "{row}, {column}"
            );
        }
    }
}

#[test]
fn a_chain_that_ends_in_a_node_without_coordinates_is_refused() {
    assert_eq!(
        mistakes_after("[[1, 2, 3], ", "[[1, 2, 4], "),
        [
            "25: model.group.paths: ends in node 2, which has no coordinates, \
          must begin and end with nodes of model.nodes or of a chain before"
        ]
    );
}

#[test]
fn a_chain_of_one_node_is_refused() {
    assert_eq!(
        mistakes_after("[[3, 10]]", "[[3]]"),
        ["30: model.group.paths: has 1 nodes, must have two or more in a chain"]
    );
    assert_eq!(
        mistakes_after("[[3, 10]]", "[[3, true]]"),
        ["30: model.group.paths: is true, must be the number or the name of a node"]
    );
}

#[test]
fn a_loop_through_a_node_without_coordinates_is_refused() {
    assert_eq!(
        mistakes_after("[[1, 2, 3], ", "[[1, 2, 2, 3], "),
        ["25: model.group.paths: has node 2, must not pass a node without coordinates twice"]
    );
}

#[test]
fn a_member_without_length_is_refused() {
    assert_eq!(
        mistakes_after("10 = [6, 4]", "10 = [0, 4]"),
        [
            "6: model.group: has a member of group \"beam\" without length, from node 3 to 10, \
          must join nodes at different places"
        ]
    );
}

#[test]
fn node_without_members_is_rejected() {
    assert_eq!(
        mistakes_after("10 = [6, 4]", "10 = [6, 4]\n11 = [7, 4]"),
        ["6: model.nodes: has node 11, which no member joins, must be joined"]
    );
}

#[test]
fn frame_that_can_move_freely_is_rejected() {
    let rollers = PORTAL.replace("fixed = [\"x\", \"y\", \"r\"]", "fixed = [\"y\"]");
    let error = read(&rollers.replace("fixed = [\"x\", \"y\"]", "fixed = [\"y\"]")).unwrap_err();
    let [mistake] = error.diagnostics() else {
        panic!("{error}")
    };
    assert_eq!(mistake.key(), "model.support");
    assert!(
        mistake.found().ends_with("-x free to move"),
        "{}",
        mistake.found()
    );
    assert_eq!(
        mistake.allowed(),
        "must be held by its supports and members"
    );
}

#[test]
fn unknown_sections_directions_and_nodes_are_refused() {
    assert_eq!(
        mistakes_after(
            "section = \"steel\"\npaths = [[3, 10]]",
            "section = \"steal\"\npaths = [[3, 10]]"
        ),
        ["29: model.group.section: is \"steal\", did you mean \"steel\"?"]
    );
    assert_eq!(
        mistakes_after("fixed = [\"x\", \"y\"]", "fixed = [\"x\", \"z\"]"),
        ["38: model.support.fixed: is \"z\", must be one of x, y, r"]
    );
    assert_eq!(
        mistakes_after("nodes = [\"foot\"]", "nodes = [\"feet\"]"),
        ["37: model.support.nodes: is \"feet\", did you mean \"foot\"?"]
    );
}

#[test]
fn coordinates_must_have_the_dimension_of_the_model() {
    assert_eq!(
        mistakes_after("10 = [6, 4]", "10 = [6, 4, 1]"),
        ["12: model.nodes.10: has 3 coordinates, must have 2 like the previous nodes"]
    );
    let truss = PORTAL
        .replace("kind = \"frame\"", "kind = \"truss\"")
        .replace("second-moment-m4 = 1e-4\n", "");
    let error = read(&truss.replace("1 = [0, 0]", "1 = [0, 0, 0]")).unwrap_err();
    assert_eq!(error.diagnostics()[0].found(), "has 2 coordinates");
    assert_eq!(
        error.diagnostics()[0].allowed(),
        "must have 3 like the previous nodes"
    );
}

#[test]
fn ground_of_a_model_with_geometry_requires_a_direction() {
    assert_eq!(
        mistakes_after("direction = \"x\"\n", ""),
        [
            "49: excitation.direction: is missing, must specify the direction of the ground \
             motion (or give influence)"
        ]
    );
    assert_eq!(
        mistakes_after("direction = \"x\"", "direction = \"z\""),
        ["52: excitation.direction: is \"z\", must be one of x, y"]
    );
    let demo = include_str!("../../../../../docs/examples/demo.toml");
    let error = read(&demo.replace("kind = \"ground\"", "kind = \"ground\"\ndirection = \"x\""))
        .unwrap_err();
    assert_eq!(
        error.diagnostics()[0].allowed(),
        "must not be given for a model without directions, see influence"
    );
}

#[test]
fn missing_tables_of_a_mesh_are_reported() {
    let (from, to) = (
        PORTAL.find("[model.nodes]").unwrap(),
        PORTAL.find("[damping]").unwrap(),
    );
    let mut text = PORTAL.to_owned();
    text.replace_range(from..to, "");
    let error = read(&text).unwrap_err();
    let keys: Vec<&str> = error
        .diagnostics()
        .iter()
        .map(crate::Diagnostic::key)
        .collect();
    assert_eq!(keys, ["model.section", "model.nodes", "model.group"]);
}

#[test]
fn numbers_whose_stiffness_overflows_are_refused() {
    let found = mistakes_after(
        "area-m2 = 0.01\nmodulus-pa = 2.1e11",
        "area-m2 = 1e10\nmodulus-pa = 1e308",
    );
    assert_eq!(
        found,
        [
            "6: model.kind: has no natural frequencies, must have masses and stiffnesses of real \
             structures"
        ]
    );
}

proptest::proptest! {
    #[test]
    fn any_chain_gives_a_structure_or_an_error(path in "\\[(\\[((-?[0-9]{1,2}|\"[a-z ]{0,3}\"), \
                                                        ){0,5}\\], ){0,3}\\]") {
        let _ = read(&PORTAL.replacen("[[1, 2, 3], [\"foot\", \"middle\", 10]]", &path, 1));
    }
}
