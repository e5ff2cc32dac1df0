//! Tests of groups of storeys, hysteresis and dashpots: valid files, and mistakes with line, key
//! and text.

use crate::Structure;
use std::path::Path;

const BOUC_WEN: &str = include_str!("../../../../../docs/examples/bouc-wen-ten.toml");
const DASHPOTS: &str = include_str!("../../../../../docs/examples/dashpot-building.toml");
const DEMO: &str = include_str!("../../../../../docs/examples/demo.toml");

fn read(text: &str) -> Result<Structure, crate::StructureError> {
    Structure::parse(text, Path::new("chain.toml"))
}

/// Reads `text` with one piece replaced and returns its mistakes as `key: found, allowed`.
#[track_caller]
fn mistakes_after(text: &str, replaced: &str, by: &str) -> Vec<String> {
    assert!(text.contains(replaced), "the file has no {replaced:?}");
    let error = read(&text.replacen(replaced, by, 1))
        .map(|_| ())
        .expect_err("the file should be refused");
    error
        .diagnostics()
        .iter()
        .map(|d| format!("{}: {}, {}", d.key(), d.found(), d.allowed()))
        .collect()
}

#[test]
fn single_and_equal_storeys_together_are_one_mistake() {
    let mixed = "masses-kg = [1e5, 1e5]\nfirst-frequency-hz = 1.0\n";
    let found = mistakes_after(DEMO, "first-frequency-hz = 1.0\n", mixed);
    let [one] = &found[..] else {
        panic!("{found:?}")
    };
    assert!(
        one.starts_with(
            "model.storeys: is given together with masses-kg, must give either masses-kg and"
        ),
        "{one}"
    );
}

#[test]
fn a_group_of_storeys_is_one_substructure() {
    let grouped = read(BOUC_WEN).unwrap();
    let names: Vec<&str> = grouped
        .system
        .substructures
        .iter()
        .map(|part| part.name.as_str())
        .collect();
    assert_eq!(
        names,
        [
            "storey-1", "storey-2", "storey-3", "storey-4", "storey-5", "upper"
        ]
    );
    let text = BOUC_WEN.replace(
        "of = [\"upper\"]",
        "of = [\"storey-6\", \"storey-7\", \"storey-8\", \"storey-9\", \"storey-10\"]",
    );
    let single =
        read(&text.replace("[[model.group]]\nname = \"upper\"\nstoreys = [6, 10]\n", "")).unwrap();
    assert_eq!(single.system.substructures.len(), 10);
    assert_eq!(
        single.system.nominal_stiffness(),
        grouped.system.nominal_stiffness()
    );
}

#[test]
fn a_group_outside_of_the_building_is_refused() {
    for wrong in ["[6, 11]", "[0, 10]", "[7, 6]", "[6.5, 10]", "[6]"] {
        let found = mistakes_after(BOUC_WEN, "[6, 10]", wrong);
        let first = &found[0];
        assert!(
            first.starts_with("model.group.storeys: is ") || first.contains("above 0"),
            "{first}"
        );
    }
    assert_eq!(
        mistakes_after(BOUC_WEN, "[6, 10]", "[6, 11]"),
        [
            "model.group.storeys: is [6.0, 11.0], must be [lowest, highest], two whole numbers \
             from 1 to 10"
        ]
    );
}

#[test]
fn groups_that_share_a_storey_or_a_name_are_refused() {
    let second = "storeys = [6, 10]\n\n[[model.group]]\nname = \"more\"\nstoreys = [5, 6]";
    assert_eq!(
        mistakes_after(BOUC_WEN, "storeys = [6, 10]", second),
        ["model.group: holds storeys of group \"upper\", must hold storeys of its own"]
    );
    assert_eq!(
        mistakes_after(
            BOUC_WEN,
            "name = \"upper\"\nstoreys",
            "name = \"storey-3\"\nstoreys"
        ),
        ["model.group.name: is \"storey-3\", a storey outside of the group, must be another name"]
    );
}

#[test]
fn unbounded_law_is_rejected() {
    assert_eq!(
        mistakes_after(BOUC_WEN, "kappa = 1500 ", "kappa = -1000 "),
        [
            "model.kappa: is -1000 beside mu = 1000, must add up to more than 0 with mu, or the \
             force of a spring has no bound"
        ]
    );
    assert_eq!(
        mistakes_after(BOUC_WEN, "eta = 2\n", "eta = 0\n"),
        ["model.eta: is 0, must be a finite number above 0"]
    );
    assert_eq!(
        mistakes_after(BOUC_WEN, "mu = 1000 ", ""),
        ["model.mu: is missing, must be a finite number from 0"]
    );
    assert_eq!(
        mistakes_after(BOUC_WEN, "\"floor\"", "\"storey\""),
        ["model.drive: is \"storey\", must be one of \"drift\", \"floor\""]
    );
}

#[test]
fn displacement_sensors_are_rejected_for_hysteretic_springs() {
    let text = BOUC_WEN.replacen("quantity = \"velocity\"", "quantity = \"displacement\"", 1);
    assert_eq!(
        mistakes_after(&text, "unit = \"m/s\"", "unit = \"m\""),
        ["node.channel.quantity: is \"displacement\", \
          must be a velocity or an acceleration for the kind bouc-wen, which does not follow \
          displacements"]
    );
}

#[test]
fn constants_can_be_scaled_only_with_hysteresis() {
    assert_eq!(
        mistakes_after(
            DEMO,
            "scales = \"stiffness\"\nof = [\"storey-1\"]",
            "scales = \"hysteresis-mu\""
        ),
        ["parameter.scales: has no effect: nothing is hysteretic, \
          must scale a constant of the kind bouc-wen that is not zero"]
    );
    assert_eq!(
        mistakes_after(BOUC_WEN, "\"hysteresis-kappa\"", "\"hysteresis-mu\""),
        [
            "parameter.of: scales the same constant as parameter \"mu\" does, must scale what no \
             other parameter scales"
        ]
    );
}

#[test]
fn dashpots_require_storeys() {
    let frame = include_str!("../../../../../docs/examples/three-pier-bridge.toml");
    let found = mistakes_after(
        frame,
        "kind = \"rayleigh\"\nalpha-per-s = 0.063\nbeta-s = 0.006",
        "kind = \"dashpots\"\ncoefficients-n-s-per-m = 1",
    );
    assert_eq!(
        found[0],
        "damping.kind: is \"dashpots\", must be \"rayleigh\" or \"matrix\" for a model without \
         storeys"
    );
    assert_eq!(
        mistakes_after(
            DASHPOTS,
            "coefficients-n-s-per-m = 600e3",
            "coefficients-n-s-per-m = [600e3]"
        ),
        ["damping.coefficients-n-s-per-m: has 1 entry, must have 4"]
    );
    assert_eq!(
        mistakes_after(DEMO, "scales = \"stiffness\"", "scales = \"damping\""),
        [
            "parameter.scales: is \"damping\", must not be scaled storey by storey unless \
             damping.kind is \"dashpots\""
        ]
    );
}

#[test]
fn a_dashpot_is_scaled_by_one_parameter() {
    let text = DASHPOTS.replacen(
        "scales = \"damping\"\nof = [\"storey-2\"]",
        "scales = \"damping\"\nof = [\"storey-1\"]",
        1,
    );
    let error = read(&text).map(|_| ()).unwrap_err();
    assert_eq!(
        error.diagnostics()[0].found(),
        "scales the dashpot of storey-1 as parameter \"dashpot-1\" does"
    );
}
