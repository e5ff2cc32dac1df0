use crate::{JudgedStructure, StructureError};
use spandrel_judge::{ConditionKind, Quantity, QuantityKind, Season};
use std::path::Path;

const FILE: &str = r#"
[structure]
name = "bridge"

[judge]
loss = 0.03
commissioning-days = 130

[[judge.quantity]]
name = "first-mode"
is = "frequency"
column = "f1_hz"

[[judge.condition]]
name = "deck"
unit = "degC"
"#;

fn parse(text: &str) -> Result<JudgedStructure, StructureError> {
    JudgedStructure::parse(text, Path::new("bridge.toml"))
}

fn mistakes(from: &str, to: &str) -> String {
    assert!(FILE.contains(from), "{from}");
    parse(&FILE.replace(from, to)).unwrap_err().to_string()
}

#[test]
fn a_structure_without_a_model_is_judged() {
    let structure = parse(FILE).unwrap();
    let settings = &structure.plan.settings;
    assert_eq!(structure.name, "bridge");
    assert_eq!((settings.loss, settings.commissioning_days), (0.03, 130));
    assert_eq!(settings.false_alarms_per_year, 0.1);
    assert_eq!(settings.season, Season::Required);
    assert_eq!(settings.quantities[0].kind, QuantityKind::Frequency);
    assert_eq!(settings.conditions[0].kind, ConditionKind::Celsius);
    assert_eq!(structure.plan.quantity_columns, ["f1_hz"]);
    assert_eq!(structure.plan.condition_columns, ["deck"]);
    assert_eq!(structure.plan.time_column, "time");
}

#[test]
fn every_mistake_names_file_line_and_allowed_values() {
    for (from, to, said) in [
        (
            "loss = 0.03",
            "loss = 3",
            "bridge.toml:6: judge.loss: is 3, must be a finite number above 0 and below 1",
        ),
        (
            "loss = 0.03",
            "losses = 0.03",
            "bridge.toml:6: judge.losses: is not a known key, did you mean \"loss\"?",
        ),
        (
            "commissioning-days = 130",
            "commissioning-days = 3",
            "bridge.toml:7: judge.commissioning-days: is 3, must be a whole number from 20 to 400",
        ),
        (
            "is = \"frequency\"",
            "is = \"damping\"",
            "bridge.toml:11: judge.quantity.is: is \"damping\", must be one of",
        ),
        (
            "unit = \"degC\"",
            "unit = \"C\"",
            "bridge.toml:16: judge.condition.unit: is \"C\", must be one of",
        ),
        (
            "unit = \"degC\"",
            "unit = \"other\"",
            "judge.condition.slope-std: is missing",
        ),
        (
            "name = \"deck\"",
            "name = \"first-mode\"",
            "repeats \"first-mode\", must be unique",
        ),
        ("[judge]", "[judgement]", "is not a known key"),
        ("[structure]", "[site]", "structure: is missing"),
    ] {
        let found = mistakes(from, to);
        assert!(found.contains(said), "{to}\n{found}");
    }
}

/// Three modes. The first one has a list of thermometers, on line 12.
fn with_thermometers(list: &str, of_second: &str) -> String {
    let mode =
        |name: &str| format!("\n[[judge.quantity]]\nname = \"{name}\"\nis = \"frequency\"\n");
    let second = mode("second") + of_second;
    let first = FILE.replace("column = \"f1_hz\"", &format!("thermometers = {list}"));
    first + &second + &mode("third") + &mode("fourth")
}

#[test]
fn other_quantities_serve_as_thermometers() {
    let structure = parse(&with_thermometers("[\"second\", \"third\"]", "")).unwrap();
    let quantities = &structure.plan.settings.quantities;
    assert_eq!(quantities[0].thermometers, ["second", "third"]);
    assert!(quantities[1].thermometers.is_empty());
    let structure = parse(&with_thermometers("[]", "")).unwrap();
    assert!(
        structure.plan.settings.quantities[0]
            .thermometers
            .is_empty()
    );
}

/// The service `judge` has recorded such settings.
#[test]
fn a_quantity_of_a_former_version_has_no_thermometers() {
    let text = r#"{"name":"first-mode","kind":"frequency"}"#;
    let quantity: Quantity = serde_json::from_str(text).unwrap();
    assert!(quantity.thermometers.is_empty());
}

#[test]
fn every_wrong_list_of_thermometers_is_named_with_its_line() {
    for (list, of_second, said) in [
        (
            "[\"second\", \"deck\"]",
            "",
            "bridge.toml:12: judge.quantity.thermometers: contains \"deck\", must contain other \
             quantities: second, third, fourth",
        ),
        (
            "[\"first-mode\", \"second\"]",
            "",
            "contains \"first-mode\", must contain other quantities",
        ),
        ("[\"second\"]", "", "has 1 name, must have at least 2"),
        (
            "[\"second\", \"second\"]",
            "",
            "repeats \"second\", must be unique",
        ),
        (
            "[\"second\", \"third\", \"fourth\"]",
            "",
            "has 3 names beside 1 conditions, must be at most 3 together",
        ),
        (
            "[\"second\", \"third\"]",
            "thermometers = [\"first-mode\", \"third\"]\n",
            "contains \"second\", which has thermometers itself, must contain quantities without",
        ),
        ("\"second\"", "", "must be a list of names"),
        ("[\"a b\", \"second\", \"third\"]", "", "bridge.toml:12: "),
    ] {
        let found = parse(&with_thermometers(list, of_second));
        let found = found.expect_err(list).to_string();
        assert!(found.contains(said), "{list}\n{found}");
    }
}

#[test]
fn a_file_with_a_model_is_read_completely() {
    let text = format!("{FILE}\n[model]\nkind = \"shear-building\"\n");
    let found = parse(&text).unwrap_err().to_string();
    assert!(found.contains("model.masses-kg: is missing"), "{found}");
    let demo = include_str!("../../../../../docs/examples/demo.toml");
    let judge = &FILE[FILE.find("[judge]").unwrap()..];
    let structure = parse(&format!("{demo}\n{judge}")).unwrap();
    assert_eq!(structure.name, "demo");
    let found = parse(demo).unwrap_err().to_string();
    assert!(found.contains("judge: is missing"), "{found}");
}
